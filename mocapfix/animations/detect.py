"""Detection of faults in an animation's joint rotations and in the position of its root.

An animation has N = J + 1 tracks: the rotations of its J joints relative to their parents, and the position of its root (of the
hips where a reference node that does not move is above them). `detect_animation_faults` detects in this order:

- gaps (`detect_animation_gaps`), because the values that a file holds in a gap resemble every other fault: intervals without
  values, of zeros, or of one repeated value. A moving body does not repeat a value to the last digit, so such an interval is a
  gap if it ends in a jump; a figure that stands still on purpose does not jump. Zeros are a gap if the joint jumps to them and
  back; zeros of the whole figure at the start or end of a file are its rest pose;
- pops and flips (`offsets.detect_offsets`);
- jitter in what remains (`detect_jitter`): noise that is independent from frame to frame. Fourth differences amplify
  it by eight and contain almost nothing of a body's motion. Unlike fast motion, it has the same size in second differences, and
  is about all axes: a kick, a landing or a clap jerks a joint about one.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_closing, median_filter

from mocapfix.animations import offsets
from mocapfix.animations.offsets import OffsetModel, OffsetThresholds, TemporaryOffset
from mocapfix.kernels import lie
from mocapfix.model.animation import AXIS_LETTERS, Animation, list_track_names
from mocapfix.model.faults import Fault, FaultKind
from mocapfix.stats.rigid_alignment import multiply_quaternions
from mocapfix.stats.sequences import find_runs

MIN_HELD_DURATION_S = 0.1  # of one value in one track; if several tracks are held together, one frame is enough
MIN_HELD_FRAMES = 2
MAX_REPEATED_DIFFERENCE = 1e-9  # radians or metres between two frames that hold the same value
MIN_JUMP = np.radians(1.0)  # radians, or metres: a smaller jump is not visible
MIN_JUMP_RATIO = 2.0  # of a jump to the largest step in the frames next to it
MIN_SHORT_JUMP_RATIO = 3.0  # the same after one value in one track for less than MIN_HELD_DURATION_S
MIN_STOP_JUMP_RATIO = 1.0  # the same after several tracks stopped, together and from one frame to the next
JUMP_CONTEXT_FRAMES = 3  # frames that a jump is compared with
MAX_HELD_SHARE = 0.5  # a track that is held in a larger share of all frames is at rest, so holding is not a fault
WHOLE_FIGURE_SHARE = 0.8  # of the moving tracks: if more are lost at once, the whole figure is


class GapAppearance(StrEnum):
    """What a file holds in a gap."""

    ABSENT = "no values"
    ZERO = "all values are zero"
    HELD = "held at one value"


class AnimationGap(NamedTuple):
    """Tracks that are lost in the frames first..last, inclusive."""

    tracks: tuple[int, ...]
    first: int
    last: int
    appearance: GapAppearance


class TrackMotion(NamedTuple):
    """Motion of N tracks over T frames, NaN where unknown."""

    steps: Float[np.ndarray, "S N"]  # distance from each frame to the next, radians or metres
    rest_distances: Float[np.ndarray, "T N"]  # distance from the rest pose, likewise


def detect_animation_gaps(motion: TrackMotion, is_absent: Bool[np.ndarray, "T N"], rate: float) -> list[AnimationGap]:
    """Detect the gaps of N tracks, ordered by first frame. `is_absent` marks frames without a value."""
    steps, last_frame = motion.steps, len(motion.rest_distances) - 1
    is_held = np.vstack([np.zeros((1, steps.shape[1]), bool), steps < MAX_REPEATED_DIFFERENCE])
    is_zero = motion.rest_distances < MAX_REPEATED_DIFFERENCE
    is_moving = is_held.mean(0) < MAX_HELD_SHARE
    is_held, is_zero = is_held & is_moving, is_zero & is_moving
    min_held_frames = max(MIN_HELD_FRAMES, round(MIN_HELD_DURATION_S * rate))
    gaps = [
        AnimationGap(tracks, first, last, GapAppearance.ABSENT)
        for (first, last), tracks in _group_tracks(is_absent, np.ones_like(is_moving), lambda *_: True)
    ]

    def is_zero_gap(first: int, last: int, tracks: Sequence[int]) -> bool:
        is_inside = first > 0 and last < last_frame
        return is_inside and bool((_detect_jumps(steps[first - 1 :: -1], tracks) & _detect_jumps(steps[last:], tracks)).any())

    def is_held_gap(first: int, last: int, tracks: Sequence[int]) -> bool:
        if last == last_frame:
            return False
        # Two moving joints do not stop in the same frame, to the last digit.
        ratio = MIN_JUMP_RATIO if last - first + 1 >= min_held_frames or len(tracks) > 1 else MIN_SHORT_JUMP_RATIO
        if len(tracks) > 1 and (steps[max(first - 2, 0), list(tracks)] > MIN_JUMP).sum() > 1:
            ratio = MIN_STOP_JUMP_RATIO
        return (last > first or len(tracks) > 1) and bool(_detect_jumps(steps[last:], tracks, ratio).any())

    for (first, last), tracks in _group_tracks(is_zero, is_moving, is_zero_gap):
        gaps.append(AnimationGap(tracks, first, last, GapAppearance.ZERO))
    is_held &= ~is_zero
    for gap in gaps:  # and the frame after each
        is_held[gap.first : gap.last + 2, list(gap.tracks)] = False
    for (first, last), tracks in _group_tracks(is_held, is_moving, is_held_gap):
        if first > 1 and _detect_jumps(steps[first - 2 :: -1], tracks).any():
            first -= 1  # the frame to which it jumps: it does not hold the last sound value
            gaps = [gap for gap in gaps if (gap.tracks, gap.last) != (tracks, first - 1)]  # it may rest before the jump
        gaps.append(AnimationGap(tracks, first, last, GapAppearance.HELD))
    return sorted(gaps, key=lambda gap: gap.first)


def _detect_jumps(
    steps: Float[np.ndarray, "S N"], tracks: Sequence[int], ratio: float = MIN_JUMP_RATIO
) -> Bool[np.ndarray, " n"]:
    """Return, for each of the tracks, whether the first step is a jump compared with the steps that follow."""
    context = np.nanmax(steps[1 : 1 + JUMP_CONTEXT_FRAMES][:, tracks], axis=0, initial=0.0)
    return steps[0, tracks] > MIN_JUMP + ratio * context


def _group_tracks(
    mask: Bool[np.ndarray, "T N"], is_moving: Bool[np.ndarray, " N"], is_gap: Callable[[int, int, Sequence[int]], bool]
) -> Iterator[tuple[tuple[int, int], tuple[int, ...]]]:
    """Yield the (first, last) frames of each run of True that is a gap of the tracks that have it, and these tracks.

    Where nearly as many tracks as are moving are True, and this is a gap, the run is of all tracks.
    """
    every = tuple(range(mask.shape[1]))
    is_whole_figure = np.zeros(len(mask), bool)
    for first, last in find_runs(mask.sum(1) >= max(WHOLE_FIGURE_SHARE * is_moving.sum(), 1)):
        if is_gap(first, last, every):
            is_whole_figure[first : last + 1] = True
            yield (first, last), every
    tracks_by_run: dict[tuple[int, int], list[int]] = {}
    for track in every:
        for first, last in find_runs(mask[:, track]):
            if not is_whole_figure[first : last + 1].any():
                tracks_by_run.setdefault((first, last), []).append(track)
    yield from ((run, tuple(tracks)) for run, tracks in sorted(tracks_by_run.items()) if is_gap(*run, tracks))


POWER_WINDOW_S = 0.2  # over which the size of jitter is measured
MIN_POWER_WINDOW_FRAMES = 7  # a kink, as of a foot that lands, shows in three differences
MIN_JITTER_DURATION_S = 0.15
MIN_JITTER_FRAMES = 5
MEAN_TO_MEDIAN_RATIO = 1.27  # of the squared length of a normally distributed vector with three components
MIN_WINDOW_WHITENESS = 0.35  # ratio of the powers by fourth and by second differences in a window
MIN_BURST_WHITENESS = 0.7  # the same over a whole burst
MIN_MEDIAN_SHARE_ALL_AXES = 0.4  # ratio of the power by the median to that by the mean, for jitter about all axes
MIN_MEDIAN_SHARE_FEW_AXES = 0.15  # the same for jitter about fewer axes
MIN_AXIS_RATIO = 0.14  # of the weakest axis to the strongest, for jitter about all axes
MIN_ELSEWHERE_RATIO = 2.0  # of jitter about fewer axes to the 99th percentile of the same joint's differences elsewhere
ELSEWHERE_QUANTILE = 0.99
MIN_SINGLE_AXIS_FRAMES = 8  # for jitter about a single axis
MAX_SINGLE_AXIS_RATIO = 0.33  # of the second strongest axis to the strongest, for jitter about a single axis
FAINT_POWER_SHARE = 0.15  # of the minimum power, which a burst keeps up where it begins and ends
MAX_REPEATED_SHARE = 0.15  # of the steps of a burst: noise repeats no value, a rate that was raised one of two to six
FAINT_GAP_FRAMES = 4  # length of the window in which gaps of a faint burst are closed
STENCIL_POWER_BY_ORDER = {2: 6.0, 4: 70.0}  # sums of the squared binomial coefficients


class JitterThresholds(NamedTuple):
    """The least jitter of a track, in radians or metres."""

    min_sd: float  # standard deviation per axis
    max_motion: float  # per s^2, times the squared frame time: contribution of motion, which matters at low frame rates
    min_background_ratio: float  # to the usual jitter of the track, the median over the animation


class JitterBurst(NamedTuple):
    """Jitter in the frames first..last, inclusive, with the standard deviation per axis, in radians or metres."""

    first: int
    last: int
    sd: float


def detect_jitter(
    track: Float[np.ndarray, "T c"], is_usable: Bool[np.ndarray, " T"], rate: float, thresholds: JitterThresholds
) -> list[JitterBurst]:
    """Detect the jitter bursts of a track: positions, or twice a joint's quaternions (x, y, z, w), without sign changes."""
    if len(track) < 2 * MIN_JITTER_FRAMES:
        return []
    known = np.where(is_usable[:, None], track, np.nan)
    differences = {order: _compute_axis_differences(known, order) for order in STENCIL_POWER_BY_ORDER}
    fourth_power, second_power = ((differences[order] ** 2).sum(1) / (3 * STENCIL_POWER_BY_ORDER[order]) for order in (4, 2))
    is_known = ~np.isnan(fourth_power)
    if not is_known.any():
        return []
    window = max(MIN_POWER_WINDOW_FRAMES, round(POWER_WINDOW_S * rate)) | 1
    power, reference = (
        MEAN_TO_MEDIAN_RATIO * median_filter(np.nan_to_num(each), window) for each in (fourth_power, second_power)
    )
    usual_sd = np.sqrt(MEAN_TO_MEDIAN_RATIO * np.median(fourth_power[is_known]))
    min_power = max(thresholds.min_sd + thresholds.max_motion / rate**2, thresholds.min_background_ratio * usual_sd) ** 2
    is_strong = (power > min_power) & (power > MIN_WINDOW_WHITENESS * reference)
    min_faint_power = max(FAINT_POWER_SHARE * min_power, thresholds.min_background_ratio * usual_sd**2)
    is_faint = binary_closing(np.nan_to_num(fourth_power) > min_faint_power, np.ones(FAINT_GAP_FRAMES))
    bursts: list[JitterBurst] = []
    min_frames = max(MIN_JITTER_FRAMES, round(MIN_JITTER_DURATION_S * rate))
    for run_first, run_last in find_runs(is_strong | is_faint):
        first, last = run_first + 1, run_last - 1  # the outermost differences extend one frame beyond the burst
        if is_strong[run_first : run_last + 1].any() and last - first + 1 >= min_frames:
            burst = JitterBurst(first, last, float(np.sqrt(np.nanmean(fourth_power[first : last + 1]))))
            is_repeated = (track[first:last] == track[first + 1 : last + 1]).all(1).mean() > MAX_REPEATED_SHARE
            if burst.sd**2 > min_power and not is_repeated and _is_jitter(differences, burst):
                bursts.append(burst)
    return _merge_overlapping(bursts)


