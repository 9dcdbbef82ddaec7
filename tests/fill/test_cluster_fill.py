import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.fill.cluster_fill import (
    compute_column_percentiles,
    compute_distance_changes,
    fill_from_clusters,
    regress_positions,
)

RATE = 100.0


def tumbling(seed=0, frames=400, size=5):
    """Return (T, M, 3): a rigid thing that turns and travels, and the turns that carry it."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames) / RATE
    turn = Rotation.from_rotvec(np.stack([np.sin(2 * t), 1.5 * np.cos(t), 0.8 * t], 1)).as_matrix()
    places = rng.normal(scale=0.1, size=(size, 3))
    return np.einsum("tab,mb->tma", turn, places) + np.stack([t, np.sin(t), 0 * t], 1)[:, None]


def without(markers, m, first, last):
    damaged = markers.copy()
    damaged[first : last + 1, m] = np.nan
    return damaged


@given(seed=st.integers(0, 99), first=st.integers(0, 250), length=st.integers(1, 149))
def test_rigid_cluster_recovers_its_marker(seed, first, length):
    """Leading and trailing gaps too."""
    truth = tumbling(seed)
    filled, deviation = fill_from_clusters(without(truth, 2, first, first + length - 1), RATE)
    gap = slice(first, first + length)
    assert np.abs(filled - truth)[gap, 2].max() < 5e-4
    assert (deviation[gap, 2] < 0.002).all()
    assert np.isnan(filled[~np.isin(np.arange(400), np.arange(first, first + length))]).all()


def test_hinge_motion_is_learned():
    """A marker that swings with another one of its neighbours is placed from it, not held where it is on average."""
    truth = tumbling(size=6)
    swing = 2.0 * np.sin(np.arange(400) / 9)[:, None] * (truth[:, 0] - truth[:, 1])
    truth[:, 4] += swing
    truth[:, 5] += 0.8 * swing
    filled, deviation = fill_from_clusters(without(truth, 5, 120, 219), RATE)
    error = np.sqrt(((filled - truth)[120:220, 5] ** 2).mean())
    assert error < 0.3 * np.sqrt((0.8 * swing[120:220] ** 2).mean())
    assert error < 3 * np.median(deviation[120:220, 5])


def test_edge_residual_is_interpolated():
    truth = tumbling()
    truth[150:250, 2, 1] += 0.004  # the marker slipped, and slipped back
    filled, _ = fill_from_clusters(without(truth, 2, 190, 200), RATE)
    assert np.abs(filled - truth)[190:201, 2].max() < 0.0015


def test_independent_markers_are_not_used():
    rng = np.random.default_rng(0)
    loose = rng.normal(size=(400, 6, 3)).cumsum(0)
    assert np.isnan(fill_from_clusters(without(loose, 2, 100, 120), RATE)[0]).all()


@pytest.mark.parametrize("others", [0, 1, 2])
def test_three_other_markers_are_required(others):
    damaged = without(tumbling(size=others + 1), 0, 100, 120)
    assert np.isnan(fill_from_clusters(damaged, RATE)[0]).all()


@pytest.mark.parametrize("frames", [0, 1, 2, 29])
def test_few_frames_fill_nothing(frames):
    damaged = tumbling(frames=60)
    damaged[frames:, 1] = np.nan
    assert np.isnan(fill_from_clusters(damaged, RATE)[0]).all()
    assert np.isnan(fill_from_clusters(np.full((frames, 3, 3), np.nan), RATE)[0]).all()


def test_distances_are_constant_within_a_rigid_body_only():
    markers = np.concatenate([tumbling(size=2), np.zeros((400, 1, 3))], 1)
    change = compute_distance_changes(markers)
    assert change[0, 1] < 1e-9
    assert change[0, 2] > 0.5
    assert np.isinf(np.diag(change)).all()


@given(seed=st.integers(0, 99), share=st.floats(0, 1))
def test_column_percentiles_equal_numpy(seed, share):
    rng = np.random.default_rng(seed)
    numbers = rng.normal(size=(20, 4))
    numbers[rng.random((20, 4)) < 0.3] = np.nan
    numbers[1:, 3] = np.nan  # too few
    expected = [np.nanpercentile(column, 100 * share) for column in numbers.T[:3]]
    found = compute_column_percentiles(np.sort(numbers, axis=0), share)
    np.testing.assert_allclose(found, [*expected, np.inf], atol=1e-12)


def test_extrapolation_is_less_certain_than_interpolation():
    rng = np.random.default_rng(0)
    learned = rng.normal(scale=0.01, size=(300, 3))
    deformation = np.concatenate([learned, 0.5 * learned[:5], 20 * learned[:5]])
    measured = learned @ rng.normal(size=(3, 3)) + rng.normal(scale=0.001, size=(300, 3))
    _, _, inflation = regress_positions(deformation, measured, 10.0)
    assert (inflation[300:305] < 1.1).all()
    assert (inflation[305:] > 1.9).all()
    _, _, independent = regress_positions(deformation, measured, 1.0)  # the more frames are independent, the more is known
    assert (independent[305:] < inflation[305:]).all()
