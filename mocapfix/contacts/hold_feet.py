"""Solve the legs so that feet in contact are where they shall be.

The contacts are point terms on the ankles and the toes, in all frames in which a foot is displaced, beside terms that keep the
legs' rotations and the root as they were, and the visible markers of thighs and shins. The weights do not depend on contacts, so
that no knee jumps where one begins.
The root yields by MAX_ROOT_DISPLACEMENT_M at most: a place that a leg does not reach from there is not where its foot stands.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter1d

from mocapfix.contacts.contacts import CONTACT_JOINTS, BodyContacts
from mocapfix.contacts.foot_displacements import compute_foot_displacements
from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.levenberg_marquardt import INITIAL_DAMPING_RATIO, solve_frames
from mocapfix.kernels.terms import PointTerm, TrackingTerm, count_rows
from mocapfix.motion import Motion
from mocapfix.skeleton import Skeleton
from mocapfix.solve.measured_segments import SHARE_SMOOTHING_S, smooth_share
from mocapfix.solve.parallel import order_independently, run_over_frames
from mocapfix.subject import Subject

LEG_SEGMENTS = (("LeftUpLeg", "LeftLeg"), ("RightUpLeg", "RightLeg"))
"""Thigh and shin, in the order of FOOT_JOINTS."""
LEG_JOINTS = ("LeftUpLeg", "LeftLeg", "LeftFoot", "RightUpLeg", "RightLeg", "RightFoot")
CONTACT_SD_M = 0.0003
"""Standard deviation of a joint about its place in a contact."""
LEG_ROTATION_SD_RAD = 0.05
"""Standard deviation of a leg's joint about its rotation before; of the root's rotation and position it is smaller."""
ROOT_ROTATION_SD_RAD = 0.0005
ROOT_SD_M = 0.01
"""Standard deviation of the root: a leg that is straight bends far for a foot that comes nearer by a few millimetres."""
MAX_ROOT_DISPLACEMENT_M = 0.0015
"""Largest displacement of the root, which carries pelvis, trunk, head and arms along."""
ROOT_LIMIT_EXPONENT = 4
"""Exponent with which the displacement approaches its limit; smaller ones change those below it more."""
FIXED_ROOT_SHARE = 1e-3
"""Share of these deviations by which a root that is fixed may move during the solve; it is where it was afterwards."""
LEG_MARKER_SD_M = 0.003
"""Standard deviation of thighs' and shins' markers about their places, while their foot is displaced."""
MARKER_DISPLACEMENT_M = 0.005
"""Displacement of a foot at which the markers of its leg have half their weight."""
MIN_KERNEL_WEIGHT = 1e-6
"""Share of a kernel within visible frames below which a residual is not known; the marker's share is 0 there."""
MIN_DISPLACEMENT_M = 2e-5
"""Displacement below which a frame is not solved."""
MAX_ITERATIONS = 20


def hold_feet(
    skeleton: Skeleton,
    motion: Motion,
    joint_position: Float[np.ndarray, "T J 3"],
    contacts: BodyContacts,
    *,
    is_locked: bool,
    is_root_fixed: bool = False,
) -> Motion:
    """Return the motion with standing feet held: at one place each (`is_locked`), or without the fast part of their motion.

    joint_position  (T, J, 3) m: of the motion
    is_root_fixed   only the legs move; otherwise the root may move a little too
    """
    displacement = compute_held_displacements(skeleton, joint_position, contacts, is_locked=is_locked)
    return displace_feet(skeleton, motion, joint_position, displacement, is_root_fixed=is_root_fixed)


def compute_held_displacements(
    skeleton: Skeleton, joint_position: Float[np.ndarray, "T J 3"], contacts: BodyContacts, *, is_locked: bool
) -> Float[np.ndarray, "T C 3"]:
    """Return the displacement in metres of each joint of the feet that holds them, in every frame."""
    feet = [skeleton.names.index(joint) for joint in CONTACT_JOINTS]
    feet_contacts = replace(
        contacts,
        joints=CONTACT_JOINTS,
        is_contact=contacts.is_contact[:, : len(feet)],
        is_known=contacts.is_known[:, : len(feet)],
    )
    return compute_foot_displacements(joint_position[:, feet], feet_contacts, is_locked=is_locked)


class LegMarkers(NamedTuple):
    """The markers of thighs and shins, near which a leg stays whose foot is displaced.

    joints    (K,) the joint that carries each marker
    offsets   (K, 3) m: in the joint's axes
    position  (T, K, 3) m: where the marker is, without noise
    share     (T, K) of its weight: 0 where it is not visible, 1 within the time that it is
    """

    joints: Int[np.ndarray, " K"]
    offsets: Float[np.ndarray, "K 3"]
    position: Float[np.ndarray, "T K 3"]
    share: Float[np.ndarray, "T K"]

    def select_frames(self, frames: Int[np.ndarray, " N"]) -> "LegMarkers":
        """Return the markers in some frames."""
        return self._replace(position=self.position[frames], share=self.share[frames])


