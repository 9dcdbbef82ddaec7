"""Detection of pops and flips: a track is offset by a constant from one frame to another, and returns by the same amount.

The third differences of a body's motion are small, and a step makes three of them large. Two steps belong to the same offset if
removing one constant between them removes both (see `stats.constant_offsets`). The steps of lively motion are distinguished by
comparison with the third differences in a window around them.

Fitting an offset takes a hundred times longer than a bound on what its removal leaves, which solves the normal equations of all
pairs of steps at once, and which few pairs pass. It is a lower bound, so no offset that would be found is lost.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import median_filter

from mocapfix.stats.constant_offsets import OffsetModel

FrameIndices = Int[np.ndarray, " n"]
Mask = Bool[np.ndarray, " n"]
Track = Float[np.ndarray, "T C"]
Differences = Float[np.ndarray, " D"]
Rows = Int[np.ndarray, "n R"]
Models = tuple[OffsetModel, ...]

THIRD_DIFFERENCE_STENCIL = np.array([-1.0, 3.0, -3.0, 1.0])
MIN_REDUCTION_RATIO = 15.0  # of the mean square that is removed to the usual one
MAX_RESIDUAL_SHARE = 0.05  # of the squares that may remain
MIN_SEPARATE_STEPS = 3  # frames from one step to another without which a third difference spans both
RELATIVE_RIDGE = 1e-13  # added to normal equations, relative to their trace, so that they have a solution
RELATIVE_ROUNDING = 1e-9  # of the squares of the targets: subtracted from the squares that remain, which rounding changes by less


class ThirdDifferences(NamedTuple):
    """Of a track: its values, where third differences are known, and how large they usually are there."""

    track: Track
    is_known: Bool[np.ndarray, " D"]
    background: Differences


class _NormalEquations(NamedTuple):
    """Least squares of S offsets, over some third differences of each: slopes' slopes, slopes' target, target' target."""

    gram: Float[np.ndarray, "S P P"]
    moment: Float[np.ndarray, "S P"]
    square: Float[np.ndarray, " S"]


def screen_offsets(differences: ThirdDifferences, models: Models, starts: FrameIndices, stops: FrameIndices) -> Mask:
    """Return whether a constant offset of the frames starts..stops - 1 may remove the steps at both ends.

    It may if so little would remain, and so much be removed, as MAX_RESIDUAL_SHARE and MIN_REDUCTION_RATIO demand.
    """
    duration, is_removable = stops - starts, np.zeros(len(starts), bool)
    is_long = duration >= MIN_SEPARATE_STEPS
    if is_long.any():
        is_removable[is_long] = _screen_long_offsets(differences, models, starts[is_long], stops[is_long])
    for frames in range(1, MIN_SEPARATE_STEPS):
        is_short = duration == frames
        if is_short.any():
            is_removable[is_short] = _screen_short_offsets(differences, models, starts[is_short], frames)
    return is_removable


def _screen_long_offsets(differences: ThirdDifferences, models: Models, starts: FrameIndices, stops: FrameIndices) -> Mask:
    """Return whether an offset may be removed. No third difference spans both of its steps, so their normal equations add up."""
    signs = _compare_signs(differences.track, starts, stops)
    steps, step_of_edge = np.unique(np.concatenate([starts, stops]), return_inverse=True)
    firsts, seconds = np.split(step_of_edge, 2)
    shifts = np.arange(-3, 0)
    rows = steps[:, None] + shifts
    is_after = shifts[:, None] + np.arange(4) >= 0
    residual = np.full(len(starts), np.inf)
    for model in models:
        entry = _build_normal_equations(differences, model, rows, is_after, np.where(is_after, 0.0, 1.0)[None])
        leave = _build_normal_equations(differences, model, rows, ~is_after, np.where(is_after, 1.0, 0.0)[None])
        total = _NormalEquations(
            entry.gram[firsts] + leave.gram[seconds],
            entry.moment[firsts] + signs[:, None] * leave.moment[seconds],
            entry.square[firsts] + leave.square[seconds],
        )
        residual = np.minimum(residual, _bound_residual(total))
    both_rows = np.concatenate([rows[firsts], rows[seconds]], axis=1)
    return _is_removable(differences, both_rows, residual)


