"""Shifted: markers that go elsewhere on their segment and stay there, by more than the solved body follows.

A marker's path on its segment is what the body leaves of its motion. How far the joints about it turn explains a part of
that, for no joint is quite where the body has it, and no skin keeps quite still. What they leave is fitted by one change, at any
time: at once (knocked, stuck on again) or slowly (it slides). It is believed where it is large beside all else that is left.

The body leans towards a marker that was moved, so that others about it seem to move, too: of those on joints next to each
other only the greatest change is believed, and then the body is asked again.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from mocapfix.detect import ramp_fit
from mocapfix.detect.body_residuals import BodyResiduals
from mocapfix.detect.ramp_fit import Ramp, RegressedPath, regress_out
from mocapfix.faults import MarkerShift
from mocapfix.motion import Motion
from mocapfix.skeleton import Skeleton
from mocapfix.subject import Subject
from mocapfix.take import Take

SHIFT_SAMPLE_RATE_HZ = 10.0  # Hz: so many frames a second are looked at
MIN_OBSERVED_DURATION_S = 4.0  # seconds: for how long a marker is seen at least
ROTATION_RIDGE_RAD = 0.1  # radians: a turn of a joint that means nothing
MIN_SHIFT_M = 0.008  # metres: of what the body leaves of a change
MIN_SHIFT_MARGIN_S = 1.0  # seconds: what must be seen before and after a change
MIN_KNOCK_RATIO = 1.8  # times what else is left: how large a knock is at least
KNOCK_SEARCH_WINDOW_S, KNOCK_AVERAGE_WINDOW_S = (
    1.0,
    0.03,
)  # seconds about a knock in which its frame is looked for, and just before and after that frame
MIN_JUMP_FRACTION, MIN_BACKGROUND_JUMP_RATIO = (
    0.5,
    8.0,
)  # of the change, and times what it usually jumps about then: what the marker jumps there at least
MIN_SLIDE_DURATION_S, SLIDE_AVERAGE_WINDOW_S, MIN_SLIDE_RATIO = (
    4.0,
    1.0,
    3.5,
)  # seconds a slide lasts at least, those of a mean, and times what those leave


class ShiftEstimate(NamedTuple):
    """A marker that is elsewhere on its segment from frame `settled` on; until `first` it is where it was.

    size  metres, as far as the body does not follow;  gain  square metres: what of its path that explains
    sure  times what else is left of its path, and what is needed
    """

    marker: int
    first: int
    settled_frame: int
    size_m: float
    gain_m2: float
    relative_ratio: float


def detect_marker_shifts(residuals: BodyResiduals, subject: Subject, motion: Motion, rate: float) -> list[ShiftEstimate]:
    """-> the markers that seem to be shifted, by index: at most one change of each.

    off  how far the samples of the subject's markers lie off the body that has this motion; rate in Hz
    """
    step = max(1, round(rate / SHIFT_SAMPLE_RATE_HZ))
    turns = {joint: _sample_joint_rotations(subject.skeleton, motion, joint, step) for joint in set(subject.joints.tolist())}
    seen = (
        _detect_shift(residuals.residual_segment[:, k], turns[int(joint)], k, rate, step)
        for k, joint in enumerate(subject.joints)
    )
    return [shift for shift in seen if shift]


def select_dominant_shifts(shifts: list[ShiftEstimate], subject: Subject) -> list[ShiftEstimate]:
    """-> those on joints not next to that of a greater one, the greatest first."""
    chosen: list[ShiftEstimate] = []
    for shift in sorted(shifts, key=lambda each: -each.gain_m2):
        if not any(are_joints_adjacent(subject, shift.marker, other.marker) for other in chosen):
            chosen.append(shift)
    return chosen


def are_joints_adjacent(subject: Subject, one: int, other: int) -> bool:
    """Are two markers on the same joint, or on one and its parent?"""
    a, b = int(subject.joints[one]), int(subject.joints[other])
    return a == b or subject.skeleton.parents[a] == b or subject.skeleton.parents[b] == a


def build_shift_fault(shift: ShiftEstimate, take: Take) -> MarkerShift:
    """-> a shift as a marker that was knocked or slid."""
    label, seconds = take.bare_labels[shift.marker], (shift.settled_frame - shift.first) / take.rate
    how = f"slides in {seconds:.0f} s" if seconds else "is knocked"
    reason = f"{label} {how} and stays elsewhere on its segment: {shift.size_m * 1e3:.0f} mm of that the body cannot follow."
    kind, sure = ("drift" if seconds else "moved"), shift.relative_ratio / (1 + shift.relative_ratio)
    return MarkerShift(
        kind, shift.marker, shift.first, take.frame_count - 1, shift.size_m, reason, sure, settled_frame=shift.settled_frame
    )


def _sample_joint_rotations(skeleton: Skeleton, motion: Motion, joint: int, step: int) -> np.ndarray:
    """-> (N, 3 J) radians: how a joint, but the root, and its children are turned in every `step`th frame."""
    about = [j for j, parent in enumerate(skeleton.parents) if joint in (j, parent) and parent >= 0]
    return np.concatenate([Rotation.from_matrix(motion.local_rotations[::step, j]).as_rotvec() for j in about], axis=1)


def _detect_shift(path: np.ndarray, joint_rotvecs: np.ndarray, marker: int, rate: float, step: int) -> ShiftEstimate | None:
    """-> the change that explains most of a marker's path (T, 3) metres, None where it is not sure that there is one."""
    some, pace = path[::step], rate / step
    frames = np.flatnonzero(~np.isnan(some[:, 0]))
    if len(frames) < MIN_OBSERVED_DURATION_S * pace:
        return None
    there = regress_out(joint_rotvecs[frames], median_filter(some[frames], (3, 1), mode="nearest"), frames, ROTATION_RIDGE_RAD)
    knock, slide = (
        ramp_fit.fit_step(there, round(MIN_SHIFT_MARGIN_S * pace)),
        ramp_fit.fit_slow_ramp(there, round(MIN_SLIDE_DURATION_S * pace), round(SLIDE_AVERAGE_WINDOW_S * pace)),
    )
    sudden = (
        knock and (slide is None or knock.gain_m2 > slide.gain_m2) and _evaluate_knock(path, there, knock, marker, rate, step)
    )
    return sudden or (slide and _evaluate_slide(there, slide, marker, pace, step))