def build_leg_markers(
    subject: Subject, markers: Float[np.ndarray, "T K 3"], body_markers: Float[np.ndarray, "T K 3"], rate: float
) -> LegMarkers:
    """Return the markers of thighs and shins of a body, by the smooth part of their distance from where it places them.

    markers       (T, K, 3) m: measured, NaN if missing or faulty
    body_markers  (T, K, 3) m: where the body places them
    """
    joints = [subject.skeleton.names.index(joint) for thigh_and_shin in LEG_SEGMENTS for joint in thigh_and_shin]
    columns = np.flatnonzero(np.isin(subject.joints, joints))
    residual = markers[:, columns] - body_markers[:, columns]
    visible = ~np.isnan(residual[..., 0])
    weight = gaussian_filter1d(visible.astype(float), SHARE_SMOOTHING_S * rate, axis=0, mode="nearest")
    total = gaussian_filter1d(np.where(visible[..., None], residual, 0.0), SHARE_SMOOTHING_S * rate, axis=0, mode="nearest")
    position = body_markers[:, columns] + total / np.maximum(weight, MIN_KERNEL_WEIGHT)[..., None]
    share = np.stack([smooth_share(each.astype(float), rate) for each in visible.T], axis=1) if len(columns) else weight
    return LegMarkers(subject.joints[columns], subject.marker_offsets[columns], position, share)


def displace_feet(
    skeleton: Skeleton,
    motion: Motion,
    joint_position: Float[np.ndarray, "T J 3"],
    displacement: Float[np.ndarray, "T C 3"],
    *,
    is_root_fixed: bool = False,
    markers: LegMarkers | None = None,
) -> Motion:
    """Return the motion with the joints of the feet displaced, in metres; each frame by itself.

    markers  near which thighs and shins stay; without them these keep their rotations
    """
    feet = np.array([skeleton.names.index(joint) for joint in CONTACT_JOINTS])
    frames = np.flatnonzero((np.linalg.norm(displacement, axis=-1) > MIN_DISPLACEMENT_M).any(1))
    if not len(frames):
        return motion
    target = joint_position[frames[:, None], feet] + displacement[frames]
    moving = motion.select_frames(frames)
    points = build_foot_targets(feet, target)
    if markers is not None:
        points = add_leg_markers(points, skeleton, markers.select_frames(frames), displacement[frames])
    if not is_root_fixed:
        step = solve_legs(skeleton, moving, points)[0] - moving.root_position
        moving = replace(moving, root_position=moving.root_position + limit_root_displacement(step))
    root_position, local_rotations = motion.root_position.copy(), motion.local_rotations.copy()
    root_position[frames] = moving.root_position
    local_rotations[frames, 1:] = solve_legs(skeleton, moving, points, root_share=FIXED_ROOT_SHARE)[1][:, 1:]
    return replace(motion, root_position=root_position, local_rotations=local_rotations)


def build_foot_targets(feet: Int[np.ndarray, " C"], target: Float[np.ndarray, "N C 3"]) -> PointTerm:
    """Return the term that places the joints `feet` at their targets, in metres."""
    weight = np.full(target.shape[:2], CONTACT_SD_M**-2)
    return PointTerm(feet, np.zeros((len(feet), 3)), np.ascontiguousarray(target), weight)


def add_leg_markers(
    points: PointTerm, skeleton: Skeleton, markers: LegMarkers, displacement: Float[np.ndarray, "N C 3"]
) -> PointTerm:
    """Return the points with the markers of each leg, which count the more the farther its foot is displaced, in metres.

    Where a foot is hardly displaced its leg is left as it is.
    """
    square = (displacement**2).sum(-1).reshape(len(displacement), len(LEG_SEGMENTS), -1).max(-1)
    leg_share = square / (square + MARKER_DISPLACEMENT_M**2)
    leg_of_marker = [
        next(n for n, segments in enumerate(LEG_SEGMENTS) if skeleton.names[joint] in segments) for joint in markers.joints
    ]
    weight = markers.share * leg_share[:, leg_of_marker] / LEG_MARKER_SD_M**2
    return PointTerm(
        np.r_[points.joints, markers.joints],
        np.r_[points.offsets, markers.offsets],
        np.ascontiguousarray(np.hstack([points.measured, markers.position])),
        np.ascontiguousarray(np.hstack([points.weight, weight])),
    )


def limit_root_displacement(displacement: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Return displacements of the root in metres, smoothly limited to MAX_ROOT_DISPLACEMENT_M."""
    ratio = np.linalg.norm(displacement, axis=1, keepdims=True) / MAX_ROOT_DISPLACEMENT_M
    return displacement / (1 + ratio**ROOT_LIMIT_EXPONENT) ** (1 / ROOT_LIMIT_EXPONENT)


def solve_legs(
    skeleton: Skeleton, motion: Motion, points: PointTerm, *, root_share: float = 1.0
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N J 3 3"]]:
    """Return root positions in metres and local rotations of poses whose legs place joints and markers where these shall be.

    root_share  factor of the standard deviations of the root
    """
    frame_count, joint_count = motion.local_rotations.shape[:2]
    is_free = np.isin(np.arange(joint_count), [0, *(skeleton.names.index(joint) for joint in LEG_JOINTS)])
    tree = KinematicTree(skeleton.parents, skeleton.offsets, is_free)
    root, local = motion.root_position.copy(), motion.local_rotations.copy()
    weight = np.full((frame_count, joint_count), LEG_ROTATION_SD_RAD**-2)
    weight[:, 0] = (root_share * ROOT_ROTATION_SD_RAD) ** -2
    root_weight = np.full(frame_count, (root_share * ROOT_SD_M) ** -2)
    terms = points, TrackingTerm(motion.local_rotations, weight, motion.root_position, root_weight)
    no_robust_scale, no_codes = np.array([np.inf]), np.zeros((frame_count, 0))
    status, iterations = np.zeros(frame_count, int), np.zeros(frame_count, int)
    run_over_frames(
        solve_frames, frame_count, tree, terms, order_independently(frame_count, joint_count), no_robust_scale,
        INITIAL_DAMPING_RATIO, MAX_ITERATIONS, count_rows(terms), root, local, no_codes, status, iterations,
    )  # fmt: skip
    return root, local
