import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.fill.cluster_fill import MAX_DISTANCE_CHANGE_M
from mocapfix.fill.gap_estimates import choose_hidden_stretches
from mocapfix.fill.neighbour_clusters import (
    build_cluster_axes,
    estimate_by_regression,
    measure_distance_changes,
    select_configurations,
    select_regression_cluster,
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


def regress(damaged, m):
    """Return the regression's estimate of the only gap of marker `m`, or None."""
    missing = np.flatnonzero(np.isnan(damaged[:, m, 0]))
    change = measure_distance_changes(damaged)[m]
    order = [k for k in np.argsort(change, kind="stable") if change[k] < MAX_DISTANCE_CHANGE_M]
    cluster = select_regression_cluster(~np.isnan(damaged[..., 0]), m, np.array(order, int))
    window = choose_hidden_stretches(~np.isnan(damaged[:, m, 0]), int(missing[0]), int(missing[-1]), RATE)
    return estimate_by_regression(damaged, m, cluster, change[cluster], window, RATE) if len(cluster) >= 3 else None


@given(seed=st.integers(0, 99), first=st.integers(0, 250), length=st.integers(1, 149))
def test_rigid_cluster_recovers_its_marker(seed, first, length):
    """Leading and trailing gaps too."""
    truth = tumbling(seed)
    estimate = regress(without(truth, 2, first, first + length - 1), 2)
    assert estimate is not None
    assert np.abs(estimate.position - truth[first : first + length, 2]).max() < 5e-4
    assert (estimate.expected_sd < 0.002).all()
    assert np.nanmax(np.abs(estimate.error), initial=0) < 5e-4


def test_hinge_motion_is_learned():
    """A marker that swings with another one of its neighbours is placed from it, not held where it is on average."""
    truth = tumbling(size=6)
    swing = 2.0 * np.sin(np.arange(400) / 9)[:, None] * (truth[:, 0] - truth[:, 1])
    truth[:, 4] += swing
    truth[:, 5] += 0.8 * swing
    damaged = without(truth, 5, 120, 219)
    change = np.full(5, 0.01)
    window = choose_hidden_stretches(~np.isnan(damaged[:, 5, 0]), 120, 219, RATE)
    estimate = estimate_by_regression(damaged, 5, np.arange(5), change, window, RATE)
    assert estimate is not None
    error = np.sqrt(((estimate.position - truth[120:220, 5]) ** 2).mean())
    assert error < 0.3 * np.sqrt((0.8 * swing[120:220] ** 2).mean())
    assert error < 3 * np.sqrt(np.nanmean(estimate.error**2))


def test_edge_residual_is_interpolated():
    truth = tumbling()
    truth[150:250, 2, 1] += 0.004  # the marker slipped, and slipped back
    estimate = regress(without(truth, 2, 190, 200), 2)
    assert estimate is not None
    assert np.abs(estimate.position - truth[190:201, 2]).max() < 0.0015


def test_independent_markers_are_not_used():
    loose = np.random.default_rng(0).normal(size=(400, 6, 3)).cumsum(0)
    assert regress(without(loose, 2, 100, 120), 2) is None


def test_neighbours_that_leave_too_few_frames_are_not_used():
    """Looser and rarely visible neighbours do not keep a rigid cluster from being used."""
    visible = np.ones((400, 8), bool)
    visible[:380, 6] = visible[100:, 7] = False
    np.testing.assert_array_equal(select_regression_cluster(visible, 0, np.array([6, 1, 2, 7, 3])), [1, 2, 3])


@pytest.mark.parametrize("frames", [0, 1, 2, 29])
def test_few_frames_predict_nothing(frames):
    visible = np.ones((60, 4), bool)
    visible[frames:, 1] = False
    assert len(select_regression_cluster(visible, 1, np.array([0, 2, 3]))) == 0


def test_axes_follow_a_rigid_cluster():
    truth = tumbling()
    axes = build_cluster_axes(truth, np.array([0, 1, 2, 3]), np.zeros(4), np.arange(400))
    assert axes is not None
    local = axes.transform_from_world(truth[:, 4])
    np.testing.assert_allclose(local, np.broadcast_to(local[0], local.shape), atol=1e-9)
    assert build_cluster_axes(np.full((5, 3, 3), np.nan), np.arange(3), np.zeros(3), np.arange(5)) is None


def test_configurations_are_those_of_motion():
    """In a take that is at rest for nine tenths of the time, most frames are of the motion."""
    t = np.r_[np.zeros(900), np.linspace(0, 3, 100)]
    frames = select_configurations(np.stack([np.sin(t), np.cos(t), t], 1)[:, None])
    assert (frames >= 900).mean() > 0.5
    still = select_configurations(np.zeros((50, 2, 3)))
    assert (np.diff(still) > 0).all()
    assert still[-1] == 49


def test_distances_are_constant_within_a_rigid_body_only():
    markers = np.concatenate([tumbling(size=2), np.zeros((400, 1, 3))], 1)
    change = measure_distance_changes(markers)
    assert change[0, 1] < 1e-9
    assert change[0, 2] > 0.5
    assert np.isinf(np.diag(change)).all()


def test_nearest_markers_count_as_the_steadiest_of_one_that_is_hardly_visible():
    markers = tumbling()
    markers[5:, 0] = np.nan
    change = measure_distance_changes(markers)
    distance = np.linalg.norm(markers[0] - markers[0, 0], axis=-1)
    assert (np.argsort(change[0])[:4] == np.argsort(distance)[1:]).all()
    assert np.isinf(change[0, 0])
    assert np.isinf(change[1:, 0]).all()
    markers[:, 0] = np.nan
    assert np.isinf(measure_distance_changes(markers)[0]).all()
