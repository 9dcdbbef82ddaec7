"""Detection of pops and flips: a track is offset by a constant from one frame to another, and returns by the same amount.

The third differences of a body's motion are small, and a step makes three of them large. Two steps belong to the same offset if
removing one constant between them removes both. The steps of lively motion are distinguished by comparison with the third
differences in a window around them.

All pairs of steps are fitted at once, by normal equations. Those of two steps without a common third difference are sums of the
equations of each step.

A rotation can have a constant offset in the parent's axes (d R), in the joint's own (R d) or in the middle one of its three
angles. In each case the corrected quaternion is linear in the correction: q = B(q') c, with c the conjugate of d where B has
four columns, and (cos, sin) of half the angle where it has two. A position has an offset vector: p = p' + c. So the correction
that makes the signal smoothest is a linear least squares problem.
"""

from typing import NamedTuple
from warnings import catch_warnings

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from mocapfix.stats.gaussian_process import compute_matern_52
from mocapfix.stats.rigid_alignment import multiply_quaternions

FrameIndices = Int[np.ndarray, " n"]
Track = Float[np.ndarray, "T C"]
Differences = Float[np.ndarray, " D"]
Rows = Int[np.ndarray, "n R"]

OFFSET_TIME_SCALE_S = 0.3  # of the signal's correlation
OFFSET_NOISE_VARIANCE_RATIO = 1e-4  # variance of a sample's noise, relative to the signal's power
OFFSET_MEAN_VARIANCE_RATIO = 100.0  # variance of the signal's unknown mean, likewise
MIN_RESIDUAL_SQUARE = 1e-12  # added to a sum of squares, so that its logarithm is finite
THIRD_DIFFERENCE_STENCIL = np.array([-1.0, 3.0, -3.0, 1.0])
MIN_REDUCTION_RATIO = 15.0  # of the mean square that is removed to the usual one
MAX_RESIDUAL_SHARE = 0.05  # of the squares that may remain
MIN_SEPARATE_STEPS = 3  # frames from one step to another without which a third difference spans both
RELATIVE_RIDGE = 1e-13  # added to normal equations, relative to their trace, so that they have a solution


class OffsetModel(NamedTuple):
    """A linear model of a correction: T samples of C numbers are fixed + basis times P unknowns."""

    fixed: Float[np.ndarray, "T C"]
    basis: Float[np.ndarray, "T C P"]
    dof: int  # degrees of freedom of the unknowns


Models = tuple[OffsetModel, ...]


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


def _build_long_equations(
    differences: ThirdDifferences, models: Models, starts: FrameIndices, stops: FrameIndices
) -> tuple[Rows, list[_NormalEquations]]:
    """Return the third differences of offsets, of which none spans both steps, and the equations by each model."""
    signs = _compare_signs(differences.track, starts, stops)
    steps, step_of_edge = np.unique(np.concatenate([starts, stops]), return_inverse=True)
    firsts, seconds = np.split(step_of_edge, 2)
    shifts = np.arange(-3, 0)
    rows = steps[:, None] + shifts
    is_after = shifts[:, None] + np.arange(4) >= 0
    equations: list[_NormalEquations] = []
    for model in models:
        entry = _build_normal_equations(differences, model, rows, is_after, np.where(is_after, 0.0, 1.0)[None])
        leave = _build_normal_equations(differences, model, rows, ~is_after, np.where(is_after, 1.0, 0.0)[None])
        equations.append(_NormalEquations(
            entry.gram[firsts] + leave.gram[seconds],
            entry.moment[firsts] + signs[:, None] * leave.moment[seconds],
            entry.square[firsts] + leave.square[seconds],
        ))  # fmt: skip
    return np.concatenate([rows[firsts], rows[seconds]], axis=1), equations


def _build_short_equations(
    differences: ThirdDifferences, models: Models, starts: FrameIndices, frames: int
) -> tuple[Rows, list[_NormalEquations]]:
    """Return the third differences of offsets of so few `frames` that one spans both steps, and the equations by each model."""
    signs = _compare_signs(differences.track, starts, starts + frames)
    shifts = np.arange(-3, frames)
    rows, samples = starts[:, None] + shifts, shifts[:, None] + np.arange(4)
    is_inside = (samples >= 0) & (samples < frames)
    outside_weights = np.where(samples >= frames, signs[:, None, None], 1.0) * ~is_inside
    return rows, [_build_normal_equations(differences, model, rows, is_inside, outside_weights) for model in models]


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
    target = (target * _find_known_rows(differences, rows)[..., None]).reshape(len(rows), -1)
    slopes = (slopes * _find_known_rows(differences, rows)[..., None, None]).reshape(len(rows), target.shape[1], -1)
    transposed = np.swapaxes(slopes, 1, 2)
    return _NormalEquations(transposed @ slopes, (transposed @ target[:, :, None])[:, :, 0], (target**2).sum(1))