def _compute_axis_differences(track: Float[np.ndarray, "T c"], order: int) -> Float[np.ndarray, "T 3"]:
    """Compute the differences of an order around each frame, metres or radians about a joint's axes; NaN where unknown."""
    half, differences = order // 2, np.diff(track, order, axis=0)
    if track.shape[1] > 3:
        differences = multiply_quaternions(track[half:-half] / 2 * [-1, -1, -1, 1], differences)[:, :3]
    return np.pad(differences, ((half, half), (0, 0)), constant_values=np.nan)


def _is_jitter(differences: dict[int, Float[np.ndarray, "T 3"]], burst: JitterBurst) -> bool:
    """Return True if a burst is white, steady, and either about all axes or unlike the rest of the joint's motion.

    The differences are given by their order, 2 and 4.
    """
    covariance: dict[int, Float[np.ndarray, "3 3"]] = {}
    for order, margin in ((4, 0), (2, 1)):
        rows = differences[order][max(0, burst.first - margin) : burst.last + 1 + margin]
        rows = rows[~np.isnan(rows[:, 0])]
        covariance[order] = rows.T @ rows / max(len(rows), 1) / STENCIL_POWER_BY_ORDER[order]
    power = np.trace(covariance[4])
    inside = _compute_squared_amplitudes(differences[4][burst.first : burst.last + 1])
    axis_power = np.linalg.eigvalsh(covariance[4])  # ascending
    is_about_all_axes = axis_power[0] > MIN_AXIS_RATIO**2 * axis_power[2]
    min_median_share = MIN_MEDIAN_SHARE_ALL_AXES if is_about_all_axes else MIN_MEDIAN_SHARE_FEW_AXES
    if power < MIN_BURST_WHITENESS * np.trace(covariance[2]):
        return False
    if MEAN_TO_MEDIAN_RATIO * np.median(inside) < min_median_share * power:
        return False
    if is_about_all_axes:
        return True
    elsewhere = _compute_squared_amplitudes(np.delete(differences[4], slice(max(0, burst.first - 4), burst.last + 5), axis=0))
    is_long_enough = len(inside) >= MIN_SINGLE_AXIS_FRAMES or axis_power[1] > MAX_SINGLE_AXIS_RATIO**2 * axis_power[2]
    if not is_long_enough or not len(elsewhere):
        return False
    return bool(power > MIN_ELSEWHERE_RATIO**2 * np.quantile(elsewhere, ELSEWHERE_QUANTILE))


