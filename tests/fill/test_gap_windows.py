import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.fill.gap_windows import (
    MAX_HIDDEN_STRETCHES,
    RESTING_SPEED_M_S,
    choose_hidden_stretches,
    choose_similar_stretches,
    compare_edge_motion,
    compute_variation_growth,
    find_stretches,
    iterate_gaps,
)

RATE = 100.0


@given(first=st.integers(0, 150), length=st.integers(1, 60), share=st.floats(0, 0.1), seed=st.integers(0, 99))
def test_stretches_are_visible_and_imitate_the_gap(first, length, share, seed):
    visible = np.random.default_rng(seed).random(220) >= share
    visible[first : first + length] = False
    window = choose_hidden_stretches(visible, first, first + length - 1, RATE)
    assert visible[window.context_frames].all()
    assert visible[window.hidden_frames].all()
    assert visible[window.hidden_context_frames].all()
    assert window.hidden_length <= length
    assert window.points[0] == 0
    assert window.points[-1] == length - 1
    assert window.hidden_points[-1] == window.hidden_length - 1
    assert len(window.points) == len(window.hidden_points)
    assert 0 <= window.count_independent_stretches() <= len(window.starts)


def test_samples_beside_a_gap_reach_up_to_it():
    visible = np.ones(100, bool)
    visible[50:60] = visible[47] = False
    window = choose_hidden_stretches(visible, 50, 59, RATE)
    np.testing.assert_array_equal(window.before, [-6, -4, -2, -1])
    np.testing.assert_array_equal(window.after, 10 + np.array([0, 1, 3, 5]))
    visible[60] = False  # another gap follows: nothing is known of this edge
    assert len(choose_hidden_stretches(visible, 50, 59, RATE).after) == 0


def test_long_gaps_are_imitated_by_shorter_stretches():
    visible = np.ones(100, bool)
    visible[30:80] = False
    length, starts = find_stretches(visible, 50, 5, 5)
    assert 1 < length < 30
    assert len(starts) > 1
    assert find_stretches(np.zeros(10, bool), 4, 0, 0)[1].size == 0


def test_overlapping_stretches_count_once():
    window = choose_hidden_stretches(np.arange(200) < 100, 100, 179, RATE)
    assert len(window.starts) > 4
    assert window.count_independent_stretches() < 2.5


def test_stretches_at_rest_are_similar_to_a_gap_at_rest():
    t = np.arange(2000) / RATE
    path = np.stack([np.where(t < 10, 0.0, np.sin(4 * (t - 10))), 0 * t, 0 * t], 1)
    visible = np.ones(2000, bool)
    visible[400:450] = False
    window = choose_hidden_stretches(visible, 400, 449, RATE)
    speed, similarity = compare_edge_motion(np.where(visible[:, None], path, np.nan)[:, None], window, RATE)
    assert speed == pytest.approx(RESTING_SPEED_M_S)
    is_resting = window.starts + 60 < 1000
    assert (similarity[is_resting] == 1).all()
    assert (similarity[window.starts > 1000] < 1e-3).all()


def test_stretches_with_the_motion_of_the_gap_are_hidden():
    t = np.arange(2000) / RATE
    path = np.stack([np.where(t < 16, 0.0, np.sin(4 * (t - 16))), 0 * t, 0 * t], 1)[:, None]
    visible = np.ones(2000, bool)
    visible[1940:1944] = False
    window = choose_similar_stretches(path, visible, 1940, 1943, RATE)
    assert len(window.starts) == MAX_HIDDEN_STRETCHES
    assert (window.starts > 1600).all()  # evenly spread ones would mostly be at rest


def test_edges_tell_less_of_a_longer_gap():
    visible = np.ones(100, bool)
    visible[40:45] = False
    motion = compare_edge_motion(np.zeros((100, 1, 3)), choose_hidden_stretches(visible, 40, 44, RATE), RATE)
    speeds = [motion.estimate_speed_in_gap(0, 2.0, seconds) for seconds in (0.01, 1.0, 20.0)]
    assert RESTING_SPEED_M_S < speeds[0] < speeds[1] < speeds[2] <= 2.0


def test_marker_that_is_seldom_visible_varies_more_in_a_gap():
    is_shown = np.zeros(1000, bool)
    is_shown[100:110] = True
    briefly = compute_variation_growth(is_shown, 1.0, RATE)
    is_shown[600:610] = True
    assert 1 < compute_variation_growth(is_shown, 1.0, RATE) < briefly
    assert compute_variation_growth(np.ones(1000, bool), 1.0, RATE) == 1


def test_axes_that_are_unknown_beside_a_gap_leave_the_known_samples():
    is_known = np.ones(400, bool)
    is_known[200:260] = False
    window = choose_hidden_stretches(is_known, 200, 259, RATE)
    is_known[197] = is_known[260] = False
    kept = window.keep_known_context(is_known[window.context_frames])
    assert is_known[kept.context_frames].all()
    assert len(kept.before) + len(kept.after) == int(is_known[window.context_frames].sum())
    assert len(kept.hidden_after) == len(kept.after)


def test_marker_that_is_seldom_visible_does_not_hide_the_others_of_its_limb():
    is_visible = np.zeros((100, 3), bool)
    is_visible[:50, :2] = True
    is_visible[:5, 2] = True
    is_missing, has_ends = ~is_visible, np.array([True, True, False])
    gaps = [lost.tolist() for _, _, lost in iterate_gaps(is_missing[:, :2], is_visible[:, :2], has_ends[:2])]
    assert gaps == [[0, 1]]
    is_missing[50:], is_missing[60:] = True, False
    is_missing[:50] = False
    gaps = [lost.tolist() for _, _, lost in iterate_gaps(is_missing, is_visible, has_ends)]
    assert gaps == [[0, 1], [2]]
