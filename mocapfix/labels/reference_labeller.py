"""The labels of points by a labelled take of the same person, where no body is known: by its markers and their neighbours.

A marker is predicted from its neighbours, those whose distances from it vary least: frames of the labelled take in which these
have about the same distances from each other show where the marker is among them. Each frame is aligned rigidly, so that a
mirror image does not fit.

Poses of the labelled take are placed in a few frames in many headings. Points and markers are assigned one-to-one, and each
marker is moved to where its neighbours have it, in turns. The best assignments are extended to more frames, the best of these
to all.

Where no labelled take is known either, the take itself shows how its markers move: those trajectories that are visible together
in its fullest stretch are the markers, and the other fragments are assigned to them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np
import scipy
from jaxtyping import Float, Int

from mocapfix.labels.body_search import (
    EXTENSION_GATE_M,
    PROPAGATION_GATE_M,
    TRIED_HEADING_COUNT,
    FoundMarkers,
    search_key_frames,
    select_extension_frames,
    select_key_frames,
)
from mocapfix.labels.tracklets import (
    LABEL_DISTANCE_DURATIONS_S,
    MAX_LABEL_DISTANCES_M,
    MIN_SEARCHED_DURATION_S,
    PointLabels,
    SampledPoints,
    TrackletDistances,
    UnlabelledPoints,
    assign_tracklets,
    assign_within_gate,
    compute_label_confidence,
    label_nothing,
    label_points_of_tracklets,
    measure_durations,
    measure_tracklets,
    sample_points,
    select_lasting_tracklets,
)
from mocapfix.stats.marker_distances import measure_distance_spread
from mocapfix.stats.rigid_alignment import compute_cross_covariance, fit_rotations
from mocapfix.stats.sequences import sample_evenly, select_farthest_rows

MAX_REFERENCE_CANDIDATES = 150  # frames of the labelled take among which those with different poses are chosen
MAX_POSES = 12  # poses of the labelled take that are kept
MAX_NEIGHBOURS = 8  # neighbours from which a marker is predicted
MIN_NEIGHBOURS = 3  # neighbours that must be visible
MIN_REFERENCE_DISTANCE_SD_M = 0.008  # smallest standard deviation of a distance between markers
RELATIVE_REFERENCE_SD = 0.03  # of a distance that did not vary, as a share of it: the person may have moved little
BODY_ROTATION_WEIGHT_M = 0.03  # arm of the points that hold nearly straight neighbours' rotation at that of all markers
MIN_POSE_RESIDUAL_M = 0.004  # residual of the neighbours up to which poses fit equally


@dataclass(frozen=True)
class ReferenceMarkers:
    """K markers of a labelled take."""

    labels: tuple[str, ...]  # their labels
    poses: Float[np.ndarray, "E K 3"]  # their positions in E frames of the take, metres, NaN where missing
    # Standard deviations of the distances of pairs; infinite for markers that were never visible together.
    distance_sd_m: Float[np.ndarray, "K K"]

    @cached_property
    def neighbours(self) -> Int[np.ndarray, "K N"]:
        """Indices of the neighbours of each marker."""
        return np.argsort(self.distance_sd_m, axis=1, kind="stable")[:, :MAX_NEIGHBOURS]

    @cached_property
    def weights(self) -> Float[np.ndarray, "K N"]:
        """Weights of the neighbours in 1/m2; 0 for those that were never visible with the marker."""
        return 1 / np.take_along_axis(self.distance_sd_m, self.neighbours, axis=1) ** 2

    def select_markers(self, markers: Int[np.ndarray, " L"]) -> "ReferenceMarkers":
        """Return some of the markers, with the neighbours that they have among each other."""
        labels = tuple(self.labels[marker] for marker in markers)
        return ReferenceMarkers(labels, self.poses[:, markers], self.distance_sd_m[np.ix_(markers, markers)])

    def predict(self, positions: Float[np.ndarray, "S K 3"]) -> Float[np.ndarray, "S K 3"]:
        """Return where each marker is by its neighbours, in metres; NaN where fewer than three of them are visible.

        Poses in which the neighbours fit about equally well are averaged.
        """
        body_rotations = np.stack([self.align(positions, pose)[0] for pose in self.poses], axis=1)
        predicted = np.full(positions.shape, np.nan)
        for k in range(len(self.labels)):
            points, squared = self.predict_marker(positions, k, self.poses, body_rotations)
            least = np.where(np.isfinite(squared.min(1)), squared.min(1), 0.0)[:, None]
            weight = np.exp(-0.5 * (squared - least) / np.maximum(least, MIN_POSE_RESIDUAL_M**2))
            total = weight.sum(1)[:, None]
            average = (weight[..., None] * np.where(weight[..., None] > 0, points, 0.0)).sum(1) / np.maximum(total, 1e-12)
            predicted[:, k] = np.where(total > 0, average, np.nan)
        return predicted

    def align(
        self, positions: Float[np.ndarray, "S K 3"], pose: Float[np.ndarray, "K 3"]
    ) -> tuple[Float[np.ndarray, "S 3 3"], Float[np.ndarray, "S K 3"]]:
        """Return the rotations of a pose to the positions of all markers, and the pose rotated and moved there."""
        weight = (~np.isnan(positions[..., 0]) & ~np.isnan(pose[:, 0])).astype(float)
        cross, mean, mean_pose = compute_cross_covariance(positions, pose, weight)
        rotations = fit_rotations(cross)
        return rotations, mean[:, None] + np.einsum("sij,skj->ski", rotations, pose - mean_pose[:, None])

    def predict_marker(
        self,
        positions: Float[np.ndarray, "S K 3"],
        k: int,
        poses: Float[np.ndarray, "E K 3"],
        body_rotations: Float[np.ndarray, "S E 3 3"],
    ) -> tuple[Float[np.ndarray, "S E 3"], Float[np.ndarray, "S E"]]:
        """Return where each pose has a marker among its neighbours, and their mean squared residual in m2 (infinite: unknown)."""
        neighbours = self.neighbours[k]
        is_visible, is_in_pose = ~np.isnan(positions[:, neighbours, 0]), ~np.isnan(poses[:, neighbours, 0]).T
        weight = self.weights[k] * is_visible
        own = np.where(is_visible[..., None], positions[:, neighbours], 0.0)
        model = np.where(is_in_pose[..., None], poses[:, neighbours].swapaxes(0, 1), 0.0)  # (N, E, 3)
        total = np.maximum(weight @ is_in_pose, 1e-9)
        weighted = own * weight[..., None]
        mean = np.einsum("sni,ne->sei", weighted, is_in_pose) / total[..., None]
        mean_model = np.einsum("sn,nej->sej", weight, model) / total[..., None]
        frames, count = len(positions), len(poses)
        products = weighted.swapaxes(1, 2).reshape(-1, len(neighbours)) @ model.reshape(len(neighbours), -1)
        cross = products.reshape(frames, 3, count, 3).swapaxes(1, 2) - total[..., None, None] * (
            mean[..., :, None] * mean_model[..., None, :]
        )
        held = cross + BODY_ROTATION_WEIGHT_M**2 * total[..., None, None] * body_rotations
        rotations = fit_rotations(held.reshape(-1, 3, 3)).reshape(frames, count, 3, 3)
        squared = ((own**2).sum(-1) * weight) @ is_in_pose + weight @ (model**2).sum(-1)
        squared -= total * ((mean**2).sum(-1) + (mean_model**2).sum(-1)) + 2 * (rotations * cross).sum((-2, -1))
        points = mean + (rotations @ (poses[:, k] - mean_model)[..., None])[..., 0]
        is_known = ((weight > 0).astype(float) @ is_in_pose >= MIN_NEIGHBOURS) & ~np.isnan(poses[:, k, 0])
        return points, np.where(is_known, np.maximum(squared / total, 0.0), np.inf)


def build_reference_markers(markers: Float[np.ndarray, "T K 3"], labels: tuple[str, ...]) -> ReferenceMarkers:
    """Return the model of a labelled take's markers, in metres, NaN where missing."""
    poses = _choose_poses(markers)
    distances = _measure_distances(poses)
    count = (~np.isnan(distances)).sum(axis=0)
    mean_distance = np.divide(np.nansum(distances, axis=0), count, out=np.full(count.shape, np.inf), where=count > 0)
    spread = np.hypot(measure_distance_spread(markers), RELATIVE_REFERENCE_SD * mean_distance)
    spread = np.hypot(spread, MIN_REFERENCE_DISTANCE_SD_M)
    np.fill_diagonal(spread, np.inf)
    return ReferenceMarkers(labels, poses, spread)


