"""Wahba's problem in closed form against Horn's eigenvector."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.kernels.rigid_registration import compute_nearest_rotation, solve_wahba
from tests.kernels import random_terms

seeds = st.integers(0, 2**32 - 1)


@given(seeds)
def test_closed_form_equals_horns_rotation(seed):
    rng = np.random.default_rng(seed)
    cross = rng.normal(size=(3, 3)) * 10.0 ** rng.uniform(-6, 6)
    is_solved, found = solve_wahba(tuple(cross.ravel()))
    assert is_solved
    horns = np.empty((3, 3))
    compute_nearest_rotation(cross, np.empty((4, 4)), np.empty((4, 4)), horns)
    np.testing.assert_allclose(np.reshape(found, (3, 3)), horns, atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(np.reshape(found, (3, 3))), 1.0)


@given(seeds)
def test_planes_are_solved_and_lines_are_not(seed):
    rng = np.random.default_rng(seed)
    first, second = np.linalg.qr(rng.normal(size=(3, 2)))[0].T
    rotation = random_terms.draw_rotations(rng, 1)[0]
    line = np.outer(rotation @ first, first)
    assert not solve_wahba(tuple(line.ravel()))[0]
    is_solved, found = solve_wahba(tuple((line + 0.3 * np.outer(rotation @ second, second)).ravel()))
    assert is_solved
    np.testing.assert_allclose(np.reshape(found, (3, 3)), rotation, atol=1e-9)
    assert not solve_wahba((0.0,) * 9)[0]
