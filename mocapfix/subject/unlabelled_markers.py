"""An initial marker set for markers without informative labels: bodies are fitted to the cloud that the markers form.

Frames in which the cloud is tall show a standing person. The average body, with the markers of one shipped set, is placed there
in many headings, with raised, half raised and hanging arms. Markers are assigned one-to-one to the nearest marker positions of
the body, and the body is solved with this assignment, in turns (iterative closest points; Besl & McKay 1992). The best bodies
are then tested on more frames, in all of which the assignment must hold: a body that faces backwards or has an arm assigned to a
leg fails there.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mocapfix.errors import TakeError
from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import BodyModel
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.solve import kinematics
from mocapfix.solve.mean_pose import JointLimits, MeanPosePrior
from mocapfix.solve.pose_problem import build_marker_problem
from mocapfix.solve.terms import build_joint_limit_term, build_pose_prior_term
from mocapfix.stats.sequences import sample_evenly
from mocapfix.subject import refinement
from mocapfix.subject.body_size import scale_skeleton
from mocapfix.subject.calibration import scale_average_subject, select_candidate_frames
from mocapfix.subject.library import load_marker_set
from mocapfix.subject.marker_set_fit import MarkerAtlas, build_marker_atlas

FITTED_SET_NAMES = (
    "cmu41", "frontwaist53", "production57", "plug-in-gait39", "optitrack-baseline41", "optitrack-core50", "qualisys-animation",
    "qualisys-sports",
)  # fmt: skip
"""Shipped sets of whole bodies, one after the other placed in the cloud; others resemble one of them."""
BODY_HEADING_COUNT = 16
"""Headings in which a body is placed."""
ARM_RAISE_SHARES = (0.0, 0.5, 1.0)
"""Arm positions in which a body is placed: 0 hanging, 1 as in a T-pose."""
GUESSED_MARKER_SPREAD_M = 0.05
"""Spread of a marker about its guessed offset."""
MIN_CLOUD_MARKERS = 20
"""Markers visible in one frame; fewer fit a body in many ways."""
HEIGHT_QUANTILES = (0.5, 0.8, 1.0)
"""Frames to which bodies are fitted, by the quantile of the cloud's height; the tallest frames have raised arms."""
MATCHING_ROUNDS = 20
"""Rounds of assignment and solve."""
BODY_SCREENING_ROUNDS = 6
"""Rounds after which only the best bodies are continued."""
CONTINUED_BODIES = 12
"""Number of these bodies."""
MATCHING_ITERATIONS = 5
"""Solver iterations of a round."""
MATCHING_GATES_M = (0.4, 0.15)
"""Largest distance of an assigned marker in the first and in the last round."""
MATCHING_MARKER_SD_M = 0.04
"""Standard deviation of a person's markers about those of the average body."""
MAX_TRIED_BODIES = 9
"""Best bodies that are tested on more frames."""
MAX_TRIAL_FRAMES = 60
"""Frames they are tested on."""
TRIAL_ROUNDS = 6
"""Rounds of assignment and solve in this test."""
UNMATCHED_GATE_SHARE = 0.95
"""Share of the gate: a marker whose capped mean distance reaches it is not assigned."""


class StandingBodies(NamedTuple):
    """H poses, root (H, 3) m and local rotations (H, J, 3, 3), of an average body with markers at all atlas positions."""

    root_position: np.ndarray
    local_rotations: np.ndarray
    subject: Subject


class MarkerAssignment(NamedTuple):
    """Assigned atlas positions of the markers, -1 for none, and the mean misfit in metres; both for one body or for H bodies."""

    atlas_indices: np.ndarray
    misfit_m: np.ndarray


