"""Calibration of a person from all takes: bones and marker places from the best frames, and what differs between takes.

The takes share the bones and the marker offsets; each has a mean pose of its own, since what a person does differs from take to
take. Where a marker was attached again or moved, it has a further place, which some of the takes share. The unknowns of one take
are a selection from those of all takes: the normal equations of the takes (see `refinement`) are summed into those of all.

The poses of all frames absorb a part of the markers' noise: a hand with one marker seems to turn more than it does, and its bone
becomes too short. This bias does not shrink with more frames (Neyman & Scott 1948). It is estimated by calibrating from simulated
markers with noise and its opposite, and removed (indirect inference, Gourieroux, Monfort & Renault 1993).

A marker's place in a take is compared with its place in the others. A moved marker turns its segment, so that its own residual is
too small and its neighbours have one too. Candidates are therefore compared with the pose that the other markers give.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mocapfix.errors import TakeError, format_name_list
from mocapfix.model.skeleton import BodyModel, load_cmu31_body, restrict_body
from mocapfix.model.subject import Subject
from mocapfix.solve.kinematics import Poses, compute_tree_poses
from mocapfix.solve.mean_pose import MeanPosePrior, load_mean_pose_prior
from mocapfix.solve.minimise import minimise_shared
from mocapfix.stats.gaussian_process import MEDIAN_DEVIATIONS_PER_SD
from mocapfix.stats.sequences import compute_known_medians
from mocapfix.subject import refinement
from mocapfix.subject.average_body import build_average_subject
from mocapfix.subject.calibration import CalibrationFrames, select_varied_poses
from mocapfix.subject.refinement import (
    CalibratedBody,
    CalibrationParameters,
    RefinementState,
    add_hip_regression,
    build_calibration_parameters,
    estimate_residual_sd,
)

TAKE_DISTANCE_S = 1e3  # distance in time at which frames of different takes are treated: their errors are independent
MAX_JOINT_ROUNDS = 20  # steps of the shared unknowns


class JointFit(NamedTuple):
    """The fitted states of all takes, with the unknowns (N,), the cost and its gradient (N,)."""

    states: list[RefinementState]
    unknowns: Float[np.ndarray, " N"]
    cost: float
    gradient: Float[np.ndarray, " N"]

    @property
    def poses(self) -> list[Poses]:
        return [state.poses for state in self.states]


@dataclass(frozen=True)
class JointCalibration:
    """A person calibrated from T takes."""

    subject: Subject  # the person with the markers at place 0
    marker_offsets: Float[np.ndarray, "T K 3"]  # metres, the markers as they are placed in each take
    states: tuple[RefinementState, ...]  # the refined frames of each take


def calibrate_jointly(
    takes: Sequence[CalibrationFrames],
    places: Int[np.ndarray, "T K"],
    body: BodyModel,
    prior: MeanPosePrior,
    previous: JointCalibration | None = None,
) -> JointCalibration:
    """Return the bones and marker offsets that explain frames of several takes best.

    Args:
        places: Number of the place of each marker in each take: takes with the same number share its offset.
        previous: A calibration from the same frames with other places, from whose poses the refinement begins.
    """
    size_ratio = float(np.median([take.size_ratio for take in takes]))
    start = build_average_subject(takes[0].known_markers, size_ratio)
    plain = build_calibration_parameters(start, body, prior)
    parameters = add_hip_regression(plain, start)
    unknowns_of_takes, information, expected = lay_out_unknowns(plain, parameters, places)
    poses = [each.poses for each in (takes if previous is None else previous.states)]

    def fit(values: np.ndarray, poses: list[Poses]) -> JointFit:
        states: list[RefinementState] = []
        deviation = values - expected
        gradient = information @ deviation
        cost = float(0.5 * deviation @ gradient)
        for take, indices, start_poses in zip(takes, unknowns_of_takes, poses, strict=True):
            of_take = values[indices]
            # the prior is that of all takes together, and is added once
            shape = replace(parameters, information=np.zeros_like(parameters.information))
            problem = refinement.build_calibration_problem(start, body, prior, take.markers, shape.compute_body(of_take))
            solved = refinement.pose_calibrated_frames(problem, start_poses)
            states.append(refinement.linearise_frames(shape, problem, of_take, solved))
            cost += states[-1].cost
            gradient[indices] += states[-1].gradient
        return JointFit(states, values, cost, gradient)

    def sum_curvature(joint: JointFit) -> np.ndarray:
        curvature = information.copy()
        for state, indices in zip(joint.states, unknowns_of_takes, strict=True):
            curvature[np.ix_(indices, indices)] += refinement.compute_curvature(state)
        return curvature

    values = np.zeros(len(expected))
    if previous is not None:
        for state, indices in zip(previous.states, unknowns_of_takes, strict=True):
            values[indices] = state.unknowns
    first = fit(values, poses)
    joint, _ = minimise_shared(lambda values, joint: fit(values, joint.poses), first, sum_curvature, MAX_JOINT_ROUNDS)
    return build_joint_calibration(start, parameters, takes, places, joint.states)


def lay_out_unknowns(
    plain: CalibrationParameters, parameters: CalibrationParameters, places: Int[np.ndarray, "T K"]
) -> tuple[list[Int[np.ndarray, " Q"]], Float[np.ndarray, "N N"], Float[np.ndarray, " N"]]:
    """Lay out the N unknowns of all takes: deformations, markers at place 0, their further places, and mean poses of the takes.

    Return the indices of each take's own unknowns, the inverse covariance about the expected values, and these.

    Args:
        plain: The parameters without the prediction of the hip joints, whose prior holds for further places.
    """
    take_count, marker_count = places.shape
    body_count = len(parameters.deformations.marker_offsets)
    shared = body_count + 3 * marker_count
    pose_count = len(parameters.information) - shared
    further = sorted({(int(k), int(places[t, k])) for t, k in zip(*np.nonzero(places), strict=True)})
    first_pose = shared + 3 * len(further)
    total = first_pose + take_count * pose_count
    information, expected = np.zeros((total, total)), np.zeros(total)
    information[:shared, :shared] = parameters.information[:shared, :shared]
    expected[:shared] = parameters.expected[:shared]
    for number, (marker, _) in enumerate(further):
        own = slice(shared + 3 * number, shared + 3 * number + 3)
        nominal = slice(body_count + 3 * marker, body_count + 3 * marker + 3)
        information[own, own] = plain.information[nominal, nominal]
    of_take: list[np.ndarray] = []
    for t in range(take_count):
        indices = np.arange(len(parameters.information))
        for number, (marker, place) in enumerate(further):
            if places[t, marker] == place:
                nominal = body_count + 3 * marker
                indices[nominal : nominal + 3] = shared + 3 * number + np.arange(3)
        own_pose = slice(first_pose + t * pose_count, first_pose + (t + 1) * pose_count)
        indices[shared:] = np.arange(own_pose.start, own_pose.stop)
        information[own_pose, own_pose] = parameters.information[shared:, shared:]
        of_take.append(indices)
    return of_take, information, expected


def build_joint_calibration(
    start: Subject,
    parameters: CalibrationParameters,
    takes: Sequence[CalibrationFrames],
    places: Int[np.ndarray, "T K"],
    states: Sequence[RefinementState],
) -> JointCalibration:
    """Return the calibration of refined states, with the standard deviations of the subject as if all takes were one."""
    body_count = len(parameters.deformations.marker_offsets)
    shared = body_count + parameters.marker_offsets.size
    unknowns = states[0].unknowns.copy()
    unknowns[shared:] = np.mean([state.unknowns[shared:] for state in states], axis=0)
    for k in range(places.shape[1]):
        if common := [state for state, row in zip(states, places, strict=True) if row[k] == 0]:
            own = slice(body_count + 3 * k, body_count + 3 * k + 3)
            unknowns[own] = common[0].unknowns[own]
    markers = np.concatenate(
        [np.where((row == 0)[:, None], take.markers, np.nan) for take, row in zip(takes, places, strict=True)]
    )
    calibrated = parameters.compute_body(unknowns)
    first = states[0].problem
    attachment = first.attachment._replace(offsets=calibrated.marker_offsets)
    prior, mask = first.pose_prior._replace(mean_vectors=calibrated.mean_pose_vectors), ~np.isnan(markers[..., 0])
    problem = replace(first, marker_positions=markers, solver_mask=mask, attachment=attachment, pose_prior=prior)
    poses = np.concatenate([state.poses[0] for state in states]), np.concatenate([state.poses[1] for state in states])
    pooled = refinement.linearise_frames(parameters, problem, unknowns, poses)
    times_s = np.concatenate([take.times_s + t * TAKE_DISTANCE_S for t, take in enumerate(takes)])
    subject = refinement.build_refined_subject(start, pooled, refinement.compute_curvature(pooled), times_s)
    offsets = np.array([state.problem.attachment.offsets for state in states])
    return JointCalibration(subject, offsets, tuple(states))


def remove_noise_bias(
    calibration: JointCalibration,
    takes: Sequence[CalibrationFrames],
    places: Int[np.ndarray, "T K"],
    body: BodyModel,
    prior: MeanPosePrior,
) -> JointCalibration:
    """Return a calibration without the bias by noise of the size of its residuals."""
    predicted = [predict_frame_markers(state) for state in calibration.states]
    distance = np.concatenate(
        [np.linalg.norm(take.markers - markers, axis=-1) for take, markers in zip(takes, predicted, strict=True)]
    )
    is_free = calibration.states[0].problem.tree.free
    noise_sd_m = estimate_residual_sd(distance, 3 + 3 * int(np.isin(np.flatnonzero(is_free), takes[0].joints).sum()))
    rng = np.random.default_rng(0)
    noise = [rng.normal(0, noise_sd_m, markers.shape) for markers in predicted]

    def calibrate_simulated(sign: int) -> JointCalibration:
        simulated = [
            replace(take, markers=np.where(np.isnan(take.markers), np.nan, markers + sign * each))
            for take, markers, each in zip(takes, predicted, noise, strict=True)
        ]
        return calibrate_jointly(simulated, places, body, prior, calibration)

    plus, minus, exact = (calibrate_simulated(sign) for sign in (1, -1, 0))
    skeleton, subject = calibration.subject.skeleton, calibration.subject

    def find_bias(values: list[np.ndarray]) -> np.ndarray:
        return (values[0] + values[1]) / 2 - values[2]

    each = (plus, minus, exact)
    offsets = skeleton.offsets - find_bias([one.subject.skeleton.offsets for one in each])
    placed = subject.marker_offsets - find_bias([one.subject.marker_offsets for one in each])
    of_take = calibration.marker_offsets - find_bias([one.marker_offsets for one in each])
    unbiased = replace(subject, skeleton=replace(skeleton, offsets=offsets), marker_offsets=placed)
    return replace(calibration, subject=unbiased, marker_offsets=of_take)


def predict_frame_markers(state: RefinementState) -> Float[np.ndarray, "N K 3"]:
    """Return where the calibrated body carries its markers, in metres."""
    position, rotation = compute_tree_poses(state.problem.tree, *state.poses)
    joints, offsets = state.problem.attachment
    return position[:, joints] + np.einsum("tkab,kb->tka", rotation[:, joints], offsets)


MIN_PLACE_FRAMES = 5  # frames of a take in which a marker must be visible to compare its place
MIN_SCREENED_MOVE_M = 0.004  # of a residual from other takes', above which its place is compared without its pull
MIN_MOVE_M = 0.015  # smallest reported; without its pull, a trunk marker differs by up to 12 mm between short takes
MIN_MOVE_SD = 3.0  # the same in standard deviations of the places of unmoved markers between takes
LONG_TAKE_S, MIN_TAKE_S = 10.0, 0.5  # duration from which MIN_MOVE_M holds, and the shortest for which it is scaled
MIN_PLACE_SD_M = 0.001  # least standard deviation of a place between takes
MIN_SESSION_DIFFERENCE_M = 0.004  # rms of the markers' places, above which they were attached again
SESSION_DIFFERENCE_RATIO = 2.0  # the same relative to the differences between takes of one session


@dataclass(frozen=True)
class MovedMarker:
    """A marker that has another place in some takes than in the rest."""

    marker: int  # index of the marker
    takes: tuple[int, ...]  # indices of the takes in which it has the other place
    distance_m: float  # distance of the two places


def compute_place_residuals(state: RefinementState, *, without_marker: int | None = None) -> Float[np.ndarray, "K 3"]:
    """Return each marker's median distance (m) from its place, NaN if seldom visible; `without_marker` moves no pose."""
    problem, poses = state.problem, state.poses
    if without_marker is not None:
        mask = problem.solver_mask.copy()
        mask[:, without_marker] = False
        poses = refinement.pose_calibrated_frames(replace(problem, solver_mask=mask), poses)
    position, rotation = compute_tree_poses(problem.tree, *poses)
    joints, offsets = problem.attachment
    columns = np.arange(len(joints)) if without_marker is None else np.array([without_marker])
    relative = problem.marker_positions[:, columns] - position[:, joints[columns]]
    places = np.einsum("tkba,tkb->tka", rotation[:, joints[columns]], relative)
    is_seen = (~np.isnan(places[..., 0])).sum(0) >= MIN_PLACE_FRAMES
    residuals = np.full((len(joints), 3), np.nan)
    seen = columns[is_seen]
    residuals[seen] = np.nanmedian(places[:, is_seen], axis=0) - offsets[seen]
    return residuals