def _find_known_rows(differences: ThirdDifferences, rows: Rows) -> Bool[np.ndarray, "n R"]:
    clipped = np.clip(rows, 0, len(differences.is_known) - 1)
    return differences.is_known[clipped] & (rows == clipped)


def _solve_equations(equations: _NormalEquations) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, " S"]]:
    """Return the squares that remain, and the amounts of the offsets in radians or metres."""
    count = equations.gram.shape[1]
    ridge = RELATIVE_RIDGE * np.trace(equations.gram, axis1=1, axis2=2) + np.finfo(float).tiny
    unknowns = np.linalg.solve(equations.gram + ridge[:, None, None] * np.eye(count), equations.moment[..., None])[..., 0]
    residual = np.maximum(equations.square - (equations.moment * unknowns).sum(1), 0.0)
    if count == 3:  # a position
        return residual, np.linalg.norm(unknowns, axis=1)
    # a quaternion, whose real part is the last of four numbers, or the first of two
    real, imaginary = (unknowns[:, 3], unknowns[:, :3]) if count == 4 else (unknowns[:, 0], unknowns[:, 1:])
    return residual, 2 * np.arctan2(np.linalg.norm(imaginary, axis=1), np.abs(real))


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
    known = np.where(is_known, difference, 0.0)
    usual = scipy.ndimage.median_filter(known, 2 * round(BACKGROUND_HALF_WINDOW_S * rate) + 1, mode="nearest")
    background = BACKGROUND_MEDIAN_FACTOR * np.maximum(usual, np.quantile(known, BACKGROUND_QUANTILE))
    background = np.maximum(background, thresholds.min_difference)
    starts, stops = _list_step_pairs(*_find_steps(np.where(is_known, difference / background, 0.0)), rate)
    candidates = [
        each
        for each in _fit_offsets(ThirdDifferences(track, is_known, background), models, starts, stops)
        if each.amount >= thresholds.min_amount
        and each.evidence >= MIN_EVIDENCE * (1 + (each.last - each.first + 1) / rate / EVIDENCE_DOUBLING_S)
    ]
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
    starts: Int[np.ndarray, " S"], power: Float[np.ndarray, " S"], rate: float
) -> tuple[FrameIndices, FrameIndices]:
    """Return the pairs of steps, in order, that are near and alike enough to be one offset's."""
    firsts, seconds = np.triu_indices(len(starts), 1)
    is_partner = (starts[seconds] - starts[firsts] <= MAX_OFFSET_DURATION_S * rate) & (
        np.abs(np.log(power[seconds] / power[firsts])) < np.log(MAX_STEP_POWER_RATIO)
    )
    return starts[firsts[is_partner]], starts[seconds[is_partner]]


def _fit_offsets(
    differences: ThirdDifferences, models: Models, starts: FrameIndices, stops: FrameIndices
) -> list[TemporaryOffset]:
    """Fit offsets of the frames starts..stops - 1; return those whose constant removes both steps."""
    found: list[TemporaryOffset] = []
    for frames in range(1, MIN_SEPARATE_STEPS + 1):
        is_chosen = np.minimum(stops - starts, MIN_SEPARATE_STEPS) == frames
        first, stop = starts[is_chosen], stops[is_chosen]
        if len(first) and frames == MIN_SEPARATE_STEPS:
            found += _select_offsets(differences, first, stop, *_build_long_equations(differences, models, first, stop))
        elif len(first):
            found += _select_offsets(differences, first, stop, *_build_short_equations(differences, models, first, frames))
    return found


def _select_offsets(
    differences: ThirdDifferences, starts: FrameIndices, stops: FrameIndices, rows: Rows, equations: list[_NormalEquations]
) -> list[TemporaryOffset]:
    """Return the offsets of whose third differences, in `rows`, so little remains and so much is removed, by the best model."""
    residuals, amounts = map(np.array, zip(*map(_solve_equations, equations), strict=True))
    residual, amount = residuals.min(0), np.take_along_axis(amounts, residuals.argmin(0)[None], axis=0)[0]
    clipped, is_row = np.clip(rows, 0, len(differences.is_known) - 1), _find_known_rows(differences, rows)
    count = np.maximum(is_row.sum(1), 2)
    before = ((np.diff(differences.track, 3, axis=0) ** 2).sum(1)[clipped] * is_row).sum(1)
    background_power = np.maximum((differences.background[clipped] ** 2 * is_row).sum(1) / count, np.finfo(float).tiny)
    reduction, remaining = (before - residual) / count / background_power, residual / (count - 1) / background_power
    evidence = reduction / (MIN_EVIDENCE_RESIDUAL + remaining)
    is_offset = (starts >= 2) & (stops <= len(differences.track) - 2) & (count >= MIN_DIFFERENCES)
    is_offset &= (residual <= MAX_RESIDUAL_SHARE * before) & (reduction >= MIN_REDUCTION_RATIO)
    is_offset &= (residual <= NEGLIGIBLE_RESIDUAL_SHARE * before) | (remaining <= MAX_RESIDUAL_RATIO)
    columns = (each[is_offset].tolist() for each in (starts, stops - 1, amount, evidence))
    return [TemporaryOffset(*values) for values in zip(*columns, strict=True)]