def _compute_squared_amplitudes(fourth_differences: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " m"]:
    """Compute the squared jitter amplitudes of the fourth differences that are known."""
    return (fourth_differences[~np.isnan(fourth_differences[:, 0])] ** 2).sum(1) / STENCIL_POWER_BY_ORDER[4]


def _merge_overlapping(bursts: list[JitterBurst]) -> list[JitterBurst]:
    merged: list[JitterBurst] = []
    for burst in bursts:
        if merged and burst.first <= merged[-1].last + 1:
            previous = merged.pop()
            burst = JitterBurst(previous.first, max(previous.last, burst.last), max(previous.sd, burst.sd))
        merged.append(burst)
    return merged


ROTATION_THRESHOLDS = OffsetThresholds(min_difference=np.radians(0.5), min_amount=np.radians(8.0))  # radians
POSITION_THRESHOLDS = OffsetThresholds(min_difference=0.005, min_amount=0.04)  # metres
ROTATION_JITTER = JitterThresholds(min_sd=np.radians(1.0), max_motion=7.0, min_background_ratio=4.0)
# Hips move so smoothly that jitter throughout is seen, too: in 250 minutes of training people at 30 Hz 4 bursts are false, and
# 5 mm for half a second are found in 96 % of cases.
POSITION_JITTER = JitterThresholds(min_sd=0.002, max_motion=1.0, min_background_ratio=0.0)
MIN_FLIP_ANGLE_RAD = np.radians(120.0)  # a larger pop is a flip
MIN_QUATERNION_RANGE = 1e-4  # range of a quaternion's components below which a joint does not move
MAX_LISTED_TRACKS = 4  # names in the description of a gap
EVIDENCE_AT_ZERO_CONFIDENCE = 10.0  # evidence of an offset at which its confidence would be 0; it rises to 1 with the evidence


