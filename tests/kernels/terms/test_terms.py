"""Every term's cost, gradient and Gauss-Newton curvature against finite differences of its residual, by one test."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.kernels.terms import normalise_pixels
from mocapfix.kernels.terms.contract import GEMAN_MCCLURE, HUBER, compute_robust_loss
from tests.kernels import dense_oracle, random_terms
from tests.kernels.solver_runs import build_equations

seeds, sizes, scales = st.integers(0, 2**32 - 1), st.integers(1, 8), st.sampled_from([np.inf, 100.0, 9.0, 1.0])


GRADIENT_ROUNDING = 1e-10
"""Error of a gradient by finite differences, per unit of cost: positions are rounded, which are larger than the residuals, and
the step is 1e-5. It remains where the gradient itself is zero, as that of distances within one body."""


def check(frame, scale2):
    """The model that the kernels make of a frame's terms is the differences' own."""
    cost, system = build_equations(frame, scale2)
    expected_cost, *expected = dense_oracle.compute_quadratic(frame, scale2)
    assert cost == pytest.approx(expected_cost, rel=1e-10, abs=1e-15)
    rounding_errors = GRADIENT_ROUNDING * expected_cost, 0.0
    for found, should, rounding in zip(
        dense_oracle.assemble_equations(frame.tree, system), expected, rounding_errors, strict=True
    ):
        np.testing.assert_allclose(found, should, rtol=0, atol=1e-7 * max(1.0, np.abs(should).max()) + rounding)


@pytest.mark.parametrize("kind", random_terms.ALL_KINDS)
@given(seed=seeds, joints=sizes, scale2=scales)
def test_term_model_is_that_of_its_residuals(kind, seed, joints, scale2):
    check(random_terms.draw_frame(np.random.default_rng(seed), joints, [kind], codes=3 if kind == "latent_code" else 0), scale2)


@pytest.mark.parametrize("codes", [0, 5])
@given(seed=seeds, joints=sizes, scale2=scales)
def test_terms_add_up_with_a_code(codes, seed, joints, scale2):
    check(random_terms.draw_frame(np.random.default_rng(seed), joints, codes=codes), scale2)


def test_random_terms_cover_all_cases():
    """So that the tests above are about something: cameras of both kinds, walls on either side, one body and two."""
    frame = random_terms.draw_frame(np.random.default_rng(0), 8)
    of = dict(zip(random_terms.ALL_KINDS, frame.terms, strict=True))
    assert len(set(of["reprojection"].perspective[of["reprojection"].cameras])) == 2
    vector = dense_oracle.compute_deviations(of["joint_limits"].reference, dense_oracle.compute_world(*frame[:1], *frame[2:]))[
        frame.tree.free
    ]
    low, high = of["joint_limits"].low[frame.tree.free], of["joint_limits"].high[frame.tree.free]
    assert (vector < low).any()
    assert (vector > high).any()
    assert ((vector >= low) & (vector <= high)).any()
    assert len(set(of["distances"].joints[:, 0] == of["distances"].joints[:, 1])) == 2
    assert not of["points"].offsets[0].any()
    assert of["points"].offsets[-1].any()


@pytest.mark.parametrize("kind", ["points", "directions", "orientations", "reprojection"])
@pytest.mark.parametrize("wild", [np.nan, np.inf, -np.inf, 1e300])
def test_missing_and_absurd_samples_are_ignored(kind, wild):
    frame = random_terms.draw_frame(np.random.default_rng(1), 4, [kind])
    term = frame.terms[random_terms.ALL_KINDS.index(kind)]
    term.weight[0, 2] = 0.0
    cost, without = build_equations(frame, 9.0)
    term.measured[0, 2] = wild
    again, unseen = build_equations(frame, 9.0)
    term.weight[0, 2] = 1.0
    absurd = build_equations(frame, 9.0)
    assert again == cost
    for found, expected in zip(unseen, without, strict=True):
        assert np.isfinite(expected).all()
        np.testing.assert_array_equal(found, expected)
    assert absurd[0] == pytest.approx(cost, abs=4.6)  # not at all, or at most as one that is far off: c^2 / 2, for Huber more
    assert all(np.isfinite(each).all() for each in absurd[1])


def test_points_behind_a_perspective_camera_are_ignored():
    frame = random_terms.draw_frame(np.random.default_rng(2), 3, ["reprojection"])
    term = frame.terms[random_terms.ALL_KINDS.index("reprojection")]
    term.perspective[:] = True
    term.translation[:] -= 2 * random_terms.CAMERA_TRANSLATION
    cost, system = build_equations(frame)
    assert cost == 0
    assert not system.h.any()


def test_pixels_become_tangents_and_metres():
    np.testing.assert_allclose(normalise_pixels(np.array([[960.0, 640.0]]), 1000.0, np.array([460.0, 540.0])), [[0.5, 0.1]])
    both = normalise_pixels(np.array([[[960.0, 640.0]]]), np.array([1000.0, 500.0]), np.array([460.0, 540.0]))
    np.testing.assert_allclose(both, [[[0.5, 0.2]]])


@pytest.mark.parametrize("kind", ["tracking", "pose_prior", "distances", "latent_code"])
def test_constant_data_may_have_one_row(kind):
    frame, last = random_terms.draw_frame(np.random.default_rng(4), 5, [kind], codes=3 if kind == "latent_code" else 0), 7
    once = frame.terms[random_terms.ALL_KINDS.index(kind)]
    for name, array in once._asdict().items():
        if isinstance(array, np.ndarray) and len(array) == 1:
            each = once._replace(**{name: np.repeat(array, last + 1, axis=0)})
            several = frame._replace(terms=random_terms.build_terms(5, last + 1, **{kind: each}))
            assert build_equations(several, t=last)[0] == build_equations(frame)[0]


def test_coincident_points_have_a_distance_without_direction():
    body = random_terms.draw_tree(np.random.default_rng(3), 1)
    touching = random_terms.DistanceTerm(np.zeros((1, 2), int), np.zeros((1, 2, 3)), np.array([[0.3]]), np.array([[100.0]]))
    frame = dense_oracle.Frame(body, random_terms.build_terms(1, distances=touching), np.zeros(3), np.eye(3)[None], np.zeros(0))
    cost, system = build_equations(frame)
    assert cost == pytest.approx(0.5 * 9)
    assert not system.row_twist.any()


# robust losses


def test_known_losses():
    for kind in (GEMAN_MCCLURE, HUBER):
        assert compute_robust_loss(kind, 8.0, np.inf) == (4.0, 1.0)
        assert compute_robust_loss(kind, 0.0, 4.0) == (0.0, 1.0)
        assert compute_robust_loss(kind, 3.0, 1e15) == pytest.approx((1.5, 1.0))
        assert compute_robust_loss(kind, 1e-6, 4.0) == pytest.approx((0.5e-6, 1.0), rel=1e-5)
    assert compute_robust_loss(GEMAN_MCCLURE, 4.0, 4.0) == pytest.approx((1.0, 0.25))
    assert compute_robust_loss(GEMAN_MCCLURE, 1e12, 4.0) == pytest.approx((2.0, 1.6e-23))  # bounded
    assert compute_robust_loss(HUBER, 4.0, 4.0) == (2.0, 1.0)
    assert compute_robust_loss(HUBER, 100.0, 4.0) == pytest.approx((2 * 10 - 2, 0.2))  # a straight line


@given(st.sampled_from([GEMAN_MCCLURE, HUBER]), st.floats(0.01, 100), st.floats(0.1, 100))
def test_weight_is_twice_the_losses_derivative_to_the_square(kind, square, scale2):
    step = 1e-5 * square
    slope = (compute_robust_loss(kind, square + step, scale2)[0] - compute_robust_loss(kind, square - step, scale2)[0]) / (
        2 * step
    )
    assert compute_robust_loss(kind, square, scale2)[1] == pytest.approx(2 * slope, rel=1e-5)
    assert compute_robust_loss(kind, square, scale2) == pytest.approx(
        tuple(map(float, dense_oracle.compute_loss(kind, np.array(square), scale2)))
    )
