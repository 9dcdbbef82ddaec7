"""Where a marker lies among its neighbours, and what of that joints, skin and their own shape do not explain.

The markers that keep their distance to a marker best make a frame of axes by weighted registration. In it the marker would
rest if all were rigid. As they are not, how their own shape changes tells, by a ridge regression, where the marker goes with
a joint's angle. What is left wanders by millimetres, unless the marker is moved.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from mocapfix.kernels.rigid import centred, fitted, inside

MOST = 6  # neighbours asked
LOOSE = 0.06  # metres: a distance that usually changes by more in a second tells nothing
STEADY = 0.003  # metres: by which even a distance on one segment changes
FAR = 0.15  # metres: a marker farther from its usual place is not moved but lost, and heard as if it were so far
RIDGE = 0.003  # metres: a change of the neighbours' own shape that means nothing
LEARNING = 100  # frames, evenly spread, from which the mean shape is learnt
LEAST = 20  # frames in which a place must be told


class Place(NamedTuple):
    """A marker's place among its neighbours in the N frames in which it can be told.

    off        (N, 3) metres from its usual place, in the neighbours' axes
    explained  (N, F) what the neighbours' own shape can explain, and a constant: orthonormal but for the ridge
    left       (N, 3) metres: what of `off` they leave
    frames     (N,) indices
    turn       (N, 3, 3) the neighbours' axes in the world
    """

    off: np.ndarray
    explained: np.ndarray
    left: np.ndarray
    frames: np.ndarray
    turn: np.ndarray


def near(loose: np.ndarray, marker: int) -> np.ndarray:
    """-> the markers (K,) that keep their distance to a marker best, by their `looseness` (M, M); at most MOST."""
    order = np.argsort(loose[marker], kind="stable")[:MOST]
    return order[loose[marker, order] < LOOSE]


def axes(cluster: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """-> what a cluster (T, K, 3) departs from its mean shape, turn (T, 3, 3) and centre (T, 3) of its axes, by weight (K,).

    A marker that is not seen is not asked, and NaN; the axes of a frame with fewer than three mean nothing.
    """
    weights = weight * ~np.isnan(cluster[..., 0])
    shape = cluster[weights.sum(1).argmax()]
    weights[:, np.isnan(shape[:, 0])] = 0
    some = np.unique(np.linspace(0, len(cluster) - 1, LEARNING).astype(int))
    for rows in (some, some, np.arange(len(cluster))):
        cross, here, there = centred(cluster[rows], shape, weights[rows])
        turn = fitted(cross)
        centre = here - np.einsum("tab,tb->ta", turn, there)
        own = np.where(weights[rows, :, None] > 0, inside(cluster[rows], centre, turn), np.nan)
        if rows is some:
            count = np.maximum((weights[rows] > 0).sum(0), 1)
            shape = np.nansum(own, axis=0) / count[:, None]
    return own - shape, turn, centre


def path_among(markers: np.ndarray, marker: int, loose: np.ndarray) -> np.ndarray:
    """-> (T, 3) metres: the marker in its neighbours' axes, NaN where it or all but two of them are not seen."""
    return _among(markers, marker, loose)[0]


def _among(markers: np.ndarray, marker: int, loose: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """-> the marker's path, its neighbours' departures (T, K, 3) from their mean shape, their turn (T, 3, 3)."""
    asked = near(loose, marker)
    own, turn, centre = axes(markers[:, asked], 1 / (loose[marker, asked] ** 2 + STEADY**2))
    path = inside(markers[:, marker, None], centre, turn)[:, 0]
    path[(~np.isnan(own[..., 0])).sum(1) < 3] = np.nan
    return path, own, turn


def place(markers: np.ndarray, marker: int, loose: np.ndarray) -> Place | None:
    """-> the marker's place among its neighbours, None where it cannot be told in LEAST frames.

    markers  (T, M, 3) metres, NaN where not believed; loose  (M, M) metres, as neighbours.looseness
    """
    if len(near(loose, marker)) < 3:
        return None
    path, own, turn = _among(markers, marker, loose)
    frames = np.flatnonzero(~np.isnan(path[:, 0]))
    if len(frames) < LEAST:
        return None
    off = median_filter(path[frames], (3, 1), mode="nearest")
    off -= np.median(off, axis=0)
    off *= np.minimum(1, FAR / np.maximum(np.linalg.norm(off, axis=1), FAR))[:, None]
    explained = span(np.nan_to_num(own[frames]).reshape(len(frames), -1))
    return Place(off, explained, off - explained @ (explained.T @ off), frames, turn[frames])


def span(features: np.ndarray) -> np.ndarray:
    """-> (N, 1 + F): what a ridge regression on features (N, F) and a constant can explain."""
    count = len(features)
    u, size, _ = np.linalg.svd(features - features.mean(0), full_matrices=False)
    gain = size**2 / (size**2 + count * RIDGE**2)
    return np.column_stack([np.full(count, count**-0.5), u * np.sqrt(gain)])
