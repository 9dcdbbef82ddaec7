"""Calibration of a person from all takes: bones and marker places from the best frames, and what differs between takes.

Differences between takes of a person: markers that were attached again for a session, or moved between two takes.

A marker's place in a take is compared with its place in the others. A moved marker turns its segment, so that its own residual is
too small and its neighbours have one too. Candidates are therefore compared with the pose that the other markers give.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int

from mocapfix.errors import TakeError, format_name_list
from mocapfix.model.skeleton import load_cmu31_body, restrict_body
from mocapfix.model.subject import Subject
from mocapfix.solve.kinematics import compute_tree_poses
from mocapfix.solve.mean_pose import load_mean_pose_prior
from mocapfix.stats.sequences import select_farthest_rows
from mocapfix.subject import refinement
from mocapfix.subject.calibration import CalibrationFrames, build_average_subject
from mocapfix.subject.joint_calibration import JointCalibration, calibrate_jointly, predict_frame_markers, remove_noise_bias
from mocapfix.subject.parameters import CalibratedBody
from mocapfix.subject.refinement import RefinementState

MIN_PLACE_FRAMES = 5
"""Frames of a take in which a marker must be visible to compare its place."""
MIN_SCREENED_MOVE_M = 0.004
"""Difference of a marker's residual from that in the other takes above which its place is compared without its own pull."""
MIN_MOVE_M = 0.015
"""Smallest move that is reported: without its own pull, a marker of the trunk differs by up to 12 mm between short takes."""
MIN_MOVE_SD = 3.0
"""The same in standard deviations of the places of unmoved markers between takes."""
LONG_TAKE_S, MIN_TAKE_S = 10.0, 0.5
"""Duration from which MIN_MOVE_M holds, and the shortest for which it is scaled."""
MIN_PLACE_SD_M = 0.001
"""Least standard deviation of a place between takes."""
MAX_MOVED_MARKER_SHARE = 0.2
"""Share of the markers of a take above which they are attached again rather than moved."""
MIN_SESSION_DIFFERENCE_M = 0.004
"""Root mean square difference of the markers' places between sessions above which they were attached again."""
SESSION_DIFFERENCE_RATIO = 2.0
"""The same relative to the differences between takes of one session."""
NORMAL_MAD_RATIO = 1.4826
"""Standard deviation of a normal variable over its median absolute deviation."""


@dataclass(frozen=True)
class MovedMarker:
    """A marker that has another place in some takes than in the rest.

    Attributes:
        marker: index of the marker.
        takes: indices of the takes in which it has the other place.
        distance_m: distance of the two places.
    """

    marker: int
    takes: tuple[int, ...]
    distance_m: float


def compute_place_residuals(state: RefinementState, *, without_marker: int | None = None) -> Float[np.ndarray, "K 3"]:
    """Return the median distance of each marker from its place in the axes of its joint, in metres; NaN if seldom visible.

    without_marker  a marker that does not affect the poses
    """
    problem, root, local = state.problem, state.root_position, state.local_rotations
    if without_marker is not None:
        mask = problem.solver_mask.copy()
        mask[:, without_marker] = False
        root, local = refinement.pose_calibrated_frames(replace(problem, solver_mask=mask), (root, local))
    position, rotation = compute_tree_poses(problem.tree, root, local)
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
    """Return the number of each marker's place in each take: sessions in which the markers lie elsewhere have their own places.

    sessions  name of the session of each take
    """
    places = np.zeros(marker_offsets.shape[:2], int)
    residuals = np.array([compute_place_residuals(state) for state in states]) + marker_offsets - marker_offsets[0]
    names = list(dict.fromkeys(sessions))
    of_session = np.array([names.index(session) for session in sessions])
    means = np.array([_compute_nanmedian(residuals[of_session == s]) for s in range(len(names))])
    within = residuals - means[of_session]
    in_large = np.isin(of_session, np.flatnonzero(np.bincount(of_session) > 1))
    noise_m = max(_compute_rms(within[in_large]), MIN_PLACE_SD_M) if in_large.any() else MIN_PLACE_SD_M
    kept: list[int] = []  # sessions whose markers lie at different places
    for s in range(len(names)):
        same = next(
            (
                other
                for other in kept
                if _compute_rms(means[s] - means[other]) <= max(MIN_SESSION_DIFFERENCE_M, SESSION_DIFFERENCE_RATIO * noise_m)
            ),
            None,
        )
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

    marker_offsets  metres, the calibrated places in each take
    shortest_s      duration of the shortest take: a place is less certain in a short one, in which the skin slides less often
    """
    if len(states) < 2:
        return []
    residuals = np.array([compute_place_residuals(state) for state in states])
    deviations = np.full(residuals.shape, np.nan)
    for k in range(places.shape[1]):
        for place in np.unique(places[:, k]):
            rows = np.flatnonzero(places[:, k] == place)
            if len(rows) > 1:
                deviations[rows, k] = residuals[rows, k] - _compute_nanmedian(residuals[rows, k])
    place_sd_m = max(NORMAL_MAD_RATIO * float(np.nanmedian(np.abs(deviations))), MIN_PLACE_SD_M)
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
    return _drop_neighbours(found, places)


def is_confirmed_move(move: MovedMarker, marker_offsets: Float[np.ndarray, "T K 3"]) -> bool:
    """Return whether a marker still lies elsewhere in some takes after a calibration in which it may.

    A marker beside one that moved may seem to move too, until the other one has a place of its own.

    marker_offsets  metres, the calibrated places in each take
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


