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

from mocapfix.errors import TakeError
from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.solve import kinematics
from mocapfix.solve.mean_pose import load_mean_pose_prior
from mocapfix.stats.sequences import assign_points, sample_evenly
from mocapfix.subject import refinement
from mocapfix.subject.average_body import PosedBody, build_average_subject, build_posed_body
from mocapfix.subject.calibration import scale_average_subject, select_candidate_frames
from mocapfix.subject.library import load_marker_set

# Shipped sets of whole bodies, one after the other placed in the cloud; others resemble one of them.
FITTED_SET_NAMES = (
    "cmu41", "frontwaist53", "production57", "plug-in-gait39", "optitrack-baseline41", "optitrack-core50", "qualisys-animation",
    "qualisys-sports",
)  # fmt: skip
BODY_HEADING_COUNT = 16  # headings in which a body is placed
GUESSED_MARKER_SPREAD_M = 0.05  # spread of a marker about its guessed offset
MIN_CLOUD_MARKERS = 20  # markers visible in one frame; fewer fit a body in many ways
HEIGHT_QUANTILES = (0.5, 0.8, 1.0)  # of the cloud, of the frames that are fitted; the tallest have raised arms
MATCHING_ROUNDS = 20  # rounds of assignment and solve
BODY_SCREENING_ROUNDS = 6  # rounds after which only the best bodies are continued
CONTINUED_BODIES = 12  # number of these bodies
MATCHING_ITERATIONS = 5  # solver iterations of a round
MATCHING_GATES_M = (0.4, 0.15)  # largest distance of an assigned marker in the first and in the last round
MATCHING_MARKER_SD_M = 0.04  # standard deviation of a person's markers about those of the average body
MAX_TRIED_BODIES = 9  # best bodies that are tested on more frames
MAX_TRIAL_FRAMES = 60  # frames they are tested on
TRIAL_ROUNDS = 6  # rounds of assignment and solve in this test


class MarkerAssignment(NamedTuple):
    """Assigned markers of a set, -1 for none, and the mean misfit in metres; both for one body or for H bodies."""

    indices: np.ndarray
    misfit_m: np.ndarray


def guess_from_marker_cloud(take: Take, labels: tuple[str, ...]) -> MarkerSet:
    """Return a set of those markers of the take for which the body has a position, under the names `labels`."""
    candidates = select_candidate_frames(take.markers)
    trial = take.markers[candidates[sample_evenly(len(candidates), MAX_TRIAL_FRAMES)]]
    if (~np.isnan(trial[..., 0])).sum(1).max(initial=0) < MIN_CLOUD_MARKERS:
        raise TakeError(f"{take.name}: shows fewer than {MIN_CLOUD_MARKERS} markers at once; name a similar known set (--like).")
    mean_height = np.nanmean(trial[..., 1], axis=1, keepdims=True)
    height = np.ptp(np.where(np.isnan(trial[..., 1]), mean_height, trial[..., 1]), axis=1)
    standing = np.argsort(height)[[round(quantile * (len(height) - 1)) for quantile in HEIGHT_QUANTILES]]
    hypotheses: list[tuple[float, np.ndarray, MarkerSet]] = []
    for marker_set in map(load_marker_set, FITTED_SET_NAMES):
        average = build_posed_body(build_average_subject(marker_set))
        for frame in standing:
            fits = fit_bodies_to_markers(trial[frame], average.fit_height(float(height[frame])))
            hypotheses += [
                (float(misfit), indices, marker_set) for indices, misfit in zip(fits.indices, fits.misfit_m, strict=True)
            ]
    hypotheses.sort(key=lambda hypothesis: hypothesis[0])
    tested = [(known, refine_assignment(indices, trial, known)) for _, indices, known in hypotheses[:MAX_TRIED_BODIES]]
    known, best = min(tested, key=lambda each: float(each[1].misfit_m))
    return build_guessed_marker_set(best.indices, labels, known)


