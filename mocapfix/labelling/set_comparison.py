"""The choice of a marker set for points without labels: the shipped sets of about as many markers are compared.

A body with the markers of each candidate is found in a few frames, as for labelling. What is compared is the logarithm of the
probability of the points: a point with a label is close to the place of its marker on the average body, within the spread of the
set; any other point lies anywhere on the body. The body must follow its markers in these frames with a common pose. Markers
without points, and points without markers, are rare.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from mocapfix.labelling.optional_markers import add_optional_markers
from mocapfix.labelling.points import UnlabelledPoints
from mocapfix.labelling.posed_body import (
    FINAL_OFFSET_WEIGHT,
    POSING_ITERATIONS,
    POSING_MARKER_SD_M,
    POSING_SCALES_M,
    ExtendedBody,
    PropagatedLabels,
    scale_nominal_subject,
)
from mocapfix.labelling.sampled_points import SampledPoints, sample_points
from mocapfix.labelling.tracklet_assignment import TrackletDistances, select_lasting_tracklets
from mocapfix.marker_set import MarkerSet
from mocapfix.subject import Subject

BodyFinder = Callable[[SampledPoints, MarkerSet, Subject | None], ExtendedBody | None]

POINT_COUNT_QUANTILE_OF_TAKE = 0.9
"""Quantile over the frames of the number of points, with which the numbers of markers of sets are compared."""
MAX_COMPARED_SETS = 6
"""Sets that are compared."""
MAX_COUNT_DIFFERENCE_SHARE = 0.2
"""Difference of the numbers of points and markers up to which a set is compared, as a share of the points."""
OPTIONAL_COUNT_WEIGHT = 0.25
"""Weight of a point above the number of required markers, where optional ones can explain it."""
BODY_SURFACE_SD_M = 0.136
"""Standard deviation per axis of a normal distribution as dense as points anywhere on the body: 1.9 m2 by 2 cm."""
AVERAGE_BODY_SD_M = 0.02
"""Standard deviation per axis of places on the average body of the right size about those on the person's own body."""
RARE_MARKER_COST = 3.9
"""Negative logarithm of the probability that a required marker has no point, or a point no marker: 2 %."""


MIN_EVIDENCE_DIFFERENCE = 20.0
"""Difference of the evidence from which one set is clearly better. It is large: the markers of a segment are off together."""
EQUAL_LABELLED_SHARE = 0.01
"""Difference of the shares of labelled points up to which they count as equal."""
MIN_LABELLED_SHARE = 0.9
"""Share of the points that must get labels of the set."""
MIN_EVIDENCE_PER_POINT = 1.5
"""Smallest evidence per point; that of the right set is 3 on average."""
MIN_AGREEING_SHARE = 0.85
"""Share of the points to which two sets, of which none is clearly better, must give labels that are names of the same marker."""


class SetComparison(NamedTuple):
    """A candidate.

    marker_set      the set
    markers         (N,) the marker of each tracklet in the set, -1 for none
    point_counts    (N,) number of sampled points of each tracklet, by which tracklets are weighted
    log_evidence    logarithm of how much more probable the points are than points anywhere on the body
    """

    marker_set: MarkerSet
    markers: Int[np.ndarray, " N"]
    point_counts: Int[np.ndarray, " N"]
    log_evidence: float

    @property
    def labelled_share(self) -> float:
        """Share of the points that got labels."""
        return float(self.point_counts[self.markers >= 0].sum() / max(1, self.point_counts.sum()))

    @property
    def evidence_per_point(self) -> float:
        """Evidence divided by the number of markers that have points."""
        return self.log_evidence / max(1, len(np.unique(self.markers[self.markers >= 0])))


class SetAssumption(NamedTuple):
    """The marker set that is assumed, None if none fits clearly, and a sentence with the reason."""

    marker_set: MarkerSet | None
    reason: str