def _screen_short_offsets(differences: ThirdDifferences, models: Models, starts: FrameIndices, frames: int) -> Mask:
    """Return whether a constant in the few `frames` from each start may remove the steps at both ends."""
    signs = _compare_signs(differences.track, starts, starts + frames)
    shifts = np.arange(-3, frames)
    rows, samples = starts[:, None] + shifts, shifts[:, None] + np.arange(4)
    is_inside = (samples >= 0) & (samples < frames)
    outside_weights = np.where(samples >= frames, signs[:, None, None], 1.0) * ~is_inside
    equations = (_build_normal_equations(differences, model, rows, is_inside, outside_weights) for model in models)
    return _is_removable(differences, rows, np.minimum.reduce([_bound_residual(each) for each in equations]))


def _compare_signs(track: Track, starts: FrameIndices, stops: FrameIndices) -> Float[np.ndarray, " n"]:
    """Return -1 where the quaternions on the two sides of an interval have opposite signs, which stand for one rotation."""
    if track.shape[1] != 4:
        return np.ones(len(starts))
    product = (track[np.maximum(starts - 1, 0)] * track[np.minimum(stops, len(track) - 1)]).sum(1)
    return np.where(product < 0, -1.0, 1.0)


def _build_normal_equations(
    differences: ThirdDifferences,
    model: OffsetModel,
    rows: Int[np.ndarray, "S R"],
    is_inside: Bool[np.ndarray, "R 4"],
    outside_weights: Float[np.ndarray, "#S R 4"],
) -> _NormalEquations:
    """Build the normal equations of S offsets over R third differences each; those that are not known do not count."""
    samples = np.clip(rows[:, :, None] + np.arange(4), 0, len(differences.track) - 1)
    inside = THIRD_DIFFERENCE_STENCIL * is_inside
    slopes = np.zeros((*rows.shape, *model.basis.shape[1:]))
    target = np.zeros((*rows.shape, differences.track.shape[1]))
    for k in range(4):
        at = samples[:, :, k]
        weights = outside_weights[:, :, k, None] * THIRD_DIFFERENCE_STENCIL[k]
        slopes += inside[:, k, None, None] * model.basis[at]
        target -= weights * differences.track[at] + inside[:, k, None] * model.fixed[at]
    is_row = _is_known_row(differences, rows)[:, :, None]
    target = (target * is_row).reshape(len(rows), -1)
    slopes = (slopes * is_row[..., None]).reshape(len(rows), target.shape[1], -1)
    transposed = np.swapaxes(slopes, 1, 2)
    return _NormalEquations(transposed @ slopes, (transposed @ target[:, :, None])[:, :, 0], (target**2).sum(1))


def _bound_residual(equations: _NormalEquations) -> Float[np.ndarray, " S"]:
    """Return the least squares that may remain, less what rounding may add."""
    ridge = RELATIVE_RIDGE * np.trace(equations.gram, axis1=1, axis2=2) + np.finfo(float).tiny
    amounts = np.linalg.solve(
        equations.gram + ridge[:, None, None] * np.eye(equations.gram.shape[1]), equations.moment[..., None]
    )
    return equations.square * (1 - RELATIVE_ROUNDING) - (equations.moment * amounts[..., 0]).sum(1)