def guess_from_marker_cloud(
    take: Take, labels: tuple[str, ...], body: BodyModel, prior: MeanPosePrior, limits: JointLimits
) -> MarkerSet:
    """Return a set of those markers of the take for which the body has a position, under the names `labels`.

    Raises TakeError if too few markers are visible at once.
    """
    candidates = select_candidate_frames(take.markers)
    trial = take.markers[candidates[sample_evenly(len(candidates), MAX_TRIAL_FRAMES)]]
    if (~np.isnan(trial[..., 0])).sum(1).max(initial=0) < MIN_CLOUD_MARKERS:
        raise TakeError(f"{take.name}: shows fewer than {MIN_CLOUD_MARKERS} markers at once; name a similar known set (--like).")
    mean_height = np.nanmean(trial[..., 1], axis=1, keepdims=True)
    height = np.ptp(np.where(np.isnan(trial[..., 1]), mean_height, trial[..., 1]), axis=1)
    standing = np.argsort(height)[[round(quantile * (len(height) - 1)) for quantile in HEIGHT_QUANTILES]]
    hypotheses: list[tuple[float, np.ndarray, MarkerAtlas]] = []
    for marker_set in map(load_marker_set, FITTED_SET_NAMES):
        atlas = build_marker_atlas((marker_set,))
        for frame in standing:
            fits = fit_bodies_to_markers(trial[frame], float(height[frame]), atlas, body, prior, limits)
            hypotheses += [
                (float(misfit), indices, atlas) for indices, misfit in zip(fits.atlas_indices, fits.misfit_m, strict=True)
            ]
    hypotheses.sort(key=lambda hypothesis: hypothesis[0])
    tested = [
        (atlas, refine_assignment(indices, trial, atlas, body, prior)) for _, indices, atlas in hypotheses[:MAX_TRIED_BODIES]
    ]
    atlas, best = min(tested, key=lambda each: float(each[1].misfit_m))
    return build_guessed_marker_set(best.atlas_indices, labels, atlas)


def fit_bodies_to_markers(
    markers: Float[np.ndarray, "M 3"],
    height: float,
    atlas: MarkerAtlas,
    body: BodyModel,
    prior: MeanPosePrior,
    limits: JointLimits,
) -> MarkerAssignment:
    """Return the assignment (H, M) and misfit (H,) of the H best bodies fitted to one frame's markers of a height in metres."""
    root_position, local_rotations, subject = build_standing_bodies(markers, height, atlas, body, prior)
    prior_term, limit_term = build_pose_prior_term(prior), build_joint_limit_term(limits)
    indices, misfit = np.full((len(root_position), len(markers)), -1), np.full(len(root_position), np.inf)
    for solve_round, gate in enumerate(np.geomspace(*MATCHING_GATES_M, MATCHING_ROUNDS)):
        if solve_round == BODY_SCREENING_ROUNDS:
            best = np.sort(np.argsort(misfit, kind="stable")[:CONTINUED_BODIES])
            root_position, local_rotations, indices, misfit = (
                np.ascontiguousarray(each[best]) for each in (root_position, local_rotations, indices, misfit)
            )
        predicted = _predict_markers(subject, root_position, local_rotations)
        target = np.full(predicted.shape, np.nan)
        for h, positions in enumerate(predicted):
            indices[h], misfit[h] = assign_nearest(np.linalg.norm(markers[:, None] - positions, axis=-1), float(gate))
            is_assigned = indices[h] >= 0
            target[h, indices[h, is_assigned]] = markers[is_assigned]
        problem = build_marker_problem(subject, body.free_joints, target, MATCHING_MARKER_SD_M, prior_term, limit_term)
        start = root_position, local_rotations
        root_position, local_rotations = problem.minimise(start, (float(gate),), max_iterations=MATCHING_ITERATIONS).poses
    return MarkerAssignment(indices, misfit)


def assign_nearest(distance: Float[np.ndarray, "M A"], max_distance: float) -> MarkerAssignment:
    """Assign markers one-to-one to the nearest of A positions, given their distances in metres (NaN if not visible).

    Markers farther than about `max_distance` from every free position are not assigned, and count with `max_distance` in the
    mean misfit of the visible markers.
    """
    from scipy.optimize import linear_sum_assignment  # slow to import

    indices, visible = np.full(len(distance), -1), np.flatnonzero(~np.isnan(distance[:, 0]))
    capped = np.minimum(distance[visible], max_distance)
    rows, columns = linear_sum_assignment(capped)
    is_near = capped[rows, columns] < UNMATCHED_GATE_SHARE * max_distance
    indices[visible[rows[is_near]]] = columns[is_near]
    total = capped[rows, columns].sum() + max_distance * (len(visible) - len(rows))
    return MarkerAssignment(indices, total / max(len(visible), 1))


