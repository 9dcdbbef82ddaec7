"""Takes damaged as on a stage: shares, durations and sizes of the damage, and that it is the same every time."""

import numpy as np
import pytest

from mocapfix.lab import clean_speed
from mocapfix.stats.sequences import find_runs
from mocapfix.synthetic import SyntheticTake

RATE = 60.0


@pytest.fixture(scope="module")
def tenth() -> SyntheticTake:
    return clean_speed.compose_tenth_missing_take(seed=1, seconds=60.0, rate=RATE)


@pytest.fixture(scope="module")
def heavy() -> SyntheticTake:
    return clean_speed.compose_heavily_damaged_take(seed=1)


def test_a_tenth_is_missing_and_nothing_is_displaced(tenth):
    assert 0.1 <= tenth.missing_mask.mean() < 0.11
    assert not tenth.spike_mask.any()
    np.testing.assert_array_equal(np.isnan(tenth.damaged_positions[..., 0]), tenth.missing_mask)
    visible = ~tenth.missing_mask
    np.testing.assert_array_equal(tenth.damaged_positions[visible], tenth.marker_positions[visible])


def test_most_gaps_are_short_and_most_missing_samples_in_long_ones(tenth):
    lengths = np.array([last - first + 1 for mask in tenth.missing_mask.T for first, last in find_runs(mask)])
    assert np.median(lengths) < 0.5 * RATE
    assert lengths[lengths > 0.5 * RATE].sum() > 0.7 * lengths.sum()
    assert lengths.max() <= 10.0 * RATE  # two or more of the longest may touch


def test_limbs_are_lost_at_times(tenth):
    limbs = clean_speed.find_limb_markers(tenth.subject)
    for name in ("LFRM", "LWRA", "LFIN"):
        assert limbs[0, tenth.labels.index(name)]
    assert not limbs[:, tenth.labels.index("STRN")].any()
    is_lost = np.array([tenth.missing_mask[:, limb].all(axis=1) for limb in limbs if limb.sum() > 3])
    assert 0.0 < is_lost.any(axis=0).mean() < 0.3


def test_heavy_damage_has_the_stated_shares_and_size(heavy):
    assert heavy.marker_positions.shape == (780, 57, 3)
    assert 0.13 <= heavy.missing_mask.mean() < 0.14
    visible = ~heavy.missing_mask
    assert heavy.spike_mask[visible].mean() == pytest.approx(0.06, abs=0.005)
    assert not heavy.spike_mask[heavy.missing_mask].any()
    distance = np.linalg.norm(heavy.damaged_positions - heavy.marker_positions, axis=-1)
    np.testing.assert_allclose(distance[heavy.spike_mask], 0.095)
    assert (distance[visible & ~heavy.spike_mask] == 0).all()


@pytest.mark.parametrize("compose", [clean_speed.compose_tenth_missing_take, clean_speed.compose_heavily_damaged_take])
def test_the_same_arguments_give_the_same_take(compose):
    first, second, other = (compose(seed=seed, seconds=3.0, rate=RATE) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.damaged_positions, second.damaged_positions)
    assert not np.array_equal(first.missing_mask, other.missing_mask)