def find_attached_again(
    states: Sequence[RefinementState], marker_offsets: Float[np.ndarray, "T K 3"], sessions: Sequence[str]
) -> Int[np.ndarray, "T K"]:
    """Return the number of each marker's place in each take: sessions in which markers lie elsewhere have their own places."""
    places = np.zeros(marker_offsets.shape[:2], int)
    residuals = np.array([compute_place_residuals(state) for state in states]) + marker_offsets - marker_offsets[0]
    names = list(dict.fromkeys(sessions))
    of_session = np.array([names.index(session) for session in sessions])
    means = np.array([compute_known_medians(residuals[of_session == s]) for s in range(len(names))])
    within = residuals - means[of_session]
    in_large = np.isin(of_session, np.flatnonzero(np.bincount(of_session) > 1))
    noise_m = max(_compute_rms(within[in_large]), MIN_PLACE_SD_M) if in_large.any() else MIN_PLACE_SD_M
    max_same_m = max(MIN_SESSION_DIFFERENCE_M, SESSION_DIFFERENCE_RATIO * noise_m)
    kept: list[int] = []  # sessions whose markers lie at different places
    for s in range(len(names)):
        differences = ((other, _compute_rms(means[s] - means[other])) for other in kept)
        same = next((other for other, difference in differences if difference <= max_same_m), None)
        if same is None:
            kept.append(s)
        places[of_session == s] = kept.index(s if same is None else same)
    return places


