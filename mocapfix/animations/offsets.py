"""Detection of pops and flips: a track is offset by a constant from one frame to another, and returns by the same amount.

The third differences of a body's motion are small, and a step makes three of them large. Two steps belong to the same offset if
removing one constant between them removes both (see `stats.constant_offsets`). The steps of lively motion are distinguished by
comparison with the third differences in a window around them.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import median_filter

from mocapfix.animations.offset_screening import (
    MAX_RESIDUAL_SHARE,
    MIN_REDUCTION_RATIO,
    THIRD_DIFFERENCE_STENCIL,
    ThirdDifferences,
    screen_offsets,
)
from mocapfix.stats.constant_offsets import OffsetModel

MIN_TRACK_FRAMES = 8  # frames of a track without which no offset is detected
MIN_DIFFERENCES = 4  # third differences without which no offset is fitted
BACKGROUND_HALF_WINDOW_S = 0.5  # on either side of a frame, for the usual size of third differences there
BACKGROUND_MEDIAN_FACTOR = 1.5  # from the median of third differences to their usual size
BACKGROUND_QUANTILE = 0.75  # of all third differences: the usual size is not less, because toes and thumbs stick and slip
MIN_STEP_RATIO = 4.0  # of a step's third difference to the usual size
MAX_STEP_COUNT = 250  # largest steps of a track that are examined
MAX_STEP_POWER_RATIO = 16.0  # between the powers of an offset's two steps
MAX_RESIDUAL_RATIO = 12.0  # of the mean square that remains after removal to the usual one
NEGLIGIBLE_RESIDUAL_SHARE = 0.004  # of the squares: if less remains, MAX_RESIDUAL_RATIO does not apply
MIN_EVIDENCE = 36.0  # ratio of the mean square that is removed to the one that remains
MIN_EVIDENCE_RESIDUAL = 0.3  # relative to the usual mean square: the least that is counted as remaining
EVIDENCE_DOUBLING_S = 2.0  # MIN_EVIDENCE doubles over this duration: the longer, the likelier are two steps by chance
MAX_OFFSET_DURATION_S = 3.0
SHORT_OFFSET_DURATION_S = 0.3  # among overlapping offsets, the evidence of those longer than this is weighted down


class TemporaryOffset(NamedTuple):
    """A constant offset in the frames first..last, inclusive.

    amount    radians or metres
    evidence  ratio of the mean squared third difference that its removal removes to the one that remains
    """

    first: int
    last: int
    amount: float
    evidence: float


class OffsetThresholds(NamedTuple):
    """Thresholds in the unit of a track.

    min_difference  least usual size of third differences that is assumed
    min_amount      smallest offset that counts as a fault
    """

    min_difference: float
    min_amount: float


def detect_offsets(
    track: Float[np.ndarray, "T C"],
    models: tuple[OffsetModel, ...],
    is_usable: Bool[np.ndarray, " T"],
    rate: float,
    thresholds: OffsetThresholds,
) -> list[TemporaryOffset]:
    """Detect offsets that do not overlap, ordered by first frame; of overlapping ones the one with the strongest evidence.

    track   positions (T, 3), or twice the quaternions (T, 4) of a joint, without sign changes
    models  the kinds of offset to try
    """
    if len(track) < MIN_TRACK_FRAMES:
        return []
    difference = np.linalg.norm(np.diff(track, 3, axis=0), axis=1)
    is_known = is_usable[3:] & is_usable[2:-1] & is_usable[1:-2] & is_usable[:-3]
    background = _estimate_background(np.where(is_known, difference, 0.0), rate, thresholds.min_difference)
    differences = ThirdDifferences(track, is_known, background)
    candidates: list[TemporaryOffset] = []
    starts, power = _find_steps(np.where(is_known, difference / background, 0.0))
    for start, stop in _list_step_pairs(differences, models, starts, power, rate):
        offset = _fit_offset(differences, models, start, stop - 1)
        min_evidence = MIN_EVIDENCE * (1 + (stop - start) / rate / EVIDENCE_DOUBLING_S)
        if offset and offset.amount >= thresholds.min_amount and offset.evidence >= min_evidence:
            candidates.append(offset)
    selected: list[TemporaryOffset] = []
    # The interval between two offsets of one joint explains as much as they do, so shorter ones are preferred.
    for each in sorted(candidates, key=lambda o: -o.evidence / (SHORT_OFFSET_DURATION_S + (o.last - o.first + 1) / rate)):
        if not any(each.first <= other.last + 1 and other.first <= each.last + 1 for other in selected):
            selected.append(each)
    return sorted(selected)


def _find_steps(relative_difference: Float[np.ndarray, " D"]) -> tuple[Int[np.ndarray, " S"], Float[np.ndarray, " S"]]:
    """Return the frames to which a step may lead, and each step's power, summed over the three differences that span it."""
    starts = np.unique(np.concatenate([np.flatnonzero(relative_difference > MIN_STEP_RATIO) + shift for shift in (1, 2, 3)]))
    power = np.array([(relative_difference[max(0, start - 3) : start] ** 2).sum() for start in starts], float)
    largest = np.sort(np.argsort(-power)[:MAX_STEP_COUNT])
    return starts[largest], power[largest]


