"""Takes without labels, made of takes whose labels are known: trajectories in random order, ghosts, and points in no order.

Trajectories end where a marker is lost, and at random besides, as cameras lose and find markers again. The random damage per
frame is the test noise of SOMA (Ghorbani & Black 2021): per frame a few markers are missing, a few ghosts are drawn from a
normal distribution about the body, and the columns are permuted; in the harder variant a number of trajectories are broken too.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from mocapfix.stats.sequences import find_runs

UnlabelledKind = Literal["tracks", "ghosts", "cloud", "noise", "broken"]
"""trajectories; with ghosts; points in random order in each frame; random damage per frame; the same with broken trajectories"""

TRAJECTORY_LIFE_S = 20.0  # mean time until a trajectory is cut at random
CUT_DURATION_S = (0.02, 0.3)  # for which the marker is lost at a cut
GHOST_INTERVAL_S = 2.0  # mean time between ghosts
GHOST_DURATION_S = (0.05, 1.0)
GHOST_DISTANCE_M = (0.1, 0.5)  # from the marker that a ghost follows
MAX_FRAME_OCCLUSIONS = 4  # markers missing at random in a frame
MAX_FRAME_GHOSTS = 3  # ghosts drawn at random in a frame
BROKEN_TRAJECTORIES = 50
MIN_BROKEN_S = 0.05  # shortest piece of a broken trajectory


@dataclass(frozen=True)
class UnlabelledTake:
    """Points without labels, and what they show.

    points          (T, C, 3) metres, NaN where missing
    marker_indices  (T, C) index of the marker that each point shows, -1 for a ghost or where there is no point
    rate            Hz
    """

    points: Float[np.ndarray, "T C 3"]
    marker_indices: Int[np.ndarray, "T C"]
    rate: float


def remove_labels(kind: UnlabelledKind, markers: Float[np.ndarray, "T M 3"], rate: float, seed: int = 0) -> UnlabelledTake:
    """Return the points of markers (metres, NaN where missing) without their labels; the same for the same arguments."""
    rng = np.random.default_rng(seed)
    if kind in ("noise", "broken"):
        return _add_frame_noise(rng, markers, rate, BROKEN_TRAJECTORIES if kind == "broken" else 0)
    take = _cut_trajectories(rng, markers, rate)
    if kind == "ghosts":
        take = _add_ghosts(rng, take, markers)
    return _shuffle_frames(rng, take, markers.shape[1]) if kind == "cloud" else _permute_columns(rng, take)


def _cut_trajectories(rng: np.random.Generator, markers: np.ndarray, rate: float) -> UnlabelledTake:
    """Return a column for each trajectory: the runs in which a marker is visible, cut at random."""
    pieces: list[tuple[int, int, int]] = []
    for m in range(markers.shape[1]):
        for first, last in find_runs(~np.isnan(markers[:, m, 0])):
            start = first
            while start <= last:
                end = min(last, start + max(2, round(rng.exponential(TRAJECTORY_LIFE_S) * rate)))
                pieces.append((m, start, end))
                start = end + 1 + max(1, round(rng.uniform(*CUT_DURATION_S) * rate))
    points = np.full((len(markers), len(pieces), 3), np.nan)
    marker_indices = np.full(points.shape[:2], -1)
    for column, (m, first, last) in enumerate(pieces):
        points[first : last + 1, column] = markers[first : last + 1, m]
        marker_indices[first : last + 1, column] = m
    return UnlabelledTake(points, marker_indices, rate)


def _add_ghosts(rng: np.random.Generator, take: UnlabelledTake, markers: np.ndarray) -> UnlabelledTake:
    """Add columns with points that follow a marker at a constant distance for a while."""
    frame_count, ghosts = len(markers), list[np.ndarray]()
    for _ in range(rng.poisson(frame_count / take.rate / GHOST_INTERVAL_S)):
        length = min(frame_count, max(2, round(rng.uniform(*GHOST_DURATION_S) * take.rate)))
        first, direction = int(rng.integers(0, frame_count - length + 1)), rng.normal(size=3)
        offset = direction / np.linalg.norm(direction) * rng.uniform(*GHOST_DISTANCE_M)
        ghost = np.full((frame_count, 3), np.nan)
        ghost[first : first + length] = markers[first : first + length, rng.integers(markers.shape[1])] + offset
        if not np.isnan(ghost[first : first + length]).any():
            ghosts.append(ghost)
    return _append_columns(take, np.stack(ghosts, 1)) if ghosts else take


def _append_columns(take: UnlabelledTake, points: np.ndarray) -> UnlabelledTake:
    """Add points (T, N, 3) that are no markers."""
    marker_indices = np.full(points.shape[:2], -1)
    return replace(
        take,
        points=np.concatenate([take.points, points], 1),
        marker_indices=np.concatenate([take.marker_indices, marker_indices], 1),
    )


def _permute_columns(rng: np.random.Generator, take: UnlabelledTake) -> UnlabelledTake:
    order = rng.permutation(take.points.shape[1])
    return replace(take, points=take.points[:, order], marker_indices=take.marker_indices[:, order])


def _shuffle_frames(rng: np.random.Generator, take: UnlabelledTake, column_count: int) -> UnlabelledTake:
    """Return the points of each frame in random order in at most `column_count` columns."""
    points = np.full((len(take.points), column_count, 3), np.nan)
    marker_indices = np.full(points.shape[:2], -1)
    for t in range(len(points)):
        present = np.flatnonzero(~np.isnan(take.points[t, :, 0]))
        columns = rng.permutation(column_count)[: len(present)]
        points[t, columns], marker_indices[t, columns] = take.points[t, present], take.marker_indices[t, present]
    return UnlabelledTake(points, marker_indices, take.rate)


def _add_frame_noise(rng: np.random.Generator, markers: np.ndarray, rate: float, broken_count: int) -> UnlabelledTake:
    """Return the markers in random columns with random occlusions and ghosts in each frame, and with broken trajectories."""
    frame_count, marker_count = markers.shape[:2]
    points, ghosts = markers.copy(), np.full((frame_count, MAX_FRAME_GHOSTS, 3), np.nan)
    for t in range(frame_count):
        points[t, rng.permutation(marker_count)[: rng.integers(MAX_FRAME_OCCLUSIONS + 1)]] = np.nan
        present = markers[t][~np.isnan(markers[t, :, 0])]
        count = rng.integers(MAX_FRAME_GHOSTS + 1) if len(present) > 1 else 0
        ghosts[t, rng.permutation(MAX_FRAME_GHOSTS)[:count]] = rng.multivariate_normal(
            np.median(present, axis=0) if len(present) else np.zeros(3), np.cov(present.T) if count else np.eye(3), count
        )
    marker_indices = np.where(np.isnan(points[..., 0]), -1, np.arange(marker_count))
    pieces, piece_indices = [points], [marker_indices]
    for _ in range(broken_count):
        m, first = int(rng.integers(marker_count)), int(rng.integers(frame_count))
        last = min(frame_count - 1, first + max(round(MIN_BROKEN_S * rate), int(rng.integers(1, frame_count // 2 + 2))))
        piece, index = np.full((frame_count, 1, 3), np.nan), np.full((frame_count, 1), -1)
        piece[first : last + 1, 0], index[first : last + 1, 0] = points[first : last + 1, m], marker_indices[first : last + 1, m]
        points[first : last + 1, m], marker_indices[first : last + 1, m] = np.nan, -1
        pieces.append(piece)
        piece_indices.append(index)
    take = UnlabelledTake(np.concatenate(pieces, 1), np.concatenate(piece_indices, 1), rate)
    return _permute_columns(rng, _append_columns(take, ghosts))
