"""The search for a body in unlabelled points: in single frames, then in more of them, then in all tracklets of a take.

A body is placed in many headings and arm positions in the frames with most points. Points and markers are assigned one-to-one,
and the pose is solved with this assignment, in turns (iterative closest points; Besl & McKay 1992), with a gate that narrows.

A body that faces backwards, or has an arm assigned to a leg, fits one frame nearly as well as the right one. Its joints cannot
follow the markers through a motion, so the labels must hold in several frames.

From there labels spread outwards: the body is posed in every frame in which enough of its markers are labelled, and shows where
the others must be. Tracklets that begin or end in such frames get their labels, until no label changes. Where all trajectories
of a limb break at once, the limb is placed in the poses that it has in other frames.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.labels.tracklets import (
    SampledPoints,
    TrackletDistances,
    assign_tracklets,
    assign_within_gate,
    compute_max_distances,
    measure_tracklets,
)
from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.skeleton import BODY_SECTIONS
from mocapfix.model.subject import Subject
from mocapfix.solve import kinematics
from mocapfix.solve.kinematics import Poses
from mocapfix.stats.sequences import sample_evenly
from mocapfix.subject.average_body import PosedBody, build_average_subject, estimate_body_size_ratio
from mocapfix.subject.marker_set_fit import measure_marker_offsets

FINAL_OFFSET_WEIGHT = 0.8  # weight of the measured offset of a marker; that of the offset of the set is the rest
POSING_SCALES_M = (0.2, 0.1)  # robust scales of the poses
POSING_ITERATIONS = 8  # solver iterations at each scale
POSING_MARKER_SD_M = 0.02  # standard deviation of a marker about the body per axis


def pose_body(body: PosedBody, markers: Float[np.ndarray, "S K 3"]) -> Poses:
    """Return the poses of a body in frames with some of its markers, in metres, NaN where missing."""
    return body.fit(markers, POSING_MARKER_SD_M, POSING_SCALES_M, POSING_ITERATIONS)


@dataclass(frozen=True)
class ExtendedBody:
    """A body with the labels of those tracklets that it was extended to."""

    body: PosedBody  # the body with its marker offsets
    markers: Int[np.ndarray, " N"]  # the marker of each of the N tracklets, -1 for none
    cost: float  # its cost per frame: half the sum of squares in standard deviations
    frames: Int[np.ndarray, " E"]  # indices of the sampled frames


@dataclass(frozen=True)
class PropagatedLabels:
    """The labels of all tracklets."""

    body: PosedBody  # the body with the offsets of this take
    markers: Int[np.ndarray, " N"]  # the marker of each of the N tracklets, -1 for none
    distances: TrackletDistances  # the distances of the tracklets from the markers
    is_posed: Bool[np.ndarray, " S"]  # the sampled frames in which the body has a pose
    poses: Poses  # root positions (S, 3) in metres and local rotations of the frames


def adapt_offsets(
    nominal: Subject, poses: Poses, positions: Float[np.ndarray, "S K 3"], weight: float = FINAL_OFFSET_WEIGHT
) -> Subject:
    """Return the subject with its marker offsets moved towards where the posed body has the markers, all the way by weight 1."""
    joint_positions, joint_rotations = kinematics.compute_tree_poses(kinematics.build_kinematic_tree(nominal.skeleton), *poses)
    offsets = nominal.marker_offsets.copy()
    for k, joint in enumerate(nominal.joints):
        own = slice(k, k + 1)
        measured = measure_marker_offsets(positions[:, own], joint_positions[:, [joint]], joint_rotations[:, [joint]])[0][0, 0]
        if not np.isnan(measured[0]):
            offsets[k] += weight * (measured - offsets[k])
    return replace(nominal, marker_offsets=offsets)


def predict_in_posed_frames(labels: PropagatedLabels, subject: Subject) -> Float[np.ndarray, "S K 3"]:
    """Return where the body carries the markers of a subject, in metres; NaN in frames without a pose."""
    predicted = np.full((len(labels.is_posed), len(subject.labels), 3), np.nan)
    frames = np.flatnonzero(labels.is_posed)
    poses = labels.poses[0][frames], labels.poses[1][frames]
    predicted[frames] = labels.body.change_subject(subject).predict(poses)
    return predicted


def scale_nominal_subject(subject: Subject, marker_set: MarkerSet) -> Subject:
    """Return a subject of the size of another one with the marker offsets of the set."""
    return build_average_subject(marker_set, subject.skeleton.size_ratio)


TRIED_HEADING_COUNT = 12  # headings in which a body is placed
SEARCH_GATES_M = (0.4, 0.1)  # distance at which a marker counts as not found, in the first and in the last round
SEARCH_ROUNDS = 12  # rounds of assignment and solve
PRUNING_ROUND = 5  # round after which only the best poses are continued
MAX_CONTINUED_POSES = 12  # poses that are continued
SEARCH_ITERATIONS = 4  # solver iterations in a round
SEARCH_MARKER_SD_M = 0.04  # standard deviation of a person's markers about those of the average body


class FoundMarkers(NamedTuple):
    """The marker of each point of a frame, or of each tracklet, -1 for none, and the cost of this assignment."""

    markers: Int[np.ndarray, " V"]
    cost: float


def search_body(positions: Float[np.ndarray, "V 3"], body: PosedBody) -> list[FoundMarkers]:
    """Return the poses found for the points of one frame, in metres, by rising cost. Poses with the same assignment are one."""
    poses = place_bodies(positions, body)
    found: list[FoundMarkers] = []
    for number, gate in enumerate(np.geomspace(*SEARCH_GATES_M, SEARCH_ROUNDS)):
        predicted = body.predict(poses)
        squared = ((positions[:, None] - predicted[:, None]) ** 2).sum(-1)
        assigned = [assign_within_gate(each, float(gate)) for each in squared]
        found = [FoundMarkers(*each) for each in assigned]
        if number == PRUNING_ROUND:
            kept = np.argsort([each.cost for each in found], kind="stable")[:MAX_CONTINUED_POSES]
            poses, found = (poses[0][kept], poses[1][kept]), [found[h] for h in kept]
        markers = _arrange_found(positions, found, predicted.shape[1])
        poses = body.solve(poses, markers, SEARCH_MARKER_SD_M, (float(gate),), SEARCH_ITERATIONS)
    markers = _arrange_found(positions, found, len(body.subject.joints))
    costs = body.compute_costs(poses, markers, SEARCH_MARKER_SD_M, SEARCH_GATES_M[1])
    missing_cost = 0.5 * (SEARCH_GATES_M[1] / SEARCH_MARKER_SD_M) ** 2
    possible = min(len(positions), len(body.subject.joints))
    totals = [
        float(cost + missing_cost * (possible - (each.markers >= 0).sum())) for cost, each in zip(costs, found, strict=True)
    ]
    best: dict[bytes, FoundMarkers] = {}
    for h in np.argsort(totals, kind="stable"):
        best.setdefault(found[h].markers.tobytes(), FoundMarkers(found[h].markers, totals[h]))
    return list(best.values())


def place_bodies(positions: Float[np.ndarray, "V 3"], body: PosedBody) -> Poses:
    """Return poses (H) of a body that stands where the points are, in all headings and arm positions."""
    local_rotations = body.turn_around(TRIED_HEADING_COUNT)
    predicted = body.predict((np.zeros((len(local_rotations), 3)), local_rotations))
    root_position = np.median(positions, axis=0) - np.median(predicted, axis=1)
    return root_position, local_rotations


def _arrange_found(positions: Float[np.ndarray, "V 3"], found: list[FoundMarkers], count: int) -> Float[np.ndarray, "H K 3"]:
    markers = np.full((len(found), count, 3), np.nan)
    for h, each in enumerate(found):
        is_assigned: Bool[np.ndarray, " V"] = each.markers >= 0
        markers[h, each.markers[is_assigned]] = positions[is_assigned]
    return markers


MAX_EXTENSION_FRAMES = 40  # frames to which a body is extended
MIN_EXTENSION_MARKER_SHARE = 0.75  # markers of such a frame, as a share of those of the frame in which the body was found
EXTENSION_GATE_M = 0.2  # distance above which all distances of a point from a marker are equal
MAX_EXTENSION_DISTANCES_M = (0.1, 0.1, 0.1, 0.15, 0.15)  # distance in each round at which no label is as likely as a label
MISSING_MARKER_COST = 120.0  # of a marker without a point where points have no marker, in half squares of sds
OFFSET_WEIGHTS = (0.0, 0.2, 0.4, 0.6, FINAL_OFFSET_WEIGHT)  # weight of the measured offset of a marker after each round
MIN_OFFSET_SPREAD_M = 0.015  # smallest standard deviation per axis of the offset of a person's marker from that of the set


def extend_body(
    sampled: SampledPoints, markers: Int[np.ndarray, " N"], body: PosedBody, marker_set: MarkerSet | None
) -> ExtendedBody:
    """Return a body with the labels that hold in several frames.

    Args:
        markers: The marker of each tracklet that was found in one frame, -1 for all others.
        body: The body with which they were found.
        marker_set: The set, from which size and offsets of the body are estimated; None if those of `body` are known.
    """
    count = len(body.subject.joints)
    frames = select_extension_frames(sampled, markers)
    part = sampled.select_frames(frames)
    if marker_set is not None:
        size = estimate_body_size_ratio(marker_set, part.arrange_markers(markers, count))
        body = body.change_subject(build_average_subject(marker_set, size))
    nominal = body.subject
    for offset_weight, max_distance in zip(OFFSET_WEIGHTS, MAX_EXTENSION_DISTANCES_M, strict=True):
        positions = part.arrange_markers(markers, count)
        poses = pose_body(body, positions)
        if marker_set is not None:
            body = body.change_subject(adapt_offsets(nominal, poses, positions, offset_weight))
        distances = measure_tracklets(part, body.predict(poses), EXTENSION_GATE_M)
        markers = assign_tracklets(part, distances.squared_m2, np.full(len(markers), max_distance))
    return ExtendedBody(body, markers, compute_body_cost(part, markers, body, nominal), frames)


def compute_body_cost(sampled: SampledPoints, markers: Int[np.ndarray, " N"], body: PosedBody, nominal: Subject) -> float:
    """Return the mean cost of a body in the frames of `sampled`, with that of its offsets and of markers that it lacks."""
    count = len(body.subject.joints)
    positions = sampled.arrange_markers(markers, count)
    poses = pose_body(body, positions)
    costs = body.compute_costs(poses, positions, POSING_MARKER_SD_M, POSING_SCALES_M[-1])
    spread = np.maximum(nominal.marker_spread, MIN_OFFSET_SPREAD_M)[:, None]
    offset_cost = 0.5 * float((((body.subject.marker_offsets - nominal.marker_offsets) / spread) ** 2).sum())
    possible = np.minimum((sampled.tracklets >= 0).sum(1), count)
    missing = possible - (~np.isnan(positions[..., 0])).sum(1)
    return float((costs + MISSING_MARKER_COST * missing).mean()) + offset_cost


def select_extension_frames(sampled: SampledPoints, markers: Int[np.ndarray, " N"]) -> Int[np.ndarray, " E"]:
    """Return the frames that show most of the labelled tracklets."""
    count = (np.append(markers, -1)[sampled.tracklets] >= 0).sum(1)
    enough = np.flatnonzero(count >= MIN_EXTENSION_MARKER_SHARE * count.max())
    return enough[sample_evenly(len(enough), MAX_EXTENSION_FRAMES)]


MIN_LOST_MARKERS = 2  # markers without a trajectory, and unlabelled trajectories, with which a limb is searched for
MAX_LIMB_POSES = 24  # poses of other frames that are tried
LIMB_GATES_M = (0.35, 0.08)  # distance at which a marker counts as not found, in the first and in the last round
LIMB_SEARCH_ROUNDS = 8  # rounds of assignment and solve


def find_limb_frame(sampled: SampledPoints, labels: PropagatedLabels, is_lost: Bool[np.ndarray, " N"]) -> int:
    """Return the frame with the most markers that may be among its unlabelled trajectories, -1 if there is none."""
    lost = np.append(is_lost, False)[sampled.tracklets].sum(1)
    marker_count = len(np.unique(labels.markers[labels.markers >= 0]))
    missing = marker_count - (np.append(labels.markers, -1)[sampled.tracklets] >= 0).sum(1)
    possible = np.where(labels.is_posed, np.minimum(lost, missing), 0)
    return int(possible.argmax()) if possible.max(initial=0) >= MIN_LOST_MARKERS else -1


def search_limb(
    sampled: SampledPoints, labels: PropagatedLabels, frame: int, is_candidate: Bool[np.ndarray, " N"]
) -> Int[np.ndarray, " N"]:
    """Return the markers of the tracklets with those that the best pose of the lost limbs gives in one frame."""
    tracklets, body = sampled.tracklets[frame], labels.body
    own = np.append(labels.markers, -1)[tracklets]
    missing = np.setdiff1d(np.unique(labels.markers[labels.markers >= 0]), own)
    free = np.flatnonzero((tracklets >= 0) & (own < 0) & np.append(is_candidate, False)[tracklets])
    poses = place_limbs(sampled, labels, frame, missing)
    markers = np.tile(
        sampled.select_frames(np.array([frame])).arrange_markers(labels.markers, len(body.subject.joints)), (len(poses[0]), 1, 1)
    )
    assigned = np.full((len(poses[0]), len(free)), -1)
    for gate in np.geomspace(*LIMB_GATES_M, LIMB_SEARCH_ROUNDS):
        predicted = body.predict(poses)[:, missing]
        markers[:, missing] = np.nan
        for h, positions in enumerate(predicted):
            squared = ((sampled.positions[frame, free][:, None] - positions) ** 2).sum(-1)
            assigned[h] = assign_within_gate(squared, float(gate))[0]
            is_found = assigned[h] >= 0
            markers[h, missing[assigned[h, is_found]]] = sampled.positions[frame, free[is_found]]
        poses = body.solve(poses, markers, POSING_MARKER_SD_M, (float(gate),), POSING_ITERATIONS)
    costs = body.compute_costs(poses, markers, POSING_MARKER_SD_M, LIMB_GATES_M[1])
    missing_cost = 0.5 * (LIMB_GATES_M[1] / POSING_MARKER_SD_M) ** 2
    best = int(np.argmin(costs - missing_cost * (assigned >= 0).sum(1)))
    found = labels.markers.copy()
    is_found = assigned[best] >= 0
    found[tracklets[free[is_found]]] = missing[assigned[best, is_found]]
    return found


def place_limbs(sampled: SampledPoints, labels: PropagatedLabels, frame: int, missing: Int[np.ndarray, " L"]) -> Poses:
    """Return poses of a frame in which the limbs of the missing markers have the poses of other frames."""
    names = labels.body.subject.skeleton.names
    lost = {names[labels.body.subject.joints[marker]] for marker in missing}
    joints = [names.index(name) for section in BODY_SECTIONS.values() if lost.intersection(section) for name in section]
    joints = [joint for joint in joints if joint > 0]
    shown: Float[np.ndarray, " S"] = np.isin(np.append(labels.markers, -1)[sampled.tracklets], missing).sum(1).astype(float)
    donors = np.flatnonzero(labels.is_posed & (shown == shown[labels.is_posed].max()))
    donors = donors[sample_evenly(len(donors), MAX_LIMB_POSES)]
    root, local = np.tile(labels.poses[0][frame], (len(donors), 1)), np.tile(labels.poses[1][frame], (len(donors), 1, 1, 1))
    local[:, joints] = labels.poses[1][donors][:, joints]
    return root, local


KEY_FRAME_COUNT = 8  # frames in which a body is searched for
KEY_FRAME_POINT_SHARE = 0.9  # points that such a frame shows, as a share of the 90th percentile over all frames
KEY_FRAME_HEIGHT_QUANTILES = (0.2, 1.0)  # range of the heights of these frames: the lowest show people who crouch or lie
STANDING_HEIGHT_QUANTILE = 0.7  # quantile of the heights that a standing person has; the highest are those of raised arms


def select_key_frames(sampled: SampledPoints) -> tuple[Int[np.ndarray, " F"], float]:
    """Return frames in which to search for a body, and the height of the standing person's points in metres."""
    count = (sampled.tracklets >= 0).sum(1)
    full = np.flatnonzero(count >= KEY_FRAME_POINT_SHARE * np.quantile(count, 0.9))
    height = sampled.positions[full, :, 1]
    height = np.nanmax(height, axis=1) - np.nanmin(height, axis=1)
    order = full[np.argsort(height, kind="stable")]
    places = np.linspace(*KEY_FRAME_HEIGHT_QUANTILES, KEY_FRAME_COUNT) * (len(order) - 1)
    return np.unique(order[places.astype(int)]), float(np.quantile(height, STANDING_HEIGHT_QUANTILE))


