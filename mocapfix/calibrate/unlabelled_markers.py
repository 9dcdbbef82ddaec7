"""Average bodies that stand where a cloud of markers is, facing all ways, and wear a marker wherever people do."""

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from mocapfix.calibrate import calibration, marker_attachment, refinement
from mocapfix.calibrate.calibration import scale_average_subject, scale_skeleton
from mocapfix.calibrate.marker_attachment import MarkerAtlas
from mocapfix.errors import TakeError
from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.marker_sets import MarkerSet, load_shipped_marker_sets
from mocapfix.motion import Motion
from mocapfix.pose_prior.joint_limits import JointLimits
from mocapfix.pose_prior.mean_pose import MeanPosePrior
from mocapfix.skeleton import BodyModel
from mocapfix.solve import kinematics
from mocapfix.solve.pose_problem import (
    MarkerAttachment,
    PoseProblem,
    build_joint_limit_term,
    build_no_tracking,
    build_pose_prior_term,
)
from mocapfix.subject import Subject
from mocapfix.take import Take

# MERGED: mocapfix.calibrate.standing
BODY_HEADING_COUNT = 16
ARM_RAISE_SHARES = (0.0, 0.5, 1.0)  # how far from hanging to a T-pose
GUESSED_MARKER_SPREAD_M = 0.05  # metres: of a marker about the place it was guessed to have


def build_standing_bodies(
    markers: np.ndarray, height: float, atlas: MarkerAtlas, body: BodyModel, prior: MeanPosePrior
) -> tuple[np.ndarray, np.ndarray, Subject]:
    """-> root (H, 3) and local rotations (H, J, 3, 3) of bodies that stand where the markers (M, 3) are, facing all ways; and
    whose they are."""
    turns = Rotation.from_euler("y", np.linspace(0, 2 * np.pi, BODY_HEADING_COUNT, endpoint=False)[:, None]).as_matrix()
    local = np.concatenate(
        [np.tile(raise_arms(prior.mean_rotations, share, body), (BODY_HEADING_COUNT, 1, 1, 1)) for share in ARM_RAISE_SHARES]
    )
    local[:, 0] = np.tile(turns, (len(ARM_RAISE_SHARES), 1, 1))
    nominal = build_atlas_subject(atlas, body, 1.0)
    tall = np.ptp(
        kinematics.compute_joint_and_marker_positions(
            nominal, wrap_poses_as_motion(np.zeros((1, 3)), prior.mean_rotations[None].copy())
        )[1][0, :, 1]
    )
    person = build_atlas_subject(atlas, body, height / float(tall))
    placed = kinematics.compute_joint_and_marker_positions(person, wrap_poses_as_motion(np.zeros((len(local), 3)), local))[1]
    root = np.nanmedian(markers, axis=0) - np.median(placed, axis=1)
    root[:, 1] = np.nanmin(markers[:, 1]) - placed[:, :, 1].min(1)
    return root, local, person


def raise_arms(local_rotations: np.ndarray, share: float, body: BodyModel) -> np.ndarray:
    """-> local rotations (J, 3, 3) with the arms so far between those given and a T-pose."""
    local = local_rotations.copy()
    for side in ("Left", "Right"):
        for bone in ("Shoulder", "Arm", "ForeArm"):
            j = body.skeleton.find_joint(side + bone)
            local[j] = Rotation.from_rotvec((1 - share) * Rotation.from_matrix(local_rotations[j]).as_rotvec()).as_matrix()
    return local


def build_atlas_subject(atlas: MarkerAtlas, body: BodyModel, size: float) -> Subject:
    """-> somebody so many times the average body's size who wears a marker at every place."""
    names = tuple(f"place {a}" for a in range(len(atlas.joints)))
    spread = np.full(len(names), GUESSED_MARKER_SPREAD_M)
    return Subject(scale_skeleton(body.skeleton, size), "atlas", names, atlas.joints, atlas.offsets * size, spread)


