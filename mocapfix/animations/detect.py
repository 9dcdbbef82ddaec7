"""Detection of faults in an animation's joint rotations and in the position of its root.

An animation has N = J + 1 tracks: the rotations of its J joints relative to their parents, and the position of its root (of the
hips where a reference node that does not move is above them).
Gaps are detected first, because the values that a file holds in a gap resemble every other fault. Pops and flips follow, and
then jitter in what remains.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.animation import AXIS_LETTERS, Animation
from mocapfix.animations import gaps, jitter, offsets
from mocapfix.animations.gaps import AnimationGap, GapAppearance, TrackMotion
from mocapfix.animations.joint_points import list_track_names
from mocapfix.animations.offsets import OffsetThresholds, TemporaryOffset
from mocapfix.faults import Fault, FaultKind
from mocapfix.kernels import quaternions
from mocapfix.stats import constant_offsets

ROTATION_THRESHOLDS = OffsetThresholds(min_difference=np.radians(0.5), min_amount=np.radians(8.0))  # radians
POSITION_THRESHOLDS = OffsetThresholds(min_difference=0.005, min_amount=0.04)  # metres
MIN_FLIP_ANGLE_RAD = np.radians(120.0)  # a larger pop is a flip
MIN_QUATERNION_RANGE = 1e-4  # range of a quaternion's components below which a joint does not move
MAX_LISTED_TRACKS = 4  # names in the description of a gap
EVIDENCE_AT_ZERO_CONFIDENCE = 10.0  # evidence of an offset at which its confidence would be 0; it rises to 1 with the evidence


def detect_animation_faults(animation: Animation) -> list[Fault]:
    """Detect the faults of an animation, ordered by joint and first frame.

    The markers of the faults are indices of tracks, and of points in `joint_points.build_tip_take`.
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

    names   of the joints
    root_position, local_rotations  metres, and relative to the parents; NaN where the file has no value
    orders  as from `list_rotation_orders`
    moving_joint  the joint whose position `root_position` is

    The markers of the faults are indices of tracks. Severities are in radians, of the root's position in metres, and NaN for
    gaps.
    """
    if len(root_position) < 2:
        return []
    joint_count, track_names = len(names), list_track_names(tuple(names), moving_joint)
    is_absent = np.column_stack([np.isnan(local_rotations).any((2, 3)), np.isnan(root_position).any(1)])
    is_lost, faults = np.zeros(is_absent.shape, bool), []
    for gap in gaps.detect_animation_gaps(compute_track_motion(root_position, local_rotations), is_absent, rate):
        is_lost[gap.first : gap.last + 1, list(gap.tracks)] = True
        faults.append(_build_gap_fault(gap, track_names, rate))
    for joint in range(joint_count):
        known_rotations = np.where(is_lost[:, joint, None, None], np.eye(3), local_rotations[:, joint])[:, None]
        joint_quaternions = quaternions.extract_joint_quaternions(known_rotations, 0, ~is_lost[:, joint])
        if np.ptp(joint_quaternions, axis=0).max() > MIN_QUATERNION_RANGE:
            faults += _detect_joint_faults(joint, names[joint], joint_quaternions, ~is_lost[:, joint], orders[joint], rate)
    position = np.where(is_lost[:, -1:], 0.0, root_position)
    models = constant_offsets.build_position_offset_models(position)
    for offset in offsets.detect_offsets(position, models, ~is_lost[:, -1], rate, POSITION_THRESHOLDS):
        reason = f"{track_names[-1]} is off by {offset.amount * 1e3:.0f} mm {_format_duration(offset.first, offset.last, rate)}."
        faults.append(Fault("spike", joint_count, offset.first, offset.last, offset.amount, reason, _compute_confidence(offset)))
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


def _detect_joint_faults(
    joint: int,
    name: str,
    joint_quaternions: Float[np.ndarray, "T 4"],
    is_usable: Bool[np.ndarray, " T"],
    order: str,
    rate: float,
) -> list[Fault]:
    """Return the pops, flips and jitter bursts of one joint."""
    faults, is_steady = [], is_usable.copy()
    track = 2 * joint_quaternions
    models = constant_offsets.build_rotation_offset_models(joint_quaternions, order)
    for offset in offsets.detect_offsets(track, models, is_usable, rate, ROTATION_THRESHOLDS):
        kind: FaultKind = "flip" if offset.amount > MIN_FLIP_ANGLE_RAD else "pop"
        verb = "is flipped" if kind == "flip" else "is off"
        duration = _format_duration(offset.first, offset.last, rate)
        reason = f"{name} {verb} by {np.degrees(offset.amount):.0f} degrees {duration}."
        faults.append(Fault(kind, joint, offset.first, offset.last, offset.amount, reason, _compute_confidence(offset)))
        is_steady[[offset.first - 1, offset.first, offset.last, offset.last + 1]] = False
    for burst in jitter.detect_rotation_jitter(track, is_steady, rate):
        duration = _format_duration(burst.first, burst.last, rate)
        reason = f"{name} jitters by {np.degrees(burst.sd_rad):.1f} degrees about each axis {duration}."
        faults.append(Fault("jitter", joint, burst.first, burst.last, burst.sd_rad, reason))
    return faults


def _format_duration(first: int, last: int, rate: float) -> str:
    return "in one frame" if first == last else f"for {(last - first + 1) / rate:.2f} s"


def _compute_confidence(offset: TemporaryOffset) -> float:
    return round(float(1 - EVIDENCE_AT_ZERO_CONFIDENCE / offset.evidence), 3)
