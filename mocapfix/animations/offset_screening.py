"""A quick estimate of how much of a track's steps the removal of a constant offset leaves.

Fitting an offset takes a hundred times longer than this estimate, which solves the normal equations of all pairs of steps at
once, and which few pairs pass. The estimate is a lower bound, so no offset that would be found is lost.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.stats.constant_offsets import OffsetModel

THIRD_DIFFERENCE_STENCIL = np.array([-1.0, 3.0, -3.0, 1.0])
MIN_REDUCTION_RATIO = 15.0  # of the mean square that is removed to the usual one
MAX_RESIDUAL_SHARE = 0.05  # of the squares that may remain
MIN_SEPARATE_STEPS = 3  # frames from one step to another without which a third difference spans both
RELATIVE_RIDGE = 1e-13  # added to normal equations, relative to their trace, so that they have a solution
RELATIVE_ROUNDING = 1e-9  # of the squares of the targets: subtracted from the squares that remain, which rounding changes by less


class ThirdDifferences(NamedTuple):
    """Of a track: its values, where third differences are known, and how large they usually are there."""

    track: Float[np.ndarray, "T C"]
    is_known: Bool[np.ndarray, " D"]
    background: Float[np.ndarray, " D"]


class _NormalEquations(NamedTuple):
    """Least squares of S offsets, over some third differences of each: slopes' slopes, slopes' target, target' target."""

    gram: Float[np.ndarray, "S P P"]
    moment: Float[np.ndarray, "S P"]
    square: Float[np.ndarray, " S"]


def screen_offsets(
    differences: ThirdDifferences,
    models: tuple[OffsetModel, ...],
    starts: Int[np.ndarray, " n"],
    stops: Int[np.ndarray, " n"],
) -> Bool[np.ndarray, " n"]:
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


def _screen_long_offsets(
    differences: ThirdDifferences,
    models: tuple[OffsetModel, ...],
    starts: Int[np.ndarray, " n"],
    stops: Int[np.ndarray, " n"],
) -> Bool[np.ndarray, " n"]:
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


def _screen_short_offsets(
    differences: ThirdDifferences, models: tuple[OffsetModel, ...], starts: Int[np.ndarray, " n"], frames: int
) -> Bool[np.ndarray, " n"]:
    """Return whether a constant in the few `frames` from each start may remove the steps at both ends."""
    signs = _compare_signs(differences.track, starts, starts + frames)
    shifts = np.arange(-3, frames)
    rows, samples = starts[:, None] + shifts, shifts[:, None] + np.arange(4)
    is_inside = (samples >= 0) & (samples < frames)
    outside_weights = np.where(samples >= frames, signs[:, None, None], 1.0) * ~is_inside
    equations = (_build_normal_equations(differences, model, rows, is_inside, outside_weights) for model in models)
    return _is_removable(differences, rows, np.minimum.reduce([_bound_residual(each) for each in equations]))


def _compare_signs(
    track: Float[np.ndarray, "T C"], starts: Int[np.ndarray, " n"], stops: Int[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
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


def _is_removable(
    differences: ThirdDifferences, rows: Int[np.ndarray, "n R"], residual: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Return whether so little may remain of the third differences in `rows` as `_fit_offset` demands."""
    clipped, is_row = np.clip(rows, 0, len(differences.is_known) - 1), _is_known_row(differences, rows)
    third_differences = np.diff(differences.track, 3, axis=0)
    before = ((third_differences**2).sum(1)[clipped] * is_row).sum(1)
    background_square = (differences.background[clipped] ** 2 * is_row).sum(1)
    return (residual <= MAX_RESIDUAL_SHARE * before) & (before - residual >= MIN_REDUCTION_RATIO * background_square)


def _is_known_row(differences: ThirdDifferences, rows: Int[np.ndarray, "n R"]) -> Bool[np.ndarray, "n R"]:
    clipped = np.clip(rows, 0, len(differences.is_known) - 1)
    return differences.is_known[clipped] & (rows == clipped)