def _drop_neighbours(found: list[MovedMarker], places: Int[np.ndarray, "T K"]) -> list[MovedMarker]:
    """Return the largest move of each take alone: others may only follow from it, and show up again if they do not."""
    largest: dict[tuple[int, ...], MovedMarker] = {}
    for each in found:
        if each.takes not in largest or each.distance_m > largest[each.takes].distance_m:
            largest[each.takes] = each
    return sorted(largest.values(), key=lambda each: each.marker)


def _compute_nanmedian(values: Float[np.ndarray, "R ..."]) -> Float[np.ndarray, "..."]:
    """Return the median over the first axis, NaN where all values are NaN."""
    is_seen = ~np.isnan(values).all(0)
    median = np.full(values.shape[1:], np.nan)
    median[is_seen] = np.nanmedian(values[:, is_seen], axis=0)
    return median


def _compute_rms(differences: Float[np.ndarray, "... 3"]) -> float:
    """Return the root mean square length of vectors, NaN left out."""
    squares = np.square(differences).sum(-1)
    return float(np.sqrt(np.nanmean(squares))) if np.isfinite(squares).any() else 0.0


MAX_JOINT_TAKES = 10
"""Takes from which bones and places are calibrated; those of the others are compared with them."""
MAX_FRAMES_PER_PERSON = 300
"""Frames of all takes of a person that enter the calibration. More of them weight the errors of the model too much."""
MIN_FRAMES_PER_TAKE = 20
"""Frames of each take that enter at least."""
MAX_MOVE_ROUNDS = 3
"""Rounds of detecting moved markers and calibrating with their places."""
MAX_OWN_RESIDUAL_RATIO = 2.5
"""Residual of a take, relative to the person's other takes, above which it is not that person's."""
MIN_FOREIGN_RESIDUAL_M = 0.015
"""The same in metres."""
RANGE_OF_MOTION_WORDS = ("rom", "range", "calib", "static")
"""Parts of the names of takes that were recorded for calibration."""


