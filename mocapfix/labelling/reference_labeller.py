"""The labels of points by a labelled take of the same person, where no body is known: by its markers and their neighbours.

Poses of the labelled take are placed in a few frames in many headings. Points and markers are assigned one-to-one, and each
marker is moved to where its neighbours have it, in turns. The best assignments are extended to more frames, the best of these to
all frames, as for a body (`labeller`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.labelling.body_extension import EXTENSION_GATE_M, select_extension_frames
from mocapfix.labelling.body_search import TRIED_HEADING_COUNT, FoundBody
from mocapfix.labelling.key_frames import select_key_frames
from mocapfix.labelling.label_confidence import compute_label_confidence
from mocapfix.labelling.label_overlaps import CONTINUED_LABEL_CONFIDENCE, continue_labels, label_single_points
from mocapfix.labelling.linking import are_points_unordered
from mocapfix.labelling.points import PointLabels, UnlabelledPoints, assign_to_tracklets
from mocapfix.labelling.propagation import PROPAGATION_GATE_M
from mocapfix.labelling.reference_markers import ReferenceMarkers
from mocapfix.labelling.sampled_points import SampledPoints, sample_points
from mocapfix.labelling.tracklet_assignment import (
    LABEL_DISTANCE_DURATIONS_S,
    MAX_LABEL_DISTANCES_M,
    MIN_SEARCHED_DURATION_S,
    TrackletDistances,
    assign_points,
    assign_tracklets,
    measure_durations,
    measure_tracklets,
    select_lasting_tracklets,
)
from mocapfix.stats.sequences import sample_evenly

SEARCHED_POSES = 6
"""Poses of the labelled take that are placed in a frame."""
REFERENCE_GATES_M = (0.4, 0.3, 0.25, 0.2, 0.15, 0.12, 0.1, 0.08)
"""Distance at which a marker counts as not found, in each round."""
RIGID_ROUNDS = 4
"""Rounds in which a pose is placed as a whole."""
MAX_BENT_POSES = 10
"""Placed poses that are continued with each marker moved by its neighbours."""
PLACES_PER_FRAME = 2
"""Best assignments of each frame."""
MAX_EXTENDED_PLACES = 5
"""Best assignments of all frames that are extended to other frames."""
MAX_REFERENCE_EXTENSION_FRAMES = 20
"""Frames to which they are extended."""
REFERENCE_EXTENSION_ROUNDS = 3
"""Rounds of prediction and assignment in these frames."""
MAX_EXTENSION_DISTANCE_M = 0.1
"""Distance in these frames at which no label is as likely as a label."""
MIN_REFERENCE_CONFIDENCE = 0.8
"""Confidence below which a tracklet stays without a label."""
MIN_PART_MARKERS = 3
"""Markers of a part that is searched for."""
MAX_PART_SEARCHES = 6
"""Frames in which parts are searched for."""
MAX_RIVAL_COST_RATIO = 2.0
"""Cost of another assignment of a part up to which it is nearly as good, as a multiple of the best one's."""
MAX_RIVAL_COST_M2 = 0.0002
"""Added to this cost: a mean squared distance within the motion of skin."""
PART_PITCHES_RAD = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Inclinations in which a part is placed; a leg swings by about this much."""
MAX_TRIED_EXCHANGES = 10
"""Pairs of labels that are exchanged to see whether they fit better."""
MAX_EXCHANGE_COST_M2 = 0.003
"""Squared distances that such an exchange seems to add at most."""
MAX_REFERENCE_ROUNDS = 40
"""Rounds of prediction and assignment in all frames."""


class ExtendedLabels(NamedTuple):
    """The marker (N,) of each tracklet in some frames, -1 for none, and the mean squared distance in m2 per marker and frame."""

    markers: Int[np.ndarray, " N"]
    cost: float


class ReferenceLabels(NamedTuple):
    """The marker (N,) of each tracklet, -1 for none, its distances from the markers, and where these are predicted (S, K, 3)."""

    markers: Int[np.ndarray, " N"]
    distances: TrackletDistances
    predicted: Float[np.ndarray, "S K 3"]


def label_points_like(points: UnlabelledPoints, reference: ReferenceMarkers) -> PointLabels:
    """Return the marker of each point by the markers of a labelled take of the same person."""
    sampled = sample_points(points)
    lasting = select_lasting_tracklets(sampled)
    starts: list[ExtendedLabels] = []
    for frame in select_key_frames(lasting)[0]:
        visible = np.flatnonzero(lasting.tracklets[frame] >= 0)
        for found in search_reference(lasting.positions[frame, visible], reference, (0.0,))[:PLACES_PER_FRAME]:
            markers = np.full(sampled.tracklet_count, -1)
            markers[lasting.tracklets[frame, visible]] = found.markers
            starts.append(ExtendedLabels(markers, found.cost))
    starts.sort(key=lambda each: each.cost)
    extended = [extend_labels(lasting, each.markers, reference) for each in starts[:MAX_EXTENDED_PLACES]]
    if not extended:
        return PointLabels(np.full(points.tracklet_indices.shape, -1), np.zeros(points.tracklet_indices.shape))
    best = try_label_exchanges(lasting, min(extended, key=lambda each: each.cost), reference)
    labels = recover_parts(sampled, propagate_reference(sampled, best.markers, reference), reference)
    confidence = compute_label_confidence(sampled, labels.markers, labels.distances)
    markers = np.where(confidence >= MIN_REFERENCE_CONFIDENCE, labels.markers, -1)
    marker_indices = label_single_points(points, sampled, labels.predicted, markers)
    point_confidence = assign_to_tracklets(points, confidence, 0.0)
    if not are_points_unordered(points.positions):
        before, marker_indices = marker_indices, continue_labels(points, marker_indices)
        point_confidence[marker_indices != before] = CONTINUED_LABEL_CONFIDENCE
    return PointLabels(marker_indices, point_confidence)


def propagate_reference(sampled: SampledPoints, markers: Int[np.ndarray, " N"], reference: ReferenceMarkers) -> ReferenceLabels:
    """Return the labels of all tracklets that can be reached from those of some."""
    predicted = np.full((len(sampled.frames), len(reference.labels), 3), np.nan)
    positions = np.full_like(predicted, np.nan)
    # In a short take the tracklets of markers are short.
    scale = LABEL_DISTANCE_DURATIONS_S[1] / min(LABEL_DISTANCE_DURATIONS_S[1], max(float(np.ptp(sampled.times_s)), 1e-3))
    max_distance = np.interp(scale * measure_durations(sampled), LABEL_DISTANCE_DURATIONS_S, MAX_LABEL_DISTANCES_M)
    distances = measure_tracklets(sampled, predicted, PROPAGATION_GATE_M)
    for _ in range(MAX_REFERENCE_ROUNDS):
        before, positions = positions, sampled.arrange_markers(markers, len(reference.labels))
        changed = np.flatnonzero(~((positions == before) | (np.isnan(positions) & np.isnan(before))).all((1, 2)))
        if not len(changed):
            break
        predicted[changed] = reference.predict(positions[changed])
        distances = measure_tracklets(sampled, predicted, PROPAGATION_GATE_M)
        markers = assign_tracklets(sampled, distances.squared_m2, max_distance)
    return ReferenceLabels(markers, distances, predicted)


def recover_parts(sampled: SampledPoints, labels: ReferenceLabels, reference: ReferenceMarkers) -> ReferenceLabels:
    """Return the labels with those of parts, such as a limb, that are too far from where any pose of the other take has them."""
    is_candidate = measure_durations(sampled) >= MIN_SEARCHED_DURATION_S
    for _ in range(MAX_PART_SEARCHES):
        is_lost = np.append(is_candidate & (labels.markers < 0), False)[sampled.tracklets]
        shown = np.append(labels.markers, -1)[sampled.tracklets]
        count = np.minimum(is_lost.sum(1), len(reference.labels) - (shown >= 0).sum(1))
        frame = int(count.argmax())
        if count[frame] < MIN_PART_MARKERS:
            break
        missing = np.setdiff1d(np.arange(len(reference.labels)), shown[frame])
        free, part = np.flatnonzero(is_lost[frame]), reference.select_markers(missing)
        found = search_reference(sampled.positions[frame, free], part, PART_PITCHES_RAD)
        if found and not has_rival(found):
            is_found = found[0].markers >= 0
            markers = labels.markers.copy()
            markers[sampled.tracklets[frame, free[is_found]]] = missing[found[0].markers[is_found]]
            extended = propagate_reference(sampled, markers, reference)
            if count_labelled_points(sampled, extended) > count_labelled_points(sampled, labels):
                labels = extended
        is_candidate[sampled.tracklets[frame, free]] = False
    return labels


def has_rival(found: list[FoundBody]) -> bool:
    """Return whether an assignment with other markers for the same points is nearly as good, as on a symmetric object."""
    best = found[0]
    for other in found[1:]:
        if other.cost > MAX_RIVAL_COST_RATIO * best.cost + MAX_RIVAL_COST_M2:
            break
        if ((best.markers != other.markers) & (best.markers >= 0) & (other.markers >= 0)).any():
            return True
    return False


def count_labelled_points(sampled: SampledPoints, labels: ReferenceLabels) -> int:
    """Return the number of sampled points with a label that fits."""
    fits = labels.distances.squared_m2.min(axis=1, initial=np.inf, where=~np.isnan(labels.distances.squared_m2))
    is_good = (labels.markers >= 0) & (fits < MAX_EXTENSION_DISTANCE_M**2)
    return int(np.append(is_good, False)[sampled.tracklets].sum())


def search_reference(
    positions: Float[np.ndarray, "V 3"], reference: ReferenceMarkers, pitches_rad: tuple[float, ...]
) -> list[FoundBody]:
    """Return the assignments of the points of one frame, in metres, by rising cost.

    The poses are placed in all headings, and inclined by the pitches.
    """
    headings = np.linspace(0, 2 * np.pi, TRIED_HEADING_COUNT, endpoint=False)
    angles = np.array([(heading, pitch) for heading in headings for pitch in pitches_rad])
    rotations = Rotation.from_euler("YX", angles).as_matrix()
    found: list[FoundBody] = []
    for pose in reference.poses[:SEARCHED_POSES]:
        if not (~np.isnan(pose[:, 0])).any():
            continue
        predicted = np.median(positions, axis=0) + np.einsum("hij,kj->hki", rotations, pose - np.nanmedian(pose, axis=0))
        for number, gate in enumerate(REFERENCE_GATES_M):
            squared = ((positions[:, None] - predicted[:, None]) ** 2).sum(-1)
            assigned = [assign_points(np.nan_to_num(each, nan=1e3), gate) for each in squared]
            if number == RIGID_ROUNDS:
                kept = np.argsort([cost for _, cost in assigned], kind="stable")[: max(2, MAX_BENT_POSES // 3)]
                assigned, predicted = [assigned[h] for h in kept], predicted[kept]
            arranged = np.full((len(assigned), len(reference.labels), 3), np.nan)
            for h, (markers, _) in enumerate(assigned):
                arranged[h, markers[markers >= 0]] = positions[markers >= 0]
            body_rotations, predicted = reference.align(arranged, pose)
            if number >= RIGID_ROUNDS:
                for k in range(len(reference.labels)):
                    bent, squared = reference.predict_marker(arranged, k, pose[None], body_rotations[:, None])
                    predicted[:, k] = np.where(np.isfinite(squared), bent[:, 0], predicted[:, k])
        squared = ((positions[:, None] - predicted[:, None]) ** 2).sum(-1)
        found += [FoundBody(*assign_points(np.nan_to_num(each, nan=1e3), REFERENCE_GATES_M[-1])) for each in squared]
    return sorted(found, key=lambda each: each.cost)


def extend_labels(sampled: SampledPoints, markers: Int[np.ndarray, " N"], reference: ReferenceMarkers) -> ExtendedLabels:
    """Return the labels that hold in several frames, given those that were found in one."""
    part = select_reference_frames(sampled, markers)
    max_distance = np.full(len(markers), MAX_EXTENSION_DISTANCE_M)
    for _ in range(REFERENCE_EXTENSION_ROUNDS):
        predicted = reference.predict(part.arrange_markers(markers, len(reference.labels)))
        markers = assign_tracklets(part, measure_tracklets(part, predicted, EXTENSION_GATE_M).squared_m2, max_distance)
    return ExtendedLabels(markers, compute_reference_cost(part, markers, reference))


def try_label_exchanges(sampled: SampledPoints, labels: ExtendedLabels, reference: ReferenceMarkers) -> ExtendedLabels:
    """Return the labels with pairs exchanged that fit better so: each of two wrong labels makes the other look right."""
    part = select_reference_frames(sampled, labels.markers)
    predicted = reference.predict(part.arrange_markers(labels.markers, len(reference.labels)))
    squared = measure_tracklets(part, predicted, EXTENSION_GATE_M).squared_m2
    labelled = np.flatnonzero((labels.markers >= 0) & np.isfinite(squared).any(1))
    cost = np.nan_to_num(squared[np.ix_(labelled, labels.markers[labelled])], nan=EXTENSION_GATE_M**2)
    change = cost + cost.T - np.diag(cost) - np.diag(cost)[:, None]
    change[labels.markers[labelled][:, None] <= labels.markers[labelled]] = np.inf
    for place in np.argsort(change, axis=None, kind="stable")[:MAX_TRIED_EXCHANGES]:
        one, other = (int(labels.markers[labelled[n]]) for n in np.unravel_index(place, change.shape))
        if change.ravel()[place] > MAX_EXCHANGE_COST_M2:
            break
        exchanged = np.where(labels.markers == one, other, np.where(labels.markers == other, one, labels.markers))
        exchanged_cost = compute_reference_cost(part, exchanged, reference)
        if exchanged_cost < labels.cost:
            labels = ExtendedLabels(exchanged, exchanged_cost)
    return labels


def select_reference_frames(sampled: SampledPoints, markers: Int[np.ndarray, " N"]) -> SampledPoints:
    """Return the frames to which labels found in one frame are extended."""
    frames = select_extension_frames(sampled, markers)
    return sampled.select_frames(frames[sample_evenly(len(frames), MAX_REFERENCE_EXTENSION_FRAMES)])


def compute_reference_cost(sampled: SampledPoints, markers: Int[np.ndarray, " N"], reference: ReferenceMarkers) -> float:
    """Return the mean squared distance in m2 of the points from where their neighbours have them; a missing one is far away."""
    count = len(reference.labels)
    positions = sampled.arrange_markers(markers, count)
    squared = np.minimum(((positions - reference.predict(positions)) ** 2).sum(-1), EXTENSION_GATE_M**2)
    possible, is_found = np.minimum((sampled.tracklets >= 0).sum(1), count).sum(), ~np.isnan(squared)
    total = squared[is_found].sum() + EXTENSION_GATE_M**2 * (possible - is_found.sum())
    return float(total / max(1, possible))
