import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.train.training_poses import detect_rotation_jumps, find_longest_jump_free_slice

RATE = 30.0


def turning(degrees):
    """-> (T, 1, 3, 3) a joint at these angles about an axis"""
    return Rotation.from_rotvec(np.radians(degrees)[:, None] * [0.0, 0.6, 0.8]).as_matrix()[:, None]


def test_a_half_turn_in_a_frame_is_a_jump_and_a_fast_turn_is_none():
    np.testing.assert_array_equal(detect_rotation_jumps(turning(np.array([0.0, 50, 230, 260])), RATE)[:, 0], [False, True, False])


def test_what_is_a_jump_depends_on_the_time_it_takes():
    turns = turning(np.array([0.0, 50]))
    assert not detect_rotation_jumps(turns, 30.0).any()
    assert detect_rotation_jumps(turns, 60.0).all()


def test_the_longest_stretch_without_a_jump_is_kept():
    assert find_longest_jump_free_slice(turning(np.array([0.0, 1, 180, 181, 182, 0, 1])), RATE) == slice(2, 5)
    assert find_longest_jump_free_slice(turning(np.arange(6.0)), RATE) == slice(0, 6)
    assert find_longest_jump_free_slice(turning(np.zeros(1)), RATE) == slice(0, 1)


def test_a_jump_of_any_joint_counts():
    two = np.concatenate([turning(np.zeros(5)), turning(np.array([0.0, 180, 180, 180, 180]))], axis=1)
    assert find_longest_jump_free_slice(two, RATE) == slice(1, 5)