def wrap_poses_as_motion(root_position: np.ndarray, local_rotations: np.ndarray) -> Motion:
    """-> poses as a motion of which nothing else is known."""
    nothing = np.zeros(len(root_position), int)
    return Motion(root_position, local_rotations, nothing, nothing, np.zeros(0), np.zeros(0))


# MERGED: mocapfix.calibrate.unlabelled
# A first guess at markers whose labels tell nothing: a body laid on the cloud they make.
#
# In a frame in which the cloud is tall somebody stands. The average body is put there facing all ways, its arms raised, half
# raised and hanging, with the markers of each set that ships; every marker takes the place for markers that it lies nearest to, no
# two the same one, and the body is solved to these, in turns (iterative closest points; Besl & McKay 1992). The likeliest bodies
# are tried on more frames, in all of which a marker must keep its place: on a body that faces backwards or has an arm for a leg
# it does not.
MIN_CLOUD_MARKERS = 20  # markers: on fewer a body can lie in any way
HEIGHT_QUANTILES = (
    0.5,
    0.8,
    1.0,
)  # of the frames are less tall than those that a body is laid on: arms raised are taller than anybody
MATCHING_ROUNDS = 20  # of nearest places
MATCHING_GATES_M = (0.4, 0.15)  # metres, the first round's and the last's: a marker farther from every place has none
MATCHING_MARKER_SD_M, MATCHING_LIMIT_SD_RAD = (
    0.04,
    0.1,
)  # metres, radians: of a stranger's markers about the average body's, of joints beyond limits
MAX_TRIED_BODIES = 9  # bodies that are tried on more frames
MAX_TRIAL_FRAMES = 60  # frames they are tried on
TRIAL_ROUNDS = 6  # rounds of that
UNMATCHED_GATE_SHARE = 0.95  # of the last gate: a marker that is on average as far from every place has none


def guess_from_marker_cloud(
    take: Take, labels: tuple[str, ...], body: BodyModel, prior: MeanPosePrior, limits: JointLimits
) -> MarkerSet:
    """-> a set that has each of the take's markers where the body has a place for it, under `labels`.

    Raises TakeError where there are too few markers to lay a body on.
    """
    looked = calibration.select_candidate_frames(take.markers)
    some = take.markers[looked[np.unique(np.linspace(0, len(looked) - 1, MAX_TRIAL_FRAMES).astype(int))]]
    if (~np.isnan(some[..., 0])).sum(1).max(initial=0) < MIN_CLOUD_MARKERS:
        raise TakeError(
            f"{take.name}: shows fewer than {MIN_CLOUD_MARKERS} markers at once; name a known set that it is like (--like)."
        )
    height = np.ptp(np.where(np.isnan(some[..., 1]), np.nanmean(some[..., 1], axis=1, keepdims=True), some[..., 1]), axis=1)
    standing = np.argsort(height)[[round(share * (len(height) - 1)) for share in HEIGHT_QUANTILES]]
    hopes = []
    for known in map(marker_attachment.build_marker_atlas, zip(load_shipped_marker_sets())):
        for frame in standing:
            assigned, misfit = fit_bodies_to_markers(some[frame], float(height[frame]), known, body, prior, limits)
            hopes += [(float(misfit[h]), assigned[h], known) for h in range(len(misfit))]
    hopes.sort(key=lambda hope: hope[0])
    tried = [(known, *refine_assignment(assigned, some, known, body, prior)) for _, assigned, known in hopes[:MAX_TRIED_BODIES]]
    known, best, _ = min(tried, key=lambda each: each[2])
    return build_guessed_marker_set(best, labels, known)