def _choose_poses(markers: Float[np.ndarray, "T K 3"]) -> Float[np.ndarray, "E K 3"]:
    """Return frames with many markers and with poses as different as possible."""
    visible = (~np.isnan(markers[..., 0])).sum(1)
    full = np.flatnonzero(visible >= np.quantile(visible, 0.5))
    candidates = markers[full[sample_evenly(len(full), MAX_REFERENCE_CANDIDATES)]]
    distances = np.nan_to_num(_measure_distances(candidates).reshape(len(candidates), -1))
    fullest = int(np.argmax((~np.isnan(candidates[..., 0])).sum(1)))
    return candidates[select_farthest_rows(distances, min(MAX_POSES, len(candidates)), fullest)]


def _measure_distances(positions: Float[np.ndarray, "S K 3"]) -> Float[np.ndarray, "S K K"]:
    return np.linalg.norm(positions[:, :, None] - positions[:, None], axis=-1)


SEARCHED_POSES = 6  # poses of the labelled take that are placed in a frame
REFERENCE_GATES_M = (0.4, 0.3, 0.25, 0.2, 0.15, 0.12, 0.1, 0.08)  # distance at which a marker counts as not found, in each round
RIGID_ROUNDS = 4  # rounds in which a pose is placed as a whole
MAX_BENT_POSES = 10  # placed poses that are continued with each marker moved by its neighbours
PLACES_PER_FRAME = 2  # best assignments of each frame
MAX_EXTENDED_PLACES = 5  # best assignments of all frames that are extended to other frames
MAX_REFERENCE_EXTENSION_FRAMES = 20  # frames to which they are extended
REFERENCE_EXTENSION_ROUNDS = 3  # rounds of prediction and assignment in these frames
MAX_EXTENSION_DISTANCE_M = 0.1  # distance in these frames at which no label is as likely as a label
MIN_REFERENCE_CONFIDENCE = 0.8  # confidence below which a tracklet stays without a label
MIN_PART_MARKERS = 3  # markers of a part that is searched for
MAX_PART_SEARCHES = 6  # frames in which parts are searched for
MAX_RIVAL_COST_RATIO = 2.0  # up to which another assignment is nearly as good, as a multiple of the best one's
MAX_RIVAL_COST_M2 = 0.0002  # added to this cost: a mean squared distance within the motion of skin
PART_PITCHES_RAD = (-1.0, -0.5, 0.0, 0.5, 1.0)  # inclinations in which a part is placed; a leg swings by about this much
MAX_TRIED_EXCHANGES = 10  # pairs of labels that are exchanged to see whether they fit better
MAX_EXCHANGE_COST_M2 = 0.003  # squared distances that such an exchange seems to add at most
MAX_REFERENCE_ROUNDS = 40  # rounds of prediction and assignment in all frames


