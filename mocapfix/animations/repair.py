"""What people's poses say of the lost joints of any body whose joints are known to be people's.

The model knows the 31 joints. The file's are told to it as these, and what it says of them is turned back into the file's.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.animation import compose_transforms
from mocapfix.animations import body_interpolation, retarget
from mocapfix.animations import rotation_repair as calmed
from mocapfix.animations import rotation_repair as unshifted
from mocapfix.animations.retarget import SkeletonAlignment
from mocapfix.faults import Fault, build_fault_mask
from mocapfix.kernels import quaternions
from mocapfix.solve import occluded_joints, state_features
from mocapfix.solve.prior_conditioner import PriorConditioner
from mocapfix.stats.runs import find_runs


# MERGED: mocapfix.solve.mapped
@dataclass(frozen=True)
class MappedPriorConditioner(PriorConditioner):
    """A trained model of poses, asked of a file's joints.

    parents  (J,) the file's tree;  fit  how the 31 joints lie in it
    """

    parents: np.ndarray
    alignment: SkeletonAlignment

    def predict_rotations(
        self, local: np.ndarray, told: np.ndarray, lost: np.ndarray, frames: np.ndarray, near: np.ndarray
    ) -> np.ndarray:
        """As `People.turns`, of the file's joints; of those that no joint of the 31 stands for it is `near`."""
        body = self.alignment.file_joints[1:]
        known, wanted = (1 + np.flatnonzero(np.isin(body, joints)) for joints in (told, lost))
        if not len(known) or not len(wanted):
            return near
        there = local[frames]
        _, world = compose_transforms(self.parents, np.zeros(there.shape[:3]), there)
        ours = retarget.convert_rotations_to_cmu31(world, self.alignment)
        said = super().predict_rotations(ours, known, wanted, np.arange(len(frames)), np.ones((len(frames), 4 * len(wanted))))
        for at, joint in enumerate(wanted):
            ours[:, joint] = Rotation.from_quat(said[:, 4 * at : 4 * at + 4]).as_matrix()
            there[:, self.alignment.file_joints[joint]] = retarget.compute_file_rotation(
                self.parents, there, self.alignment, int(joint), ours
            )
        found = near.reshape(len(frames), len(lost), 4).copy()
        for at, joint in enumerate(lost):
            if joint in self.alignment.file_joints[wanted]:
                turned = 2 * quaternions.extract_joint_quaternions(there, int(joint), np.ones(len(frames), bool))
                found[:, at] = np.where((turned * found[:, at]).sum(1, keepdims=True) < 0, -turned, turned)
        return found.reshape(near.shape)


# MERGED: mocapfix.solve.turns
# An animation's faults mended: what each kind leaves of the truth is kept.
#
# A pop or a flip hides nothing: it is turned back. A tremble hides little: it is smoothed. Only what is lost is recalled, from the
# moments around it and those at which the rest of the body did alike, and from a trained model of people's poses; and of a whole
# figure from time alone. Whatever no fault is about stays as it is.
EXACT_VARIANCE_RAD2 = 1e-8  # rad^2: the variance of what nobody doubts
MIN_JOINT_MOTION_RAD = 1e-3  # radians: a joint that never turns by more rests
REPAIR_METHODS = ("", "its own motion, turned back", "its own motion, smoothed", "moments alike", "the course around it")
UNCHANGED, OFFSET_REMOVED, JITTER_SMOOTHED, JOINT_INFERRED, GAP_INTERPOLATED = range(len(REPAIR_METHODS))


class AnimationRepair(NamedTuple):
    """A figure over time, N = J + 1 courses: the joints' turns, and last the root's place.

    root (T, 3) metres;  local (T, J, 3, 3)
    variance (T, N) of what was mended, rad^2 and m^2 per axis, 0 elsewhere;  way (T, N) how: an index into WAYS
    """

    root_position: np.ndarray
    local_rotations: np.ndarray
    variance: np.ndarray
    method: np.ndarray


def repair_animation(
    parents: np.ndarray,
    root: np.ndarray,
    local_rotations: np.ndarray,
    rotation_orders: Sequence[str],
    faults: Sequence[Fault],
    rate: float,
    conditioner: PriorConditioner | None = None,
) -> AnimationRepair:
    """-> the figure without the faults, which are as `detect.turns.found` tells them. root (T, 3), local (T, J, 3, 3): NaN
    where there is no number; orders: each joint's axes of rotation; people: a model of the poses of this very skeleton."""
    shape = (len(root), local_rotations.shape[1] + 1)
    gone = build_fault_mask([fault for fault in faults if fault.kind in ("gap", "stuck")], shape)
    local_rotations = np.where(gone[:, :-1, None, None], np.eye(3), local_rotations)
    root = np.where(gone[:, -1:], 0.0, root)
    work = AnimationRepair(root, local_rotations, np.zeros(shape), np.zeros(shape, int))
    if not faults:
        return work
    unsound = build_fault_mask(faults, shape)
    for fault in sorted(faults, key=lambda fault: fault.last - fault.first):
        if fault.kind in ("pop", "flip", "spike"):
            _remove_offset(work, fault, unsound, rotation_orders, rate)
            unsound[fault.frame_slice, fault.marker] = False
    moving = np.flatnonzero(np.ptp(local_rotations, axis=0).max((1, 2)) > MIN_JOINT_MOTION_RAD)
    for fault in faults:
        if fault.kind == "jitter":
            _smooth_jitter(work, fault, unsound, moving, rate)
    unsound &= gone
    whole = gone[:, moving].sum(1) > occluded_joints.MAX_UNOBSERVED_SHARE * len(moving)
    _infer_lost_joints(work, gone & ~whole[:, None], moving, rate, conditioner)
    _interpolate_gaps(work, parents, gone, whole, rate)
    return work


