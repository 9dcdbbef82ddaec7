"""The closed form gives what Horn's eigenvector gives, and says where it cannot."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.kernels.rigid_registration import solve_wahba
from mocapfix.stats.rigid_alignment import fit_rotations
from tests.kernels import random_terms

seeds = st.integers(0, 2**32 - 1)


@given(seeds)
def test_closed_form_equals_horns_rotation(seed):
    rng = np.random.default_rng(seed)
    cross = rng.normal(size=(3, 3)) * 10.0 ** rng.uniform(-6, 6)
    told, found = solve_wahba(tuple(cross.ravel()))
    assert told
    np.testing.assert_allclose(np.reshape(found, (3, 3)), fit_rotations(cross[None])[0], atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(np.reshape(found, (3, 3))), 1.0)


@given(seeds)
def test_planes_are_solved_and_lines_are_not(seed):
    rng = np.random.default_rng(seed)
    first, second = np.linalg.qr(rng.normal(size=(3, 2)))[0].T
    ways = random_terms.rotations(rng, 1)[0]
    line = np.outer(ways @ first, first)
    assert not solve_wahba(tuple(line.ravel()))[0]
    told, found = solve_wahba(tuple((line + 0.3 * np.outer(ways @ second, second)).ravel()))
    assert told
    np.testing.assert_allclose(np.reshape(found, (3, 3)), ways, atol=1e-9)
    assert not solve_wahba((0.0,) * 9)[0]
