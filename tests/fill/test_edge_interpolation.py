import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.fill.edge_interpolation import (
    WorldInterpolation,
    build_edge_maps,
    build_world_axes,
    fill_with_splines,
    find_complete_stretches,
    interpolate_in_axes,
)
from mocapfix.fill.gap_windows import FillMethod, MovingAxes
from mocapfix.stats.rigid_alignment import interpolate_stretches
from tests.fill.gap_examples import RATE, build_gap, build_take

SPLINE_RATE = 120.0


def interpolate(path, length, before, after):
    """Return the estimates (E, length, 3) between samples before and after a gap, at distances from its edges."""
    beside = np.concatenate([-1 - np.array(before, int), length + np.array(after, int)]) + max(before, default=-1) + 1
    rows = np.concatenate([beside, max(before, default=-1) + 1 + np.arange(length)])[None]
    edges = build_edge_maps(tuple(before), tuple(after))
    return interpolate_stretches(path, *build_world_axes(len(path)), rows, np.arange(length), length, edges, np.ones(0))[0][:, 0]


@given(length=st.integers(1, 60), before=st.integers(0, 6), after=st.integers(0, 6))
def test_a_marker_at_rest_stays_at_its_place(length, before, after):
    assume(before + after)
    found = interpolate(np.ones((before + length + after, 3)), length, range(before)[::-1], range(after))
    assert len(found) == (2 if min(before, after) >= 3 else 1)
    np.testing.assert_allclose(found, 1, atol=1e-9)


def test_lines_and_splines_are_exact():
    t = np.arange(32) / RATE
    line, parabola = np.stack([3 * t, t, -t], 1), np.stack([2 * t**2 - t, t**2, t], 1)
    edges = range(6)[::-1], range(6)
    np.testing.assert_allclose(interpolate(line, 20, *edges)[0], line[6:26], atol=1e-12)
    np.testing.assert_allclose(interpolate(parabola, 20, *edges)[1], parabola[6:26], atol=1e-9)


def test_marker_on_a_rigid_body_is_exact_in_its_axes():
    t = np.arange(400) / RATE
    rotation = Rotation.from_rotvec(np.stack([np.sin(3 * t), 2 * t, 0 * t], 1)).as_matrix()
    axes = MovingAxes(rotation, np.stack([t, np.cos(t), 0 * t], 1))
    truth = rotation @ np.array([0.1, 0.2, 0.3]) + axes.origin
    path = truth.copy()
    path[150:220] = np.nan
    take = build_take(path[:, None])
    gap = build_gap(take, 0, 150, 219)
    for estimate in interpolate_in_axes(path, axes, gap, RATE, "a body"):
        np.testing.assert_allclose(estimate.position, truth[150:220], atol=1e-9)
        np.testing.assert_allclose(estimate.error, 0, atol=1e-9)
    world = WorldInterpolation(take)(gap)
    assert np.abs(world[0].position - truth[150:220]).max() > 0.05
    assert np.abs(world[0].error).max() > 0.05


@pytest.mark.parametrize("method", [0, 1])
def test_hidden_errors_are_those_of_the_gap(method):
    """The gap is one of the stretches that could be hidden, so that its error is like theirs."""
    t = np.arange(3000) / RATE
    truth = np.stack([np.sin(4 * t), np.cos(2.3 * t), np.sin(3 * t + 1)], 1)
    visible = np.ones(3000, bool)
    visible[1500:1540] = False
    path = np.where(visible[:, None], truth, np.nan)
    take = build_take(path[:, None])
    estimate = WorldInterpolation(take)(build_gap(take, 0, 1500, 1539, speed_m_s=3.0))[method]
    assert estimate.method == (FillMethod.LINE, FillMethod.SPLINE)[method]
    actual = np.sqrt(((estimate.position - truth[1500:1540]) ** 2).mean())
    assert 0.3 < actual / np.sqrt((estimate.error**2).mean()) < 3


def remove_samples(markers, first, last):
    damaged = markers.copy()
    damaged[first : last + 1, 0] = np.nan
    return damaged


def build_swing(frames=600, noise=0.0):
    t = np.arange(frames) / SPLINE_RATE
    path = np.stack([0.3 * np.sin(5 * t), 1 + 0.1 * np.cos(7 * t), 0.5 * t], -1)[:, None]
    return path + np.random.default_rng(0).normal(scale=noise, size=path.shape)