def _evaluate_knock(
    path: np.ndarray, regressed: RegressedPath, ramp: Ramp, marker: int, rate: float, step: int
) -> ShiftEstimate | None:
    sure = ramp.size_m / ramp_fit.compute_residual_rms(regressed, ramp, 1) / MIN_KNOCK_RATIO
    before, after = (int(regressed.frames[at]) * step for at in (ramp.start, ramp.end))
    first, jump, usual = _locate_knock(path, before, after, ramp.displacement, rate)
    if ramp.size_m < MIN_SHIFT_M or sure < 1 or jump < max(MIN_JUMP_FRACTION * ramp.size_m, MIN_BACKGROUND_JUMP_RATIO * usual):
        return None
    return ShiftEstimate(marker, first, first, ramp.size_m, ramp.gain_m2, sure)


def _evaluate_slide(regressed: RegressedPath, ramp: Ramp, marker: int, pace: float, step: int) -> ShiftEstimate | None:
    """-> a slow change, None where it is not sure, or is not seen to begin and to end, or would rather be quicker."""
    sure = ramp.size_m / ramp_fit.compute_residual_rms(regressed, ramp, round(SLIDE_AVERAGE_WINDOW_S * pace)) / MIN_SLIDE_RATIO
    within = MIN_SHIFT_MARGIN_S * pace <= ramp.start and ramp.end <= len(regressed.residual) - MIN_SHIFT_MARGIN_S * pace
    if ramp.size_m < MIN_SHIFT_M or sure < 1 or not within or ramp.end - ramp.start <= round(MIN_SLIDE_DURATION_S * pace):
        return None
    first, settled = (int(regressed.frames[at]) * step for at in (ramp.start, ramp.end))
    return ShiftEstimate(marker, first, settled, ramp.size_m, ramp.gain_m2, sure)


def _locate_knock(path: np.ndarray, before: int, after: int, displacement: np.ndarray, rate: float) -> tuple[int, float, float]:
    """-> the first frame at the new place, how far the marker jumps there along `way` (3,), and how far it usually does, metres.

    Of the frames from BESIDE before to BESIDE after those given, the one at which the path (T, 3) jumps farthest.
    """
    begin, aside = max(0, before - round(KNOCK_SEARCH_WINDOW_S * rate)), max(1, round(KNOCK_AVERAGE_WINDOW_S * rate))
    along = path[begin : after + round(KNOCK_SEARCH_WINDOW_S * rate) + 1] @ (displacement / np.linalg.norm(displacement))
    seen = np.flatnonzero(~np.isnan(along))
    if len(seen) < 4 * aside:
        return after, 0.0, 0.0
    total, cuts = np.r_[0, np.cumsum(along[seen])], np.arange(aside, len(seen) - aside + 1)
    jump = (total[cuts + aside] - 2 * total[cuts] + total[cuts - aside]) / aside
    most = int(jump.argmax())
    usual = np.sqrt(np.mean(jump[abs(cuts - cuts[most]) >= aside] ** 2))
    return begin + int(seen[cuts[most]]), float(jump[most]), float(usual)
