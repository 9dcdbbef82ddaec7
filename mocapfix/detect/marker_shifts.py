"""Marker shifts: markers that move to another position on their segment and stay there, by more than the solved body follows.

A marker's path on its segment is the part of its motion that the body does not explain. The rotations of the adjacent joints
explain some of it, because no joint is exactly where the body has it and skin moves: that part is removed by ridge regression.
The rest is fitted by one ramp, sudden (a marker that was knocked or attached again) or slow (a marker that slides), together
with the regression, so that a change that coincides with one of pose is neither missed nor overestimated. The product of a ramp
with a column is a difference of cumulative sums, so that all ramps are tried. The largest is accepted if it is large relative
to the remaining residual.

The body follows a marker that has moved, so that its neighbours seem to move as well. Of the markers on adjacent joints only
the largest change is accepted, and the body is solved again.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mocapfix.detect.body_outliers import BodyResiduals
from mocapfix.model.faults import MarkerShift
from mocapfix.model.motion import Motion
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.stats.rigid_alignment import compute_rotation_vectors


class RegressedPath(NamedTuple):
    """A marker's path over the N frames in which it is visible, after the regression."""

    basis: np.ndarray  # columns (N, 1 + F) of the regression, a constant first, orthonormal but for the ridge
    residual: np.ndarray  # residual (N, 3) of the position in metres
    frames: np.ndarray  # frame indices (N,)
    step_products: np.ndarray  # (N, 4 + F) the sums of the products of residual and basis with the steps up to each sample


def regress_out(
    features: Float[np.ndarray, "N F"], path: Float[np.ndarray, "N 3"], frames: Int[np.ndarray, " N"], ridge: float
) -> RegressedPath:
    """Remove the part of a path that varies with the features.

    Args:
        features: Features of each frame.
        ridge: Variation of a feature that is insignificant.
    """
    count = len(features)
    u, singular_values, _ = np.linalg.svd(features - features.mean(0), full_matrices=False)
    gain = singular_values**2 / (singular_values**2 + count * ridge**2)
    basis = np.column_stack([np.full(count, count**-0.5), u * np.sqrt(gain)])
    residual = path - basis @ (basis.T @ path)
    after = np.cumsum(np.concatenate([residual, basis], axis=1)[::-1], axis=0)[::-1]
    return RegressedPath(basis, residual, frames, np.cumsum(after, axis=0))


class Ramp(NamedTuple):
    """A change of position."""

    start: int  # index of the last sample at the old position
    end: int  # index of the first sample at the new position
    displacement: np.ndarray  # displacement (3,) in metres in the segment's axes
    gain_m2: float  # reduction of the sum of squared residuals, in square metres

    @property
    def size_m(self) -> float:
        """Length of the displacement in metres."""
        return float(np.linalg.norm(self.displacement))

    def compute_progress(self, count: int) -> Float[np.ndarray, " N"]:
        """Compute the fraction of the displacement, 0..1, at each of `count` samples."""
        return np.clip((np.arange(count) - self.start) / (self.end - self.start), 0, 1)


def fit_best_ramp(path: RegressedPath, starts: Int[np.ndarray, " P"], ends: Int[np.ndarray, " P"]) -> Ramp:
    """Return the ramp with the largest gain among those from `starts` to `ends` (sample indices)."""
    count, lengths = len(path.residual), ends - starts
    product = (path.step_products[ends] - path.step_products[starts]) / lengths[:, None]
    square = (lengths + 1) * (2 * lengths + 1) / (6 * lengths) + count - 1 - ends
    unexplained = np.maximum(square - (product[:, 3:] ** 2).sum(1), 1e-9)
    gain = (product[:, :3] ** 2).sum(1) / unexplained
    best = int(gain.argmax())
    return Ramp(int(starts[best]), int(ends[best]), product[best, :3] / unexplained[best], float(gain[best]))