def fit_bodies_to_markers(markers: Float[np.ndarray, "M 3"], body: PosedBody) -> MarkerAssignment:
    """Return the assignment (H, M) and misfit (H,) of the H best poses of a body fitted to one frame's markers in metres."""
    local_rotations = body.turn_around(BODY_HEADING_COUNT)
    predicted = body.predict((np.zeros((len(local_rotations), 3)), local_rotations))
    root_position = np.nanmedian(markers, axis=0) - np.median(predicted, axis=1)
    root_position[:, 1] = np.nanmin(markers[:, 1]) - predicted[:, :, 1].min(1)
    poses = root_position, local_rotations
    indices, misfit = np.full((len(poses[0]), len(markers)), -1), np.full(len(poses[0]), np.inf)
    for solve_round, gate in enumerate(np.geomspace(*MATCHING_GATES_M, MATCHING_ROUNDS)):
        if solve_round == BODY_SCREENING_ROUNDS:
            best = np.sort(np.argsort(misfit, kind="stable")[:CONTINUED_BODIES])
            poses, indices, misfit = (poses[0][best], poses[1][best]), indices[best], misfit[best]
        predicted = body.predict(poses)
        target = np.full(predicted.shape, np.nan)
        for h, positions in enumerate(predicted):
            indices[h], misfit[h] = assign_nearest(np.linalg.norm(markers[:, None] - positions, axis=-1), float(gate))
            is_assigned = indices[h] >= 0
            target[h, indices[h, is_assigned]] = markers[is_assigned]
        poses = body.solve(poses, target, MATCHING_MARKER_SD_M, (float(gate),), MATCHING_ITERATIONS)
    return MarkerAssignment(indices, misfit)


def assign_nearest(distance: Float[np.ndarray, "M A"], max_distance: float) -> MarkerAssignment:
    """Assign markers one-to-one to the nearest of A positions, given their distances in metres (NaN if not visible).

    Markers farther than about `max_distance` from every free position are not assigned, and count with `max_distance` in the
    mean misfit of the visible markers.
    """
    indices, visible = np.full(len(distance), -1), np.flatnonzero(~np.isnan(distance[:, 0]))
    indices[visible], costs = assign_points(distance[visible], max_distance)
    total = costs.sum() + max_distance * (len(visible) - len(costs))
    return MarkerAssignment(indices, total / max(len(visible), 1))


def refine_assignment(indices: np.ndarray, markers: Float[np.ndarray, "N M 3"], known: MarkerSet) -> MarkerAssignment:
    """Return the assignment that fits all frames, starting from the assignment `indices` (M,) in one frame."""
    body, assignment, gate = load_cmu31_body(), MarkerAssignment(indices, np.array(np.inf)), MATCHING_GATES_M[1]
    prior = load_mean_pose_prior("mean-pose", body.skeleton)
    for _ in range(TRIAL_ROUNDS):
        guess = build_guessed_marker_set(assignment.indices, tuple(map(str, range(len(indices)))), known)
        take = Take(markers[:, [int(label) for label in guess.labels]], guess.labels, 1.0)
        subject = scale_average_subject(take, guess)
        poses = refinement.pose_frames(subject, body, prior, take.markers)
        scaled = build_average_subject(known, subject.skeleton.size_ratio)
        predicted = kinematics.predict_markers(scaled, poses)
        distance = np.full((len(indices), predicted.shape[1]), np.nan)
        for m in np.flatnonzero(~np.isnan(markers[..., 0]).all(0)):
            each = np.linalg.norm(markers[:, m, None] - predicted, axis=-1)
            distance[m] = np.nanmean(np.minimum(each, gate), axis=0)
        assignment = assign_nearest(distance, gate)
    return assignment


def build_guessed_marker_set(indices: np.ndarray, labels: tuple[str, ...], known: MarkerSet) -> MarkerSet:
    """Return the markers (M,) that are assigned to one of a known set as a marker set."""
    assigned = np.flatnonzero(indices >= 0)
    places, spread = indices[assigned], np.full(len(assigned), GUESSED_MARKER_SPREAD_M)
    names, aliases = tuple(labels[m] for m in assigned), ((),) * len(assigned)
    return MarkerSet("guess", "guess", "cmu31", names, known.joints[places], known.marker_offsets[places], spread, aliases)
