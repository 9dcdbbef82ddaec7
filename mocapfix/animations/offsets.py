"""Pops and flips: what is off from one frame to the next, and comes back by the same amount.

A course that bodies go has small third differences; a step makes three large ones. Two steps belong together where one and
the same amount, undone between them, takes both away (see `kernels.offsets`). What a lively motion does on its own is told from
the third differences of the second around.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from mocapfix.stats.constant_offsets import OffsetModel

THIRD_DIFFERENCE_STENCIL = np.array([-1.0, 3.0, -3.0, 1.0])
BACKGROUND_HALF_WINDOW_S = 0.5  # seconds to either side, over which it is seen how lively a course is
MIN_STEP_RATIO = 4.0  # times what is usual, a third difference is large
MAX_RESIDUAL_RATIO, MIN_REDUCTION_RATIO = 12.0, 15.0  # times what is usual: the mean square that may be left, and that must go
MIN_EVIDENCE, MIN_EVIDENCE_RESIDUAL = 36.0, 0.3  # how much more must go than is left, which counts as so much at least
LENGTH_PENALTY_S = (
    2.0  # seconds after which that must be twice as much: two steps by chance are the likelier the longer one waits
)
MAX_STEP_POWER_RATIO = 16.0  # the power of two steps of one shift, at most times that of the other
MAX_RESIDUAL_SHARE, NEGLIGIBLE_RESIDUAL_SHARE = (
    0.05,
    0.004,
)  # of the squares may be left; with so few left it does not matter how much that is
MAX_STEP_COUNT = 250  # steps of a course that are looked at, the largest
MAX_OFFSET_DURATION_S, SHORT_OFFSET_DURATION_S = (
    3.0,
    0.3,
)  # seconds: no shift is longer; from where on a longer one is the less likely


class TemporaryOffset(NamedTuple):
    """Frames first..last, inclusive, that are off by an amount, in radians or metres; plain is how plainly they are."""

    first: int
    last: int
    amount: float
    evidence: float


def detect_offsets(
    track: np.ndarray,
    corrections: tuple[OffsetModel, ...],
    is_usable: np.ndarray,
    rate: float,
    min_difference: float,
    min_amount: float,
) -> list[TemporaryOffset]:
    """-> shifts that do not overlap in a course (T, C), where it is `usable` (T,), the plainest of each place, by first frame.

    least     third difference that any course may have;  smallest  amount that counts, in the course's unit
    """
    if len(track) < 8:
        return []
    size = np.linalg.norm(np.diff(track, 3, axis=0), axis=1)
    whole = is_usable[3:] & is_usable[2:-1] & is_usable[1:-2] & is_usable[:-3]
    usual = _estimate_background(np.where(whole, size, 0.0), rate, min_difference)
    tried = []
    starts, power = _find_steps(np.where(whole, size / usual, 0.0))
    for i, a in enumerate(starts):
        near = (starts[i + 1 :] - a <= MAX_OFFSET_DURATION_S * rate) & (
            np.abs(np.log(power[i + 1 :] / power[i])) < np.log(MAX_STEP_POWER_RATIO)
        )
        for b in starts[i + 1 :][near]:
            shift = _fit_offset(track, corrections, whole, usual, int(a), int(b) - 1)
            if shift and shift.amount >= min_amount and shift.evidence >= MIN_EVIDENCE * (1 + (b - a) / rate / LENGTH_PENALTY_S):
                tried.append(shift)
    kept: list[TemporaryOffset] = []
    # between two shifts of one joint lies a third that explains as much: the shorter ones are the likelier
    for each in sorted(tried, key=lambda s: -s.evidence / (SHORT_OFFSET_DURATION_S + (s.last - s.first + 1) / rate)):
        if not any(each.first <= k.last + 1 and k.first <= each.last + 1 for k in kept):
            kept.append(each)
    return sorted(kept)


def _find_steps(relative_difference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> the frames into which steps may lead, and the power of each: it shows in the three third differences (T - 3,) that
    lead over it."""
    starts = np.unique(np.concatenate([np.flatnonzero(relative_difference > MIN_STEP_RATIO) + k for k in (1, 2, 3)]))
    power = np.array([(relative_difference[max(0, s - 3) : s] ** 2).sum() for s in starts])
    kept = np.sort(np.argsort(-power)[:MAX_STEP_COUNT])
    return starts[kept], power[kept]