def find_moved_markers(
    states: Sequence[RefinementState],
    marker_offsets: Float[np.ndarray, "T K 3"],
    places: Int[np.ndarray, "T K"],
    shortest_s: float = LONG_TAKE_S,
) -> list[MovedMarker]:
    """Return the markers that some takes show elsewhere than the others with the same place number.

    Args:
        shortest_s: Duration of the shortest take: a place is less certain in a short one, in which the skin slides less often.
    """
    if len(states) < 2:
        return []
    residuals = np.array([compute_place_residuals(state) for state in states])
    deviations = np.full(residuals.shape, np.nan)
    for k in range(places.shape[1]):
        for place in np.unique(places[:, k]):
            rows = np.flatnonzero(places[:, k] == place)
            if len(rows) > 1:
                deviations[rows, k] = residuals[rows, k] - compute_known_medians(residuals[rows, k])
    place_sd_m = max(MEDIAN_DEVIATIONS_PER_SD * float(np.nanmedian(np.abs(deviations))), MIN_PLACE_SD_M)
    noise_ratio = np.sqrt(max(1.0, LONG_TAKE_S / max(shortest_s, MIN_TAKE_S)))
    threshold_m = max(noise_ratio * MIN_MOVE_M, MIN_MOVE_SD * np.sqrt(3) * place_sd_m)
    with np.errstate(invalid="ignore"):
        screened = np.nanmax(np.where(np.isnan(deviations), 0.0, deviations) ** 2 @ np.ones(3), axis=0) > MIN_SCREENED_MOVE_M**2
    found: list[MovedMarker] = []
    for k in np.flatnonzero(screened):
        own = np.array([compute_place_residuals(state, without_marker=int(k))[k] for state in states])
        for place in np.unique(places[:, k]):
            rows = np.flatnonzero((places[:, k] == place) & ~np.isnan(own[:, 0]))
            found += _split_places(int(k), rows, own[rows] + marker_offsets[rows, k], threshold_m)
    largest: dict[tuple[int, ...], MovedMarker] = {}  # of each take: others may only follow from it, and show up again if not
    for each in found:
        if each.takes not in largest or each.distance_m > largest[each.takes].distance_m:
            largest[each.takes] = each
    return sorted(largest.values(), key=lambda each: each.marker)


