"""Repair of an animation's faults, keeping what each kind of fault leaves of the original motion.

A pop or a flip only adds an offset, which is removed. Jitter is smoothed. Lost joints are inferred from neighbouring frames, from
frames with a similar body state and from a trained pose model; a lost whole body is interpolated. Everything outside faults is
left unchanged.
"""

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.animations import body_interpolation
from mocapfix.animations.body_interpolation import FrameSpan, InterpolatedBody
from mocapfix.kernels import lie
from mocapfix.model.faults import Fault, build_fault_mask
from mocapfix.solve import occluded_joints
from mocapfix.solve.gap_combination import (
    GapContext,
    combine_rotations,
    compute_combined_variance,
    compute_prediction_weight,
)
from mocapfix.solve.prior_conditioner import PriorConditioner
from mocapfix.stats.sequences import find_runs

EXACT_VARIANCE_RAD2 = 1e-8
"""Variance of rotations without a fault."""
MIN_JOINT_MOTION_RAD = 1e-3
"""Range of a rotation matrix's entries above which a joint counts as moving."""


class RepairMethod(IntEnum):
    """How a value was repaired."""

    UNCHANGED = 0
    OFFSET_REMOVED = 1
    JITTER_SMOOTHED = 2
    JOINT_INFERRED = 3
    GAP_INTERPOLATED = 4

    @property
    def description(self) -> str:
        """The source of the repaired value, as a phrase for reports; "" if it is unchanged."""
        return _REPAIR_DESCRIPTIONS[self]


_REPAIR_DESCRIPTIONS = {
    RepairMethod.UNCHANGED: "",
    RepairMethod.OFFSET_REMOVED: "its own motion, offset removed",
    RepairMethod.JITTER_SMOOTHED: "its own motion, smoothed",
    RepairMethod.JOINT_INFERRED: "frames with a similar body state",
    RepairMethod.GAP_INTERPOLATED: "interpolation across the gap",
}


class AnimationRepair(NamedTuple):
    """A repaired animation with N = J + 1 tracks: the rotations of J joints, and last the root position.

    root_position    (T, 3) m
    local_rotations  (T, J, 3, 3)
    variance         (T, N) of repaired values, in rad^2 or m^2 per axis; 0 elsewhere
    method           (T, N) a RepairMethod for each value
    """

    root_position: Float[np.ndarray, "T 3"]
    local_rotations: Float[np.ndarray, "T J 3 3"]
    variance: Float[np.ndarray, "T N"]
    method: Int[np.ndarray, "T N"]


def repair_animation(
    parents: Int[np.ndarray, " J"],
    root_position: Float[np.ndarray, "T 3"],
    local_rotations: Float[np.ndarray, "T J 3 3"],
    rotation_orders: Sequence[str],
    faults: Sequence[Fault],
    rate: float,
    conditioner: PriorConditioner | None = None,
) -> AnimationRepair:
    """Return the animation without its faults.

    root_position    in metres, NaN without a value; local_rotations likewise. Those that no fault names stay NaN
    rotation_orders  each joint's axes of rotation
    faults           as from `animations.detect.detect_pose_faults`
    conditioner      a pose model for this skeleton
    """
    shape = (len(root_position), local_rotations.shape[1] + 1)
    if not faults:
        return AnimationRepair(root_position, local_rotations, np.zeros(shape), np.zeros(shape, int))
    is_lost = build_fault_mask([fault for fault in faults if fault.kind in ("gap", "stuck")], shape)
    is_finite = np.column_stack([np.isfinite(local_rotations).all((2, 3)), np.isfinite(root_position).all(1)])
    stays_missing = ~is_finite & ~is_lost
    is_lost |= stays_missing
    local_rotations = np.where(is_lost[:, :-1, None, None], np.eye(3), local_rotations)
    root_position = np.where(is_lost[:, -1:], 0.0, root_position)
    repair = AnimationRepair(root_position, local_rotations, np.zeros(shape), np.zeros(shape, int))
    is_faulty = build_fault_mask(faults, shape) | stays_missing
    for fault in sorted(faults, key=lambda fault: fault.last - fault.first):
        if fault.kind in ("pop", "flip", "spike"):
            _remove_offset(repair, fault, is_faulty, rotation_orders, rate)
            is_faulty[fault.frame_slice, fault.marker] = False
    moving_joints = np.flatnonzero(np.ptp(local_rotations, axis=0).max((1, 2)) > MIN_JOINT_MOTION_RAD)
    for fault in faults:
        if fault.kind == "jitter":
            _smooth_jitter(repair, fault, is_faulty, moving_joints, rate)
    is_body_lost = is_lost[:, moving_joints].sum(1) > occluded_joints.MAX_UNOBSERVED_SHARE * len(moving_joints)
    _infer_lost_joints(repair, is_lost & ~is_body_lost[:, None], moving_joints, rate, conditioner)
    _interpolate_gaps(repair, parents, is_lost, is_body_lost, rate, conditioner)
    repair.local_rotations[stays_missing[:, :-1]], repair.root_position[stays_missing[:, -1]] = np.nan, np.nan
    repair.variance[stays_missing], repair.method[stays_missing] = 0.0, RepairMethod.UNCHANGED
    return repair


