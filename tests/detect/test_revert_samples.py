from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mocapfix.model.take import Take
from mocapfix.review.apply_decisions import revert_samples

masks = arrays(bool, (12, 3), elements=st.booleans())


@given(where=masks, filled=masks)
def test_samples_are_reverted_in_the_mask_and_unchanged_elsewhere(where, filled):
    rng = np.random.default_rng(0)
    before = Take(rng.normal(size=(12, 3, 3)), tuple("ABC"), 100.0)
    before.markers[filled] = np.nan
    sample_sd = np.where(filled, 0.001, np.nan)
    repaired = before.exchange_labels((0, 1, 2), 0, 11)
    after = replace(repaired, markers=np.where(filled[..., None], 1.0, repaired.markers), sample_sd=sample_sd)
    back = revert_samples(after, before, where)
    for name in ("markers", "source_points"):
        was, now, got = (getattr(take, name) for take in (before, after, back))
        np.testing.assert_array_equal(got[where], was[where])
        np.testing.assert_array_equal(got[~where], now[~where])
    assert back.sample_sd is not None
    assert np.isnan(back.sample_sd[where]).all()
    np.testing.assert_array_equal(back.sample_sd[~where], sample_sd[~where])


def test_computed_samples_are_reverted():
    computed = np.zeros((12, 3), bool)
    computed[3:6, 1] = True
    before = Take(np.ones((12, 3, 3)), tuple("ABC"), 100.0, computed=computed)
    where = np.zeros((12, 3), bool)
    where[:, 1] = True
    back = revert_samples(replace(before, computed=None), before, where)
    np.testing.assert_array_equal(back.measured, before.measured)