def detect_animation_faults(animation: Animation) -> list[Fault]:
    """Detect the faults of an animation, ordered by joint and first frame.

    The markers of the faults are indices of tracks, and of points in `build_tip_take`.
    """
    local_rotations = animation.compute_local_rotations()
    root_position = animation.compute_local_positions()[:, animation.moving_joint]
    orders = list_rotation_orders(animation)
    faults = detect_pose_faults(
        animation.names, root_position, local_rotations, orders, animation.rate, moving_joint=animation.moving_joint
    )
    return sorted(faults, key=lambda fault: (fault.marker, fault.first))


def list_rotation_orders(animation: Animation) -> list[str]:
    """Return the axes of each joint's rotation channels, the outermost first, such as "ZYX"; "" for a joint without any."""
    joints = range(len(animation.names))
    return ["".join(AXIS_LETTERS[axis] for axis in animation.get_rotation_channels(joint)[1]) for joint in joints]


def detect_pose_faults(
    names: Sequence[str],
    root_position: Float[np.ndarray, "T 3"],
    local_rotations: Float[np.ndarray, "T J 3 3"],
    orders: Sequence[str],
    rate: float,
    *,
    moving_joint: int = 0,
) -> list[Fault]:
    """Detect the faults of a moving figure, ordered by first frame and track.

    The markers of the faults are indices of tracks. Severities are in radians, of the root's position in metres, and NaN for
    gaps.

    Args:
        names: Names of the joints.
        root_position: Metres, of `moving_joint`; NaN where the file has no value, and so are rotations.
        local_rotations: Relative to the parents.
        orders: As from `list_rotation_orders`.
        rate: Frames per second.
        moving_joint: The joint that moves the figure.
    """
    if len(root_position) < 2:
        return []
    joint_count, track_names = len(names), list_track_names(tuple(names), moving_joint)
    is_absent = np.column_stack([np.isnan(local_rotations).any((2, 3)), np.isnan(root_position).any(1)])
    is_lost, faults = np.zeros(is_absent.shape, bool), []
    for gap in detect_animation_gaps(compute_track_motion(root_position, local_rotations), is_absent, rate):
        is_lost[gap.first : gap.last + 1, list(gap.tracks)] = True
        faults.append(_build_gap_fault(gap, track_names, rate))
    for joint in range(joint_count):
        known_rotations = np.where(is_lost[:, joint, None, None], np.eye(3), local_rotations[:, joint])[:, None]
        joint_quaternions = lie.extract_joint_quaternions(known_rotations, 0, ~is_lost[:, joint])
        if np.ptp(joint_quaternions, axis=0).max() > MIN_QUATERNION_RANGE:
            models = offsets.build_rotation_offset_models(joint_quaternions, orders[joint])
            faults += _detect_track_faults(joint, names[joint], 2 * joint_quaternions, models, ~is_lost[:, joint], rate)
    position = np.where(is_lost[:, -1:], 0.0, root_position)
    models = offsets.build_position_offset_models(position)
    faults += _detect_track_faults(joint_count, track_names[-1], position, models, ~is_lost[:, -1], rate)
    faults = [replace(fault, severity_unit="rad") if fault.marker < joint_count else fault for fault in faults]
    return sorted(faults, key=lambda fault: (fault.first, fault.marker))


