"""The curvature of the cost of markers, compared with differences of their places."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.options import SolveOptions
from mocapfix.solve import kinematics, mean_pose, pose_problem
from mocapfix.solve.prior_conditioner import WorldPoses, compute_left_jacobian, compute_marker_curvature
from mocapfix.stats.rigid_alignment import compute_rotations
from mocapfix.synthetic import compose_take

BODY = load_cmu31_body()


@pytest.fixture(scope="module")
def scene():
    """Return a composed take, and its motion problem."""
    truth = compose_take(seed=4, seconds=1.0, rate=60.0)
    prior, limits = mean_pose.load_mean_pose_prior("mean-pose", BODY.skeleton), mean_pose.load_joint_limits(BODY.skeleton)
    take = Take(truth.marker_positions, truth.labels, 60.0)
    return truth, pose_problem.build_motion_problem(take, truth.subject, BODY, prior, limits, SolveOptions())


def test_left_jacobian_is_the_derivative_of_the_exponential():
    rng = np.random.default_rng(1)
    vectors, step = rng.normal(size=(5, 1, 3)), 1e-6 * rng.normal(size=(5, 1, 3))
    moved = compute_rotations(vectors + step) @ np.swapaxes(compute_rotations(vectors), -1, -2)
    expected = (compute_left_jacobian(vectors) @ step[..., None])[..., 0]
    np.testing.assert_allclose(Rotation.from_matrix(moved[:, 0]).as_rotvec(), expected[:, 0], atol=1e-10)


def test_marker_curvature_is_that_of_the_cost(scene):
    truth, problem = scene
    part = problem.pose_problem.select_frames(np.array([30]))
    local, root = truth.motion.local_rotations[[30]], truth.motion.root_position[[30]]
    joints = np.flatnonzero(BODY.free_joints)[1:]
    vectors = np.zeros((1, len(joints), 3))

    def place_markers(step):
        moved = local.copy()
        moved[:, joints] = compute_rotations(step) @ local[:, joints]
        return kinematics.predict_markers(truth.subject, (root, moved))

    pose = WorldPoses(*kinematics.compute_tree_poses(part.tree, root, local), local)
    curvature = compute_marker_curvature(part, pose, compute_left_jacobian(vectors))
    step = 1e-6 * np.eye(vectors.size).reshape(-1, *vectors.shape)
    slopes = np.array([(place_markers(each) - place_markers(-each)).ravel() / 2e-6 for each in step]) / part.marker_sd
    np.testing.assert_allclose(curvature[0, 6:, 6:], slopes @ slopes.T, rtol=1e-4, atol=1e-3)
