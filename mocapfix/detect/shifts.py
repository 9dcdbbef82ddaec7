"""Pops and flips: what is off from one frame to the next, and comes back by the same amount.

A course that bodies go has small third differences; a step makes three large ones. Two steps belong together where one and
the same amount, undone between them, takes both away (see `kernels.offsets`). What a lively motion does on its own is told from
the third differences of the second around.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from mocapfix.kernels.offsets import Undoing

STENCIL = np.array([-1.0, 3.0, -3.0, 1.0])
AROUND = 0.5  # seconds to either side, over which it is seen how lively a course is
STEP = 4.0  # times what is usual, a third difference is large
LEFT, GAIN = 12.0, 15.0  # times what is usual: the mean square that may be left, and that must go
PLAIN, FIRM = 36.0, 0.3  # how much more must go than is left, which counts as so much at least
SLOW = 2.0  # seconds after which that must be twice as much: two steps by chance are the likelier the longer one waits
ALIKE = 16.0  # the power of two steps of one shift, at most times that of the other
SHARE, CLEAR = 0.05, 0.004  # of the squares may be left; with so few left it does not matter how much that is
MOST = 250  # steps of a course that are looked at, the largest
LONGEST, SHORT = 3.0, 0.3  # seconds: no shift is longer; from where on a longer one is the less likely


class Shift(NamedTuple):
    """Frames first..last, inclusive, that are off by an amount, in radians or metres; plain is how plainly they are."""

    first: int
    last: int
    amount: float
    plain: float


def found(
    course: np.ndarray, ways: tuple[Undoing, ...], usable: np.ndarray, rate: float, least: float, smallest: float
) -> list[Shift]:
    """-> shifts that do not overlap in a course (T, C), where it is `usable` (T,), the plainest of each place, by first frame.

    least     third difference that any course may have;  smallest  amount that counts, in the course's unit
    """
    if len(course) < 8:
        return []
    size = np.linalg.norm(np.diff(course, 3, axis=0), axis=1)
    whole = usable[3:] & usable[2:-1] & usable[1:-2] & usable[:-3]
    usual = _background(np.where(whole, size, 0.0), rate, least)
    tried = []
    starts, power = _starts(np.where(whole, size / usual, 0.0))
    for i, a in enumerate(starts):
        near = (starts[i + 1 :] - a <= LONGEST * rate) & (np.abs(np.log(power[i + 1 :] / power[i])) < np.log(ALIKE))
        for b in starts[i + 1 :][near]:
            shift = _tested(course, ways, whole, usual, int(a), int(b) - 1)
            if shift and shift.amount >= smallest and shift.plain >= PLAIN * (1 + (b - a) / rate / SLOW):
                tried.append(shift)
    kept: list[Shift] = []
    # between two shifts of one joint lies a third that explains as much: the shorter ones are the likelier
    for each in sorted(tried, key=lambda s: -s.plain / (SHORT + (s.last - s.first + 1) / rate)):
        if not any(each.first <= k.last + 1 and k.first <= each.last + 1 for k in kept):
            kept.append(each)
    return sorted(kept)


def _starts(large: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> the frames into which steps may lead, and the power of each: it shows in the three third differences (T - 3,) that
    lead over it."""
    starts = np.unique(np.concatenate([np.flatnonzero(large > STEP) + k for k in (1, 2, 3)]))
    power = np.array([(large[max(0, s - 3) : s] ** 2).sum() for s in starts])
    kept = np.sort(np.argsort(-power)[:MOST])
    return starts[kept], power[kept]


def _tested(
    course: np.ndarray, ways: tuple[Undoing, ...], whole: np.ndarray, usual: np.ndarray, first: int, last: int
) -> Shift | None:
    """-> the shift of first..last, where undoing one amount takes both steps away; None where none does."""
    rows = np.unique(np.r_[first - 3 : first, last - 2 : last + 1])
    rows = rows[(rows >= 0) & (rows < len(whole))]
    rows = rows[whole[rows]]
    if first < 2 or last > len(course) - 3 or len(rows) < 4:
        return None
    at = rows[:, None] + np.arange(4)
    within = (at >= first) & (at <= last)
    # twice a quaternion: the two sides of the span may bear opposite signs, which mean the same
    turned = course.shape[1] == 4 and (course[first - 1] * course[last + 1]).sum() < 0
    inside, outside = STENCIL * within, STENCIL * ~within * np.where(turned & (at > last), -1.0, 1.0)
    still = np.einsum("rk,rkc->rc", outside, course[at])
    before = float((np.einsum("k,rkc->rc", STENCIL, course[at]) ** 2).sum())
    left, amount = min(_left(way, still, inside, at) for way in ways)
    scale, freedom = float((usual[rows] ** 2).mean()), len(rows) - 1
    gain = (before - left) / len(rows) / scale
    plain = gain / (FIRM + left / freedom / scale)
    if left > SHARE * before or gain < GAIN or (left > CLEAR * before and left / freedom > LEFT * scale):
        return None
    return Shift(first, last, amount, plain)


def _left(way: Undoing, still: np.ndarray, inside: np.ndarray, at: np.ndarray) -> tuple[float, float]:
    """-> the squares that are left when a way undoes what it can, and the amount."""
    slopes = np.einsum("rk,rkcp->rcp", inside, way.basis[at]).reshape(still.size, -1)
    target = -(still + np.einsum("rk,rkc->rc", inside, way.fixed[at])).ravel()
    amounts, *_ = np.linalg.lstsq(slopes, target, rcond=None)
    if way.basis.shape[1] == 3:
        amount = np.linalg.norm(amounts)
    else:  # a quaternion: its real part is the last of four numbers, or the first of two
        real, others = (amounts[3], amounts[:3]) if len(amounts) == 4 else (amounts[0], amounts[1:])
        amount = 2 * np.arctan2(np.linalg.norm(others), abs(real))
    return float(((slopes @ amounts - target) ** 2).sum()), float(amount)


def _background(size: np.ndarray, rate: float, least: float) -> np.ndarray:
    """-> how large third differences (N,) usually are about each, by 1.5 times the median, and at least; at least about what
    they are a quarter of the time, too, for toes and thumbs stick and slip."""
    least = max(least, 1.5 * float(np.quantile(size, 0.75)))
    return np.maximum(1.5 * median_filter(size, 2 * round(AROUND * rate) + 1, mode="nearest"), least)