def _list_step_pairs(
    differences: ThirdDifferences,
    models: tuple[OffsetModel, ...],
    starts: Int[np.ndarray, " S"],
    power: Float[np.ndarray, " S"],
    rate: float,
) -> list[tuple[int, int]]:
    """Return the pairs of steps, in order, that are near and alike enough to be one offset's and that one constant may remove."""
    firsts, seconds = np.triu_indices(len(starts), 1)
    is_partner = (starts[seconds] - starts[firsts] <= MAX_OFFSET_DURATION_S * rate) & (
        np.abs(np.log(power[seconds] / power[firsts])) < np.log(MAX_STEP_POWER_RATIO)
    )
    firsts, seconds = starts[firsts[is_partner]], starts[seconds[is_partner]]
    is_removable = screen_offsets(differences, models, firsts, seconds)
    return list(zip(firsts[is_removable].tolist(), seconds[is_removable].tolist(), strict=True))


def _fit_offset(differences: ThirdDifferences, models: tuple[OffsetModel, ...], first: int, last: int) -> TemporaryOffset | None:
    """Fit an offset of the frames first..last. Returns None if no constant removes both of its steps."""
    track = differences.track
    rows = np.unique(np.r_[first - 3 : first, last - 2 : last + 1])
    rows = rows[(rows >= 0) & (rows < len(differences.is_known))]
    rows = rows[differences.is_known[rows]]
    if first < 2 or last > len(track) - 3 or len(rows) < MIN_DIFFERENCES:
        return None
    samples = rows[:, None] + np.arange(4)
    is_inside = (samples >= first) & (samples <= last)
    # Of quaternions, the two sides of the interval may have opposite signs, which stand for the same rotation.
    has_opposite_sign = track.shape[1] == 4 and (track[first - 1] * track[last + 1]).sum() < 0
    inside = THIRD_DIFFERENCE_STENCIL * is_inside
    outside = THIRD_DIFFERENCE_STENCIL * ~is_inside * np.where(has_opposite_sign & (samples > last), -1.0, 1.0)
    outside_sum = np.einsum("rk,rkc->rc", outside, track[samples])
    before = float((np.einsum("k,rkc->rc", THIRD_DIFFERENCE_STENCIL, track[samples]) ** 2).sum())
    residual, amount = min(_fit_model(model, outside_sum, inside, samples) for model in models)
    background_power, dof = float((differences.background[rows] ** 2).mean()), len(rows) - 1
    reduction = (before - residual) / len(rows) / background_power
    evidence = reduction / (MIN_EVIDENCE_RESIDUAL + residual / dof / background_power)
    if residual > MAX_RESIDUAL_SHARE * before or reduction < MIN_REDUCTION_RATIO:
        return None
    if residual > NEGLIGIBLE_RESIDUAL_SHARE * before and residual / dof > MAX_RESIDUAL_RATIO * background_power:
        return None
    return TemporaryOffset(first, last, amount, evidence)


def _fit_model(
    model: OffsetModel,
    outside_sum: Float[np.ndarray, "R C"],
    inside: Float[np.ndarray, "R 4"],
    samples: Int[np.ndarray, "R 4"],
) -> tuple[float, float]:
    """Fit an offset of one kind by least squares. Returns the squares that remain, and the amount.

    outside_sum  third differences of the samples outside the interval alone
    inside       weights of the samples inside the interval
    """
    slopes = np.einsum("rk,rkcp->rcp", inside, model.basis[samples]).reshape(outside_sum.size, -1)
    target = -(outside_sum + np.einsum("rk,rkc->rc", inside, model.fixed[samples])).ravel()
    amounts, *_ = np.linalg.lstsq(slopes, target, rcond=None)
    if model.basis.shape[1] == 3:
        amount = np.linalg.norm(amounts)
    else:  # a quaternion, whose real part is the last of four numbers, or the first of two
        real, imaginary = (amounts[3], amounts[:3]) if len(amounts) == 4 else (amounts[0], amounts[1:])
        amount = 2 * np.arctan2(np.linalg.norm(imaginary), abs(real))
    return float(((slopes @ amounts - target) ** 2).sum()), float(amount)


def _estimate_background(difference: Float[np.ndarray, " D"], rate: float, min_difference: float) -> Float[np.ndarray, " D"]:
    """Estimate the usual size of third differences around each of them."""
    least = max(min_difference, BACKGROUND_MEDIAN_FACTOR * float(np.quantile(difference, BACKGROUND_QUANTILE)))
    window = 2 * round(BACKGROUND_HALF_WINDOW_S * rate) + 1
    return np.maximum(BACKGROUND_MEDIAN_FACTOR * median_filter(difference, window, mode="nearest"), least)