class ReferenceLabels(NamedTuple):
    """The marker (N,) of each tracklet, -1 for none, its distances from the markers, and where these are predicted (S, K, 3)."""

    markers: Int[np.ndarray, " N"]
    distances: TrackletDistances
    predicted: Float[np.ndarray, "S K 3"]


def label_points_like(points: UnlabelledPoints, reference: ReferenceMarkers) -> PointLabels:
    """Return the marker of each point by the markers of a labelled take of the same person."""
    sampled = sample_points(points)
    lasting = select_lasting_tracklets(sampled)
    starts = search_key_frames(
        lasting, select_key_frames(lasting)[0], lambda points: search_reference(points, reference, (0.0,))[:PLACES_PER_FRAME]
    )
    extended = [extend_labels(lasting, each.markers, reference) for each in starts[:MAX_EXTENDED_PLACES]]
    if not extended:
        return label_nothing(points)
    best = try_label_exchanges(lasting, min(extended, key=lambda each: each.cost), reference)
    labels = recover_parts(sampled, propagate_reference(sampled, best.markers, reference), reference)
    confidence = compute_label_confidence(sampled, labels.markers, labels.distances)
    markers = np.where(confidence >= MIN_REFERENCE_CONFIDENCE, labels.markers, -1)
    return label_points_of_tracklets(points, sampled, labels.predicted, markers, confidence)


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


def has_rival(found: list[FoundMarkers]) -> bool:
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
) -> list[FoundMarkers]:
    """Return the assignments of a frame's points, in metres, by rising cost; the poses have all headings, and the pitches."""
    headings = np.linspace(0, 2 * np.pi, TRIED_HEADING_COUNT, endpoint=False)
    angles = np.array([(heading, pitch) for heading in headings for pitch in pitches_rad])
    rotations = scipy.spatial.transform.Rotation.from_euler("YX", angles).as_matrix()
    found: list[FoundMarkers] = []
    for pose in reference.poses[:SEARCHED_POSES]:
        if not (~np.isnan(pose[:, 0])).any():
            continue
        predicted = np.median(positions, axis=0) + np.einsum("hij,kj->hki", rotations, pose - np.nanmedian(pose, axis=0))
        for number, gate in enumerate(REFERENCE_GATES_M):
            squared = ((positions[:, None] - predicted[:, None]) ** 2).sum(-1)
            assigned = [assign_within_gate(np.nan_to_num(each, nan=1e3), gate) for each in squared]
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
        found += [FoundMarkers(*assign_within_gate(np.nan_to_num(each, nan=1e3), REFERENCE_GATES_M[-1])) for each in squared]
    return sorted(found, key=lambda each: each.cost)


