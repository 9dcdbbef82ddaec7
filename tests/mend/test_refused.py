from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mocapfix import mend
from mocapfix.take import Take

masks = arrays(bool, (12, 3), elements=st.booleans())


@given(where=masks, filled=masks)
def test_samples_are_as_before_where_asked_and_as_mended_elsewhere(where, filled):
    rng = np.random.default_rng(0)
    before = Take(rng.normal(size=(12, 3, 3)), tuple("ABC"), 100.0)
    before.markers[filled] = np.nan
    deviation = np.where(filled, 0.001, np.nan)
    mended = before.exchanged((0, 1, 2), 0, 11)
    after = replace(mended, markers=np.where(filled[..., None], 1.0, mended.markers), deviation=deviation)
    back = mend.put_back(after, before, where)
    for name in ("markers", "sources"):
        was, now, got = (getattr(take, name) for take in (before, after, back))
        np.testing.assert_array_equal(got[where], was[where])
        np.testing.assert_array_equal(got[~where], now[~where])
    assert back.deviation is not None
    assert np.isnan(back.deviation[where]).all()
    np.testing.assert_array_equal(back.deviation[~where], deviation[~where])


def test_what_a_program_filled_before_is_so_again():
    computed = np.zeros((12, 3), bool)
    computed[3:6, 1] = True
    before = Take(np.ones((12, 3, 3)), tuple("ABC"), 100.0, computed=computed)
    where = np.zeros((12, 3), bool)
    where[:, 1] = True
    back = mend.put_back(replace(before, computed=None), before, where)
    np.testing.assert_array_equal(back.measured, before.measured)