def _remove_offset(
    repair: AnimationRepair, fault: Fault, is_faulty: np.ndarray, rotation_orders: Sequence[str], rate: float
) -> None:
    """Remove the offset of a pop, flip or spike, in place."""
    j, frames, is_sound = fault.marker, fault.frame_slice, ~is_faulty[:, fault.marker]
    span = FrameSpan(fault.first, fault.last, rate)
    if fault.kind == "spike":
        repair.root_position[frames], variance = body_interpolation.remove_position_offset(repair.root_position, is_sound, span)
    else:
        joint = lie.extract_joint_quaternions(repair.local_rotations, j, is_sound)
        corrected, variance = body_interpolation.remove_rotation_offset(joint, is_sound, span, rotation_orders[j])
        repair.local_rotations[frames, j] = Rotation.from_quat(corrected).as_matrix()
    repair.variance[frames, j], repair.method[frames, j] = variance, RepairMethod.OFFSET_REMOVED


def _smooth_jitter(repair: AnimationRepair, fault: Fault, is_faulty: np.ndarray, moving_joints: np.ndarray, rate: float) -> None:
    """Smooth one joint's jitter, in place, if enough frames without faults remain."""
    j, frames, is_sound = fault.marker, fault.frame_slice, ~is_faulty[:, fault.marker]
    is_usable = (moving_joints > 0) & (moving_joints != j) & ~is_faulty[frames][:, moving_joints].any(0)
    other_joints = moving_joints[is_usable]
    joint = lie.extract_joint_quaternions(repair.local_rotations, j, np.ones(len(is_sound), bool))
    is_steady = is_sound & ~is_faulty[:, other_joints].any(1)
    is_steady[frames] = True
    if is_steady.sum() - (fault.last - fault.first + 1) < body_interpolation.MIN_STEADY_FRAMES:
        return
    smoothed, variance = body_interpolation.smooth_joint_jitter(
        repair.root_position,
        repair.local_rotations,
        joint,
        other_joints,
        is_steady,
        FrameSpan(fault.first, fault.last, rate),
        fault.severity,
    )
    repair.local_rotations[frames, j] = Rotation.from_quat(smoothed).as_matrix()
    repair.variance[frames, j], repair.method[frames, j] = variance, RepairMethod.JITTER_SMOOTHED


