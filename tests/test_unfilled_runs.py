import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mocapfix.changes import UnfilledRun, expand_unfilled_reasons, find_unfilled_runs
from mocapfix.take import Take


def take(seen):
    return Take(np.where(seen[..., None], 1.0, np.nan).repeat(3, 2), tuple("ABCDE")[: seen.shape[1]], 100.0)


def test_unfilled_runs_have_one_reason_each():
    seen = np.ones((10, 3), bool)
    seen[2:7, 2] = seen[8:, 2] = seen[5, 0] = False
    said = np.full(seen.shape, "", object)
    said[2:4, 2] = said[5:7, 2] = said[8:, 2] = "too far"
    said[4, 2] = "unsure"
    said[5, 0] = said[0, 0] = "not to be touched"  # the latter is there after all
    assert find_unfilled_runs(take(seen), said) == (
        UnfilledRun(0, 5, 5, "not to be touched"),
        UnfilledRun(2, 2, 3, "too far"),
        UnfilledRun(2, 4, 4, "unsure"),
        UnfilledRun(2, 5, 6, "too far"),
        UnfilledRun(2, 8, 9, "too far"),
    )


shape = (12, 3)


@given(seen=arrays(bool, shape, elements=st.booleans()), said=arrays(np.int8, shape, elements=st.integers(0, 2)))
def test_every_missing_sample_is_in_one_unfilled_run(seen, said):
    words = np.array(["", "too far", "unsure"], object)[said]
    left = find_unfilled_runs(take(seen), words)
    again = expand_unfilled_reasons(left, shape)
    np.testing.assert_array_equal(again[~seen], words[~seen])
    assert (again[seen] == "").all()
    assert sum(each.last - each.first + 1 for each in left) == (~seen).sum()
    for one in left:
        assert UnfilledRun(one.marker, one.last + 1, one.last + 1, one.reason) not in left
    assert len({(each.marker, each.first) for each in left}) == len(left)


def test_complete_take_has_no_unfilled_runs():
    assert find_unfilled_runs(take(np.ones((4, 2), bool)), np.full((4, 2), "", object)) == ()