def extend_labels(sampled: SampledPoints, markers: Int[np.ndarray, " N"], reference: ReferenceMarkers) -> FoundMarkers:
    """Return the labels that hold in several frames, given those of one; the cost is a mean squared distance in m2."""
    part = select_reference_frames(sampled, markers)
    max_distance = np.full(len(markers), MAX_EXTENSION_DISTANCE_M)
    for _ in range(REFERENCE_EXTENSION_ROUNDS):
        predicted = reference.predict(part.arrange_markers(markers, len(reference.labels)))
        markers = assign_tracklets(part, measure_tracklets(part, predicted, EXTENSION_GATE_M).squared_m2, max_distance)
    return FoundMarkers(markers, compute_reference_cost(part, markers, reference))


def try_label_exchanges(sampled: SampledPoints, labels: FoundMarkers, reference: ReferenceMarkers) -> FoundMarkers:
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
            labels = FoundMarkers(exchanged, exchanged_cost)
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


LikeLabeller: TypeAlias = Callable[[UnlabelledPoints, ReferenceMarkers], PointLabels]
"""labels points by the markers of a labelled take"""
MIN_FRAGMENT_S = 0.5  # duration of a fragment below which it may be a ghost and names no marker
MIN_LASTING_SHARE = 0.8  # share of the fragments of the fullest frame that are still visible at the ends of its stretch
MIN_JOINED_MARKERS = 5  # markers that a take must show together to be joined
MIN_MARKER_SHARE = 0.2  # samples of a marker, relative to those of the median one, below which it is a ghost
MAX_TRIED_FRAMES = 50  # frames with the most fragments among which the one with the longest stretch is chosen


def join_trajectories(points: UnlabelledPoints, label_like: LikeLabeller) -> tuple[PointLabels, tuple[str, ...]]:
    """Return the marker of each point, and the names of the markers: M01 and so on; none where too few are visible together."""
    fragments = select_marker_fragments(points)
    if len(fragments) < MIN_JOINED_MARKERS:
        return label_nothing(points), ()
    marker_of_fragment = np.full(points.tracklet_count + 1, -1)
    marker_of_fragment[fragments] = np.arange(len(fragments))
    markers = arrange_points(points, marker_of_fragment[points.tracklet_indices], len(fragments))
    names = number_markers(len(fragments))
    joined = arrange_points(points, label_like(points, build_reference_markers(markers, names)).marker_indices, len(fragments))
    sample_count = (~np.isnan(joined[..., 0])).sum(axis=0)
    joined = joined[:, sample_count >= MIN_MARKER_SHARE * np.median(sample_count)]
    names = number_markers(joined.shape[1])
    return label_like(points, build_reference_markers(joined, names)), names


def number_markers(count: int) -> tuple[str, ...]:
    """Return names of markers: M01, M02 and so on."""
    digits = max(2, len(str(count)))
    return tuple(f"M{n + 1:0{digits}d}" for n in range(count))


def select_marker_fragments(points: UnlabelledPoints) -> Int[np.ndarray, " K"]:
    """Return the fragments, none of them short, of the frame in which most are visible for the longest time."""
    count = points.tracklet_count
    first, last = np.full(count, len(points.positions)), np.full(count, -1)
    frames, columns = np.nonzero(points.tracklet_indices >= 0)
    np.minimum.at(first, points.tracklet_indices[frames, columns], frames)
    np.maximum.at(last, points.tracklet_indices[frames, columns], frames)
    lasting = np.flatnonzero(last - first + 1 >= min(MIN_FRAGMENT_S * points.rate, len(points.positions)))
    every_frame = np.arange(len(points.positions))[:, None]
    visible = (first[lasting] <= every_frame) & (every_frame <= last[lasting])
    number = visible.sum(axis=1)
    fullest = np.flatnonzero(number == number.max(initial=0)) if len(lasting) else np.zeros(0, int)
    if not len(fullest):
        return np.zeros(0, int)
    tried = fullest[sample_evenly(len(fullest), MAX_TRIED_FRAMES)]
    durations = [(visible[:, visible[frame]].mean(axis=1) >= MIN_LASTING_SHARE).sum() for frame in tried]
    return lasting[visible[tried[int(np.argmax(durations))]]]


def arrange_points(
    points: UnlabelledPoints, marker_indices: Int[np.ndarray, "T C"], marker_count: int
) -> Float[np.ndarray, "T K 3"]:
    """Return the positions of markers in metres, NaN where no point has the marker."""
    markers = np.full((len(points.positions), marker_count, 3), np.nan)
    frames, columns = np.nonzero(marker_indices >= 0)
    markers[frames, marker_indices[frames, columns]] = points.positions[frames, columns]
    return markers
