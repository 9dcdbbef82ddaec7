"""The joints of a neck, which carry no markers: how each bends is people's habit, though both its ends are known."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.files.shipped import DEFAULT_INIT_METHOD
from mocapfix.initialise import joint_positions
from mocapfix.initialise.hybrik import HybrikVariant, solve_hybrik
from mocapfix.initialise.segment_registration import register_poses
from mocapfix.motion import Motion
from mocapfix.pose_prior.mean_pose import MeanPosePrior
from mocapfix.skeleton import BodyModel
from mocapfix.solve import kinematics
from mocapfix.subject import Subject
from mocapfix.take import Take


# MERGED: mocapfix.initialise.necks
def bend_unmarked_chains(motion: Motion, subject: Subject, prior: MeanPosePrior) -> Motion:
    """-> the motion, joints on the way to a leaf with markers bent from the mean pose by equal parts of the leaf's turn.

    Two short bones that are all but straight fold this way or that for a millimetre more or less between their ends. Their
    solve would end on that side: markers hardly tell.
    """
    skeleton, rotations = subject.skeleton, motion.local_rotations.copy()
    world = kinematics.compute_world_poses(skeleton, motion)[1]
    for chain in find_unmarked_chains(subject):
        turn = world[:, skeleton.parents[chain[0]]].swapaxes(1, 2) @ world[:, chain[-1]]
        mean = np.linalg.multi_dot(prior.mean_rotations[chain])
        vector = Rotation.from_matrix(mean.T @ turn).as_rotvec()
        part = Rotation.from_rotvec(vector / len(chain)).as_matrix()
        before = np.eye(3)
        for j in chain[:-1]:
            rotations[:, j] = prior.mean_rotations[j] @ part
            before = before @ rotations[:, j]
        rotations[:, chain[-1]] = np.swapaxes(before, -1, -2) @ turn
    return replace(motion, local_rotations=rotations)


def find_unmarked_chains(subject: Subject) -> list[list[int]]:
    """-> for each leaf with markers, the joints down to it from the last one with markers above: none, where that is next."""
    parents, carrying = subject.skeleton.parents, set(subject.joints.tolist())
    found = []
    for leaf in carrying - set(parents.tolist()):
        chain = [leaf]
        while int(parents[chain[0]]) > 0 and int(parents[chain[0]]) not in carrying:
            chain.insert(0, int(parents[chain[0]]))
        if len(chain) > 1:
            found.append(chain)
    return found


# MERGED: mocapfix.initialise.previous
# The classical start: each frame goes on from the solved pose of the one before it.
#
# It is near, and so a few iterations are saved; but frames can no longer be solved side by side, and a frame that ends wrong leads
# the next one astray.
MIN_START_MARKER_SHARE = 0.5  # of the markers that are ever seen: with so many, a frame's own start is one to go on from


def start_from_previous(motion: Motion, seen: np.ndarray) -> Motion:
    """-> a start without poses, NaN, after the first frame that is seen well: from there each goes on from the one before.

    start  a pose of its own for every frame
    seen   (T, K) bool: the markers that are believed
    """
    well = seen.sum(axis=1) >= MIN_START_MARKER_SHARE * seen.any(axis=0).sum()
    later = np.arange(motion.frame_count) > well.argmax()
    root, rotations = motion.root_position.copy(), motion.local_rotations.copy()
    root[later] = rotations[later] = np.nan
    return replace(motion, root_position=root, local_rotations=rotations)


# MERGED: mocapfix.initialise
# Initialisation: a first pose for every frame, each on its own, so that a lost frame cannot spoil the next.
#
# Ways to it, by the names in scenes.STARTS:
#
# hybrik-...    joints from the markers (initialise/joints), and from these each frame's pose in closed form (closed_form)
# registration  the subject's segments laid on the markers seen, down the tree (kernels/registration)
# previous      none but for the first frame: each other goes on from where the solve of the one before it ended

MIN_MARKER_TRUST = 0.25  # of its weight: a marker that counts no more lies 5 cm from where the others lay its segment
HYBRIK_VARIANTS: dict[str, HybrikVariant] = {"hybrik-x": "x", "hybrik-adaptive": "adaptive", "hybrik-naive": "naive"}


def initialise_motion(
    take: Take, subject: Subject, body: BodyModel, prior: MeanPosePrior, method: str = DEFAULT_INIT_METHOD
) -> Motion:
    """-> every frame's pose in closed form; NaN where a frame has none of its own and goes on from the one before it.

    worn   the take's markers in the subject's order, NaN where not seen or not believed
    prior  its mean pose is that of joints that the body does not turn
    by     the way to it, one of scenes.STARTS
    """
    if method in HYBRIK_VARIANTS:
        placed, held = joint_positions.estimate_joint_positions(take, subject, body), ~body.free_joints
        heard = np.where(placed.marker_trust[..., None] > MIN_MARKER_TRUST, take.markers, np.nan)
        found = solve_hybrik(
            placed.positions, subject, variant=HYBRIK_VARIANTS[method], joint_sd=placed.sd, markers=heard, held_joints=held
        )
        found.local_rotations[:, held] = prior.mean_rotations[held]
        return bend_unmarked_chains(found, subject, prior)
    registered = register_poses(subject, body.free_joints, prior, take.markers)
    return start_from_previous(registered, take.visible) if method == "previous" else registered
