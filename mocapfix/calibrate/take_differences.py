"""Differences between takes of a person: markers that were attached again for a session, or moved between two takes.

A marker's place in a take is compared with its place in the others. A moved marker turns its segment, so that its own residual is
too small and its neighbours have one too. Candidates are therefore compared with the pose that the other markers give.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from mocapfix.calibrate import refinement
from mocapfix.calibrate.refinement import RefinementState
from mocapfix.solve.kinematics import compute_tree_poses
from mocapfix.solve.pose_problem import build_no_tracking

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
        root, local = root.copy(), local.copy()
        replace(problem, solver_mask=mask).solve(
            root,
            local,
            build_no_tracking(local.shape[1]),
            (refinement.CALIBRATION_ROBUST_SCALE_M,),
            refinement.MAX_CALIBRATION_POSE_ITERATIONS,
        )
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
