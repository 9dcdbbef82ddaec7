"""Rigid groups of markers."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.stats.marker_distances import find_prop_groups, find_rigid_groups, measure_distance_spread

FRAMES = 120


def move_rigidly(shape: np.ndarray, seed: int) -> np.ndarray:
    """Return a rigid shape (K, 3) in motion (T, K, 3)."""
    rng, time = np.random.default_rng(seed), np.linspace(0, 2 * np.pi, FRAMES)
    rotation = Rotation.from_rotvec(np.outer(np.sin(time), rng.normal(size=3))).as_matrix()
    return np.einsum("tab,kb->tka", rotation, shape) + np.outer(np.cos(time), rng.normal(size=3))[:, None]


@pytest.fixture
def markers() -> np.ndarray:
    """Return a box of five markers, a board of four, and three markers that move alone."""
    rng = np.random.default_rng(0)
    box, board = (move_rigidly(rng.normal(0, 0.2, (count, 3)), seed) for seed, count in ((1, 5), (2, 4)))
    loose = [move_rigidly(rng.normal(0, 0.2, (1, 3)), seed) for seed in (3, 4, 5)]
    return np.concatenate([box, board, *loose], axis=1) + rng.normal(0, 0.0002, (FRAMES, 12, 3))


def test_rigid_groups_are_found(markers):
    groups = find_rigid_groups(measure_distance_spread(markers))
    assert [group.markers for group in groups] == [(0, 1, 2, 3, 4), (5, 6, 7, 8)]
    assert all(group.spread_m < 0.001 < 0.02 < group.motion_m for group in groups)


def test_order_and_gaps_do_not_matter(markers):
    order = np.random.default_rng(1).permutation(12)
    shuffled = markers[:, order].copy()
    shuffled[np.random.default_rng(2).random(shuffled.shape[:2]) < 0.3] = np.nan
    found = {frozenset(order[list(group.markers)].tolist()) for group in find_rigid_groups(measure_distance_spread(shuffled))}
    assert found == {frozenset(range(5)), frozenset(range(5, 9))}


def test_markers_at_rest_are_no_rigid_groups(markers):
    at_rest = np.tile(markers[:1], (FRAMES, 1, 1))
    moving = np.concatenate([at_rest[:, :9], at_rest[:, 9:] + 0.005 * markers[:, 9:]], axis=1)
    groups = find_rigid_groups(measure_distance_spread(moving))
    assert groups == ()


def test_groups_with_markers_of_the_body_are_no_props(markers):
    is_on_body = np.zeros(12, bool)
    is_on_body[2] = True
    assert [group.markers for group in find_prop_groups(measure_distance_spread(markers), is_on_body)] == [(5, 6, 7, 8)]


def test_markers_that_are_never_visible_together_have_no_spread():
    markers = np.zeros((40, 2, 3))
    markers[:20, 0], markers[20:, 1] = np.nan, np.nan
    assert np.isinf(measure_distance_spread(markers)).all()