def compute_track_motion(root_position: Float[np.ndarray, "T 3"], local_rotations: Float[np.ndarray, "T J 3 3"]) -> TrackMotion:
    """Compute how far each track moves from frame to frame and how far it is from rest, in radians and metres."""
    # The Frobenius norm of a small rotation's difference from another is the square root of 2 times its angle.
    step_rad = np.linalg.norm(np.diff(local_rotations, axis=0), axis=(2, 3)) / np.sqrt(2)
    rest_rad = np.linalg.norm(local_rotations - np.eye(3), axis=(2, 3)) / np.sqrt(2)
    steps = np.column_stack([step_rad, np.linalg.norm(np.diff(root_position, axis=0), axis=1)])
    return TrackMotion(steps, np.column_stack([rest_rad, np.linalg.norm(root_position, axis=1)]))


def _build_gap_fault(gap: AnimationGap, track_names: Sequence[str], rate: float) -> Fault:
    if len(gap.tracks) == len(track_names):
        subject = "The whole figure"
    else:
        subject = ", ".join(track_names[track] for track in gap.tracks[:MAX_LISTED_TRACKS])
        more = len(gap.tracks) - MAX_LISTED_TRACKS
        subject += f" and {more} more" if more > 0 else ""
    reason = f"{subject}: {gap.appearance} {_format_duration(gap.first, gap.last, rate)}."
    kind: FaultKind = "stuck" if gap.appearance is GapAppearance.HELD else "gap"
    return Fault(kind, gap.tracks[0], gap.first, gap.last, np.nan, reason, 1.0, gap.tracks[1:])


