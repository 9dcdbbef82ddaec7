"""The frames that a gap's prediction is trained on."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.stats import sequences


def test_columns_with_the_same_gap_are_grouped():
    missing = np.zeros((20, 5), bool)
    missing[3:7, [1, 2]] = missing[4:7, 3] = missing[15:, 2] = True
    assert {gap: list(columns) for gap, columns in sequences.group_gaps(missing).items()} == {
        (3, 6): [1, 2],
        (4, 6): [3],
        (15, 19): [2],
    }


@given(st.integers(0, 3000), st.integers(1, 400), st.sampled_from([30.0, 120.0]))
def test_training_frames_cover_both_edges_and_the_whole_take(first, length, rate):
    is_known = np.ones(3000, bool)
    is_known[first : first + length] = False
    frames = sequences.select_training_frames(is_known, first, first + length - 1, rate)
    assert len(frames) <= sequences.MAX_TRAINING_FRAMES
    assert (np.diff(frames) > 0).all()
    assert is_known[frames].all()
    for edge in (first - 1, first + length):
        assert not 0 <= edge < 3000 or edge in frames
    if first > 500:
        assert frames[0] == 0
    if first + length < 2500:
        assert frames[-1] == 2999