def search_key_frames(
    sampled: SampledPoints, frames: Int[np.ndarray, " F"], search: Callable[[Float[np.ndarray, "V 3"]], list[FoundMarkers]]
) -> list[FoundMarkers]:
    """Return the markers of the tracklets that a search finds in the points of single frames, by rising cost."""
    found: list[FoundMarkers] = []
    for frame in frames:
        visible = np.flatnonzero(sampled.tracklets[frame] >= 0)
        for each in search(sampled.positions[frame, visible]):
            markers = np.full(sampled.tracklet_count, -1)
            markers[sampled.tracklets[frame, visible]] = each.markers
            found.append(FoundMarkers(markers, each.cost))
    return sorted(found, key=lambda each: each.cost)


MIN_POSED_MARKER_SHARE = 0.6  # of the markers that the body has in most frames, with which a frame is posed
MAX_PROPAGATION_ROUNDS = 200  # rounds of posing and assignment; a round extends the labels by about the duration of a tracklet
MAX_OFFSET_FRAMES = 120  # frames from which the offsets of the markers are estimated
MAX_OFFSET_ROUNDS = 6  # rounds in which the offsets are adapted
PROPAGATION_GATE_M = 0.2  # distance above which all distances of a point from a marker are equal


def propagate_labels(sampled: SampledPoints, start: ExtendedBody, nominal: Subject | None) -> PropagatedLabels:
    """Return the labels of all tracklets that can be reached from those of `start`.

    Args:
        start: A body and its labels in some frames.
        nominal: The subject whose offsets are adapted to the take; None if those of `start` are known.
    """
    body, markers = start.body, start.markers
    marker_count, frame_count = len(body.subject.joints), len(sampled.frames)
    root = np.zeros((frame_count, 3))
    local = np.tile(body.prior.mean_rotations, (frame_count, 1, 1, 1))
    posed_positions = np.full((frame_count, marker_count, 3), np.nan)
    is_posed = np.zeros(frame_count, bool)
    predicted = np.full((frame_count, marker_count, 3), np.nan)
    distances = TrackletDistances(np.full((len(markers), marker_count), np.nan), np.zeros(len(markers), int))
    min_count = MIN_POSED_MARKER_SHARE * np.median((np.append(markers, -1)[sampled.tracklets[start.frames]] >= 0).sum(1))
    max_distance = compute_max_distances(sampled)
    for number in range(MAX_PROPAGATION_ROUNDS):
        positions = sampled.arrange_markers(markers, marker_count)
        is_ready = (~np.isnan(positions[..., 0])).sum(1) >= min_count
        is_changed = is_ready & ~(
            ((positions == posed_positions) | (np.isnan(positions) & np.isnan(posed_positions))).all((1, 2))
        )
        is_changed |= is_ready & ~is_posed
        adapts = nominal is not None and number < MAX_OFFSET_ROUNDS
        if not is_changed.any() and not adapts:
            break
        frames = np.flatnonzero(is_changed)
        if len(frames):
            root[frames], local[frames] = pose_body(body, positions[frames])
            posed_positions[frames] = positions[frames]
            is_posed |= is_changed
        if adapts and nominal is not None:
            known = np.flatnonzero(is_posed)
            chosen = known[sample_evenly(len(known), MAX_OFFSET_FRAMES)]
            body = body.change_subject(adapt_offsets(nominal, (root[chosen], local[chosen]), posed_positions[chosen]))
            frames = known
            root[frames], local[frames] = body.solve(
                (root[frames], local[frames]), posed_positions[frames], POSING_MARKER_SD_M, POSING_SCALES_M[-1:], 3
            )
        predicted[frames] = body.predict((root[frames], local[frames]))
        distances = measure_tracklets(sampled, predicted, PROPAGATION_GATE_M)
        markers = assign_tracklets(sampled, distances.squared_m2, max_distance)
    return PropagatedLabels(body, markers, distances, is_posed, (root, local))