def _fit_offset(
    track: np.ndarray,
    corrections: tuple[OffsetModel, ...],
    is_complete: np.ndarray,
    background: np.ndarray,
    first: int,
    last: int,
) -> TemporaryOffset | None:
    """-> the shift of first..last, where undoing one amount takes both steps away; None where none does."""
    rows = np.unique(np.r_[first - 3 : first, last - 2 : last + 1])
    rows = rows[(rows >= 0) & (rows < len(is_complete))]
    rows = rows[is_complete[rows]]
    if first < 2 or last > len(track) - 3 or len(rows) < 4:
        return None
    at = rows[:, None] + np.arange(4)
    within = (at >= first) & (at <= last)
    # twice a quaternion: the two sides of the span may bear opposite signs, which mean the same
    turned = track.shape[1] == 4 and (track[first - 1] * track[last + 1]).sum() < 0
    inside, outside = (
        THIRD_DIFFERENCE_STENCIL * within,
        THIRD_DIFFERENCE_STENCIL * ~within * np.where(turned & (at > last), -1.0, 1.0),
    )
    still = np.einsum("rk,rkc->rc", outside, track[at])
    before = float((np.einsum("k,rkc->rc", THIRD_DIFFERENCE_STENCIL, track[at]) ** 2).sum())
    left, amount = min(_compute_residual(way, still, inside, at) for way in corrections)
    scale, freedom = float((background[rows] ** 2).mean()), len(rows) - 1
    gain = (before - left) / len(rows) / scale
    plain = gain / (MIN_EVIDENCE_RESIDUAL + left / freedom / scale)
    if (
        left > MAX_RESIDUAL_SHARE * before
        or gain < MIN_REDUCTION_RATIO
        or (left > NEGLIGIBLE_RESIDUAL_SHARE * before and left / freedom > MAX_RESIDUAL_RATIO * scale)
    ):
        return None
    return TemporaryOffset(first, last, amount, plain)


def _compute_residual(
    correction: OffsetModel, outside: np.ndarray, inside: np.ndarray, samples: np.ndarray
) -> tuple[float, float]:
    """-> the squares that are left when a way undoes what it can, and the amount."""
    slopes = np.einsum("rk,rkcp->rcp", inside, correction.basis[samples]).reshape(outside.size, -1)
    target = -(outside + np.einsum("rk,rkc->rc", inside, correction.fixed[samples])).ravel()
    amounts, *_ = np.linalg.lstsq(slopes, target, rcond=None)
    if correction.basis.shape[1] == 3:
        amount = np.linalg.norm(amounts)
    else:  # a quaternion: its real part is the last of four numbers, or the first of two
        real, others = (amounts[3], amounts[:3]) if len(amounts) == 4 else (amounts[0], amounts[1:])
        amount = 2 * np.arctan2(np.linalg.norm(others), abs(real))
    return float(((slopes @ amounts - target) ** 2).sum()), float(amount)


def _estimate_background(difference: np.ndarray, rate: float, min_difference: float) -> np.ndarray:
    """-> how large third differences (N,) usually are about each, by 1.5 times the median, and at least; at least about what
    they are a quarter of the time, too, for toes and thumbs stick and slip."""
    min_difference = max(min_difference, 1.5 * float(np.quantile(difference, 0.75)))
    return np.maximum(
        1.5 * median_filter(difference, 2 * round(BACKGROUND_HALF_WINDOW_S * rate) + 1, mode="nearest"), min_difference
    )