def fit_step(path: RegressedPath, edge: int) -> Ramp | None:
    """Fit the best change from one sample to the next, at least `edge` samples and one from both ends."""
    edge = max(edge, 1)
    ends = np.arange(edge, len(path.residual) - edge + 1)
    return fit_best_ramp(path, ends - 1, ends) if len(ends) else None


def fit_slow_ramp(path: RegressedPath, min_length: int, step: int) -> Ramp | None:
    """Fit the best change over at least `min_length` samples, its ends first to `step` samples, then to a fifth of that."""
    count, min_length, step = len(path.residual), max(min_length, 1), max(step, 1)
    grid = np.arange(0, count, step)
    coarse = _fit_ramp_on_grid(path, grid, grid, min_length)
    if coarse is None:
        return None
    offsets = np.arange(-step, step + 1, max(1, step // 5))
    starts, ends = (coarse.start + offsets).clip(0, count - 1), (coarse.end + offsets).clip(0, count - 1)
    return _fit_ramp_on_grid(path, starts, ends, min_length)


def _fit_ramp_on_grid(path: RegressedPath, starts: np.ndarray, ends: np.ndarray, min_length: int) -> Ramp | None:
    pairs = np.stack(np.meshgrid(starts, ends), -1).reshape(-1, 2)
    pairs = pairs[pairs[:, 1] - pairs[:, 0] >= min_length]
    return fit_best_ramp(path, pairs[:, 0], pairs[:, 1]) if len(pairs) else None


def compute_residual_rms(path: RegressedPath, ramp: Ramp, block_length: int) -> float:
    """Compute the root mean square in metres of the residual with the ramp removed, averaged over blocks of samples."""
    progress = ramp.compute_progress(len(path.residual))
    residual = path.residual - np.outer(progress - path.basis @ (path.basis.T @ progress), ramp.displacement)
    block_count = max(1, len(residual) // max(block_length, 1))
    length, longer = divmod(len(residual), block_count)
    starts = np.arange(block_count) * length + np.minimum(np.arange(block_count), longer)
    residual = np.add.reduceat(residual, starts) / np.diff(starts, append=len(residual))[:, None]
    return float(np.sqrt(np.mean((residual**2).sum(1))))


SHIFT_SAMPLE_RATE_HZ = 10.0  # rate to which the paths are reduced
MIN_OBSERVED_DURATION_S = 4.0  # a marker that is visible for a shorter time is not judged
ROTATION_RIDGE_RAD = 0.1  # insignificant variation of a joint rotation
MIN_SHIFT_M = 0.008  # smallest displacement that the body does not follow
MIN_SHIFT_MARGIN_S = 1.0  # visible time before and after a change
MIN_KNOCK_RATIO = 1.8  # smallest displacement of a knock, relative to the remaining residual
# Time around a knock in which its frame is searched, and over which the position before and after the frame is averaged.
KNOCK_SEARCH_WINDOW_S = 1.0
KNOCK_AVERAGE_WINDOW_S = 0.03
# Smallest jump at the frame of a knock: relative to its displacement, and to the usual jumps around it.
MIN_JUMP_FRACTION = 0.5
MIN_BACKGROUND_JUMP_RATIO = 8.0
# Shortest slide, and the blocks over which its residual is averaged.
MIN_SLIDE_DURATION_S = 4.0
SLIDE_AVERAGE_WINDOW_S = 1.0
MIN_SLIDE_RATIO = 3.5  # smallest displacement of a slide, relative to the remaining residual


class ShiftEstimate(NamedTuple):
    """A marker that moves on its segment."""

    marker: int  # index of the marker
    first: int  # index of the first frame off the old position
    settled_frame: int  # index of the first frame at the new position
    size_m: float  # displacement in metres that the body does not follow
    gain_m2: float  # reduction of the sum of squared residuals of its path, in square metres
    relative_ratio: float  # displacement relative to the remaining residual, divided by the smallest ratio that is accepted


class _MarkerPath(NamedTuple):
    """The path of a marker on its segment."""

    marker: int  # index of the marker
    residual: np.ndarray  # position (T, 3) in metres, NaN where missing
    regressed: RegressedPath  # every `step`-th position, after the regression
    rate: float  # frame rate in Hz
    step: int  # number of frames from one reduced sample to the next

    @property
    def reduced_rate(self) -> float:
        return self.rate / self.step


def detect_marker_shifts(residuals: BodyResiduals, subject: Subject, motion: Motion, rate: float) -> list[ShiftEstimate]:
    """Detect markers that seem to move on their segments, ordered by marker; at most one change of each."""
    step = max(1, round(rate / SHIFT_SAMPLE_RATE_HZ))
    sampled = motion.local_rotations[::step]
    rotvecs = compute_rotation_vectors(sampled)
    rotvecs_by_joint: dict[int, np.ndarray] = {}  # (N, 3 J): of a joint, except the root, and of its children
    for joint in set(subject.joints.tolist()):
        adjacent = [j for j, parent in enumerate(subject.skeleton.parents) if joint in (j, parent) and parent >= 0]
        rotvecs_by_joint[joint] = rotvecs[:, adjacent].reshape(len(sampled), -1)
    shifts: list[ShiftEstimate] = []
    for k, joint in enumerate(subject.joints):
        shift = _detect_shift(residuals.residual_segment[:, k], rotvecs_by_joint[int(joint)], k, rate, step)
        if shift:
            shifts.append(shift)
    return shifts


def select_dominant_shifts(shifts: list[ShiftEstimate], subject: Subject) -> list[ShiftEstimate]:
    """Remove the shifts on joints adjacent to that of a larger one; return the rest, the largest first."""
    selected: list[ShiftEstimate] = []
    for shift in sorted(shifts, key=lambda shift: -shift.gain_m2):
        if not any(are_joints_adjacent(subject, shift.marker, other.marker) for other in selected):
            selected.append(shift)
    return selected


def are_joints_adjacent(subject: Subject, one: int, other: int) -> bool:
    """Return whether two markers are on the same joint, or on a joint and its parent."""
    a, b = int(subject.joints[one]), int(subject.joints[other])
    return bool(a == b or subject.skeleton.parents[a] == b or subject.skeleton.parents[b] == a)


def build_shift_fault(shift: ShiftEstimate, take: Take) -> MarkerShift:
    """Build the fault of a marker that was knocked, or that slid."""
    label, duration_s = take.bare_labels[shift.marker], (shift.settled_frame - shift.first) / take.rate
    motion = f"slides for {duration_s:.0f} s" if duration_s else "is knocked"
    size = f"{shift.size_m * 1e3:.0f} mm not explained by the body"
    reason = f"{label} {motion} and keeps a new position on its segment: {size}."
    kind, confidence = ("drift" if duration_s else "moved"), shift.relative_ratio / (1 + shift.relative_ratio)
    return MarkerShift(
        kind, shift.marker, shift.first, take.frame_count - 1, shift.size_m, reason, confidence, settled_frame=shift.settled_frame
    )


def _detect_shift(residual: np.ndarray, joint_rotvecs: np.ndarray, marker: int, rate: float, step: int) -> ShiftEstimate | None:
    """Detect the change that explains most of a marker's path (T, 3) in metres; None if none is certain."""
    reduced, reduced_rate = residual[::step], rate / step
    frames = np.flatnonzero(~np.isnan(reduced[:, 0]))
    if len(frames) < MIN_OBSERVED_DURATION_S * reduced_rate:
        return None
    before, own, after = reduced[np.r_[frames[:1], frames[:-1]]], reduced[frames], reduced[np.r_[frames[1:], frames[-1:]]]
    smoothed = np.maximum(np.minimum(before, own), np.minimum(np.maximum(before, own), after))  # the median of the three
    regressed = regress_out(joint_rotvecs[frames], smoothed, frames, ROTATION_RIDGE_RAD)
    path = _MarkerPath(marker, residual, regressed, rate, step)
    knock = fit_step(regressed, round(MIN_SHIFT_MARGIN_S * reduced_rate))
    slide = fit_slow_ramp(regressed, round(MIN_SLIDE_DURATION_S * reduced_rate), round(SLIDE_AVERAGE_WINDOW_S * reduced_rate))
    if knock and (slide is None or knock.gain_m2 > slide.gain_m2):
        shift = _evaluate_knock(path, knock)
        if shift:
            return shift
    return _evaluate_slide(path, slide) if slide else None


def _evaluate_knock(path: _MarkerPath, ramp: Ramp) -> ShiftEstimate | None:
    """Return a sudden change; None if it is not certain, or if the marker does not jump."""
    relative_ratio = ramp.size_m / compute_residual_rms(path.regressed, ramp, 1) / MIN_KNOCK_RATIO
    frame, jump_m, usual_jump_m = _locate_knock(path, ramp)
    min_jump_m = max(MIN_JUMP_FRACTION * ramp.size_m, MIN_BACKGROUND_JUMP_RATIO * usual_jump_m)
    if ramp.size_m < MIN_SHIFT_M or relative_ratio < 1 or jump_m < min_jump_m:
        return None
    return ShiftEstimate(path.marker, frame, frame, ramp.size_m, ramp.gain_m2, relative_ratio)


def _evaluate_slide(path: _MarkerPath, ramp: Ramp) -> ShiftEstimate | None:
    """Return a slow change; None if it is not certain, if its begin or end is not visible, or if a faster one fits better."""
    block_length = round(SLIDE_AVERAGE_WINDOW_S * path.reduced_rate)
    relative_ratio = ramp.size_m / compute_residual_rms(path.regressed, ramp, block_length) / MIN_SLIDE_RATIO
    margin = MIN_SHIFT_MARGIN_S * path.reduced_rate
    is_inside = margin <= ramp.start and ramp.end <= len(path.regressed.residual) - margin
    is_shortest = ramp.end - ramp.start <= round(MIN_SLIDE_DURATION_S * path.reduced_rate)
    if ramp.size_m < MIN_SHIFT_M or relative_ratio < 1 or not is_inside or is_shortest:
        return None
    first, settled = (int(path.regressed.frames[index]) * path.step for index in (ramp.start, ramp.end))
    return ShiftEstimate(path.marker, first, settled, ramp.size_m, ramp.gain_m2, relative_ratio)


def _locate_knock(path: _MarkerPath, ramp: Ramp) -> tuple[int, float, float]:
    """Locate the largest jump along the displacement, at most KNOCK_SEARCH_WINDOW_S before or after the ramp.

    Returns:
        The first frame at the new position, the jump there, and the usual jump, in metres.
    """
    before, after = (int(path.regressed.frames[index]) * path.step for index in (ramp.start, ramp.end))
    reach, half_width = round(KNOCK_SEARCH_WINDOW_S * path.rate), max(1, round(KNOCK_AVERAGE_WINDOW_S * path.rate))
    begin = max(0, before - reach)
    position_m = path.residual[begin : after + reach + 1] @ (ramp.displacement / np.linalg.norm(ramp.displacement))
    visible = np.flatnonzero(~np.isnan(position_m))
    if len(visible) < 4 * half_width:
        return after, 0.0, 0.0
    total = np.r_[0, np.cumsum(position_m[visible])]
    splits = np.arange(half_width, len(visible) - half_width + 1)
    jump_m = (total[splits + half_width] - 2 * total[splits] + total[splits - half_width]) / half_width
    largest = int(jump_m.argmax())
    usual_jump_m = np.sqrt(np.mean(jump_m[abs(splits - splits[largest]) >= half_width] ** 2))
    return begin + int(visible[splits[largest]]), float(jump_m[largest]), float(usual_jump_m)
