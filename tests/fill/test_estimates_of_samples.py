import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.fill.fill_methods import FillMethod, build_marker_estimate, find_impossible_speeds, measure_fastest_speed
from mocapfix.fill.gap_filling import (
    PARTIAL_BODY_SD_RATIO,
    combine_with_partial_body,
    estimate_missing_samples,
)
from mocapfix.fill.weighted_estimates import ESTIMATE_CORRELATION, PREDICTED_SPREAD_DOF, combine_estimates
from mocapfix.io import capture
from mocapfix.model.take import Take
from tests.captures import CAPTURES, needs_captures

CAPTURE = CAPTURES / "cmu" / "06_01.c3d"
RATE = 100.0


def prop(frames=400):
    t = np.arange(frames) / RATE
    turn = Rotation.from_rotvec(np.stack([np.sin(2 * t), np.cos(t), 0.8 * t], 1)).as_matrix()
    places = np.random.default_rng(0).normal(scale=0.2, size=(6, 3))
    markers = np.einsum("tab,mb->tma", turn, places) + np.stack([t, 1 + 0 * t, 0 * t], 1)[:, None]
    return Take(markers, tuple("ABCDEF"), RATE)


def estimate(place, sd):
    """Return an estimate of one sample at `place` on every axis."""
    return build_marker_estimate(np.full((1, 1, 3), place), np.array([[sd]]), FillMethod.SPLINE)


def test_estimates_are_combined_by_precision_with_correlation():
    nothing = estimate(np.nan, np.nan)
    (mean, deviation, _), _ = combine_estimates([estimate(0.0, 0.1), nothing, estimate(0.05, 0.2)])
    np.testing.assert_allclose(mean[0, 0], 0.01)  # weights 100 and 25: shares of 0.8 and 0.2
    variance = (0.8 * 0.1) ** 2 + (0.2 * 0.2) ** 2 + 2 * ESTIMATE_CORRELATION * 0.8 * 0.1 * 0.2 * 0.2
    np.testing.assert_allclose(deviation[0, 0] ** 2, variance)
    assert np.isnan(combine_estimates([nothing, nothing])[0].position).all()
    assert np.isnan(combine_estimates([nothing, nothing])[0].sd).all()


def test_single_estimate_is_returned():
    (mean, deviation, _), _ = combine_estimates([estimate(np.nan, np.nan), estimate(0.3, 0.02)])
    np.testing.assert_allclose(mean, 0.3)
    np.testing.assert_allclose(deviation, 0.02)


def test_method_has_the_largest_weight():
    body = build_marker_estimate(np.zeros((1, 2, 3)), np.array([[0.01, 0.2]]), FillMethod.BODY)
    path = build_marker_estimate(np.zeros((1, 2, 3)), np.array([[0.02, 0.1]]), FillMethod.SPLINE)
    np.testing.assert_array_equal(combine_estimates([path, body])[0].method, [[FillMethod.BODY, FillMethod.SPLINE]])
    np.testing.assert_array_equal(combine_estimates([body, path])[0].method, [[FillMethod.BODY, FillMethod.SPLINE]])


def test_inconsistent_estimates_increase_the_sd():
    near = combine_estimates([estimate(0.0, 0.01), estimate(0.01, 0.01)])[0].sd
    far = combine_estimates([estimate(0.0, 0.01), estimate(0.1, 0.01)])[0].sd
    np.testing.assert_allclose(far / near, np.sqrt(2 * 0.05**2 / 0.01**2))  # Birge's ratio, per axis, of two estimates


def test_expected_sd_is_that_of_simulated_estimates():
    rng, samples, sd = np.random.default_rng(0), 20000, 0.01
    scale = np.sqrt(PREDICTED_SPREAD_DOF / rng.chisquare(PREDICTED_SPREAD_DOF, (samples, 1, 1)))  # actual over predicted
    shared = np.sqrt(ESTIMATE_CORRELATION) * rng.normal(size=(samples, 1, 3))
    own = np.sqrt(1 - ESTIMATE_CORRELATION) * rng.normal(size=(2, samples, 1, 3))
    errors = scale * sd * (shared + own)
    each_sd = np.full((samples, 1), sd)
    combined, ratio = combine_estimates([build_marker_estimate(error, each_sd, FillMethod.SPLINE) for error in errors])
    within = np.abs(combined.position) < (combined.sd * ratio)[..., None]
    assert within.mean() == pytest.approx(0.66, abs=0.02)  # of Student's distribution with nine degrees of freedom


