"""The choice of a marker set for points without labels: the shipped sets of about as many markers are compared.

A body with the markers of each candidate is found in a few frames. The evidence for a set is how much more probable the points
are with its markers than anywhere on the body: a labelled point is close to the place of its marker on the average body, within
the spread of the set, and the body must follow its markers in several frames with a common pose. Markers without points are
rare. A set that the user named is compared with the others where the points fit it badly.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.errors import format_name_list
from mocapfix.labels.body_search import (
    FINAL_OFFSET_WEIGHT,
    POSING_MARKER_SD_M,
    POSING_SCALES_M,
    ExtendedBody,
    pose_body,
    scale_nominal_subject,
)
from mocapfix.labels.tracklets import (
    PointLabels,
    SampledPoints,
    UnlabelledPoints,
    assign_tracklets,
    measure_durations,
    measure_tracklets,
    sample_points,
    select_lasting_tracklets,
)
from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.subject import Subject
from mocapfix.solve import kinematics
from mocapfix.solve.kinematics import Poses

BODY_SURFACE_SD_M = 0.136  # of a normal distribution as dense as points anywhere on the body: 1.9 m2 by 2 cm
AVERAGE_BODY_SD_M = 0.02  # of places on the average body of the right size about those on the person's own body
RARE_MARKER_COST = 3.9  # negative logarithm of the probability that a required marker has no point, or a point no marker: 2 %


class MarkerEvidence(NamedTuple):
    """The evidence of the labelled points of a body that was found in some frames."""

    sampled: SampledPoints  # in these frames
    poses: Poses
    log_evidence: float  # logarithm of how much more probable the points are at their markers than anywhere on the body
    marker_count: int  # that were found

    @property
    def per_marker(self) -> float:
        """Evidence divided by the number of markers."""
        return self.log_evidence / max(1, self.marker_count)


def measure_marker_evidence(sampled: SampledPoints, found: ExtendedBody, required: MarkerSet) -> MarkerEvidence:
    """Return the evidence for the required markers of a set, given a body with them that was found in the points."""
    part, count = sampled.select_frames(found.frames), len(required.labels)
    positions = part.arrange_markers(found.markers, count)
    poses = pose_body(found.body, positions)
    pose_cost = float(found.body.compute_costs(poses, positions, POSING_MARKER_SD_M, POSING_SCALES_M[-1]).mean())
    missing = count - float((~np.isnan(positions[..., 0])).sum(1).mean())
    evidence = _compute_offset_evidence(found, required) - pose_cost - RARE_MARKER_COST * missing
    return MarkerEvidence(part, poses, evidence, len(np.setdiff1d(found.markers, [-1])))


def _compute_offset_evidence(found: ExtendedBody, required: MarkerSet) -> float:
    """Return how much more probable the places of the markers on the body are than places anywhere on it, as a logarithm."""
    nominal = scale_nominal_subject(found.body.subject, required)
    is_found = np.isin(np.arange(len(required.labels)), found.markers)
    offsets = (found.body.subject.marker_offsets - nominal.marker_offsets)[is_found] / FINAL_OFFSET_WEIGHT
    spread = np.hypot(nominal.marker_spread, AVERAGE_BODY_SD_M)[is_found, None]
    return float((np.log(BODY_SURFACE_SD_M / spread) * 3 - 0.5 * ((offsets / spread) ** 2).sum(1, keepdims=True)).sum())


MAX_OPTIONAL_DISTANCE_M = 0.05  # distance of a tracklet from an optional marker of the set up to which it has its label
MIN_OPTIONAL_DURATION_S = 2.0  # duration of such a tracklet; a shorter one may be a ghost


def add_optional_markers(
    sampled: SampledPoints, markers: Int[np.ndarray, " N"], marker_set: MarkerSet, predicted: Float[np.ndarray, "S K 3"]
) -> Int[np.ndarray, " N"]:
    """Return the markers of the tracklets with optional ones for long tracklets that have none.

    `predicted` is where the body carries all markers of the set, in metres, NaN where unknown.
    """
    squared = measure_tracklets(sampled, predicted, 2 * MAX_OPTIONAL_DISTANCE_M).squared_m2
    is_optional = np.array([label in marker_set.optional_labels for label in marker_set.labels])
    is_free = (markers < 0) & (measure_durations(sampled) >= MIN_OPTIONAL_DURATION_S)
    squared[~is_free[:, None] | ~is_optional] = np.nan
    found = assign_tracklets(sampled, squared, np.full(len(markers), MAX_OPTIONAL_DISTANCE_M))
    return np.where(is_free, found, markers)


BodyFinder = Callable[[SampledPoints, MarkerSet, Subject | None], ExtendedBody | None]

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


def assume_marker_set(
    points: UnlabelledPoints, marker_sets: Sequence[MarkerSet], find_body: BodyFinder
) -> tuple[MarkerSet | None, str]:
    """Return the set that fits the points of one person, None if none fits clearly, and a sentence with the reason.

    Of several sets of which none is clearly better, it is the one whose required markers are the most points, if the others have
    nearly all points at the same places of the body, by whatever names. Of two such sets, one with markers that the other lacks
    is recognised by these; the evidence of all other markers may differ by chance. `find_body` finds a body with the markers of
    a set (`labeller.find_labelled_body`).
    """
    found = compare_marker_sets(points, marker_sets, find_body)
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
    points: UnlabelledPoints, labels: PointLabels, named: MarkerSet, marker_sets: Sequence[MarkerSet], find_body: BodyFinder
) -> str:
    """Return a sentence if the points, which got labels of a named set, fit another set clearly better; "" if they do not."""
    share = (labels.marker_indices >= 0).sum() / max(1, (points.tracklet_indices >= 0).sum())
    if labels.evidence_per_marker > MAX_COMPARED_EVIDENCE and share >= MIN_SHARE_OF_NAMED_SET:
        return ""
    own = _compare(select_lasting_tracklets(sample_points(points)), named, find_body)
    found = compare_marker_sets(points, [each for each in marker_sets if each.name != named.name], find_body)
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


def compare_marker_sets(points: UnlabelledPoints, marker_sets: Sequence[MarkerSet], find_body: BodyFinder) -> list[SetComparison]:
    """Return those of the marker sets that fit the points of one person, by falling evidence."""
    lasting = select_lasting_tracklets(sample_points(points))
    found = [_compare(lasting, each, find_body) for each in select_candidates(lasting, marker_sets)]
    return sorted((each for each in found if each), key=lambda each: -each.log_evidence)


def select_candidates(sampled: SampledPoints, marker_sets: Sequence[MarkerSet]) -> list[MarkerSet]:
    """Return the sets with about as many markers as there are points."""
    counts = (sampled.tracklets >= 0).sum(1)
    count = float(np.quantile(counts, POINT_COUNT_QUANTILE_OF_TAKE)) if len(counts) else 0.0

    def measure_difference(marker_set: MarkerSet) -> float:
        required, most = len(marker_set.required_labels), len(marker_set.labels)
        return max(required - count, OPTIONAL_COUNT_WEIGHT * min(count - required, most - required) + max(count - most, 0.0))

    near = [each for each in marker_sets if measure_difference(each) <= MAX_COUNT_DIFFERENCE_SHARE * count]
    return sorted(near, key=measure_difference)[:MAX_COMPARED_SETS]


def _compare(sampled: SampledPoints, marker_set: MarkerSet, find_body: BodyFinder) -> SetComparison | None:
    required = marker_set.select_markers(marker_set.required_labels)
    found = find_body(sampled, required, None)
    if found is None:
        return None
    measured = measure_marker_evidence(sampled, found, required)
    part = measured.sampled
    markers = _add_optional(found, measured, marker_set, required)
    extra = float(((part.tracklets >= 0) & (np.append(markers, -1)[part.tracklets] < 0)).sum(1).mean())
    point_counts = np.bincount(part.tracklets[part.tracklets >= 0], minlength=part.tracklet_count)
    return SetComparison(marker_set, markers, point_counts, measured.log_evidence - RARE_MARKER_COST * extra)


def _add_optional(
    found: ExtendedBody, measured: MarkerEvidence, marker_set: MarkerSet, required: MarkerSet
) -> Int[np.ndarray, " N"]:
    indices = np.array([marker_set.labels.index(label) for label in required.labels] + [-1])
    markers = indices[found.markers]
    if len(required.labels) == len(marker_set.labels):
        return markers
    predicted = kinematics.predict_markers(scale_nominal_subject(found.body.subject, marker_set), measured.poses)
    return add_optional_markers(measured.sampled, markers, marker_set, predicted)
