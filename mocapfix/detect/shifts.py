"""Pops and flips: a joint that is turned by too much from one frame to the next, and comes back by the same amount.

A course that bodies go has small third differences; a step makes three large ones. Two steps belong together where one and
the same turn, undone between them, takes both away (see `kernels.offsets`). What a lively motion does on its own is told from
the third differences of the second around.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from mocapfix.kernels import offsets

STENCIL = np.array([-1.0, 3.0, -3.0, 1.0])
AROUND = 0.5  # seconds to either side, over which it is seen how lively a joint is
LEAST = np.radians(0.5)  # third difference that any joint may have
STEP = 4.0  # times what is usual, a third difference is large
SMALLEST = np.radians(4.0)  # no smaller turn is a pop
LEFT, GAIN = 6.0, 40.0  # times what is usual: the mean square that may be left, and that must go away
SHARE = 0.1  # of the squares may be left
MOST = 80  # steps of a joint that are looked at, the largest
LONGEST = 3.0  # seconds


class Shift(NamedTuple):
    """Frames first..last, inclusive, turned by so many radians too much; gain says how plain it is."""

    first: int
    last: int
    angle: float
    gain: float


def found(quaternions: np.ndarray, usable: np.ndarray, order: str, rate: float) -> list[Shift]:
    """-> shifts that do not overlap in a joint's quaternions (T, 4), where `usable` (T,), the plainest of each place."""
    if len(quaternions) < 8:
        return []
    quaternions = continuous(quaternions)
    course = 2 * quaternions
    size = np.sqrt((third(course) ** 2).sum(1))
    size = np.where(~(usable[3:] & usable[2:-1] & usable[1:-2] & usable[:-3]), np.nan, size)
    usual = background(size, rate)
    steps = np.flatnonzero(size > STEP * usual)
    if not len(steps):
        return []
    starts = np.unique(np.concatenate([steps + k for k in (1, 2, 3)]))  # a step into frame s shows from s - 3 to s - 1
    power = np.array([np.nansum(size[max(0, s - 3) : s] ** 2 / usual[max(0, s - 3) : s] ** 2) for s in starts])
    starts = np.sort(starts[np.argsort(-power)[:MOST]])
    maps = offsets.bases(quaternions, order)
    tried = []
    for i, a in enumerate(starts):
        for b in starts[i + 1 :]:
            if b - a <= LONGEST * rate and (shift := tested(course, maps, usable, usual, int(a), int(b) - 1)):
                tried.append(shift)
    kept: list[Shift] = []
    for each in sorted(tried, key=lambda s: -s.gain):
        if not any(each.first <= k.last + 1 and k.first <= each.last + 1 for k in kept):
            kept.append(each)
    return kept


def tested(course, maps, usable, usual, first: int, last: int) -> Shift | None:
    """-> the shift of first..last, where undoing one turn there takes both steps away; None where it does not."""
    frames = len(course)
    rows = np.unique(np.r_[np.arange(first - 3, first), np.arange(last - 2, last + 1)])
    rows = rows[(rows >= 0) & (rows < frames - 3)]
    at = rows[:, None] + np.arange(4)
    good = usable[at].all(1)
    if first < 2 or last > frames - 3 or good.sum() < min(4, len(rows)):
        return None
    rows, at = rows[good], at[good]
    inside = (at >= first) & (at <= last)
    # the two sides of the span may bear opposite signs, which mean the same
    sign = np.where((course[first - 1] * course[last + 1]).sum() < 0, -1.0, 1.0)
    outside = np.where(at > last, sign, 1.0) * ~inside * STENCIL
    target = -np.einsum("rk,rkc->rc", outside, course[at]).ravel()
    before = (np.einsum("k,rkc->rc", STENCIL, course[at]) ** 2).sum()
    scale = (usual[rows] ** 2).mean()
    best = None
    for basis in maps:
        matrix = np.einsum("rk,rkcp->rcp", inside * STENCIL, 2 * basis[at]).reshape(-1, basis.shape[2])
        c, *_ = np.linalg.lstsq(matrix, target, rcond=None)
        left = ((matrix @ c - target) ** 2).sum()
        if best is None or left < best[0]:
            best = left, c
    left, c = best
    freedom = max(len(rows) * 3 - 3, 1) / 3
    angle = float(2 * np.arctan2(np.linalg.norm(c[:-1]) if len(c) == 4 else abs(c[1]), abs(c[3] if len(c) == 4 else c[0])))
    gain = (before - left) / len(rows) / scale
    if angle < SMALLEST or left / freedom > LEFT * scale or gain < GAIN or left > SHARE * before:
        return None
    return Shift(first, last, angle, gain / (1 + left / freedom / scale))


def continuous(quaternions: np.ndarray) -> np.ndarray:
    """-> (T, 4) the same turns without changes of sign from frame to frame."""
    signs = np.sign((quaternions[1:] * quaternions[:-1]).sum(1))
    return quaternions * np.cumprod(np.r_[1.0, np.where(signs == 0, 1.0, signs)])[:, None]


def third(course: np.ndarray) -> np.ndarray:
    """-> (T - 3, C) the third differences."""
    return np.diff(course, 3, axis=0)


def background(size: np.ndarray, rate: float) -> np.ndarray:
    """-> how large third differences (N,) usually are about each; not less than LEAST."""
    window = 2 * round(AROUND * rate) + 1
    known = np.where(np.isnan(size), 0.0, size)
    return np.maximum(1.5 * median_filter(known, window, mode="nearest"), LEAST)
