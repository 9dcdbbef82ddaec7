import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.kernels.small import cholesky_inverse_6, inverse_3
from tests.kernels import dense

seeds = st.integers(0, 2**32 - 1)


@given(seeds, st.floats(-6, 6))
def test_inverse_3_inverts(seed, power):
    matrix, out = dense.spd(np.random.default_rng(seed), 1, 3, 10.0**power)[0], np.empty((3, 3))
    inverse_3(matrix, out)
    np.testing.assert_allclose(out @ matrix, np.eye(3), atol=1e-9)
    np.testing.assert_array_equal(out, out.T)


@given(seeds, st.floats(-3, 6))
def test_cholesky_inverse_6_inverts_in_place(seed, power):
    matrix = dense.spd(np.random.default_rng(seed), 1, 6, 10.0**power)[0]
    out = matrix.copy()
    cholesky_inverse_6(out)
    np.testing.assert_allclose(out @ matrix, np.eye(6), atol=1e-9)
    np.testing.assert_array_equal(out, out.T)


def test_a_direction_that_nothing_holds_is_all_but_free_and_does_not_spoil_the_others():
    held = np.diag([4.0, 0, 9, 0, 1, 25])
    cholesky_inverse_6(held)
    np.testing.assert_allclose(np.diag(held), [1 / 4, 1e9, 1 / 9, 1e9, 1, 1 / 25])
    np.testing.assert_array_equal(held - np.diag(np.diag(held)), 0)