def fit_bodies_to_markers(
    markers: np.ndarray, height: float, atlas: MarkerAtlas, body: BodyModel, prior: MeanPosePrior, limits: JointLimits
) -> tuple[np.ndarray, np.ndarray]:
    """-> for H bodies the place (H, M) in the atlas that each of a frame's markers (M, 3) has, -1 for none, and the mean misfit
    (H,) in metres.

    height  metres, of the markers
    """
    root, local, person = build_standing_bodies(markers, height, atlas, body, prior)
    tree = KinematicTree(body.skeleton.parents, person.skeleton.offsets, body.free_joints)
    pull, walls = build_pose_prior_term(prior), build_joint_limit_term(limits, MATCHING_LIMIT_SD_RAD)
    assigned, misfit = np.full((len(root), len(markers)), -1), np.full(len(root), np.inf)
    for gate in np.geomspace(*MATCHING_GATES_M, MATCHING_ROUNDS):
        placed = kinematics.compute_joint_and_marker_positions(person, wrap_poses_as_motion(root, local))[1]
        target = np.full(placed.shape, np.nan)
        for h, there in enumerate(placed):
            assigned[h], misfit[h] = assign_nearest(np.linalg.norm(markers[:, None] - there, axis=-1), float(gate))
            has = assigned[h] >= 0
            target[h, assigned[h, has]] = markers[has]
        attached = MarkerAttachment(person.joints, person.marker_offsets)
        problem = PoseProblem(tree, attached, target, ~np.isnan(target[..., 0]), MATCHING_MARKER_SD_M, pull, walls)
        problem.solve(root, local, build_no_tracking(local.shape[1]), (float(gate),), 5)
    return assigned, misfit


def assign_nearest(distance: np.ndarray, max_distance: float) -> tuple[np.ndarray, float]:
    """-> the place (M,) that each marker has by its distances from A places (M, A), in metres, no two the same one, -1 for none
    nearer than `gate` or left; and the mean distance of those that are seen, without a place as at the gate."""
    assigned, seen = np.full(len(distance), -1), np.flatnonzero(~np.isnan(distance[:, 0]))
    capped = np.minimum(distance[seen], max_distance)
    rows, columns = linear_sum_assignment(capped)
    near = capped[rows, columns] < UNMATCHED_GATE_SHARE * max_distance
    assigned[seen[rows[near]]] = columns[near]
    return assigned, float((capped[rows, columns].sum() + max_distance * (len(seen) - len(rows))) / max(len(seen), 1))


def refine_assignment(
    assigned: np.ndarray, markers: np.ndarray, atlas: MarkerAtlas, body: BodyModel, prior: MeanPosePrior
) -> tuple[np.ndarray, float]:
    """-> places (M,) in the atlas that the markers keep in all frames (N, M, 3), from those they have in one; and the mean misfit
    in metres."""
    misfit, gate = np.inf, MATCHING_GATES_M[1]
    for _ in range(TRIAL_ROUNDS):
        guess = build_guessed_marker_set(assigned, tuple(map(str, range(len(assigned)))), atlas)
        worn = Take(markers[:, [int(label) for label in guess.labels]], guess.labels, 1.0)
        person = scale_average_subject(worn, guess, body)
        motion = refinement.pose_frames(person, body, prior, worn.markers)
        grown = build_atlas_subject(atlas, body, person.skeleton.total_length_m / body.skeleton.total_length_m)
        placed = kinematics.compute_joint_and_marker_positions(grown, motion)[1]
        distance = np.full((len(assigned), placed.shape[1]), np.nan)
        for m in np.flatnonzero(~np.isnan(markers[..., 0]).all(0)):
            apart = np.linalg.norm(markers[:, m, None] - placed, axis=-1)
            distance[m] = np.nanmean(np.minimum(apart, gate), axis=0)
        assigned, misfit = assign_nearest(distance, gate)
    return assigned, misfit


def build_guessed_marker_set(assigned: np.ndarray, labels: tuple[str, ...], atlas: MarkerAtlas) -> MarkerSet:
    """-> the markers that have a place (M,) in the atlas, as a set."""
    on = np.flatnonzero(assigned >= 0)
    which, spread = assigned[on], np.full(len(on), GUESSED_MARKER_SPREAD_M)
    names = tuple(labels[m] for m in on)
    return MarkerSet("guess", "guess", "cmu31", names, atlas.joints[which], atlas.offsets[which], spread, ((),) * len(on))