def assume_marker_set(points: UnlabelledPoints, marker_sets: Sequence[MarkerSet], find_body: BodyFinder) -> SetAssumption:
    """Return the set that fits the points of one person.

    Of several sets of which none is clearly better, it is the one that labels the most points, if the others give the same
    labels to nearly all points. `find_body` finds a body with the markers of a set (`labeller.find_labelled_body`).
    """
    found = compare_marker_sets(points, marker_sets, find_body)
    if not found:
        return SetAssumption(None, "No shipped marker set with about as many markers fits the points.")
    near = [each for each in found if each.log_evidence >= found[0].log_evidence - MIN_EVIDENCE_DIFFERENCE]
    most = max(each.labelled_share for each in near)
    best = next(each for each in near if each.labelled_share >= most - EQUAL_LABELLED_SHARE)
    name, share = best.marker_set.name, f"{best.labelled_share:.0%} of the points"
    nearest = f"The nearest shipped marker set is {name}, but it does not fit:"
    if best.labelled_share < MIN_LABELLED_SHARE:
        return SetAssumption(None, f"{nearest} only {share} would get labels.")
    if best.evidence_per_point < MIN_EVIDENCE_PER_POINT:
        return SetAssumption(None, f"{nearest} the points are too far from its places on the body.")
    others = [(each, compute_agreement(best, each)) for each in near if each is not best]
    if differing := [other.marker_set.name for other, agreement in others if agreement < MIN_AGREEING_SHARE]:
        return SetAssumption(None, f"Several shipped marker sets fit with different labels: {', '.join([name, *differing])}.")
    reason = f"The marker set {name} was assumed: {share} get labels"
    if others:
        also = ", ".join(f"{other.marker_set.name} (the same labels for {agreement:.0%} of them)" for other, agreement in others)
        return SetAssumption(best.marker_set, f"{reason}. Also possible: {also}; name the right set with --marker-set.")
    second = next((each for each in found if each is not best), None)
    rest = f"; the next, {second.marker_set.name}, fits clearly worse" if second else ""
    return SetAssumption(best.marker_set, f"{reason}{rest}.")


def compute_agreement(one: SetComparison, other: SetComparison) -> float:
    """Return the share of the points with labels of both sets whose labels are names of the same marker."""
    same = {one.marker_set.labels.index(name): k for name, k in one.marker_set.match_labels(other.marker_set.labels).items()}
    renamed = np.array([same.get(k, -2) for k in range(len(one.marker_set.labels))])
    is_both = (one.markers >= 0) & (other.markers >= 0)
    is_same = renamed[one.markers[is_both]] == other.markers[is_both]
    weight = one.point_counts[is_both]
    return float(weight[is_same].sum() / max(1, weight.sum()))


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
    part, count = sampled.select_frames(found.frames), len(required.labels)
    positions = part.arrange_markers(found.markers, count)
    poses = found.body.register(positions)
    found.body.solve(poses, positions, POSING_MARKER_SD_M, POSING_SCALES_M, POSING_ITERATIONS)
    pose_cost = float(found.body.compute_costs(poses, positions, POSING_MARKER_SD_M, POSING_SCALES_M[-1]).mean())
    markers = _add_optional(part, found, marker_set, required, poses)
    missing = count - float((~np.isnan(positions[..., 0])).sum(1).mean())
    extra = float(((part.tracklets >= 0) & (np.append(markers, -1)[part.tracklets] < 0)).sum(1).mean())
    evidence = _compute_offset_evidence(found, required) - pose_cost - RARE_MARKER_COST * (missing + extra)
    point_counts = np.bincount(part.tracklets[part.tracklets >= 0], minlength=part.tracklet_count)
    return SetComparison(marker_set, markers, point_counts, evidence)


def _add_optional(
    part: SampledPoints, found: ExtendedBody, marker_set: MarkerSet, required: MarkerSet, poses: tuple[np.ndarray, np.ndarray]
) -> Int[np.ndarray, " N"]:
    indices = np.array([marker_set.labels.index(label) for label in required.labels] + [-1])
    markers = indices[found.markers]
    if len(required.labels) == len(marker_set.labels):
        return markers
    everywhere = np.ones(len(part.frames), bool)
    distances = TrackletDistances(np.zeros((0, 0)), np.zeros(0, int))
    labels = PropagatedLabels(found.body, found.markers, distances, everywhere, poses)
    return add_optional_markers(part, markers, marker_set, scale_nominal_subject(found.body.subject, marker_set), labels)


def _compute_offset_evidence(found: ExtendedBody, required: MarkerSet) -> float:
    """Return how much more probable the places of the markers on the body are than places anywhere on it, as a logarithm."""
    nominal = scale_nominal_subject(found.body.subject, required)
    is_found = np.isin(np.arange(len(required.labels)), found.markers)
    offsets = (found.body.subject.marker_offsets - nominal.marker_offsets)[is_found] / FINAL_OFFSET_WEIGHT
    spread = np.hypot(nominal.marker_spread, AVERAGE_BODY_SD_M)[is_found, None]
    return float((np.log(BODY_SURFACE_SD_M / spread) * 3 - 0.5 * ((offsets / spread) ** 2).sum(1, keepdims=True)).sum())