def _remove_offset(
    repair: AnimationRepair, fault: Fault, is_faulty: np.ndarray, rotation_orders: Sequence[str], rate: float
) -> None:
    j, span, sound = fault.marker, fault.frame_slice, ~is_faulty[:, fault.marker]
    if fault.kind == "spike":
        repair.root_position[span], variance = unshifted.remove_position_offset(
            repair.root_position, sound, fault.first, fault.last, rate
        )
    else:
        turned = quaternions.extract_joint_quaternions(repair.local_rotations, j, sound)
        found, variance = unshifted.remove_rotation_offset(turned, sound, fault.first, fault.last, rotation_orders[j], rate)
        repair.local_rotations[span, j] = Rotation.from_quat(found).as_matrix()
    repair.variance[span, j], repair.method[span, j] = variance, OFFSET_REMOVED


def _smooth_jitter(repair: AnimationRepair, fault: Fault, is_faulty: np.ndarray, moving_joints: np.ndarray, rate: float) -> None:
    j, span, sound = fault.marker, fault.frame_slice, ~is_faulty[:, fault.marker]
    told = moving_joints[(moving_joints > 0) & (moving_joints != j) & ~is_faulty[span][:, moving_joints].any(0)]
    turned = quaternions.extract_joint_quaternions(repair.local_rotations, j, np.ones(len(sound), bool))
    known = sound & ~is_faulty[:, told].any(1)
    known[span] = True
    if known.sum() - (fault.last - fault.first + 1) < calmed.MIN_STEADY_FRAMES:
        return
    found, variance = calmed.smooth_joint_jitter(
        repair.root_position, repair.local_rotations, turned, told, known, fault.first, fault.last, fault.severity, rate
    )
    repair.local_rotations[span, j] = Rotation.from_quat(found).as_matrix()
    repair.variance[span, j], repair.method[span, j] = variance, JITTER_SMOOTHED


def _infer_lost_joints(
    repair: AnimationRepair, is_lost: np.ndarray, moving_joints: np.ndarray, rate: float, conditioner: PriorConditioner | None
) -> None:
    """Recall the joints that are `gone` (T, N) below the root, in place."""
    joints = is_lost[:, :-1].copy()
    joints[:, 0] = False
    if not joints.any():
        return
    free = np.zeros(joints.shape[1], bool)
    free[[0, *moving_joints]] = True
    variance = np.full(joints.shape, EXACT_VARIANCE_RAD2)
    occluded_joints.infer_occluded_joints(
        repair.root_position,
        repair.local_rotations,
        variance,
        joints,
        free,
        rate,
        conditioner,
        state_features.RECORDED_ROTATION_KERNEL,
    )
    found = joints & (variance != EXACT_VARIANCE_RAD2)
    repair.variance[:, :-1][found], repair.method[:, :-1][found] = variance[found], JOINT_INFERRED


def _interpolate_gaps(
    repair: AnimationRepair, parents: np.ndarray, is_lost: np.ndarray, is_body_lost: np.ndarray, rate: float
) -> None:
    """Lead what is `gone` (T, N) and not yet found across, the whole figure or each joint for itself, in place."""
    left = is_lost & (repair.method == UNCHANGED)
    sound = np.logical_not(is_lost.any(axis=1))
    for first, last in find_runs(is_body_lost) if np.any(sound) else ():
        span, mask = slice(first, last + 1), left[first : last + 1]
        place, local, of_place, variance = body_interpolation.interpolate_body(
            parents, repair.root_position, repair.local_rotations, sound, first, last, rate
        )
        repair.root_position[span] = np.where(mask[:, -1:], place, repair.root_position[span])
        repair.local_rotations[span] = np.where(mask[:, :-1, None, None], local, repair.local_rotations[span])
        repair.variance[span] = np.where(mask, np.column_stack([variance, of_place]), repair.variance[span])
        repair.method[span][mask] = GAP_INTERPOLATED
    left &= ~is_body_lost[:, None]
    for n in np.flatnonzero(left.any(0) & ~is_lost.all(0)):
        for first, last in find_runs(left[:, n]):
            near, span = body_interpolation.find_context_frames(~is_lost[:, n], first, last, rate), slice(first, last + 1)
            if not len(near):
                continue
            if n == repair.local_rotations.shape[1]:
                repair.root_position[span], repair.variance[span, n] = body_interpolation.interpolate_values(
                    repair.root_position[near], near, first, last, rate
                )
            else:
                repair.local_rotations[span, n], repair.variance[span, n] = body_interpolation.interpolate_rotations(
                    repair.local_rotations[near, n], near, first, last, rate
                )
            repair.method[span, n] = GAP_INTERPOLATED
