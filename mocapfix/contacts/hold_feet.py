"""Solve the legs so that feet in contact are where they shall be.

The contacts are point terms on the ankles and the toes, in all frames in which a foot is displaced, beside terms that keep the
legs' rotations and the root as they were. The weights are the same in all frames, so that no knee jumps where a contact begins.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from mocapfix.contacts.contacts import CONTACT_JOINTS, BodyContacts
from mocapfix.contacts.foot_displacements import compute_foot_displacements
from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.levenberg_marquardt import INITIAL_DAMPING_RATIO, solve_frames
from mocapfix.kernels.terms import PointTerm, TrackingTerm, count_rows
from mocapfix.motion import Motion
from mocapfix.skeleton import Skeleton
from mocapfix.solve.parallel import order_independently, run_over_frames

LEG_JOINTS = ("LeftUpLeg", "LeftLeg", "LeftFoot", "RightUpLeg", "RightLeg", "RightFoot")
CONTACT_SD_M = 0.0003
"""Standard deviation of a joint about its place in a contact."""
LEG_ROTATION_SD_RAD = 0.05
"""Standard deviation of a leg's joint about its rotation before; of the root's rotation and position it is smaller."""
ROOT_ROTATION_SD_RAD = 0.0005
ROOT_SD_M = 0.01
"""Standard deviation of the root: a leg that is straight bends far for a foot that comes nearer by a few millimetres."""
FIXED_ROOT_SHARE = 1e-3
"""Share of these deviations by which a root that is fixed may move during the solve; it is where it was afterwards."""
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
    feet = np.array([skeleton.names.index(joint) for joint in CONTACT_JOINTS])
    feet_contacts = replace(
        contacts,
        joints=CONTACT_JOINTS,
        is_contact=contacts.is_contact[:, : len(feet)],
        is_known=contacts.is_known[:, : len(feet)],
    )
    displacement = compute_foot_displacements(joint_position[:, feet], feet_contacts, is_locked=is_locked)
    frames = np.flatnonzero((np.linalg.norm(displacement, axis=-1) > MIN_DISPLACEMENT_M).any(1))
    if not len(frames):
        return motion
    target = joint_position[frames[:, None], feet] + displacement[frames]
    moving = motion.select_frames(frames)
    root, local = solve_legs(skeleton, moving, feet, target, root_share=FIXED_ROOT_SHARE if is_root_fixed else 1.0)
    if is_root_fixed:
        root, local[:, 0] = moving.root_position, moving.local_rotations[:, 0]
    root_position, local_rotations = motion.root_position.copy(), motion.local_rotations.copy()
    root_position[frames], local_rotations[frames] = root, local
    return replace(motion, root_position=root_position, local_rotations=local_rotations)


def solve_legs(
    skeleton: Skeleton, motion: Motion, feet: np.ndarray, target: Float[np.ndarray, "N C 3"], *, root_share: float = 1.0
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N J 3 3"]]:
    """Return root positions in metres and local rotations of poses whose joints `feet` are at their targets, in metres.

    root_share  factor of the standard deviations of the root
    """
    frame_count, joint_count = motion.local_rotations.shape[:2]
    is_free = np.isin(np.arange(joint_count), [0, *(skeleton.names.index(joint) for joint in LEG_JOINTS)])
    tree = KinematicTree(skeleton.parents, skeleton.offsets, is_free)
    root, local = motion.root_position.copy(), motion.local_rotations.copy()
    weight = np.full((frame_count, joint_count), LEG_ROTATION_SD_RAD**-2)
    weight[:, 0] = (root_share * ROOT_ROTATION_SD_RAD) ** -2
    terms = (
        PointTerm(
            feet, np.zeros((len(feet), 3)), np.ascontiguousarray(target), np.full((frame_count, len(feet)), CONTACT_SD_M**-2)
        ),
        TrackingTerm(motion.local_rotations, weight, motion.root_position, np.full(frame_count, (root_share * ROOT_SD_M) ** -2)),
    )
    no_robust_scale, no_codes = np.array([np.inf]), np.zeros((frame_count, 0))
    status, iterations = np.zeros(frame_count, int), np.zeros(frame_count, int)
    run_over_frames(
        solve_frames, frame_count, tree, terms, order_independently(frame_count, joint_count), no_robust_scale,
        INITIAL_DAMPING_RATIO, MAX_ITERATIONS, count_rows(terms), root, local, no_codes, status, iterations,
    )  # fmt: skip
    return root, local
