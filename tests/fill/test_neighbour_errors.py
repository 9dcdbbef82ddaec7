"""How well visible markers are interpolated in a gap of another one."""

import numpy as np
import pytest

from mocapfix.fill.edge_interpolation import MethodRatios, estimate_from_edges, keep_known_context
from mocapfix.fill.fill_methods import compute_variation_growth, measure_velocity_variation
from mocapfix.fill.gap_estimates import NeighbourActivity, choose_hidden_stretches, measure_neighbour_errors

RATE = 100.0
GAP = slice(200, 260)


def build_markers(smooth: float) -> np.ndarray:
    """Return five markers on one path, the first lost for a while: a parabola, and noise from one frame to the next."""
    t = np.arange(400) / RATE
    path = np.stack([2 * (t - 2) ** 2, 0 * t, 0 * t], 1)
    noise = np.random.default_rng(0).normal(0, 1 - smooth, (400, 3))
    markers = path[:, None] * smooth + noise[:, None] + np.arange(5)[:, None]
    markers[GAP, 0] = np.nan
    return markers


def measure(markers: np.ndarray):
    window = choose_hidden_stretches(~np.isnan(markers[:, 0, 0]), GAP.start, GAP.stop - 1, RATE)
    return window, measure_neighbour_errors(markers, window, RATE, measure_velocity_variation(markers, RATE))


def test_velocities_at_the_edges_help_where_they_help_the_neighbours():
    _, smooth = measure(build_markers(1.0))
    straight, _, cubic = smooth.log_ratio[:, 1:].mean(1)
    assert cubic < straight - 1
    _, rough = measure(build_markers(0.0))
    straight, _, cubic = rough.log_ratio[:, 1:].mean(1)
    assert cubic > straight + 1


def test_lost_markers_show_nothing():
    _, errors = measure(build_markers(1.0))
    assert errors.compute_ratios(np.array([0])) is None
    ratios = errors.compute_ratios(np.array([0, 1, 2]))
    assert ratios is not None
    assert ratios.neighbour_count == 2


@pytest.mark.parametrize("ratio", [0.1, 1.0, 5.0])
def test_expected_errors_follow_those_of_the_neighbours(ratio):
    markers = build_markers(1.0)
    window, _ = measure(markers)
    ratios = MethodRatios(np.log([ratio, 1.0, 1.0]), 1000)
    usual = estimate_from_edges(markers[:, 0], None, window, RATE, 1.0)
    shown = estimate_from_edges(markers[:, 0], None, window, RATE, 1.0, ratios=ratios)
    changes = [float(np.mean(s.expected_sd / u.expected_sd)) for s, u in zip(shown[:1], usual[:1], strict=True)]
    np.testing.assert_allclose(changes, ratio**0.6, rtol=0.02)
    assert all((s.position == u.position).all() for s, u in zip(shown, usual, strict=True))


def test_marker_that_is_seldom_visible_varies_more_in_a_gap():
    is_shown = np.zeros(1000, bool)
    is_shown[100:110] = True
    briefly = compute_variation_growth(is_shown, 1.0, RATE)
    is_shown[600:610] = True
    assert 1 < compute_variation_growth(is_shown, 1.0, RATE) < briefly
    assert compute_variation_growth(np.ones(1000, bool), 1.0, RATE) == 1


def test_neighbours_show_that_a_marker_is_visible_at_rest_only():
    t = np.arange(600) / RATE
    path = np.where((t > 2) & (t < 4), np.sin(6 * (t - 2)), 0.0)
    markers = np.stack([path, 0 * t, 0 * t], 1)[:, None] + np.arange(4)[:, None]
    markers[190:410, 0] = np.nan
    window = choose_hidden_stretches(~np.isnan(markers[:, 0, 0]), 190, 409, RATE)
    activity = NeighbourActivity(markers, RATE)
    assert activity.compare(0, window, np.array([1, 2, 3])) > 5
    resting = choose_hidden_stretches(np.ones(600, bool), 50, 99, RATE)
    assert activity.compare(1, resting, np.array([2, 3])) == 1
    assert activity.compare(0, window, np.array([], int)) == 1


def test_axes_that_are_unknown_beside_a_gap_leave_the_known_samples():
    markers = build_markers(1.0)
    window, _ = measure(markers)
    is_known = np.ones(len(markers), bool)
    is_known[GAP.start - 3] = is_known[GAP.stop] = False
    kept = keep_known_context(window, is_known)
    assert is_known[kept.context_frames].all()
    assert len(kept.before) + len(kept.after) == int(is_known[window.context_frames].sum())
    assert len(kept.hidden_after) == len(kept.after)
