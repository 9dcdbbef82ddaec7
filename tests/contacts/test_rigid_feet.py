"""Ankle and toes keep their distance, move horizontally unless the foot is steep, and the one that is held moves less."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.contacts.foot_displacements import restore_foot_length

LENGTH_M = 0.14
metres = st.floats(-0.02, 0.02)
shares = st.floats(0, 1)


@given(st.tuples(metres, metres), st.tuples(metres, metres), shares, shares, st.floats(-0.05, 0.05))  # not a steep foot
def test_length_and_heights_are_kept(ankle_shift, toe_shift, ankle_share, toe_share, height_m):
    ankle = np.array([[ankle_shift[0], height_m, ankle_shift[1]]])
    toe = np.array([[toe_shift[0], 0.0, toe_shift[1] + np.sqrt(LENGTH_M**2 - height_m**2)]])
    moved = restore_foot_length(ankle, toe, (np.array([ankle_share]), np.array([toe_share])), np.array([LENGTH_M]))
    np.testing.assert_allclose(np.linalg.norm(moved[1] - moved[0], axis=1), LENGTH_M, atol=1e-9)
    np.testing.assert_allclose(moved[0][:, 1], ankle[:, 1])
    np.testing.assert_allclose(moved[1][:, 1], toe[:, 1])


@given(st.tuples(metres, metres), shares, shares, st.floats(0.06, 0.14))
def test_a_small_change_of_length_moves_a_steep_foot_little(ankle_shift, ankle_share, toe_share, height_m):
    toe = np.array([[0.0, 0.0, np.sqrt(LENGTH_M**2 - height_m**2)]])
    ankle = np.array([[ankle_shift[0], height_m, ankle_shift[1]]])
    moved = restore_foot_length(ankle, toe, (np.array([ankle_share]), np.array([toe_share])), np.array([LENGTH_M]))
    change_m = float(abs(np.linalg.norm(ankle - toe) - LENGTH_M))
    np.testing.assert_allclose(np.linalg.norm(moved[1] - moved[0], axis=1), LENGTH_M, atol=0.1 * change_m + 1e-9)
    largest_m = max(np.linalg.norm(new - old) for new, old in zip(moved, (ankle, toe), strict=True))
    assert largest_m <= 2 * change_m + 1e-9


def test_the_joint_that_is_held_stays():
    ankle, toe = np.zeros((1, 3)), np.array([[0.0, 0.0, 0.2]])
    held, free = np.ones(1), np.zeros(1)
    new_ankle, new_toe = restore_foot_length(ankle, toe, (free, held), np.array([LENGTH_M]))
    np.testing.assert_allclose(new_toe, toe, atol=1e-4)
    np.testing.assert_allclose(new_ankle[0], [0.0, 0.0, 0.06], atol=1e-4)


def test_both_move_by_the_same_distance_if_both_are_held():
    ankle, toe = np.zeros((1, 3)), np.array([[0.0, 0.0, 0.2]])
    held = np.ones(1)
    new_ankle, new_toe = restore_foot_length(ankle, toe, (held, held), np.array([LENGTH_M]))
    np.testing.assert_allclose([new_ankle[0, 2], new_toe[0, 2]], [0.03, 0.17])


def test_a_vertical_foot_is_not_divided_by_zero():
    ankle, toe = np.array([[0.0, LENGTH_M, 0.0]]), np.zeros((1, 3))
    moved = restore_foot_length(ankle, toe, (np.ones(1), np.ones(1)), np.array([LENGTH_M]))
    assert np.isfinite(moved).all()
