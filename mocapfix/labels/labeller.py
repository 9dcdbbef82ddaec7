"""The labeller: the marker of each of a take's unlabelled points, and the marker set that they have.

The labeller finds one person among any number of other points. The points that it leaves without a label are searched for the
next person, as long as there are enough of them. Then every tracklet belongs to one person, those without a label to the nearest,
and each person is labelled once more as if alone: points of others no longer mislead the search.

Where no set is named, the shipped sets of about as many markers are compared. A body with the markers of each candidate is found
in a few frames. The evidence for a set is how much more probable the points are with its markers than anywhere on the body: a
labelled point is close to the place of its marker on the average body, within the spread of the set, and the body must follow its
markers in several frames with a common pose. Markers without points are rare. A set that the user named is compared with the
others where the points fit it badly.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.errors import format_name_list
from mocapfix.labels import body_search, tracklets
from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.subject import Subject
from mocapfix.solve import kinematics
from mocapfix.solve.kinematics import Poses
from mocapfix.stats.sequences import sample_evenly
from mocapfix.subject.average_body import build_average_subject, build_posed_body

BODY_SURFACE_SD_M = 0.136  # of a normal distribution as dense as points anywhere on the body: 1.9 m2 by 2 cm
AVERAGE_BODY_SD_M = 0.02  # of places on the average body of the right size about those on the person's own body
RARE_MARKER_COST = 3.9  # negative logarithm of the probability that a required marker has no point, or a point no marker: 2 %


class MarkerEvidence(NamedTuple):
    """The evidence of the labelled points of a body that was found in some frames."""

    sampled: tracklets.SampledPoints  # in these frames
    poses: Poses
    log_evidence: float  # logarithm of how much more probable the points are at their markers than anywhere on the body
    marker_count: int  # that were found

    @property
    def per_marker(self) -> float:
        """Evidence divided by the number of markers."""
        return self.log_evidence / max(1, self.marker_count)


def measure_marker_evidence(
    sampled: tracklets.SampledPoints, found: body_search.ExtendedBody, required: MarkerSet
) -> MarkerEvidence:
    """Return the evidence for the required markers of a set, given a body with them that was found in the points."""
    part, count = sampled.select_frames(found.frames), len(required.labels)
    positions = part.arrange_markers(found.markers, count)
    poses = body_search.pose_body(found.body, positions)
    pose_cost = float(
        found.body.compute_costs(poses, positions, body_search.POSING_MARKER_SD_M, body_search.POSING_SCALES_M[-1]).mean()
    )
    missing = count - float((~np.isnan(positions[..., 0])).sum(1).mean())
    evidence = _compute_offset_evidence(found, required) - pose_cost - RARE_MARKER_COST * missing
    return MarkerEvidence(part, poses, evidence, len(np.setdiff1d(found.markers, [-1])))


def _compute_offset_evidence(found: body_search.ExtendedBody, required: MarkerSet) -> float:
    """Return how much more probable the places of the markers on the body are than places anywhere on it, as a logarithm."""
    nominal = body_search.scale_nominal_subject(found.body.subject, required)
    is_found = np.isin(np.arange(len(required.labels)), found.markers)
    offsets = (found.body.subject.marker_offsets - nominal.marker_offsets)[is_found] / body_search.FINAL_OFFSET_WEIGHT
    spread = np.hypot(nominal.marker_spread, AVERAGE_BODY_SD_M)[is_found, None]
    return float((np.log(BODY_SURFACE_SD_M / spread) * 3 - 0.5 * ((offsets / spread) ** 2).sum(1, keepdims=True)).sum())


MAX_OPTIONAL_DISTANCE_M = 0.05  # distance of a tracklet from an optional marker of the set up to which it has its label
MIN_OPTIONAL_DURATION_S = 2.0  # duration of such a tracklet; a shorter one may be a ghost


def add_optional_markers(
    sampled: tracklets.SampledPoints, markers: Int[np.ndarray, " N"], marker_set: MarkerSet, predicted: Float[np.ndarray, "S K 3"]
) -> Int[np.ndarray, " N"]:
    """Return the markers of the tracklets with optional ones for long tracklets that have none.

    `predicted` is where the body carries all markers of the set, in metres, NaN where unknown.
    """
    if not marker_set.optional_labels:
        return markers
    squared = tracklets.measure_tracklets(sampled, predicted, 2 * MAX_OPTIONAL_DISTANCE_M).squared_m2
    is_optional = np.array([label in marker_set.optional_labels for label in marker_set.labels])
    is_free = (markers < 0) & (tracklets.measure_durations(sampled) >= MIN_OPTIONAL_DURATION_S)
    squared[~is_free[:, None] | ~is_optional] = np.nan
    found = tracklets.assign_tracklets(sampled, squared, np.full(len(markers), MAX_OPTIONAL_DISTANCE_M))
    return np.where(is_free, found, markers)


POINT_COUNT_QUANTILE_OF_TAKE = 0.9  # of the number of points, compared with the numbers of markers of sets
MAX_COMPARED_SETS = 6  # sets that are compared
MAX_COUNT_DIFFERENCE_SHARE = 0.2  # of the points, by which the number of markers of a compared set may differ
OPTIONAL_COUNT_WEIGHT = 0.25  # weight of a point above the number of required markers, where optional ones can explain it

MIN_EVIDENCE_DIFFERENCE = 20.0  # of a clearly better set; large, since the markers of a segment are off together
MIN_EVIDENCE_DIFFERENCE_OF_SAME_PLACES = 50.0  # the same for sets with nearly all points at the same places
MAX_SAME_PLACE_DISTANCE_M = 0.06  # of markers of two sets with the same place; sets state places this differently
EQUAL_LABELLED_SHARE = 0.01  # difference of the shares of labelled points up to which they count as equal
MIN_LABELLED_SHARE = 0.9  # share of the points that must get labels of the set
MIN_EVIDENCE_PER_POINT = 1.5  # smallest evidence per point; that of the right set is 3 on average
MIN_AGREEING_SHARE = 0.85  # share of the points that must have the same place in two sets of which none is clearly better
MIN_SHARE_OF_NAMED_SET = 0.95  # share of the points with labels of a named set below which it is compared with the others
MAX_COMPARED_EVIDENCE = 2.2  # per marker, up to which a named set is compared with others; wrong sets rarely reach it


class SetComparison(NamedTuple):
    """A candidate."""

    marker_set: MarkerSet  # the set
    markers: Int[np.ndarray, " N"]  # the marker of each tracklet in the set, -1 for none
    point_counts: Int[np.ndarray, " N"]  # number of sampled points of each tracklet, by which tracklets are weighted
    log_evidence: float  # logarithm of how much more probable the points are than points anywhere on the body

    @property
    def labelled_share(self) -> float:
        """Share of the points that got labels."""
        return float(self.point_counts[self.markers >= 0].sum() / max(1, self.point_counts.sum()))

    @property
    def required_share(self) -> float:
        """Share of the points that got labels of required markers; nearly any point can be an optional one."""
        is_required = np.array([label in self.marker_set.required_labels for label in self.marker_set.labels] + [False])
        return float(self.point_counts[is_required[self.markers]].sum() / max(1, self.point_counts.sum()))

    @property
    def evidence_per_point(self) -> float:
        """Evidence divided by the number of markers that have points."""
        return self.log_evidence / max(1, len(np.unique(self.markers[self.markers >= 0])))


def assume_marker_set(points: tracklets.UnlabelledPoints, marker_sets: Sequence[MarkerSet]) -> tuple[MarkerSet | None, str]:
    """Return the set that fits the points of one person, None if none fits clearly, and a sentence with the reason.

    Of several sets of which none is clearly better, it is the one whose required markers are the most points, if the others have
    nearly all points at the same places of the body, by whatever names. Of two such sets, one with markers that the other lacks
    is recognised by these; the evidence of all other markers may differ by chance.
    """
    found = compare_marker_sets(points, marker_sets)
    if not found:
        return (None, "No shipped marker set with about as many markers fits the points.")
    near = [
        each
        for each in found
        if (less := found[0].log_evidence - each.log_evidence) <= MIN_EVIDENCE_DIFFERENCE
        or (less <= MIN_EVIDENCE_DIFFERENCE_OF_SAME_PLACES and compute_place_agreement(found[0], each) >= MIN_AGREEING_SHARE)
    ]
    most = max(each.required_share for each in near)
    best = next(each for each in near if each.required_share >= most - EQUAL_LABELLED_SHARE)
    name, share = best.marker_set.name, f"{best.labelled_share:.0%} of the points"
    nearest = f"The nearest shipped marker set is {name}, but it does not fit:"
    if best.labelled_share < MIN_LABELLED_SHARE:
        return (None, f"{nearest} only {share} would get labels.")
    if best.evidence_per_point < MIN_EVIDENCE_PER_POINT:
        return (None, f"{nearest} the points are too far from its places on the body.")
    others = [(each, compute_agreement(best, each)) for each in near if each is not best]
    if differing := [other.marker_set.name for other, _ in others if compute_place_agreement(best, other) < MIN_AGREEING_SHARE]:
        return (None, f"Several shipped marker sets fit with different labels: {format_name_list([name, *differing])}.")
    reason = f"The marker set {name} was assumed: {share} get labels"
    if others:
        also = format_name_list([f"{other.marker_set.name} ({agreement:.0%} the same labels)" for other, agreement in others])
        return (best.marker_set, f"{reason}. Also possible: {also}; name the right set with --marker-set.")
    second = next((each for each in found if each is not best), None)
    rest = f"; the next, {second.marker_set.name}, fits clearly worse" if second else ""
    return (best.marker_set, f"{reason}{rest}.")


def describe_better_set(
    points: tracklets.UnlabelledPoints, labels: tracklets.PointLabels, named: MarkerSet, marker_sets: Sequence[MarkerSet]
) -> str:
    """Return a sentence if the points, which got labels of a named set, fit another set clearly better; "" if they do not."""
    share = (labels.marker_indices >= 0).sum() / max(1, (points.tracklet_indices >= 0).sum())
    if labels.evidence_per_marker > MAX_COMPARED_EVIDENCE and share >= MIN_SHARE_OF_NAMED_SET:
        return ""
    own = _compare(tracklets.select_lasting_tracklets(tracklets.sample_points(points)), named)
    found = compare_marker_sets(points, [each for each in marker_sets if each.name != named.name])
    if own is None or not found or found[0].log_evidence < own.log_evidence + MIN_EVIDENCE_DIFFERENCE:
        return ""
    if compute_place_agreement(own, found[0]) >= MIN_AGREEING_SHARE:
        return ""
    best = found[0].marker_set.name
    return f"The points fit {best} clearly better than {named.name}: its labels are likely to be wrong. Check --marker-set."


def compute_agreement(one: SetComparison, other: SetComparison) -> float:
    """Return the share of the points with labels of both sets whose labels are names of the same marker."""
    same = {one.marker_set.labels.index(name): k for name, k in one.marker_set.match_labels(other.marker_set.labels).items()}
    renamed = np.array([same.get(k, -2) for k in range(len(one.marker_set.labels))])
    return _measure_share(one, other, renamed[one.markers] == other.markers)


def compute_place_agreement(one: SetComparison, other: SetComparison) -> float:
    """Return the share of the points with labels of both sets whose markers have about the same place on the body."""
    k, m = one.markers, other.markers
    distance = np.linalg.norm(one.marker_set.marker_offsets[k] - other.marker_set.marker_offsets[m], axis=-1)
    return _measure_share(
        one, other, (one.marker_set.joints[k] == other.marker_set.joints[m]) & (distance <= MAX_SAME_PLACE_DISTANCE_M)
    )


def _measure_share(one: SetComparison, other: SetComparison, is_same: Bool[np.ndarray, " N"]) -> float:
    """Return the share of points in a mask of the tracklets among those with labels of both sets."""
    is_both = (one.markers >= 0) & (other.markers >= 0)
    return float(one.point_counts[is_both & is_same].sum() / max(1, one.point_counts[is_both].sum()))


def compare_marker_sets(points: tracklets.UnlabelledPoints, marker_sets: Sequence[MarkerSet]) -> list[SetComparison]:
    """Return those of the marker sets that fit the points of one person, by falling evidence."""
    lasting = tracklets.select_lasting_tracklets(tracklets.sample_points(points))
    found = [_compare(lasting, each) for each in select_candidates(lasting, marker_sets)]
    return sorted((each for each in found if each), key=lambda each: -each.log_evidence)


def select_candidates(sampled: tracklets.SampledPoints, marker_sets: Sequence[MarkerSet]) -> list[MarkerSet]:
    """Return the sets with about as many markers as there are points."""
    counts = (sampled.tracklets >= 0).sum(1)
    count = float(np.quantile(counts, POINT_COUNT_QUANTILE_OF_TAKE)) if len(counts) else 0.0

    def measure_difference(marker_set: MarkerSet) -> float:
        required, most = len(marker_set.required_labels), len(marker_set.labels)
        return max(required - count, OPTIONAL_COUNT_WEIGHT * min(count - required, most - required) + max(count - most, 0.0))

    near = [each for each in marker_sets if measure_difference(each) <= MAX_COUNT_DIFFERENCE_SHARE * count]
    return sorted(near, key=measure_difference)[:MAX_COMPARED_SETS]


def _compare(sampled: tracklets.SampledPoints, marker_set: MarkerSet) -> SetComparison | None:
    required = marker_set.select_markers(marker_set.required_labels)
    found = find_labelled_body(sampled, required, None)
    if found is None:
        return None
    measured = measure_marker_evidence(sampled, found, required)
    part = measured.sampled
    indices = np.array([marker_set.labels.index(label) for label in required.labels] + [-1])
    predicted = kinematics.predict_markers(body_search.scale_nominal_subject(found.body.subject, marker_set), measured.poses)
    markers = add_optional_markers(part, indices[found.markers], marker_set, predicted)
    extra = float(((part.tracklets >= 0) & (np.append(markers, -1)[part.tracklets] < 0)).sum(1).mean())
    point_counts = np.bincount(part.tracklets[part.tracklets >= 0], minlength=part.tracklet_count)
    return SetComparison(marker_set, markers, point_counts, measured.log_evidence - RARE_MARKER_COST * extra)


BODIES_PER_KEY_FRAME = 3  # bodies of each frame that are kept
MAX_EXTENDED_BODIES = 8  # best bodies of all frames that are extended to other frames

MIN_KEPT_CONFIDENCE = 0.5  # confidence below which a tracklet stays without a label

MIN_RECONSIDERED_S = 0.5  # total duration of tracklets with which other labels are tried
MIN_LOST_TRACKLET_S = 0.4  # duration of an unlabelled tracklet that may be a lost marker; shorter ones are often ghosts
MAX_LIMB_SEARCHES = 6  # frames in which limbs are searched for


def label_points(
    points: tracklets.UnlabelledPoints, marker_set: MarkerSet, subject: Subject | None = None
) -> tracklets.PointLabels:
    """Return the marker of each point.

    Args:
        points: Points of one person, with any number of points that are not the person's.
        marker_set: The person's markers. Its optional markers are looked for once all others have their labels.
        subject: The person, if known; with the markers of the set in this order.
    """
    sampled = tracklets.sample_points(points)
    searched = marker_set.select_markers(marker_set.required_labels)
    known = subject.select_markers(searched.labels) if subject else None
    lasting = tracklets.select_lasting_tracklets(sampled)
    start = find_labelled_body(lasting, searched, known)
    if start is None:
        return tracklets.label_nothing(points)
    evidence = np.inf if subject else measure_marker_evidence(lasting, start, searched).per_marker
    nominal = None if subject else body_search.scale_nominal_subject(start.body.subject, searched)
    labels = recover_limbs(sampled, body_search.propagate_labels(sampled, start, nominal))
    if nominal is not None:
        labels = reconsider_labels(sampled, labels, nominal)
    confidence = tracklets.compute_label_confidence(sampled, labels.markers, labels.distances)
    indices = np.array([marker_set.labels.index(label) for label in searched.labels] + [-1])
    markers = indices[np.where(confidence >= MIN_KEPT_CONFIDENCE, labels.markers, -1)]
    all_markers = subject or body_search.scale_nominal_subject(labels.body.subject, marker_set)
    predicted = body_search.predict_in_posed_frames(labels, all_markers)
    markers = add_optional_markers(sampled, markers, marker_set, predicted)
    labelled = tracklets.label_points_of_tracklets(points, sampled, predicted, markers, confidence)
    return replace(labelled, evidence_per_marker=evidence)


def recover_limbs(sampled: tracklets.SampledPoints, labels: body_search.PropagatedLabels) -> body_search.PropagatedLabels:
    """Return the labels with those of limbs whose trajectories all broke at once."""
    is_candidate = tracklets.measure_durations(sampled) >= MIN_LOST_TRACKLET_S
    for _ in range(MAX_LIMB_SEARCHES):
        frame = body_search.find_limb_frame(sampled, labels, is_candidate & (labels.markers < 0))
        if frame < 0:
            break
        markers = body_search.search_limb(sampled, labels, frame, is_candidate)
        is_new = (markers >= 0) & (labels.markers < 0)
        if is_new.sum() >= body_search.MIN_LOST_MARKERS:
            start = body_search.ExtendedBody(labels.body, markers, 0.0, np.flatnonzero(labels.is_posed))
            recovered = body_search.propagate_labels(sampled, start, None)
            if (recovered.markers >= 0).sum() > (labels.markers >= 0).sum():
                labels = recovered
        is_candidate[sampled.tracklets[frame][sampled.tracklets[frame] >= 0]] = False
    return labels


def reconsider_labels(
    sampled: tracklets.SampledPoints, labels: body_search.PropagatedLabels, nominal: Subject
) -> body_search.PropagatedLabels:
    """Return the labels, or others that the places of the markers in the set suggest if the body fits better with them.

    Labels that were exchanged from the beginning, such as those of a wrist and a hand, are where the offsets adapted to the wrong
    markers. So the tracklets are assigned once more to where the posed body has the markers of the set itself.

    Args:
        labels: The labels with a body that is adapted to the take.
    """
    squared = tracklets.measure_tracklets(
        sampled, body_search.predict_in_posed_frames(labels, nominal), body_search.PROPAGATION_GATE_M
    ).squared_m2
    suggested = tracklets.assign_tracklets(sampled, squared, tracklets.compute_max_distances(sampled))
    is_other = (suggested != labels.markers) & (suggested >= 0)
    if tracklets.measure_durations(sampled)[is_other].sum() < MIN_RECONSIDERED_S:
        return labels
    start = body_search.ExtendedBody(labels.body.change_subject(nominal), suggested, 0.0, np.flatnonzero(labels.is_posed))
    others = body_search.propagate_labels(sampled, start, nominal)
    if (others.markers == labels.markers).all():
        return labels
    frames = body_search.select_extension_frames(sampled, np.maximum(labels.markers, others.markers))
    part = sampled.select_frames(frames)

    def compute_cost(each: body_search.PropagatedLabels) -> float:
        return body_search.compute_body_cost(part, each.markers, each.body, nominal)

    return min((labels, others), key=compute_cost)


def find_labelled_body(
    sampled: tracklets.SampledPoints, marker_set: MarkerSet, subject: Subject | None
) -> body_search.ExtendedBody | None:
    """Return the best body in a few frames of the take; None if the points show neither a body nor a part of one."""
    body = build_posed_body(subject or build_average_subject(marker_set))
    frames, height_m = body_search.select_key_frames(sampled)
    if not subject:
        body = body.fit_height(height_m)
    candidates = body_search.search_key_frames(
        sampled, frames, lambda points: body_search.search_body(points, body)[:BODIES_PER_KEY_FRAME]
    )
    extended = [
        body_search.extend_body(sampled, candidate.markers, body, None if subject else marker_set)
        for candidate in candidates[:MAX_EXTENDED_BODIES]
    ]
    best = min(extended, key=lambda each: each.cost, default=None)
    found = {marker_set.labels[k] for k in set(best.markers.tolist()) - {-1}} if best else set[str]()
    return best if best and not marker_set.describe_missing_body(found) else None


MIN_PERSON_SHARE = 0.6  # share of the markers of the set that another person has at least
POINT_COUNT_QUANTILE = 0.9  # quantile over the frames of the number of points
MAX_PEOPLE = 6  # largest number of people
MAX_PROXIMITY_FRAMES = 60  # frames in which the distance of a tracklet from each person is measured
NEAREST_POINT_COUNT = 3  # labelled points of a person to which that distance is measured


def label_people(points: tracklets.UnlabelledPoints, marker_set: MarkerSet) -> tracklets.PointLabels:
    """Return the marker of each point, and to whom it belongs if there are several people with the markers of a set."""
    people = [label_points(points, marker_set)]
    rest = points.select_points(people[0].marker_indices < 0)
    while len(people) < MAX_PEOPLE and _has_person(rest.tracklet_indices >= 0, marker_set):
        found = label_points(rest, marker_set)
        if not _has_person(found.marker_indices >= 0, marker_set):
            break
        people.append(found)
        rest = rest.select_points(found.marker_indices < 0)
    if len(people) == 1:
        return people[0]
    persons = assign_to_people(points, [labels.marker_indices >= 0 for labels in people])
    markers, confidence = np.full(points.tracklet_indices.shape, -1), np.zeros(points.tracklet_indices.shape)
    subjects, evidence = np.full(points.tracklet_indices.shape, -1), np.inf
    for n in range(len(people)):
        is_own = persons == n
        labels = label_points(points.select_points(is_own), marker_set)
        markers[is_own], confidence[is_own] = labels.marker_indices[is_own], labels.confidence[is_own]
        subjects[is_own & (labels.marker_indices >= 0)] = n
        evidence = min(evidence, labels.evidence_per_marker)
    return tracklets.PointLabels(markers, confidence, subjects, evidence)


def separate_people(
    labels: tracklets.PointLabels, marker_labels: tuple[str, ...]
) -> tuple[tracklets.PointLabels, tuple[str, ...]]:
    """Return the labels of several people as those of one list of markers, and this list: P1:LFHD and so on."""
    if not labels.subject_indices.size:
        return labels, marker_labels
    count = int(labels.subject_indices.max()) + 1
    indices = np.where(labels.marker_indices >= 0, labels.subject_indices * len(marker_labels) + labels.marker_indices, -1)
    single = tracklets.PointLabels(indices, labels.confidence, evidence_per_marker=labels.evidence_per_marker)
    return single, tuple(f"P{n + 1}:{label}" for n in range(count) for label in marker_labels)


def assign_to_people(points: tracklets.UnlabelledPoints, masks: list[Bool[np.ndarray, "T C"]]) -> Int[np.ndarray, "T C"]:
    """Return the person of each point, -1 where there is no point.

    Args:
        masks: The labelled points of each person. A tracklet belongs to whom most of them are, or else to the nearest person.
    """
    of_point = points.tracklet_indices
    counts = np.stack([np.bincount(of_point[mask & (of_point >= 0)], minlength=points.tracklet_count) for mask in masks])
    person = counts.argmax(0)
    order = np.argsort(of_point, axis=None, kind="stable")
    starts = np.searchsorted(of_point.ravel()[order], np.arange(points.tracklet_count + 1))
    for n in np.flatnonzero(counts.sum(0) == 0):
        places = order[starts[n] : starts[n + 1]]
        places = places[sample_evenly(len(places), MAX_PROXIMITY_FRAMES)]
        frames, columns = np.unravel_index(places, of_point.shape)
        person[n] = int(np.argmin([_measure_distance(points.positions, frames, columns, mask) for mask in masks]))
    return np.append(person, -1)[of_point]


def _measure_distance(
    positions: np.ndarray, frames: Int[np.ndarray, " F"], columns: Int[np.ndarray, " F"], mask: Bool[np.ndarray, "T C"]
) -> float:
    """Return the mean distance (m) of points from the nearest ones in a mask; infinite where there are none in these frames."""
    distance = np.linalg.norm(positions[frames] - positions[frames, columns, None], axis=-1)
    nearest = np.sort(np.where(mask[frames], distance, np.inf), axis=1)[:, :NEAREST_POINT_COUNT]
    known = nearest[np.isfinite(nearest)]
    return float(known.mean()) if len(known) else np.inf


def _has_person(mask: Bool[np.ndarray, "T C"], marker_set: MarkerSet) -> bool:
    """Return whether a mask has enough points in most frames for another person."""
    count = np.quantile(mask.sum(1), POINT_COUNT_QUANTILE) if len(mask) else 0
    return bool(count >= MIN_PERSON_SHARE * len(marker_set.required_labels))