@given(gap=st.integers(1, 60), edge_count=st.integers(3, 9), seed=st.integers(0, 99))
def test_parabola_is_exact(gap, edge_count, seed):
    t = np.arange(gap + 2 * edge_count) / 50
    path = np.random.default_rng(seed).normal(size=(3, 3)) @ np.stack([np.ones_like(t), t, t**2])
    found = interpolate(path.T, gap, range(edge_count)[::-1], range(edge_count))[1]
    np.testing.assert_allclose(found, path[:, edge_count : edge_count + gap].T, atol=1e-9)


@given(first=st.integers(20, 400), seconds=st.floats(0.01, 0.25))
def test_swing_is_filled_within_its_sd(first, seconds):
    last = first + round(seconds * SPLINE_RATE)
    truth = build_swing(noise=0.0003)
    filled, deviation, _ = fill_with_splines(remove_samples(truth, first, last), SPLINE_RATE, 0.5)
    gap = slice(first, last + 1)
    error = np.abs(filled - truth)[gap, 0]
    assert (error < 5 * deviation[gap]).all()
    assert np.isnan(filled[:first, 0]).all()
    assert np.isnan(filled[last + 1 :, 0]).all()


def test_deviation_of_quiet_samples_is_that_of_their_noise():
    truth = build_swing(noise=0.00015)
    filled, deviation, _ = fill_with_splines(remove_samples(truth, 200, 204), SPLINE_RATE, 0.5)
    assert (deviation[200:205, 0] > 0.0001).all()
    assert (deviation[200:205, 0] < 0.00028).all()
    assert (np.abs(filled - truth)[200:205, 0] < 5 * deviation[200:205, :1]).all()


def test_sd_grows_with_gap_duration():
    sds = [
        fill_with_splines(remove_samples(build_swing(), 200, 200 + n), SPLINE_RATE, 0.5)[1][200 + n // 2, 0]
        for n in (11, 23, 35, 47)
    ]
    assert sds == sorted(sds)
    assert sds[-1] > 4 * sds[0]


def test_random_missing_samples_are_tolerated():
    truth = build_swing(noise=0.0003)
    damaged = truth.copy()
    damaged[np.random.default_rng(1).random(600) < 0.1, 0] = np.nan
    filled, deviation, _ = fill_with_splines(damaged, SPLINE_RATE, 0.5)
    done = ~np.isnan(deviation)
    assert done.sum() > 0.9 * np.isnan(damaged[..., 0]).sum()
    assert np.abs(filled - truth)[done].max() < 0.002


def test_one_outlier_at_the_edge_has_little_influence():
    truth = build_swing()
    damaged = remove_samples(truth, 200, 229)
    damaged[199, 0, 1] += 0.01
    filled, *_ = fill_with_splines(damaged, SPLINE_RATE, 0.5)
    assert np.abs(filled - truth)[200:230, 0].max() < 0.035  # 46 with the velocity of the last two samples alone


@pytest.mark.parametrize(
    ("first", "last", "why"), [(0, 20, "leading"), (580, 599, "trailing"), (100, 200, "long"), (2, 10, "too near the start")]
)
def test_unsuitable_gaps_are_not_filled(first, last, why):
    filled, deviation, _ = fill_with_splines(remove_samples(build_swing(), first, last), SPLINE_RATE, 0.5)
    assert np.isnan(filled).all(), why
    assert np.isnan(deviation).all()


def test_marker_with_few_complete_stretches_is_not_filled():
    assert np.isnan(fill_with_splines(remove_samples(build_swing(40), 12, 28), SPLINE_RATE, 0.5)[0]).all()


def test_gaps_of_one_pattern_are_filled_like_single_gaps():
    """A gap is filled from the samples beside it, also if other gaps have the same pattern."""
    truth = build_swing(noise=0.0003)
    damaged = truth.copy()
    firsts = [100, 200, 300, 301, 420]
    damaged[firsts, 0] = np.nan
    filled, *_ = fill_with_splines(damaged, SPLINE_RATE, 0.5)
    for first, last in ((100, 100), (200, 200), (300, 301), (420, 420)):
        across = interpolate(truth[first - 7 : last + 8, 0], last - first + 1, range(7)[::-1], range(7))[1]
        np.testing.assert_allclose(filled[first : last + 1, 0], across, atol=1e-12)


@given(seed=st.integers(0, 99), step=st.integers(1, 5))
def test_complete_stretches_show_all_frames(seed, step):
    rng = np.random.default_rng(seed)
    seen, used = rng.random(80) < 0.8, np.array([-3, -1, 0, 2])
    expected = [s for s in range(3, 78, step) if seen[s + used].all()]
    np.testing.assert_array_equal(find_complete_stretches(seen, used, step), expected)