def build_rotation_offset_models(quaternions: Float[np.ndarray, "T 4"], order: str) -> tuple[OffsetModel, ...]:
    """Return the models of quaternions (x, y, z, w) without sign changes, each times two.

    They are an offset in the parent's axes, in the joint's own and, if the joint has three axes, in the middle angle of an
    `order` of intrinsic rotations such as "ZYX".
    """
    q, zeros, units = 2 * quaternions, np.zeros_like(quaternions), np.eye(4)
    products = multiply_quaternions(units[:, None], units)
    in_parent, in_joint = (np.swapaxes(np.tensordot(q, products, (1, axis)), 1, 2) for axis in (1, 0))
    models = [OffsetModel(zeros, basis, 3) for basis in (in_parent, in_joint)]
    if len(order) == 3:
        rotations = scipy.spatial.transform.Rotation.from_quat(quaternions)
        with catch_warnings(action="ignore"):  # in gimbal lock, where any outer angle is right
            outer = scipy.spatial.transform.Rotation.from_euler(order[0], rotations.as_euler(order)[:, :1])
        axis = outer.apply(np.eye(3)["XYZ".index(order[1])])
        derivative = multiply_quaternions(np.pad(axis, ((0, 0), (0, 1))), q)
        models.append(OffsetModel(zeros, np.stack([q, derivative], axis=2), 1))
    return tuple(models)


def build_position_offset_models(positions: Float[np.ndarray, "T 3"]) -> tuple[OffsetModel, ...]:
    """Return the only model of positions: an offset vector."""
    return (OffsetModel(positions, np.broadcast_to(np.eye(3), (len(positions), 3, 3)), 3),)


def fit_smoothest_offset(
    known: Float[np.ndarray, "N C"],
    known_times_s: Float[np.ndarray, " N"],
    models: tuple[OffsetModel, ...],
    span_times_s: Float[np.ndarray, " n"],
    used_samples: Int[np.ndarray, " U"],
) -> tuple[Float[np.ndarray, "n C"], float]:
    """Return the corrected samples inside a span that continue the known samples most smoothly, and the correction's variance per
    axis.

    The signal is a Gaussian process (Matern-5/2) about an unknown mean. Models are compared by their least squares and, as they
    differ in the number of unknowns, by Schwarz's criterion.

    Args:
        known: Samples beside the span, at `known_times_s`.
        models: Of the span's samples, at `span_times_s`; the most likely one is used.
        used_samples: Indices of the span's samples that are fitted: samples far from both edges contain no information.
    """
    times_s = np.r_[known_times_s, span_times_s[used_samples]]
    covariance = OFFSET_MEAN_VARIANCE_RATIO + compute_matern_52(times_s[:, None] - times_s, OFFSET_TIME_SCALE_S)
    factor = np.linalg.cholesky(covariance + OFFSET_NOISE_VARIANCE_RATIO * np.eye(len(times_s)))
    best_criterion, best = np.inf, (np.zeros((len(span_times_s), known.shape[1])), np.inf)
    for model in models:
        values = np.concatenate([known, model.fixed[used_samples]])
        slopes = np.concatenate([np.zeros((len(known), *model.basis.shape[1:])), model.basis[used_samples]])
        white_values = scipy.linalg.solve_triangular(factor, values, lower=True).ravel()
        white_slopes = scipy.linalg.solve_triangular(factor, slopes.reshape(len(times_s), -1), lower=True)
        white_slopes = white_slopes.reshape(len(white_values), -1)
        unknowns = np.linalg.lstsq(white_slopes, -white_values, rcond=None)[0]
        square = float(((white_slopes @ unknowns + white_values) ** 2).sum()) + MIN_RESIDUAL_SQUARE
        criterion = 3 * len(times_s) * np.log(square) + model.dof * np.log(3 * len(times_s))
        if criterion < best_criterion:
            variance = square / (3 * len(times_s)) * np.trace(np.linalg.pinv(white_slopes.T @ white_slopes)) / 3
            is_rotation = model.dof < known.shape[1]  # a variance of quaternions, a quarter of the rotation vectors'
            best_criterion, best = criterion, (model.fixed + model.basis @ unknowns, 4 * variance if is_rotation else variance)
    return best