@dataclass(frozen=True)
class PersonCalibration:
    """A person calibrated from several takes.

    Attributes:
        subject: bones and the usual marker places.
        take_subjects: by id of a take, the subject with the marker places of that take, where they differ.
        sessions: by id of a take, the number of the attachment of all markers; 0 unless they were attached again.
        moved: moved markers, whose takes are indices of `takes`.
        takes: ids of the takes that fit the person.
        rejected: by id, why a take does not belong to the person.
    """

    subject: Subject
    take_subjects: dict[str, Subject]
    sessions: dict[str, int]
    moved: tuple[MovedMarker, ...]
    takes: tuple[str, ...]
    rejected: dict[str, str] = field(default_factory=dict[str, str])

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

    sessions  the session of each take: markers are attached again only between sessions; None if all are of one

    Raises TakeError if the takes have different marker sets.
    """
    takes = join_marker_sets(takes)
    session_of_take = {take.take: name for take, name in zip(takes, sessions or [""] * len(takes), strict=True)}
    body = restrict_body(load_cmu31_body(), set(takes[0].joints.tolist()))
    prior = load_mean_pose_prior(mean_pose_prior, body.skeleton)
    ranked = sorted(takes, key=_rank_take)
    frame_count = max(MIN_FRAMES_PER_TAKE, MAX_FRAMES_PER_PERSON // min(len(ranked), MAX_JOINT_TAKES))
    thinned = [thin_frames(take, frame_count) for take in ranked]
    chosen = thinned[:MAX_JOINT_TAKES]
    calibration = calibrate_jointly(chosen, np.zeros((len(chosen), len(takes[0].labels)), int), body, prior)
    rejected = find_foreign_takes(chosen, calibration.states)
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
    start = build_average_subject(take, body, take.size_ratio)
    first = calibration.states[0]
    no_deviation = np.zeros_like(person.subject.skeleton.offsets)
    placed = CalibratedBody(person.subject.skeleton.offsets, person.subject.marker_offsets, no_deviation)
    problem = refinement.build_calibration_problem(start, body, prior, take.markers, placed)
    state = refinement.solve_and_linearise(
        first.parameters, problem, first.unknowns, take.root_position.copy(), take.local_rotations.copy()
    )
    if reason := find_foreign_take(take, state, calibration.states):
        return replace(person, rejected={**person.rejected, take.take: reason})
    common = [t for t, name in enumerate(person.takes[: len(calibration.states)]) if name not in person.take_subjects]
    states = [*(calibration.states[t] for t in common), state]
    offsets = np.tile(person.subject.marker_offsets, (len(states), 1, 1))
    index = len(person.takes)
    own = person.subject.marker_offsets.copy()
    moved = list(person.moved)
    duration_s = float(np.ptp(take.times_s))
    for each in find_moved_markers(states, offsets, np.zeros(offsets.shape[:2], int), duration_s):
        if each.takes == (len(states) - 1,):
            own[each.marker] += compute_place_residuals(state, without_marker=each.marker)[each.marker]
            moved.append(replace(each, takes=(index,)))
    has_own = bool((own != person.subject.marker_offsets).any())
    own_subjects = {take.take: replace(person.subject, marker_offsets=own)} if has_own else {}
    return replace(
        person,
        takes=(*person.takes, take.take),
        sessions={**person.sessions, take.take: 0},
        moved=tuple(moved),
        take_subjects={**person.take_subjects, **own_subjects},
    )


def join_marker_sets(takes: Sequence[CalibrationFrames]) -> list[CalibrationFrames]:
    """Return the takes with the markers of all: those that a take does not have are missing in it.

    Raises TakeError if the takes have different marker sets.
    """
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
    """Return at most `count` frames of a take, those that differ most in pose."""
    if len(take.times_s) <= count:
        return take
    flat = take.local_rotations[:, 1:].reshape(len(take.times_s), -1)
    kept = np.sort(select_different(flat, count))
    return replace(
        take,
        times_s=take.times_s[kept],
        markers=take.markers[kept],
        root_position=take.root_position[kept],
        local_rotations=take.local_rotations[kept],
    )


def select_different(values: Float[np.ndarray, "N D"], count: int) -> Int[np.ndarray, " C"]:
    """Return the indices of rows: half of them by farthest-point selection, half evenly spaced among the others."""
    chosen = select_farthest_rows(values, count // 2)
    rest = np.setdiff1d(np.arange(len(values)), chosen)
    return np.r_[chosen, rest[np.linspace(0, len(rest) - 1, count - len(chosen)).astype(int)]]


def find_foreign_takes(takes: Sequence[CalibrationFrames], states: Sequence[RefinementState]) -> dict[str, str]:
    """Return the takes whose markers do not fit the body that the others have in common, with the reason."""
    reasons = {take.take: find_foreign_take(take, state, states) for take, state in zip(takes, states, strict=True)}
    return {name: reason for name, reason in reasons.items() if reason}


def find_foreign_take(take: CalibrationFrames, state: RefinementState, others: Sequence[RefinementState]) -> str:
    """Return why a take does not belong to the person of the others; "" if it does."""
    own_m, usual_m = compute_typical_residual(state), float(np.median([compute_typical_residual(each) for each in others]))
    if len(others) < 3 or own_m <= max(MIN_FOREIGN_RESIDUAL_M, MAX_OWN_RESIDUAL_RATIO * usual_m):
        return ""
    return f"The markers of {take.take} lie {1e3 * own_m:.0f} mm from the person's body, usual are {1e3 * usual_m:.0f} mm."


def compute_typical_residual(state: RefinementState) -> float:
    """Return the median distance in metres of the markers from the calibrated body."""
    return float(np.nanmedian(np.linalg.norm(state.problem.marker_positions - predict_frame_markers(state), axis=-1)))


def _rank_take(take: CalibrationFrames) -> tuple[bool, float]:
    """Return the order of a take: ranges of motion first, then by how much the poses vary."""
    name = take.take.casefold()
    return not any(word in name for word in RANGE_OF_MOTION_WORDS), -take.pose_variation_rad
