"""Points linked into tracklets: permuted columns, crossings, gaps, ghosts, and columns that change their content."""

import numpy as np
import pytest

from mocapfix.labels.tracklets import UnlabelledPoints, are_points_unordered, cut_columns, find_tracklets, link_points
from mocapfix.synthetic import compose_take

RATE = 120.0


def permute_columns(positions: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of each frame in random order, and the column (T, C) that each came from."""
    rng = np.random.default_rng(seed)
    order = np.stack([rng.permutation(positions.shape[1]) for _ in positions])
    return np.take_along_axis(positions, order[..., None], axis=1), order


def compute_purity(points: UnlabelledPoints, source: np.ndarray) -> float:
    """Return the share of points whose tracklet mostly shows their source."""
    is_point = points.tracklet_indices >= 0
    count = np.zeros((points.tracklet_count, source.max() + 1), int)
    np.add.at(count, (points.tracklet_indices[is_point], source[is_point]), 1)
    return count.max(1).sum() / count.sum()


@pytest.fixture(scope="module")
def moving_body() -> np.ndarray:
    return compose_take(3, 10.0, RATE).marker_positions


def test_permuted_points_of_a_moving_body_are_one_tracklet_a_marker(moving_body: np.ndarray) -> None:
    shuffled, source = permute_columns(moving_body)
    points = find_tracklets(shuffled, RATE)
    assert points.tracklet_count == moving_body.shape[1]
    assert compute_purity(points, source) == 1


def test_noise_and_random_occlusions_leave_tracklets_pure(moving_body: np.ndarray) -> None:
    rng = np.random.default_rng(1)
    damaged = moving_body + rng.normal(0, 0.001, moving_body.shape)
    damaged[rng.random(damaged.shape[:2]) < 0.05] = np.nan
    shuffled, source = permute_columns(damaged)
    points = link_points(shuffled, RATE)
    assert compute_purity(points, source) > 0.9999
    assert points.tracklet_count < 4 * moving_body.shape[1]


def test_points_that_cross_at_a_distance_are_followed() -> None:
    t = np.arange(120) / RATE
    lines = np.stack([np.stack([t - 0.5, 0 * t, 0 * t], 1), np.stack([0.5 - t, 0 * t + 0.01, 0 * t], 1)], 1)
    shuffled, source = permute_columns(lines)
    points = link_points(shuffled, RATE)
    assert points.tracklet_count == 2
    assert compute_purity(points, source) == 1


def test_tracklets_end_where_two_points_part_in_one_place() -> None:
    t = np.arange(120) / RATE
    apart = np.maximum(0.0, t - 0.5)  # both at rest 1 mm apart, then one of them leaves: either may
    lines = np.zeros((120, 2, 3))
    lines[:, 1, 2] = 0.0001
    lines[60:, 0, 0] = -apart[60:]
    lines[60:, 1, 0] = apart[60:]
    shuffled, source = permute_columns(lines)
    points = link_points(shuffled, RATE)
    assert compute_purity(points, source) > 0.5
    first, last = points.tracklet_indices[0], points.tracklet_indices[-1]
    assert set(first.tolist()).isdisjoint(last.tolist())


def test_tracklets_continue_after_short_gaps_and_end_at_long_ones() -> None:
    t = np.arange(240) / RATE
    positions = np.stack([np.sin(3 * t), np.cos(2 * t), t], 1)[:, None]
    positions[60:66] = np.nan
    assert find_tracklets(positions, RATE).tracklet_count == 1
    positions[120:150] = np.nan
    assert find_tracklets(positions, RATE).tracklet_indices[[119, 150], 0].tolist() == [0, 1]


def test_a_point_far_from_where_another_went_is_a_tracklet_of_its_own() -> None:
    positions = np.zeros((60, 1, 3))
    positions[30:, 0, 0] = 0.1  # after 5 missing frames, 0.1 m off
    positions[30:35] = np.nan
    assert cut_columns(positions, RATE).tracklet_indices[[29, 35], 0].tolist() == [0, 1]


def test_columns_that_exchange_their_content_are_followed(moving_body: np.ndarray) -> None:
    positions, source = moving_body.copy(), np.tile(np.arange(moving_body.shape[1]), (len(moving_body), 1))
    positions[500:, [3, 8]] = positions[500:, [8, 3]]
    source[500:, [3, 8]] = source[500:, [8, 3]]
    points = find_tracklets(positions, RATE)
    assert compute_purity(points, source) == 1
    assert points.tracklet_count == moving_body.shape[1]


def test_ghosts_of_one_frame_are_tracklets_of_one_point(moving_body: np.ndarray) -> None:
    ghosts = np.full((len(moving_body), 1, 3), np.nan)
    ghosts[::20, 0] = np.random.default_rng(2).normal(moving_body.mean((0, 1)), 0.5, (len(ghosts[::20]), 3))
    shuffled, source = permute_columns(np.concatenate([moving_body, ghosts], 1))
    points = link_points(shuffled, RATE)
    is_ghost = (source == moving_body.shape[1]) & (points.tracklet_indices >= 0)
    assert (np.bincount(points.tracklet_indices[is_ghost])[points.tracklet_indices[is_ghost]] <= 2).all()
    assert points.tracklet_count <= moving_body.shape[1] + is_ghost.sum()


def test_tracklets_are_numbered_by_their_first_frames(moving_body: np.ndarray) -> None:
    moving_body = moving_body.copy()
    moving_body[:200, 5] = np.nan
    points = find_tracklets(moving_body, RATE)
    first = [np.flatnonzero((points.tracklet_indices == n).any(1))[0] for n in range(points.tracklet_count)]
    assert first == sorted(first)
    assert ((points.tracklet_indices >= 0) == ~np.isnan(moving_body[..., 0])).all()


def test_only_permuted_points_are_unordered(moving_body: np.ndarray) -> None:
    assert not are_points_unordered(moving_body)
    assert are_points_unordered(permute_columns(moving_body)[0])


@pytest.mark.parametrize("shape", [(0, 3, 3), (5, 0, 3), (1, 2, 3), (5, 2, 3)])
def test_takes_without_points_have_no_tracklets(shape: tuple[int, ...]) -> None:
    assert find_tracklets(np.full(shape, np.nan), RATE).tracklet_count == 0
