"""Courses: does one path lead on to another?"""

import numpy as np

from mocapfix.detect.pieces import Piece

AGREES = 0.010  # metres: the same marker twice lies no farther from itself
LISTENED = 0.03  # seconds of a course that tell its velocity
ROUGH, SWERVE = 0.002, 2.5  # metres, m/s2: a course misses by the one and, after t seconds, the other times t squared besides
STRAY = 3.5  # standard deviations: an end counts for no more, for the last sample of a label is often a bad one


def course(piece: Piece, path: np.ndarray, rate: float, reach: float) -> float:
    """-> the cost of going from a marker's path (T, 3) to the piece and on: the mean square of what both ends miss, in standard
    deviations; NaN where neither is within `reach` seconds, infinite where piece and marker are seen together and apart.
    """
    seen = ~np.isnan(path[:, 0])
    both = seen[piece.frames]
    if both.any():
        apart = float(np.median(np.linalg.norm(piece.points[both] - path[piece.frames[both]], axis=1)))
        return (2 * apart / AGREES) ** 2 if apart <= AGREES else np.inf
    first, last, far = piece.frames[0], piece.frames[-1], round(reach * rate) + 1
    start = max(0, first - far)
    early, late = start + np.flatnonzero(seen[start:first]), last + 1 + np.flatnonzero(seen[last + 1 : last + 1 + far])
    ends = []
    if len(early):
        ends.append(onward(early, path[early], piece.frames, piece.points, rate))
    if len(late):
        ends.append(onward(piece.frames, piece.points, late, path[late], rate))
    return float(np.mean([min(STRAY, off / (ROUGH + SWERVE * lag**2)) ** 2 for off, lag in ends])) if ends else np.nan


def onward(early: np.ndarray, before: np.ndarray, late: np.ndarray, after: np.ndarray, rate: float) -> tuple[float, float]:
    """-> metres by which a path misses that goes on from its last point to another's first at the mean of their velocities,
    and the seconds between.

    early (N,) and late (K,) frames, before (N, 3) and after (K, 3) metres
    """
    lag = (late[0] - early[-1]) / rate
    mean = (_velocity(early[::-1], before[::-1], rate) + _velocity(late, after, rate)) / 2
    return float(np.linalg.norm(after[0] - before[-1] - mean * lag)), float(lag)


def _velocity(frames: np.ndarray, points: np.ndarray, rate: float) -> np.ndarray:
    """-> (3,) m/s near the first of the frames (N,), by a straight line through what is listened to; 0 from one alone."""
    near = max(2, int(np.searchsorted(np.abs(frames - frames[0]), LISTENED * rate, side="right")))
    time = (frames[:near] - frames[:near].mean()) / rate
    return time @ points[:near] / max(float(time @ time), 1e-12)


def smoother(piece: Piece, path: np.ndarray, rate: float) -> bool:
    """Does a marker's path (T, 3) lead through the piece more smoothly, at both its ends, than through its own samples?"""
    first, last = piece.frames[0], piece.frames[-1]
    seen = np.flatnonzero(~np.isnan(path[:, 0]))
    early, late, own = seen[seen < first], seen[seen > last], seen[(seen >= first) & (seen <= last)]
    ends = []
    for frames, points in ((piece.frames, piece.points), (own, path[own])):
        into = onward(early, path[early], frames, points, rate)[0] if len(early) else 0.0
        out = onward(frames, points, late, path[late], rate)[0] if len(late) else 0.0
        ends.append((into, out))
    (into, out), (own_into, own_out) = ends
    return max(own_into, own_out) > ROUGH and into < own_into and out < own_out
