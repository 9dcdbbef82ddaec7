from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.fill.edge_interpolation import interpolate_in_axes
from mocapfix.fill.gap_estimates import estimate_missing_samples
from mocapfix.fill.gap_windows import choose_hidden_stretches, select_visible_together
from mocapfix.fill.neighbour_clusters import (
    ChangingCluster,
    ClusterInterpolation,
    NeighbourRegression,
    build_changing_axes,
    build_cluster_axes,
    measure_distance_changes,
    remove_steps,
    select_changing_cluster,
    select_configurations,
)
from tests.fill.gap_examples import RATE, build_gap, build_take


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
    take = build_take(damaged)
    found = NeighbourRegression(take)(build_gap(take, m, int(missing[0]), int(missing[-1])))
    return found[0] if found else None


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
    take = replace(build_take(without(truth, 5, 120, 219)), distance_change_m=np.full((6, 6), 0.01))
    [estimate] = NeighbourRegression(take)(build_gap(take, 5, 120, 219))
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
    np.testing.assert_array_equal(select_visible_together(visible, 0, np.array([6, 1, 2, 7, 3]), 30, 12)[0], [1, 2, 3])


@pytest.mark.parametrize("frames", [0, 1, 2, 29])
def test_few_frames_predict_nothing(frames):
    visible = np.ones((60, 4), bool)
    visible[frames:, 1] = False
    assert not select_visible_together(visible, 1, np.array([0, 2, 3]), 30, 12)[0]


def test_axes_follow_a_rigid_cluster():
    truth = tumbling()
    axes = build_cluster_axes(build_take(truth), np.array([0, 1, 2, 3]), np.zeros(4), np.arange(400))
    assert axes is not None
    local = axes.transform_from_world(truth[:, 4])
    np.testing.assert_allclose(local, np.broadcast_to(local[0], local.shape), atol=1e-9)
    assert build_cluster_axes(build_take(np.full((5, 3, 3), np.nan)), np.arange(3), np.zeros(3), np.arange(5)) is None


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


def test_a_deformation_that_was_not_learned_is_less_certain():
    """A marker that moves with another one, which moves ten times as far in the gap as where the marker is visible."""
    sds: list[float] = []
    for size in (1.0, 10.0):
        truth = tumbling(size=6)
        swing = 0.2 * np.sin(np.arange(400) / 9)[:, None] * (truth[:, 0] - truth[:, 1])
        swing[120:220] *= size
        truth[:, 4] += swing
        truth[:, 5] += 0.8 * swing + np.random.default_rng(0).normal(scale=0.001, size=swing.shape)
        take = replace(build_take(without(truth, 5, 120, 219)), distance_change_m=np.full((6, 6), 0.01))
        [estimate] = NeighbourRegression(take)(build_gap(take, 5, 120, 219))
        sds.append(float(estimate.expected_sd.max()))
    assert sds[1] > 1.5 * sds[0]


def test_markers_on_one_rigid_body_are_interpolated_exactly():
    truth = tumbling(size=12)
    take = build_take(without(truth, 5, 120, 219))
    found = ClusterInterpolation(take)(build_gap(take, 5, 120, 219))
    assert {each.axes for each in found} == {"4 neighbours", "8 neighbours"}
    for each in found:
        np.testing.assert_allclose(each.position, truth[120:220, 5], atol=1e-6)
        assert np.abs(each.error).max() < 1e-6


FIRST, LENGTH = 150, 100
GAP = slice(FIRST, FIRST + LENGTH)
CHANGE_M = np.array([0.001, 0.001, 0.001, 0.001, 0.001, 0.001, np.inf])


def hide(truth: np.ndarray, first_change: int, last_change: int) -> np.ndarray:
    """Hide marker 6 in the gap; markers 0 to 2 from one frame of the gap, 3 to 5 until another one."""
    damaged = truth.copy()
    damaged[GAP, 6] = np.nan
    damaged[FIRST + last_change : FIRST + LENGTH, :3] = np.nan
    damaged[FIRST : FIRST + first_change, 3:6] = np.nan
    return damaged