def refine_assignment(
    indices: np.ndarray, markers: Float[np.ndarray, "N M 3"], atlas: MarkerAtlas, body: BodyModel, prior: MeanPosePrior
) -> MarkerAssignment:
    """Return the assignment that fits all frames, starting from the assignment `indices` (M,) in one frame."""
    assignment, gate = MarkerAssignment(indices, np.array(np.inf)), MATCHING_GATES_M[1]
    for _ in range(TRIAL_ROUNDS):
        guess = build_guessed_marker_set(assignment.atlas_indices, tuple(map(str, range(len(indices)))), atlas)
        take = Take(markers[:, [int(label) for label in guess.labels]], guess.labels, 1.0)
        subject = scale_average_subject(take, guess, body)
        motion = refinement.pose_frames(subject, body, prior, take.markers)
        scaled = build_atlas_subject(atlas, body, subject.skeleton.total_length_m / body.skeleton.total_length_m)
        predicted = kinematics.compute_joint_and_marker_positions(scaled, motion)[1]
        distance = np.full((len(indices), predicted.shape[1]), np.nan)
        for m in np.flatnonzero(~np.isnan(markers[..., 0]).all(0)):
            each = np.linalg.norm(markers[:, m, None] - predicted, axis=-1)
            distance[m] = np.nanmean(np.minimum(each, gate), axis=0)
        assignment = assign_nearest(distance, gate)
    return assignment


def build_guessed_marker_set(indices: np.ndarray, labels: tuple[str, ...], atlas: MarkerAtlas) -> MarkerSet:
    """Return the markers with an assigned atlas position (M,) as a marker set."""
    assigned = np.flatnonzero(indices >= 0)
    known, spread = indices[assigned], np.full(len(assigned), GUESSED_MARKER_SPREAD_M)
    names, aliases = tuple(labels[m] for m in assigned), ((),) * len(assigned)
    return MarkerSet("guess", "guess", "cmu31", names, atlas.joints[known], atlas.offsets[known], spread, aliases)


def build_standing_bodies(
    markers: Float[np.ndarray, "M 3"], height: float, atlas: MarkerAtlas, body: BodyModel, prior: MeanPosePrior
) -> StandingBodies:
    """Return bodies of the given height that stand where the markers are, in all headings and arm positions."""
    angles = np.linspace(0, 2 * np.pi, BODY_HEADING_COUNT, endpoint=False)
    headings = Rotation.from_euler("y", angles[:, None]).as_matrix()
    arm_poses = [raise_arms(prior.mean_rotations, share, body) for share in ARM_RAISE_SHARES]
    local_rotations = np.concatenate([np.tile(pose, (BODY_HEADING_COUNT, 1, 1, 1)) for pose in arm_poses])
    local_rotations[:, 0] = np.tile(headings, (len(ARM_RAISE_SHARES), 1, 1))
    average = build_atlas_subject(atlas, body, 1.0)
    average_markers = _predict_markers(average, np.zeros((1, 3)), prior.mean_rotations[None].copy())
    subject = build_atlas_subject(atlas, body, height / float(np.ptp(average_markers[0, :, 1])))
    predicted = _predict_markers(subject, np.zeros((len(local_rotations), 3)), local_rotations)
    root_position = np.nanmedian(markers, axis=0) - np.median(predicted, axis=1)
    root_position[:, 1] = np.nanmin(markers[:, 1]) - predicted[:, :, 1].min(1)
    return StandingBodies(root_position, local_rotations, subject)


def raise_arms(local_rotations: Float[np.ndarray, "J 3 3"], share: float, body: BodyModel) -> Float[np.ndarray, "J 3 3"]:
    """Return a pose with the arms between the given pose (share 0) and a T-pose (share 1)."""
    raised = local_rotations.copy()
    for side in ("Left", "Right"):
        for bone in ("Shoulder", "Arm", "ForeArm"):
            j = body.skeleton.find_joint(side + bone)
            raised[j] = Rotation.from_rotvec((1 - share) * Rotation.from_matrix(local_rotations[j]).as_rotvec()).as_matrix()
    return raised


def build_atlas_subject(atlas: MarkerAtlas, body: BodyModel, size: float) -> Subject:
    """Return a subject `size` times as large as the average body with a marker at every position of the atlas."""
    labels = tuple(f"position {a}" for a in range(len(atlas.joints)))
    spread = np.full(len(labels), GUESSED_MARKER_SPREAD_M)
    return Subject(scale_skeleton(body.skeleton, size), "atlas", labels, atlas.joints, atlas.offsets * size, spread)


def _predict_markers(subject: Subject, root_position: np.ndarray, local_rotations: np.ndarray) -> np.ndarray:
    """Return the positions (H, A, 3) of the subject's markers in H poses, in metres."""
    zeros = np.zeros(len(root_position), int)
    motion = Motion(root_position, local_rotations, zeros, zeros, np.zeros(0), np.zeros(0))
    return kinematics.compute_joint_and_marker_positions(subject, motion)[1]
