import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.fill.gap_estimates import estimate_without_body, iterate_gaps
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


def estimate_take(take, is_inlier):
    return estimate_without_body(take.markers, is_inlier, take.rate)


@given(first=st.integers(0, 300), length=st.integers(1, 99), bad=st.floats(-2, 2))
def test_only_outliers_are_estimated(first, length, bad):
    truth = prop()
    markers = truth.markers.copy()
    gap = slice(first, first + length)
    markers[gap, 3] += bad
    is_inlier = np.ones(markers.shape[:2], bool)
    is_inlier[gap, 3] = False
    filled, deviation, _ = estimate_take(truth.replace_markers(markers), is_inlier)
    assert np.abs(filled - truth.markers)[gap, 3].max() < 0.005
    assert np.isnan(filled[is_inlier]).all()
    assert (~np.isnan(deviation) == ~is_inlier).all()


def test_rarely_visible_marker_is_not_estimated():
    truth = prop()
    is_inlier = truth.visible.copy()
    is_inlier[15:, 0] = False
    filled, _, _ = estimate_take(truth, is_inlier)
    assert np.isnan(filled[~is_inlier]).all()


def test_rarely_visible_marker_is_estimated_between_its_samples():
    truth = prop()
    is_inlier = truth.visible.copy()
    is_inlier[:, 0] = False
    is_inlier[[10, 11, 12, 30, 31, 32], 0] = True
    filled, deviation, _ = estimate_take(truth, is_inlier)
    assert not np.isnan(filled[13:30, 0]).any()
    assert np.isnan(filled[:10, 0]).all()
    assert np.isnan(filled[33:, 0]).all()
    error = np.sqrt(((filled - truth.markers)[13:30, 0] ** 2).mean())
    assert error < 3 * np.sqrt((deviation[13:30, 0] ** 2).mean())


def test_marker_seen_only_at_rest_follows_its_neighbours():
    """It shows nothing of its motion: that of its neighbours shows that it does not rest in the gap."""
    t = np.arange(600) / RATE
    angle = np.where((t > 1) & (t < 5), 1 - np.cos(2 * np.pi * (t - 1) / 4), 0.0)
    turn = Rotation.from_rotvec(angle[:, None] * [0.3, 1.0, 0.2]).as_matrix()
    places = np.random.default_rng(1).normal(scale=0.1, size=(8, 3))
    noise = np.random.default_rng(2).normal(scale=2e-4, size=(600, 8, 3))
    markers = np.einsum("tab,mb->tma", turn, places) + np.stack([angle, 0 * t, 0 * t], 1)[:, None] + noise
    damaged = markers.copy()
    damaged[20:-20, 0] = np.nan
    filled, deviation, _ = estimate_without_body(damaged, ~np.isnan(damaged[..., 0]), RATE)
    error = np.linalg.norm(filled - markers, axis=-1)[20:-20, 0]
    assert error.max() < 0.02
    assert deviation[20:-20, 0].max() < 0.25


def test_marker_that_is_seldom_visible_does_not_hide_the_others_of_its_limb():
    is_visible = np.zeros((100, 3), bool)
    is_visible[:50, :2] = True
    is_visible[:5, 2] = True
    is_missing = ~is_visible
    gaps = [lost.tolist() for _, _, lost in iterate_gaps(is_missing[:, :2], is_visible[:, :2])]
    assert gaps == [[0, 1]]
    is_missing[50:], is_missing[60:] = True, False
    is_missing[:50] = False
    gaps = [lost.tolist() for _, _, lost in iterate_gaps(is_missing, is_visible)]
    assert gaps == [[0, 1], [2]]


@pytest.mark.parametrize("markers", [1, 2, 3])
def test_marker_without_neighbours_is_filled_from_its_trajectory(markers):
    """Uncertainly, and the more so the longer the gap is."""
    truth = prop()
    truth = Take(truth.markers[:, :markers], truth.labels[:markers], RATE)
    is_inlier = truth.visible.copy()
    is_inlier[100:130, 0] = is_inlier[200:300, 0] = False
    filled, deviation, _ = estimate_take(truth, is_inlier)
    error = np.abs(filled - truth.markers)[:, 0].max(1)
    assert error[100:130].max() < 0.05
    assert (error[200:300] < 4 * deviation[200:300, 0]).all()
    assert deviation[250, 0] > deviation[115, 0]


def test_marker_at_rest_stays_where_it_is():
    """A foot that stands before and after a gap, of a person who moves."""
    t = np.arange(600) / RATE
    rng = np.random.default_rng(0)
    body = rng.normal(scale=0.3, size=(1, 8, 3)) + 0.3 * np.sin(2 * t + rng.normal(size=(8, 3, 1)) * 2).transpose(2, 0, 1)
    step = np.clip((t % 2 - 1.4) / 0.6, 0, 1)  # the foot stands for 1.4 s of every 2
    foot = np.stack([t // 2 + step**2 * (3 - 2 * step), 0.1 * np.sin(np.pi * step), 0 * t], 1)
    truth = Take(np.concatenate([body, foot[:, None]], 1), tuple("ABCDEFGHI"), RATE)
    is_inlier = truth.visible.copy()
    is_inlier[220:320, 8] = False
    filled, deviation, _ = estimate_take(truth, is_inlier)
    assert np.linalg.norm(filled - truth.markers, axis=-1)[220:320, 8].max() < 0.01
    assert deviation[220:320, 8].max() < 0.05


def test_no_inliers_give_no_estimate():
    truth = prop()
    filled, deviation, _ = estimate_take(truth, np.zeros_like(truth.visible))
    assert np.isnan(filled).all()
    assert np.isnan(deviation).all()


@needs_captures
def test_real_hand_gap_is_filled_better_than_linearly():
    truth = capture.read_take(CAPTURE)
    hand, gap = truth.bare_labels.index("RFIN"), slice(200, 320)
    is_inlier = truth.visible.copy()
    assert is_inlier[gap, hand].all()
    is_inlier[gap, hand] = False
    filled, deviation, _ = estimate_take(truth, is_inlier)
    step = np.linspace(0, 1, 122)[1:-1, None]
    line = (1 - step) * truth.markers[199, hand] + step * truth.markers[320, hand]
    error = np.linalg.norm(filled[gap, hand] - truth.markers[gap, hand], axis=1)
    assert error.mean() < 0.3 * np.linalg.norm(line - truth.markers[gap, hand], axis=1).mean()
    assert (error < 3 * np.sqrt(3) * deviation[gap, hand]).mean() > 0.9
