import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from mocapfix.stats.rigid_alignment import compute_shortest_rotation

VECTORS = st.tuples(*[st.floats(-2, 2)] * 3).map(np.array)


@given(VECTORS, VECTORS)
def test_the_shortest_turn_takes_one_direction_to_the_other_by_the_angle_between_them(a, b):
    assume(np.linalg.norm(a) > 1e-6 and np.linalg.norm(b) > 1e-6)
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    assume(a @ b > -1 + 1e-9)  # opposite ones follow
    turn = compute_shortest_rotation(3 * a, b)
    np.testing.assert_allclose(turn @ a, b, atol=1e-8)
    np.testing.assert_allclose((np.trace(turn) - 1) / 2, a @ b, atol=1e-8)


def test_opposite_directions_are_half_a_turn_apart():
    for a in np.eye(3):
        turn = compute_shortest_rotation(a, -a)
        np.testing.assert_allclose(turn @ a, -a, atol=1e-12)
        np.testing.assert_allclose((np.linalg.det(turn), np.trace(turn)), (1, -1), atol=1e-12)


def test_what_has_no_direction_turns_nothing():
    np.testing.assert_array_equal(compute_shortest_rotation(np.zeros(3), np.ones(3)), np.eye(3))
    np.testing.assert_array_equal(compute_shortest_rotation(np.ones(3), np.zeros(3)), np.eye(3))
