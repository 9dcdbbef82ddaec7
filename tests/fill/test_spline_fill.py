import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.fill.spline_fill import build_hermite_map, fill_with_splines, find_complete_stretches

RATE = 120.0


def remove_samples(markers, first, last):
    damaged = markers.copy()
    damaged[first : last + 1, 0] = np.nan
    return damaged


def build_swing(frames=600, noise=0.0):
    t = np.arange(frames) / RATE
    path = np.stack([0.3 * np.sin(5 * t), 1 + 0.1 * np.cos(7 * t), 0.5 * t], -1)[:, None]
    return path + np.random.default_rng(0).normal(scale=noise, size=path.shape)


@given(gap=st.integers(1, 60), edge_count=st.integers(3, 9), seed=st.integers(0, 99))
def test_parabola_is_exact(gap, edge_count, seed):
    t = np.arange(gap + 2 * edge_count) / 50
    path = np.random.default_rng(seed).normal(size=(3, 3)) @ np.stack([np.ones_like(t), t, t**2])
    beside = np.r_[np.arange(edge_count)[::-1], edge_count + gap : len(t)]
    np.testing.assert_allclose(
        build_hermite_map(gap, np.arange(edge_count), np.arange(edge_count)) @ path[:, beside].T,
        path[:, edge_count : edge_count + gap].T,
        atol=1e-9,
    )


@given(first=st.integers(20, 400), seconds=st.floats(0.01, 0.25))
def test_swing_is_filled_within_its_sd(first, seconds):
    last = first + round(seconds * RATE)
    truth = build_swing(noise=0.0003)
    filled, deviation = fill_with_splines(remove_samples(truth, first, last), RATE, 0.5)
    gap = slice(first, last + 1)
    error = np.abs(filled - truth)[gap, 0]
    assert (error < 5 * deviation[gap]).all()
    assert np.isnan(filled[:first, 0]).all()
    assert np.isnan(filled[last + 1 :, 0]).all()


def test_sd_grows_with_gap_duration():
    sds = [
        fill_with_splines(remove_samples(build_swing(), 200, 200 + n), RATE, 0.5)[1][200 + n // 2, 0] for n in (11, 23, 35, 47)
    ]
    assert sds == sorted(sds)
    assert sds[-1] > 4 * sds[0]


def test_random_missing_samples_are_tolerated():
    truth = build_swing(noise=0.0003)
    damaged = truth.copy()
    damaged[np.random.default_rng(1).random(600) < 0.1, 0] = np.nan
    filled, deviation = fill_with_splines(damaged, RATE, 0.5)
    done = ~np.isnan(deviation)
    assert done.sum() > 0.9 * np.isnan(damaged[..., 0]).sum()
    assert np.abs(filled - truth)[done].max() < 0.002


def test_one_outlier_at_the_edge_has_little_influence():
    truth = build_swing()
    damaged = remove_samples(truth, 200, 229)
    damaged[199, 0, 1] += 0.01
    filled, _ = fill_with_splines(damaged, RATE, 0.5)
    assert np.abs(filled - truth)[200:230, 0].max() < 0.035  # 46 with the velocity of the last two samples alone


@pytest.mark.parametrize(
    ("first", "last", "why"), [(0, 20, "leading"), (580, 599, "trailing"), (100, 200, "long"), (2, 10, "too near the start")]
)
def test_unsuitable_gaps_are_not_filled(first, last, why):
    filled, deviation = fill_with_splines(remove_samples(build_swing(), first, last), RATE, 0.5)
    assert np.isnan(filled).all(), why
    assert np.isnan(deviation).all()


def test_marker_with_few_complete_stretches_is_not_filled():
    assert np.isnan(fill_with_splines(remove_samples(build_swing(40), 12, 28), RATE, 0.5)[0]).all()


def test_gaps_of_one_pattern_are_filled_like_single_gaps():
    """A gap is filled from the samples beside it, also if other gaps have the same pattern."""
    truth = build_swing(noise=0.0003)
    damaged = truth.copy()
    firsts = [100, 200, 300, 301, 420]
    damaged[firsts, 0] = np.nan
    filled, _ = fill_with_splines(damaged, RATE, 0.5)
    for first, last in ((100, 100), (200, 200), (300, 301), (420, 420)):
        before, after = np.arange(7), np.arange(7)
        across = build_hermite_map(last - first + 1, before, after)
        beside = np.r_[first - 1 - before, last + 1 + after]
        np.testing.assert_allclose(filled[first : last + 1, 0], across @ truth[beside, 0], atol=1e-12)


@given(seed=st.integers(0, 99), step=st.integers(1, 5))
def test_complete_stretches_show_all_frames(seed, step):
    rng = np.random.default_rng(seed)
    seen, used = rng.random(80) < 0.8, np.array([-3, -1, 0, 2])
    expected = [s for s in range(3, 78, step) if seen[s + used].all()]
    np.testing.assert_array_equal(find_complete_stretches(seen, used, step), expected)