@given(first=st.integers(0, 300), length=st.integers(1, 99), bad=st.floats(-2, 2))
def test_only_outliers_are_estimated(first, length, bad):
    truth = prop()
    markers = truth.markers.copy()
    gap = slice(first, first + length)
    markers[gap, 3] += bad
    is_inlier = np.ones(markers.shape[:2], bool)
    is_inlier[gap, 3] = False
    filled, deviation, _ = estimate_missing_samples(truth.replace_markers(markers), is_inlier)
    assert np.abs(filled - truth.markers)[gap, 3].max() < 0.005
    assert np.isnan(filled[is_inlier]).all()
    assert (~np.isnan(deviation) == ~is_inlier).all()


@pytest.mark.parametrize("markers", [1, 2, 3])
def test_no_estimate_without_support(markers):
    truth = prop()
    truth = Take(truth.markers[:, :markers], truth.labels[:markers], RATE)
    is_inlier = truth.visible.copy()
    is_inlier[:30, 0] = is_inlier[380:, 0] = False
    filled, _, _ = estimate_missing_samples(truth, is_inlier)
    assert np.isnan(filled[~is_inlier]).all()


def test_no_inliers_give_no_estimate():
    truth = prop()
    filled, deviation, _ = estimate_missing_samples(truth, np.zeros_like(truth.visible))
    assert np.isnan(filled).all()
    assert np.isnan(deviation).all()


@needs_captures
def test_real_hand_gap_is_filled_better_than_linearly():
    truth = capture.read_take(CAPTURE)
    hand, gap = truth.bare_labels.index("RFIN"), slice(200, 320)
    is_inlier = truth.visible.copy()
    assert is_inlier[gap, hand].all()
    is_inlier[gap, hand] = False
    filled, deviation, _ = estimate_missing_samples(truth, is_inlier)
    step = np.linspace(0, 1, 122)[1:-1, None]
    line = (1 - step) * truth.markers[199, hand] + step * truth.markers[320, hand]
    error = np.linalg.norm(filled[gap, hand] - truth.markers[gap, hand], axis=1)
    assert error.mean() < 0.3 * np.linalg.norm(line - truth.markers[gap, hand], axis=1).mean()
    assert (error < 3 * np.sqrt(3) * deviation[gap, hand]).mean() > 0.9


def test_impossible_speeds_are_found():
    t = np.arange(200) / 100.0
    path = np.stack([np.stack([t, 0 * t, 0 * t], 1), np.stack([0 * t, t, 0 * t], 1)], 1)  # both at a metre a second
    is_inlier = np.ones((200, 2), bool)
    is_inlier[40:140, 0] = is_inlier[50:80, 1] = False
    path[60, 0] += [0.0, 0.9, 0.0]  # 90 metres a second
    mask = find_impossible_speeds(path, is_inlier, 100.0, measure_fastest_speed(path[:, 1:], 100.0))
    assert mask[40:87, 0].all()
    assert mask.sum() == 47


def test_partial_body_weighs_less_than_it_predicts_and_fills_what_nothing_else_does():
    is_missing = np.array([[True, True, True, False]])

    def of_samples(places, sds, method):
        return build_marker_estimate(np.repeat(np.array([places])[..., None], 3, -1), np.array([sds]), method)

    without = of_samples([0.0, np.nan, 0.03, np.nan], [0.02, np.nan, 0.02, np.nan], FillMethod.CLUSTER)
    body = of_samples([0.05, 0.07, np.nan, np.nan], [0.02, 0.01, np.nan, np.nan], FillMethod.BODY)
    combined = combine_with_partial_body(without, body, is_missing)
    np.testing.assert_allclose(combined.position[0, :3, 0], [0.05 / (1 + PARTIAL_BODY_SD_RATIO**2), 0.07, 0.03])
    np.testing.assert_allclose(combined.sd[0, 1:3], [0.01 * PARTIAL_BODY_SD_RATIO, 0.02])
    np.testing.assert_array_equal(combined.method[0, :3], [FillMethod.CLUSTER, FillMethod.BODY, FillMethod.CLUSTER])
    assert np.isnan(combined.sd[0, 3])
