import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton
from mocapfix.model.subject import Subject
from mocapfix.solve import kinematics
from tests.kernels import dense_oracle, random_terms

FRAMES = 4


def motion_of(root, rotations):
    zeros = np.zeros(len(root), int)
    return Motion(root, rotations, zeros, zeros, np.zeros((len(root), 0)), np.zeros((len(root), 0)))


def skeleton_of(tree):
    names = tuple(f"j{j}" for j in range(len(tree.parents)))
    return Skeleton(names, tree.parents, tree.offsets, np.full(tree.offsets.shape, np.nan))


@given(st.integers(0, 2**32 - 1), st.integers(1, 15))
def test_positions_equal_a_plain_walk_down_the_tree(seed, joints):
    rng = np.random.default_rng(seed)
    tree = random_terms.draw_tree(rng, joints)
    root, local = rng.normal(size=(FRAMES, 3)), np.stack([random_terms.draw_rotations(rng, joints) for _ in range(FRAMES)])
    position, rotation = kinematics.compute_world_poses(skeleton_of(tree), motion_of(root, local))
    on, places = rng.integers(joints, size=5), rng.normal(size=(5, 3))
    subject = Subject(skeleton_of(tree), "", tuple("abcde"), on, places, np.ones(5))
    again, carried = kinematics.compute_joint_and_marker_positions(subject, motion_of(root, local))
    np.testing.assert_array_equal(again, position)
    for t in range(FRAMES):
        expected = dense_oracle.compute_world(tree, root[t], local[t])
        np.testing.assert_allclose(position[t], expected.position, atol=1e-12)
        np.testing.assert_allclose(rotation[t], expected.rotation, atol=1e-12)
        np.testing.assert_allclose(carried[t], dense_oracle.compute_point_positions(on, places, expected), atol=1e-12)


@pytest.mark.parametrize(("axis", "hand"), [(1, [0, 2, -1]), (2, [0, 3, 0])])
def test_elbow_bent_by_a_quarter_turn(axis, hand):
    # upper arm 2 m up from the origin, forearm 1 m along x
    offsets = np.array([[0, 0, 0], [0, 2, 0], [1.0, 0, 0]])
    skeleton = Skeleton(("root", "elbow", "hand"), np.array([-1, 0, 1]), offsets, np.zeros((3, 3)))
    local = np.tile(np.eye(3), (1, 3, 1, 1))
    quarter = {1: [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], 2: [[0, -1, 0], [1, 0, 0], [0, 0, 1]]}
    local[0, 1] = quarter[axis]
    position, _ = kinematics.compute_world_poses(skeleton, motion_of(np.zeros((1, 3)), local))
    np.testing.assert_allclose(position[0], [[0, 0, 0], [0, 2, 0], hand], atol=1e-15)