def is_confirmed_move(move: MovedMarker, marker_offsets: Float[np.ndarray, "T K 3"]) -> bool:
    """Return whether a marker still lies elsewhere in some takes after a calibration in which it may.

    A marker beside one that moved may seem to move too, until the other one has a place of its own.
    """
    others = [t for t in range(len(marker_offsets)) if t not in move.takes]
    own, usual = (np.median(marker_offsets[rows, move.marker], axis=0) for rows in (list(move.takes), others))
    return bool(np.linalg.norm(own - usual) >= MIN_MOVE_M)


def number_places(moved: Sequence[MovedMarker], places: Int[np.ndarray, "T K"]) -> Int[np.ndarray, "T K"]:
    """Return the place numbers with one more for each moved marker."""
    places = places.copy()
    for each in moved:
        places[list(each.takes), each.marker] = places[:, each.marker].max() + 1
    return places


def _split_places(
    marker: int, rows: Int[np.ndarray, " R"], found: Float[np.ndarray, "R 3"], threshold_m: float
) -> list[MovedMarker]:
    """Return the groups of takes whose place is farther than the threshold from that of the largest or first group."""
    groups: list[list[int]] = []
    for i in range(len(rows)):
        near = [group for group in groups if np.linalg.norm(found[i] - np.median(found[group], axis=0)) <= threshold_m]
        if near:
            near[0].append(i)
        else:
            groups.append([i])
    if len(groups) < 2:
        return []
    usual = max(groups, key=len)
    middle = np.median(found[usual], axis=0)
    moves = [
        MovedMarker(marker, tuple(rows[group].tolist()), float(np.linalg.norm(np.median(found[group], axis=0) - middle)))
        for group in groups
    ]
    return [move for move in moves if move.distance_m > threshold_m]