def _detect_track_faults(
    n: int,
    name: str,
    track: Float[np.ndarray, "T c"],
    models: tuple[OffsetModel, ...],
    is_usable: Bool[np.ndarray, " T"],
    rate: float,
) -> list[Fault]:
    """Return the pops, flips and jitter bursts of a joint, or the spikes and jitter bursts of a position, as `detect_jitter`."""
    faults, is_steady, is_position = [], is_usable.copy(), track.shape[1] == 3
    thresholds = POSITION_THRESHOLDS if is_position else ROTATION_THRESHOLDS
    for offset in offsets.detect_offsets(track, models, is_usable, rate, thresholds):
        kind: FaultKind = "spike" if is_position else "flip" if offset.amount > MIN_FLIP_ANGLE_RAD else "pop"
        amount = f"{offset.amount * 1e3:.0f} mm" if is_position else f"{np.degrees(offset.amount):.0f} degrees"
        duration = _format_duration(offset.first, offset.last, rate)
        reason = f"{name} {'is flipped' if kind == 'flip' else 'is off'} by {amount} {duration}."
        faults.append(Fault(kind, n, offset.first, offset.last, offset.amount, reason, _compute_confidence(offset)))
        is_steady[[offset.first - 1, offset.first, offset.last, offset.last + 1]] = False
    for burst in detect_jitter(track, is_steady, rate, POSITION_JITTER if is_position else ROTATION_JITTER):
        amount = f"{burst.sd * 1e3:.0f} mm along" if is_position else f"{np.degrees(burst.sd):.1f} degrees about"
        duration = _format_duration(burst.first, burst.last, rate)
        faults.append(Fault("jitter", n, burst.first, burst.last, burst.sd, f"{name} jitters by {amount} each axis {duration}."))
    return faults


def _format_duration(first: int, last: int, rate: float) -> str:
    return "in one frame" if first == last else f"for {(last - first + 1) / rate:.2f} s"


def _compute_confidence(offset: TemporaryOffset) -> float:
    return round(float(1 - EVIDENCE_AT_ZERO_CONFIDENCE / offset.evidence), 3)
