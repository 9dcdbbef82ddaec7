"""The root's place and turn, frame by frame, by registering what it carries; from the frames around where that is too little."""

import numpy as np

from mocapfix.initialise.bones import Root
from mocapfix.kernels.rigid import centred, fitted

ENOUGH = 3  # places that tell a turn


def registered(
    carried: Root, points: np.ndarray, variance: np.ndarray, refine: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """-> place (T, 3) metres and turn (T, 3, 3) of the root, and (T,) bool: whether the frame itself tells them.

    The rotation of least squares, never a reflection (HybrIK, appendix A, whose Eq. 33 does not rule it out).

    points    (T, Q, 3) metres, NaN where unknown; the first is the root
    variance  (T or 1, Q) m^2 per axis
    refine    whether the root's own place is fitted, too, or, where it is known, left as it is given
    """
    seen, frames = points[:, carried.source], len(points)
    known = ~np.isnan(seen[..., 0])
    weight = known / (variance[:, carried.source] + carried.spread)
    cross, here, there = centred(seen, carried.place, weight)
    turn = fitted(cross)
    place = here - np.einsum("tab,tb->ta", turn, there)
    if not refine:
        place = np.where(np.isnan(points[:, 0]), place, points[:, 0])
    distinct = np.unique(carried.place.round(6), axis=0, return_inverse=True)[1].reshape(-1)
    told = np.stack([known[:, distinct == d].any(axis=1) for d in range(distinct.max() + 1)], axis=1).sum(axis=1) >= ENOUGH
    source = np.flatnonzero(told)
    if len(source) == 0:
        return np.nan_to_num(place), turn, told
    nearest = source[np.rint(np.interp(np.arange(frames), source, np.arange(len(source)))).astype(int)]
    place = np.stack([np.interp(np.arange(frames), source, place[source, a]) for a in range(3)], axis=1)
    return place, turn[nearest], told