def _compute_rms(differences: Float[np.ndarray, "... 3"]) -> float:
    """Return the root mean square length of vectors, NaN left out."""
    squares = np.square(differences).sum(-1)
    return float(np.sqrt(np.nanmean(squares))) if np.isfinite(squares).any() else 0.0


MAX_JOINT_TAKES = 10  # takes from which bones and places are calibrated; those of the others are compared with them
MAX_FRAMES_PER_PERSON = 300  # of all takes that enter a calibration; more weight the errors of the model too much
MIN_FRAMES_PER_TAKE = 20  # frames of each take that enter at least
MAX_MOVE_ROUNDS = 3  # rounds of detecting moved markers and calibrating with their places
MAX_OWN_RESIDUAL_RATIO = 2.5  # residual of a take, relative to the person's other takes, above which it is not that person's
MIN_FOREIGN_RESIDUAL_M = 0.015  # the same in metres
RANGE_OF_MOTION_WORDS = ("rom", "range", "calib", "static")  # parts of the names of takes that were recorded for calibration


@dataclass(frozen=True)
class PersonCalibration:
    """A person calibrated from several takes."""

    subject: Subject  # bones and the usual marker places
    take_subjects: dict[str, Subject]  # by id of a take, the subject with the marker places of that take, where they differ
    sessions: dict[str, int]  # by id of a take, the number of the attachment of all markers; 0 unless they were attached again
    moved: tuple[MovedMarker, ...]  # moved markers, whose takes are indices of `takes`
    takes: tuple[str, ...]  # ids of the takes that fit the person
    rejected: dict[str, str] = field(default_factory=dict[str, str])  # by id, why a take does not belong to the person

    def describe_moves(self) -> list[str]:
        """Return a sentence for each moved marker."""
        return [
            f"Marker {self.subject.labels[each.marker]} lies {1e3 * each.distance_m:.0f} mm from its usual place in "
            f"{format_name_list([self.takes[take] for take in each.takes])}: it has a place of its own there."
            for each in self.moved
        ]

    def describe_take(self, take: str) -> tuple[str, ...]:
        """Return a sentence for each marker that lies elsewhere in a take, and one if all were attached again."""
        index = self.takes.index(take)
        moves = tuple(
            f"Marker {self.subject.labels[each.marker]} lies {1e3 * each.distance_m:.0f} mm from its place in this person's "
            "other takes: the place of this take was used."
            for each in self.moved
            if index in each.takes
        )
        again = (
            "The markers lie elsewhere than in this person's first takes: they were attached again, and have places of their own."
        )
        return (*moves, again) if self.sessions.get(take) else moves


