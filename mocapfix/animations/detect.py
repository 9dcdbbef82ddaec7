"""What is wrong with the turns of an animation's joints and with the place of its root.

N courses: the turns of J joints, in their parents' axes, and last the root's place. What is lost comes first, for what a file
says instead would look like every other fault; then pops and flips; then what trembles, apart from those.
"""

from collections.abc import Sequence

import numpy as np

from mocapfix.animations import gaps, jitter, offsets
from mocapfix.faults import Fault, FaultKind
from mocapfix.kernels import quaternions
from mocapfix.stats import constant_offsets

ROTATION_THRESHOLDS_RAD = np.radians(0.5), np.radians(8.0)  # third difference that any joint may have, and the smallest pop
POSITION_THRESHOLDS_M = 0.005, 0.04  # metres: likewise of the root
MIN_FLIP_ANGLE_RAD = np.radians(120.0)  # a larger pop is a flip


def detect_pose_faults(
    names: Sequence[str], root: np.ndarray, local: np.ndarray, orders: Sequence[str], rate: float
) -> list[Fault]:
    """-> faults by first frame; their markers are indices of joints or, for the root's place, their number J. A fault's severity
    is in radians, of the place in metres, NaN for what is lost.

    root (T, 3) metres and local (T, J, 3, 3), NaN where there is no number; orders: each joint's axes of rotation, as "ZYX"
    """
    if len(root) < 2:
        return []  # one pose does not move
    labels = (*names, f"{names[0]}'s place")
    absent = np.column_stack([np.isnan(local).any((2, 3)), np.isnan(root).any(1)])
    gone, faults = np.zeros(absent.shape, bool), []
    for each in gaps.detect_animation_gaps(*compute_steps(root, local), absent, rate):
        gone[each.first : each.last + 1, list(each.tracks)] = True
        faults.append(_build_gap_fault(each, labels, rate))
    for j in range(local.shape[1]):
        turns = quaternions.extract_joint_quaternions(
            np.where(gone[:, j, None, None], np.eye(3), local[:, j])[:, None], 0, ~gone[:, j]
        )
        if np.ptp(turns, axis=0).max() > 1e-4:  # it moves at all
            faults += _detect_joint_faults(j, labels[j], turns, ~gone[:, j], orders[j], rate)
    place = np.where(gone[:, -1:], 0.0, root)
    for each in offsets.detect_offsets(
        place, constant_offsets.build_position_offset_models(place), ~gone[:, -1], rate, *POSITION_THRESHOLDS_M
    ):
        reason = (
            f"{labels[-1]} is off by {each.amount * 1e3:.0f} mm {_format_duration(each.first, each.last, rate)}, and then back."
        )
        faults.append(Fault("spike", len(names), each.first, each.last, each.amount, reason, _compute_confidence(each)))
    return sorted(faults, key=lambda fault: (fault.first, fault.marker))


def compute_steps(root: np.ndarray, local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> (T - 1, N) how far each course goes from frame to frame, and (T, N) how far it is from rest: radians; of the root's
    place, a radian for a metre."""
    step = np.linalg.norm(np.diff(local, axis=0), axis=(2, 3)) / np.sqrt(2)  # of a small turn that is its angle
    rest = np.linalg.norm(local - np.eye(3), axis=(2, 3)) / np.sqrt(2)
    steps = np.column_stack([step, np.linalg.norm(np.diff(root, axis=0), axis=1)])
    return steps, np.column_stack([rest, np.linalg.norm(root, axis=1)])


def _build_gap_fault(gap: gaps.AnimationGap, track_names: Sequence[str], rate: float) -> Fault:
    what = "The whole figure" if len(gap.tracks) == len(track_names) else ", ".join(track_names[n] for n in gap.tracks[:4])
    what += f" and {len(gap.tracks) - 4} more" if 4 < len(gap.tracks) < len(track_names) else ""
    reason = f"{what}: {gap.appearance} {_format_duration(gap.first, gap.last, rate)}."
    kind: FaultKind = "stuck" if gap.appearance == gaps.VALUE_HELD else "gap"
    return Fault(kind, gap.tracks[0], gap.first, gap.last, np.nan, reason, 1.0, gap.tracks[1:])


def _detect_joint_faults(
    joint: int, label: str, quaternions: np.ndarray, is_usable: np.ndarray, order: str, rate: float
) -> list[Fault]:
    """-> the pops, flips and trembles of one joint's quaternions (T, 4)."""
    faults, steady = [], is_usable.copy()
    course = 2 * quaternions
    for each in offsets.detect_offsets(
        course, constant_offsets.build_rotation_offset_models(quaternions, order), is_usable, rate, *ROTATION_THRESHOLDS_RAD
    ):
        kind: FaultKind = "flip" if each.amount > MIN_FLIP_ANGLE_RAD else "pop"
        what = "turned over" if kind == "flip" else "off"
        reason = f"{label} is {what} by {np.degrees(each.amount):.0f} degrees {_format_duration(each.first, each.last, rate)}."
        faults.append(Fault(kind, joint, each.first, each.last, each.amount, reason, _compute_confidence(each)))
        steady[[each.first - 1, each.first, each.last, each.last + 1]] = False
    for each in jitter.detect_rotation_jitter(course, steady, rate):
        size = f"{np.degrees(each.sd_rad):.1f} degrees"
        reason = f"{label} trembles by {size} about each axis {_format_duration(each.first, each.last, rate)}."
        faults.append(Fault("jitter", joint, each.first, each.last, each.sd_rad, reason))
    return faults


def _format_duration(first: int, last: int, rate: float) -> str:
    return "in one frame" if first == last else f"for {(last - first + 1) / rate:.2f} s"


def _compute_confidence(offset: offsets.TemporaryOffset) -> float:
    return round(float(1 - 10 / offset.evidence), 3)
