"""Poses and networks for the tests of learned inverse kinematics."""

import numpy as np

from mocapfix.kernels.pose_transfer import FEATURES_PER_JOINT
from mocapfix.model.skeleton import load_cmu31_skeleton
from mocapfix.solve.kinematics import build_kinematic_tree, compute_tree_poses
from mocapfix.solve.learned_ik import Perceptron
from tests.lab.motion_files import draw_motion

SKELETON = load_cmu31_skeleton()
JOINTS = len(SKELETON.names)


def place(rotations, root=None):
    """Return world positions and rotations."""
    root = np.zeros((len(rotations), 3)) if root is None else root
    return compute_tree_poses(build_kinematic_tree(SKELETON), root, np.ascontiguousarray(rotations))


def draw_poses(seed=0, frames=12, spread=0.3):
    """Return local rotations; the hip stubs and clavicles of CMU's skeleton do not move."""
    rotations = draw_motion(seed, frames, spread)
    for name in ("LHipJoint", "RHipJoint"):
        rotations[:, SKELETON.find_joint(name)] = np.eye(3)
    return rotations


def build_network(seed=0, scale=0.1, width=8):
    """Return a network with random weights; a scale of 0 leaves the closed form unchanged."""
    rng, inputs, outputs = np.random.default_rng(seed), FEATURES_PER_JOINT * JOINTS, 3 * JOINTS + 3
    weights = (rng.normal(size=(inputs, width)) / inputs**0.5, scale * rng.normal(size=(width, outputs)))
    mean, factor = np.zeros(inputs, np.float32), np.ones(inputs, np.float32)
    biases = np.zeros(width, np.float32), np.zeros(outputs, np.float32)
    return Perceptron(mean, factor, tuple(each.astype(np.float32) for each in weights), biases)
