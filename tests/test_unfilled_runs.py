import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mocapfix.changes import UnfilledRun, expand_unfilled_reasons, find_unfilled_runs
from mocapfix.take import Take


def take(visible):
    return Take(np.where(visible[..., None], 1.0, np.nan).repeat(3, 2), tuple("ABCDE")[: visible.shape[1]], 100.0)


def test_unfilled_runs_have_one_reason_each():
    visible = np.ones((10, 3), bool)
    visible[2:7, 2] = visible[8:, 2] = visible[5, 0] = False
    reasons = np.full(visible.shape, "", object)
    reasons[2:4, 2] = reasons[5:7, 2] = reasons[8:, 2] = "too far"
    reasons[4, 2] = "uncertain"
    reasons[5, 0] = reasons[0, 0] = "not to be changed"  # the latter is there after all
    assert find_unfilled_runs(take(visible), reasons) == (
        UnfilledRun(0, 5, 5, "not to be changed"),
        UnfilledRun(2, 2, 3, "too far"),
        UnfilledRun(2, 4, 4, "uncertain"),
        UnfilledRun(2, 5, 6, "too far"),
        UnfilledRun(2, 8, 9, "too far"),
    )


shape = (12, 3)


@given(visible=arrays(bool, shape, elements=st.booleans()), reasons=arrays(np.int8, shape, elements=st.integers(0, 2)))
def test_every_missing_sample_is_in_one_unfilled_run(visible, reasons):
    words = np.array(["", "too far", "uncertain"], object)[reasons]
    left = find_unfilled_runs(take(visible), words)
    again = expand_unfilled_reasons(left, shape)
    np.testing.assert_array_equal(again[~visible], words[~visible])
    assert (again[visible] == "").all()
    assert sum(each.last - each.first + 1 for each in left) == (~visible).sum()
    for one in left:
        assert UnfilledRun(one.marker, one.last + 1, one.last + 1, one.reason) not in left
    assert len({(each.marker, each.first) for each in left}) == len(left)


def test_complete_take_has_no_unfilled_runs():
    assert find_unfilled_runs(take(np.ones((4, 2), bool)), np.full((4, 2), "", object)) == ()
