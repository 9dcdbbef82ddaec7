import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.kernels import small_matrices
from tests.kernels import random_terms

seeds = st.integers(0, 2**32 - 1)


def test_nine_numbers_are_a_matrix():
    rng = np.random.default_rng(0)
    stack, vector = rng.normal(size=(2, 3, 3)), rng.normal(size=3)
    a, b = small_matrices.load_matrix(stack, 0), small_matrices.load_matrix(stack, 1)
    np.testing.assert_array_equal(a, stack[0].ravel())
    np.testing.assert_allclose(small_matrices.multiply_matrices(a, b), (stack[0] @ stack[1]).ravel(), rtol=1e-14)
    np.testing.assert_array_equal(small_matrices.transpose_matrix(a), stack[0].T.ravel())
    np.testing.assert_allclose(small_matrices.multiply_vector(a, *map(float, vector)), stack[0] @ vector, rtol=1e-14)
    small_matrices.store_matrix(a, stack, 1)
    np.testing.assert_array_equal(stack[1], stack[0])


@given(seeds, st.floats(-6, 6))
def test_symmetric_3x3_is_inverted_in_place(seed, power):
    stack = random_terms.draw_spd(np.random.default_rng(seed), 3, 3, 10.0**power)
    out = stack.copy()
    l10, l20, l21, *d = small_matrices.invert_symmetric_3x3(out, 1)
    np.testing.assert_allclose(out[1] @ stack[1], np.eye(3), atol=1e-9)
    np.testing.assert_array_equal(out[1], out[1].T)
    np.testing.assert_array_equal(out[[0, 2]], stack[[0, 2]])
    lower = np.array([[1, 0, 0], [l10, 1, 0], [l20, l21, 1]])
    np.testing.assert_allclose(lower / d @ lower.T, stack[1], rtol=1e-9, atol=1e-12 * 10.0**power)


@given(seeds, st.integers(0, 40))
def test_multiply_rows(seed, size):
    rng = np.random.default_rng(seed)
    rows, x = rng.normal(size=(3, size)), rng.normal(size=size)
    np.testing.assert_allclose(small_matrices.multiply_rows(rows, x), rows @ x, atol=1e-12)


@given(seeds, st.integers(0, 12), st.floats(-3, 6))
def test_inverse_from_the_cholesky_factor(seed, size, power):
    matrix = random_terms.draw_spd(np.random.default_rng(seed), 1, size, 10.0**power)[0]
    out = matrix.copy()
    small_matrices.factor_cholesky(out)
    small_matrices.invert_cholesky(out)
    np.testing.assert_allclose(out @ matrix, np.eye(size), atol=1e-8)
    np.testing.assert_array_equal(out, out.T)


@given(seeds, st.integers(0, 12))
def test_cholesky_solution(seed, size):
    rng = np.random.default_rng(seed)
    matrix, x = random_terms.draw_spd(rng, 1, size)[0], rng.normal(size=size)
    factor, found = matrix.copy(), x.copy()
    factor[np.triu_indices(size, 1)] = np.nan  # the lower triangle is enough
    small_matrices.factor_cholesky(factor)
    small_matrices.solve_cholesky(factor, found)
    np.testing.assert_allclose(matrix @ found, x, atol=1e-8)
    np.testing.assert_allclose(np.tril(factor) @ np.tril(factor).T, matrix, atol=1e-10)


def test_unconstrained_direction_does_not_spoil_the_others():
    held = np.diag([4.0, 0, 9, 0, 1, 25])
    small_matrices.factor_cholesky(held)
    small_matrices.invert_cholesky(held)
    np.testing.assert_allclose(np.diag(held), [1 / 4, 1e9, 1 / 9, 1e9, 1, 1 / 25])
    np.testing.assert_array_equal(held - np.diag(np.diag(held)), 0)


def test_axis_without_information_has_inverse_zero():
    stack = np.zeros((1, 3, 3))
    small_matrices.invert_symmetric_3x3(stack, 0)
    np.testing.assert_array_equal(stack, 0)


def test_banded_solution():
    rng = np.random.default_rng(0)
    half = np.triu(rng.normal(size=(9, 9))) * (np.subtract.outer(np.arange(9), np.arange(9)) >= -2)
    matrix, right = half.T @ half + np.eye(9), rng.normal(size=(9, 2))
    band = np.zeros((3, 9))
    for above in range(3):
        band[2 - above, above:] = np.diagonal(matrix, above)
    solution = right.copy()
    small_matrices.solve_banded(band, solution)
    np.testing.assert_allclose(matrix @ solution, right, atol=1e-12)
