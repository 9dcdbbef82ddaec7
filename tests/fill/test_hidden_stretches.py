import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.fill.gap_estimates import choose_hidden_stretches, find_stretches

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
