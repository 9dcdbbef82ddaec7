"""The root's place and turn, frame by frame, by registering what it carries; from the frames around where that is too little."""

import numpy as np

from mocapfix.kernels.root import Carried, register_frames
from mocapfix.kernels.threads import over_frames

ENOUGH = 3  # places that tell a turn


def registered(
    carried: Carried, points: np.ndarray, variance: np.ndarray, refine: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """-> place (T, 3) metres and turn (T, 3, 3) of the root, and (T,) bool: whether the frame itself tells them.

    The rotation of least squares, never a reflection (HybrIK, appendix A, whose Eq. 33 does not rule it out).

    points    (T, Q, 3) metres, NaN where unknown; the first is the root
    variance  (T or 1, Q) m^2 per axis
    refine    whether the root's own place is fitted, too, or, where it is known, left as it is given
    """
    frames = len(points)
    place, turn, places = np.empty((frames, 3)), np.empty((frames, 3, 3)), np.empty(frames, int)
    over_frames(register_frames, frames, carried, points, variance, refine, place, turn, places)
    told, source = places >= ENOUGH, np.flatnonzero(places >= ENOUGH)
    if 0 < len(source) < frames:
        nearest = source[np.rint(np.interp(np.arange(frames), source, np.arange(len(source)))).astype(int)]
        guess = np.stack([np.interp(np.arange(frames), source, place[source, a]) for a in range(3)], axis=1)
        here = np.where(np.isnan(points[:, :1]).any(axis=2), guess, points[:, 0])  # seen, it stays, however it is turned
        place, turn = np.where(told[:, None], place, here), turn[nearest]
    return place, turn, told