def calibrate_person(
    takes: Sequence[CalibrationFrames], sessions: Sequence[str] | None = None, mean_pose_prior: str = "mean-pose"
) -> PersonCalibration:
    """Return a person's bones and marker places, estimated from frames of several takes.

    Args:
        sessions: The session of each take: markers are attached again only between sessions; None if all are of one.
    """
    takes = join_marker_sets(takes)
    session_of_take = {take.take: name for take, name in zip(takes, sessions or [""] * len(takes), strict=True)}
    body = restrict_body(load_cmu31_body(), set(takes[0].joints.tolist()))
    prior = load_mean_pose_prior(mean_pose_prior, body.skeleton)
    is_range = {take.take: any(word in take.take.casefold() for word in RANGE_OF_MOTION_WORDS) for take in takes}
    ranked = sorted(takes, key=lambda take: (not is_range[take.take], -take.pose_variation_rad))
    frame_count = max(MIN_FRAMES_PER_TAKE, MAX_FRAMES_PER_PERSON // min(len(ranked), MAX_JOINT_TAKES))
    thinned = [thin_frames(take, frame_count) for take in ranked]
    chosen = thinned[:MAX_JOINT_TAKES]
    calibration = calibrate_jointly(chosen, np.zeros((len(chosen), len(takes[0].labels)), int), body, prior)
    reasons = {
        take.take: find_foreign_take(take, state, calibration.states)
        for take, state in zip(chosen, calibration.states, strict=True)
    }
    rejected = {name: reason for name, reason in reasons.items() if reason}
    if rejected:
        chosen = [take for take in chosen if take.take not in rejected]
        calibration = calibrate_jointly(chosen, np.zeros((len(chosen), len(takes[0].labels)), int), body, prior)
    names = [session_of_take[take.take] for take in chosen]
    places = find_attached_again(calibration.states, calibration.marker_offsets, names)
    if places.any():
        calibration = calibrate_jointly(chosen, places, body, prior, calibration)
    attachments = places[:, 0].copy() if places.size else np.zeros(len(chosen), int)
    moved, attached = list[MovedMarker](), places
    shortest_s = min(float(np.ptp(take.times_s)) for take in chosen)
    for _ in range(MAX_MOVE_ROUNDS):
        new = find_moved_markers(calibration.states, calibration.marker_offsets, places, shortest_s)
        if not new:
            break
        moved += new
        places = number_places(new, places)
        calibration = calibrate_jointly(chosen, places, body, prior, calibration)
    confirmed = [each for each in moved if is_confirmed_move(each, calibration.marker_offsets)]
    if len(confirmed) < len(moved):
        moved, places = confirmed, number_places(confirmed, attached)
        calibration = calibrate_jointly(chosen, places, body, prior, calibration)
    if len(chosen) > 1:
        calibration = remove_noise_bias(calibration, chosen, places, body, prior)
    ids = [take.take for take in chosen]
    take_subjects = {
        name: replace(calibration.subject, marker_offsets=offsets)
        for name, offsets, row in zip(ids, calibration.marker_offsets, places, strict=True)
        if row.any()
    }
    numbers = dict(zip(ids, attachments.tolist(), strict=True))
    result = PersonCalibration(calibration.subject, take_subjects, numbers, tuple(moved), tuple(ids), rejected)
    for take in thinned[MAX_JOINT_TAKES:]:
        result = add_take(result, calibration, take)
    return result


def add_take(person: PersonCalibration, calibration: JointCalibration, take: CalibrationFrames) -> PersonCalibration:
    """Return the person with one more take, whose marker places are compared with those of the calibration."""
    body = restrict_body(load_cmu31_body(), set(take.joints.tolist()))
    prior = load_mean_pose_prior("mean-pose", body.skeleton)
    start = build_average_subject(take.known_markers, take.size_ratio)
    first = calibration.states[0]
    no_deviation = np.zeros_like(person.subject.skeleton.offsets)
    placed = CalibratedBody(person.subject.skeleton.offsets, person.subject.marker_offsets, no_deviation)
    problem = refinement.build_calibration_problem(start, body, prior, take.markers, placed)
    poses = refinement.pose_calibrated_frames(problem, take.poses)
    state = refinement.linearise_frames(first.parameters, problem, first.unknowns, poses)
    if reason := find_foreign_take(take, state, calibration.states):
        return replace(person, rejected={**person.rejected, take.take: reason})
    common = [t for t, name in enumerate(person.takes[: len(calibration.states)]) if name not in person.take_subjects]
    states = [*(calibration.states[t] for t in common), state]
    offsets = np.tile(person.subject.marker_offsets, (len(states), 1, 1))
    own, moved = person.subject.marker_offsets.copy(), list(person.moved)
    for each in find_moved_markers(states, offsets, np.zeros(offsets.shape[:2], int), float(np.ptp(take.times_s))):
        if each.takes == (len(states) - 1,):
            own[each.marker] += compute_place_residuals(state, without_marker=each.marker)[each.marker]
            moved.append(replace(each, takes=(len(person.takes),)))
    has_own = bool((own != person.subject.marker_offsets).any())
    own_subjects = {take.take: replace(person.subject, marker_offsets=own)} if has_own else {}
    takes, sessions = (*person.takes, take.take), {**person.sessions, take.take: 0}
    subjects = {**person.take_subjects, **own_subjects}
    return replace(person, takes=takes, sessions=sessions, moved=tuple(moved), take_subjects=subjects)


def join_marker_sets(takes: Sequence[CalibrationFrames]) -> list[CalibrationFrames]:
    """Return the takes with the markers of all: those that a take does not have are missing in it."""
    if len({take.marker_set for take in takes}) > 1:
        names = format_name_list([f"{take.take} ({take.marker_set})" for take in takes])
        raise TakeError(
            f"The takes have different marker sets: {names}; calibrate them separately, or name one with --marker-set."
        )
    source = {label: (take, k) for take in reversed(takes) for k, label in enumerate(take.labels)}
    largest = max(takes, key=lambda take: len(take.labels))
    labels = (*largest.labels, *(label for label in source if label not in largest.labels))
    joints, offsets, spread = (
        np.array([getattr(source[label][0], name)[source[label][1]] for label in labels])
        for name in ("joints", "marker_offsets", "marker_spread")
    )
    joined: list[CalibrationFrames] = []
    for take in takes:
        markers = np.full((len(take.times_s), len(labels), 3), np.nan)
        markers[:, [labels.index(label) for label in take.labels]] = take.markers
        joined.append(replace(take, labels=labels, joints=joints, marker_offsets=offsets, marker_spread=spread, markers=markers))
    return joined


def thin_frames(take: CalibrationFrames, count: int) -> CalibrationFrames:
    """Return at most `count` frames of a take: half of them the most different poses, half evenly spaced among the others."""
    kept = select_varied_poses(take.local_rotations, None, count)
    root, local = take.root_position[kept], take.local_rotations[kept]
    return replace(take, times_s=take.times_s[kept], markers=take.markers[kept], root_position=root, local_rotations=local)


def find_foreign_take(take: CalibrationFrames, state: RefinementState, others: Sequence[RefinementState]) -> str:
    """Return why a take does not belong to the person of the others; "" if it does."""
    own_m, usual_m = compute_typical_residual(state), float(np.median([compute_typical_residual(each) for each in others]))
    if len(others) < 3 or own_m <= max(MIN_FOREIGN_RESIDUAL_M, MAX_OWN_RESIDUAL_RATIO * usual_m):
        return ""
    return f"The markers of {take.take} lie {1e3 * own_m:.0f} mm from the person's body, usual are {1e3 * usual_m:.0f} mm."


def compute_typical_residual(state: RefinementState) -> float:
    """Return the median distance in metres of the markers from the calibrated body."""
    return float(np.nanmedian(np.linalg.norm(state.problem.marker_positions - predict_frame_markers(state), axis=-1)))