def estimate(damaged: np.ndarray, *, is_smooth: bool = True) -> list[np.ndarray]:
    """Return the positions in the gap by all methods of interpolation, and the errors in hidden stretches."""
    is_known = ~np.isnan(damaged[..., 0])
    window = choose_hidden_stretches(is_known[:, 6], FIRST, FIRST + LENGTH - 1, RATE)
    cluster = select_changing_cluster(is_known, CHANGE_M, window, 8)
    assert cluster is not None
    axes = build_changing_axes(damaged, cluster, window, np.arange(len(damaged)))
    assert axes is not None
    gap = build_gap(build_take(damaged), 6, FIRST, FIRST + LENGTH - 1)
    found = interpolate_in_axes(damaged[:, 6], axes, gap, RATE, "changing")
    return [(remove_steps(each, cluster, window) if is_smooth else each).position for each in found]


@given(seed=st.integers(0, 99), first=st.integers(1, 60), overlap=st.integers(0, 39))
def test_rigid_cluster_places_its_marker_although_no_member_is_visible_throughout(seed, first, overlap):
    truth = tumbling(seed, size=7)
    for position in estimate(hide(truth, first, first + overlap)):
        # Steps are told from motion by the neighbouring frames, whose velocities differ by the acceleration.
        assert np.abs(position - truth[GAP, 6]).max() < 0.003


def test_estimate_has_no_steps_where_the_members_change():
    truth = tumbling(3, size=7)
    truth[:, 3:6] += np.linspace(0.0, 0.02, len(truth))[:, None, None]  # half of the cluster slides along
    damaged = hide(truth, 50, 50)
    plain, smooth = (np.diff(estimate(damaged, is_smooth=each)[0], 2, axis=0) for each in (False, True))
    natural = np.abs(np.diff(truth[GAP, 6], 2, axis=0)).max()
    assert np.abs(plain).max() > 5 * natural
    assert np.abs(smooth).max() < 2 * natural


def test_no_changing_cluster_where_members_stay_or_too_few_are_visible():
    truth = tumbling(size=7)
    window = choose_hidden_stretches(np.arange(len(truth)) >= FIRST + LENGTH, FIRST, FIRST + LENGTH - 1, RATE)
    for damaged in (hide(truth, 0, LENGTH), hide(truth, 60, 40)):
        assert select_changing_cluster(~np.isnan(damaged[..., 0]), CHANGE_M, window, 8) is None


@pytest.mark.parametrize("has_first_edge", [True, False])
def test_edges_of_the_gap_stay_where_they_are(has_first_edge):
    truth = tumbling(1, size=7)
    damaged = hide(truth, 30, 60)
    is_known = ~np.isnan(damaged[..., 0])
    is_known[:FIRST, 6] &= has_first_edge
    window = choose_hidden_stretches(is_known[:, 6], FIRST, FIRST + LENGTH - 1, RATE)
    cluster = ChangingCluster(np.arange(6), is_known[GAP, :6])
    axes = build_changing_axes(damaged, cluster, window, np.arange(len(damaged)))
    assert axes is not None
    path = np.where(is_known[:, 6, None], damaged[:, 6], np.nan)
    gap = build_gap(build_take(np.where(is_known[..., None], damaged, np.nan)), 6, FIRST, FIRST + LENGTH - 1)
    for each in interpolate_in_axes(path, axes, gap, RATE, "changing"):
        moved = remove_steps(each, cluster, window).position - each.position
        np.testing.assert_allclose(moved[-1], 0.0, atol=2e-4)
        if has_first_edge:
            np.testing.assert_allclose(moved[0], 0.0, atol=2e-4)


def test_fill_uses_a_changing_cluster_where_no_other_is_as_near():
    """Six markers on a box, and four that move independently of it and are visible throughout."""
    truth = np.concatenate([tumbling(2, size=7), 3 * tumbling(5, size=4)], axis=1)
    damaged = hide(truth, 40, 60)
    estimated = next(estimate_missing_samples(damaged, RATE))
    assert np.linalg.norm(estimated.position[GAP, 6] - truth[GAP, 6], axis=1).max() < 0.01
