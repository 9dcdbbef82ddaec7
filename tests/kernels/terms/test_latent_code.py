"""Linearisations of a decoder, updated so that they explain a step with the least change."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.kernels.terms import LatentCodeTerm
from mocapfix.kernels.terms.latent_code import update_code_curvature, update_linearisations
from tests.kernels import dense_oracle, random_terms

seeds = st.integers(0, 2**32 - 1)
SIZE, BENT = 5, 3


def draw_linearised_term(rng) -> LatentCodeTerm:
    """Return two linearisations of a decoder that bends the first numbers of its code, and is linear in the others"""
    frame = random_terms.draw_frame(rng, 4, codes=SIZE)
    return random_terms.draw_latent_code(rng, dense_oracle.compute_world(frame.tree, frame.root, frame.local, frame.shared))


def curved(term: LatentCodeTerm) -> np.ndarray:
    return np.einsum("djap,jab,djbq->dpq", term.jacobian, term.information, term.jacobian)


@given(seeds)
def test_curvature_is_the_sum_over_joints(seed):
    term = draw_linearised_term(np.random.default_rng(seed))
    np.testing.assert_allclose(term.curvature, curved(term), atol=1e-9 * term.curvature.max(initial=1.0))


@given(seeds)
def test_broyden_update_explains_the_step_with_the_least_change(seed):
    rng = np.random.default_rng(seed)
    term = draw_linearised_term(rng)
    before = LatentCodeTerm(*(np.copy(each) for each in term))
    step, decoded = rng.normal(size=(1, SIZE)), rng.normal(size=(1, 4, 3))
    update_linearisations(term, np.array([1]), before.code[1:] + step, decoded, BENT)
    np.testing.assert_allclose(term.code[1:], before.code[1:] + step)
    np.testing.assert_array_equal(term.decoded[1:], decoded)
    np.testing.assert_allclose(term.jacobian[1] @ step[0], decoded[0] - before.decoded[1], atol=1e-9)
    change = (term.jacobian - before.jacobian)[1]
    assert not change[..., BENT:].any()
    along = step[0, :BENT] / np.linalg.norm(step[0, :BENT])
    np.testing.assert_allclose(change[..., :BENT], (change[..., :BENT] @ along)[..., None] * along, atol=1e-9)
    np.testing.assert_allclose(term.curvature, curved(term), atol=1e-9 * term.curvature.max(initial=1.0))
    for now, then in zip((term.code, term.decoded, term.jacobian, term.curvature), (before.code, before.decoded, before.jacobian,
                         before.curvature), strict=True):  # fmt: skip
        np.testing.assert_array_equal(now[0], then[0])


def test_zero_step_changes_nothing():
    term = draw_linearised_term(np.random.default_rng(0))
    before = term.jacobian.copy()
    update_linearisations(term, np.array([0, 1]), term.code.copy(), term.decoded + 1e-9, BENT)
    np.testing.assert_array_equal(term.jacobian, before)


@pytest.mark.parametrize("rows", [[0], [1, 0]])
def test_only_selected_linearisations_are_updated(rows):
    term = draw_linearised_term(np.random.default_rng(1))
    right = term.curvature.copy()
    term.curvature[:] = -1.0
    update_code_curvature(term, np.array(rows), SIZE)
    np.testing.assert_allclose(term.curvature[rows], right[rows])
    assert (np.delete(term.curvature, rows, axis=0) == -1.0).all()