def _is_removable(differences: ThirdDifferences, rows: Rows, residual: Float[np.ndarray, " n"]) -> Mask:
    """Return whether so little may remain of the third differences in `rows` as `_fit_offset` demands."""
    clipped, is_row = np.clip(rows, 0, len(differences.is_known) - 1), _is_known_row(differences, rows)
    third_differences = np.diff(differences.track, 3, axis=0)
    before = ((third_differences**2).sum(1)[clipped] * is_row).sum(1)
    background_square = (differences.background[clipped] ** 2 * is_row).sum(1)
    return (residual <= MAX_RESIDUAL_SHARE * before) & (before - residual >= MIN_REDUCTION_RATIO * background_square)


def _is_known_row(differences: ThirdDifferences, rows: Rows) -> Bool[np.ndarray, "n R"]:
    clipped = np.clip(rows, 0, len(differences.is_known) - 1)
    return differences.is_known[clipped] & (rows == clipped)


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
    """A constant offset in the frames first..last, inclusive."""

    first: int
    last: int
    amount: float  # radians or metres
    evidence: float  # ratio of the mean squared third difference that its removal removes to the one that remains


class OffsetThresholds(NamedTuple):
    """Thresholds in the unit of a track."""

    min_difference: float  # least usual size of third differences that is assumed
    min_amount: float  # smallest offset that counts as a fault


def detect_offsets(
    track: Track, models: Models, is_usable: Bool[np.ndarray, " T"], rate: float, thresholds: OffsetThresholds
) -> list[TemporaryOffset]:
    """Detect offsets that do not overlap, ordered by first frame; of overlapping ones the one with the strongest evidence.

    The track has positions (T, 3), or twice the quaternions (T, 4) of a joint, without sign changes.
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


def _find_steps(relative_difference: Differences) -> tuple[Int[np.ndarray, " S"], Float[np.ndarray, " S"]]:
    """Return the frames to which a step may lead, and each step's power, summed over the three differences that span it."""
    starts = np.unique(np.concatenate([np.flatnonzero(relative_difference > MIN_STEP_RATIO) + shift for shift in (1, 2, 3)]))
    power = np.array([(relative_difference[max(0, start - 3) : start] ** 2).sum() for start in starts], float)
    largest = np.sort(np.argsort(-power)[:MAX_STEP_COUNT])
    return starts[largest], power[largest]


def _list_step_pairs(
    differences: ThirdDifferences, models: Models, starts: Int[np.ndarray, " S"], power: Float[np.ndarray, " S"], rate: float
) -> list[tuple[int, int]]:
    """Return the pairs of steps, in order, that are near and alike enough to be one offset's and that one constant may remove."""
    firsts, seconds = np.triu_indices(len(starts), 1)
    is_partner = (starts[seconds] - starts[firsts] <= MAX_OFFSET_DURATION_S * rate) & (
        np.abs(np.log(power[seconds] / power[firsts])) < np.log(MAX_STEP_POWER_RATIO)
    )
    firsts, seconds = starts[firsts[is_partner]], starts[seconds[is_partner]]
    is_removable = screen_offsets(differences, models, firsts, seconds)
    return list(zip(firsts[is_removable].tolist(), seconds[is_removable].tolist(), strict=True))


def _fit_offset(differences: ThirdDifferences, models: Models, first: int, last: int) -> TemporaryOffset | None:
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
    model: OffsetModel, outside_sum: Float[np.ndarray, "R C"], inside: Float[np.ndarray, "R 4"], samples: Int[np.ndarray, "R 4"]
) -> tuple[float, float]:
    """Fit an offset of one kind by least squares. Returns the squares that remain, and the amount.

    The third differences of the samples outside the interval alone are `outside_sum`, the weights of those inside `inside`.
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


def _estimate_background(difference: Differences, rate: float, min_difference: float) -> Differences:
    """Estimate the usual size of third differences around each of them."""
    least = max(min_difference, BACKGROUND_MEDIAN_FACTOR * float(np.quantile(difference, BACKGROUND_QUANTILE)))
    window = 2 * round(BACKGROUND_HALF_WINDOW_S * rate) + 1
    return np.maximum(BACKGROUND_MEDIAN_FACTOR * median_filter(difference, window, mode="nearest"), least)