def _infer_lost_joints(
    repair: AnimationRepair, is_lost: np.ndarray, moving_joints: np.ndarray, rate: float, conditioner: PriorConditioner | None
) -> None:
    """Infer lost joints (T, N) below the root from the rest of the body, in place."""
    is_unobserved = is_lost[:, :-1].copy()
    is_unobserved[:, 0] = False
    if not is_unobserved.any():
        return
    free_joints = np.zeros(is_unobserved.shape[1], bool)
    free_joints[[0, *moving_joints]] = True
    variance = np.full(is_unobserved.shape, EXACT_VARIANCE_RAD2)
    occluded_joints.infer_occluded_joints(
        repair.root_position,
        repair.local_rotations,
        variance,
        is_unobserved,
        free_joints,
        rate,
        conditioner=conditioner,
        kernel=occluded_joints.RECORDED_ROTATION_KERNEL,
    )
    is_inferred = is_unobserved & (variance != EXACT_VARIANCE_RAD2)
    repair.variance[:, :-1][is_inferred] = variance[is_inferred]
    repair.method[:, :-1][is_inferred] = RepairMethod.JOINT_INFERRED


def _interpolate_gaps(
    repair: AnimationRepair,
    parents: np.ndarray,
    is_lost: np.ndarray,
    is_body_lost: np.ndarray,
    rate: float,
    conditioner: PriorConditioner | None,
) -> None:
    """Interpolate lost values (T, N) that are not yet repaired, of the whole body or track by track, in place."""
    remaining = is_lost & (repair.method == RepairMethod.UNCHANGED)
    is_known = np.logical_not(is_lost.any(axis=1))
    for first, last in find_runs(is_body_lost) if np.any(is_known) else ():
        frames, mask = slice(first, last + 1), remaining[first : last + 1]
        body = body_interpolation.interpolate_body(
            parents, repair.root_position, repair.local_rotations, is_known, FrameSpan(first, last, rate)
        )
        if conditioner:
            context = GapContext(
                repair.root_position, repair.local_rotations, ~is_lost[:, :-1] & ~is_lost[:, -1:], first, last, rate
            )
            body = _combine_body(body, context, conditioner)
        repair.root_position[frames] = np.where(mask[:, -1:], body.root_position, repair.root_position[frames])
        repair.local_rotations[frames] = np.where(mask[:, :-1, None, None], body.local_rotations, repair.local_rotations[frames])
        variance = np.column_stack([body.rotation_variance, body.root_variance])
        repair.variance[frames] = np.where(mask, variance, repair.variance[frames])
        repair.method[frames][mask] = RepairMethod.GAP_INTERPOLATED
    remaining &= ~is_body_lost[:, None]
    for n in np.flatnonzero(remaining.any(0) & ~is_lost.all(0)):
        for first, last in find_runs(remaining[:, n]):
            span, frames = FrameSpan(first, last, rate), slice(first, last + 1)
            context = body_interpolation.find_context_frames(~is_lost[:, n], span)
            if not len(context):
                continue
            if n == repair.local_rotations.shape[1]:
                values, variance = body_interpolation.interpolate_values(repair.root_position[context], context, span)
                repair.root_position[frames] = values
            else:
                rotations = repair.local_rotations[context, n]
                values, variance = body_interpolation.interpolate_rotations(rotations, context, span)
                repair.local_rotations[frames, n] = values
            repair.variance[frames, n], repair.method[frames, n] = variance, RepairMethod.GAP_INTERPOLATED


def _combine_body(body: InterpolatedBody, context: GapContext, conditioner: PriorConditioner) -> InterpolatedBody:
    """Return an interpolated body combined with the motion prior's prediction."""
    cropped = context.crop()
    local_rotations, joints = cropped.local_rotations.copy(), np.arange(body.local_rotations.shape[1])
    local_rotations[cropped.frames] = body.local_rotations
    prediction = conditioner.predict_gap(cropped._replace(local_rotations=local_rotations), joints)
    if prediction is None:
        return body
    rotations, rotation_variance = combine_rotations(body.local_rotations, body.rotation_variance, prediction)
    weight = compute_prediction_weight(body.root_variance, prediction.root_variance)
    root = body.root_position + weight[:, None] * (prediction.root_position - body.root_position)
    root_variance = compute_combined_variance(body.root_variance, prediction.root_variance, weight)
    return InterpolatedBody(root, rotations, root_variance, rotation_variance)
