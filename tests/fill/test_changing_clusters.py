"""Axes of clusters whose members come and go within a gap."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.fill.edge_interpolation import estimate_from_edges
from mocapfix.fill.gap_estimates import choose_hidden_stretches, estimate_without_body
from mocapfix.fill.neighbour_clusters import (
    ChangingCluster,
    build_changing_axes,
    remove_steps,
    select_changing_cluster,
)
from tests.fill.test_neighbour_clusters import RATE, tumbling

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
    found = estimate_from_edges(damaged[:, 6], axes, window, RATE, 1.0)
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
    path = np.where(is_known[:, 6, None], damaged[:, 6], np.nan)
    for each in estimate_from_edges(path, axes, window, RATE, 1.0):
        moved = remove_steps(each, cluster, window).position - each.position
        np.testing.assert_allclose(moved[-1], 0.0, atol=2e-4)
        if has_first_edge:
            np.testing.assert_allclose(moved[0], 0.0, atol=2e-4)


def test_fill_uses_a_changing_cluster_where_no_other_is_as_near():
    """Six markers on a box, and four that move independently of it and are visible throughout."""
    truth = np.concatenate([tumbling(2, size=7), 3 * tumbling(5, size=4)], axis=1)
    damaged = hide(truth, 40, 60)
    estimated = estimate_without_body(damaged, ~np.isnan(damaged[..., 0]), RATE)
    assert np.linalg.norm(estimated.position[GAP, 6] - truth[GAP, 6], axis=1).max() < 0.01
