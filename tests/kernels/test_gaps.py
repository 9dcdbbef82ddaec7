import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.stats import gaussian_process


def test_columns_lost_from_then_till_then_are_recalled_together():
    gone = np.zeros((20, 5), bool)
    gone[3:7, [1, 2]] = gone[4:7, 3] = gone[15:, 2] = True
    assert {gap: list(lost) for gap, lost in gaussian_process.group_gaps(gone).items()} == {
        (3, 6): [1, 2],
        (4, 6): [3],
        (15, 19): [2],
    }


@given(st.integers(0, 3000), st.integers(1, 400), st.sampled_from([30.0, 120.0]))
def test_a_gap_is_learnt_from_both_edges_and_from_all_the_take(first, length, rate):
    known = np.ones(3000, bool)
    known[first : first + length] = False
    chosen = gaussian_process.select_training_frames(known, first, first + length - 1, rate)
    assert len(chosen) <= gaussian_process.MAX_TRAINING_FRAMES
    assert (np.diff(chosen) > 0).all()
    assert known[chosen].all()
    for edge in (first - 1, first + length):
        assert not 0 <= edge < 3000 or edge in chosen
    if first > 500:
        assert chosen[0] == 0
    if first + length < 2500:
        assert chosen[-1] == 2999
