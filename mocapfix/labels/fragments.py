"""Fragments: trajectories that continue a marker under another label (`*12`, `C_123`, `RBAC-1`).

`detect_fragments` compares each segment of such a trajectory with the markers that are missing at that time, by their rigid
signatures: the distances to the markers of the segment, the side of them on which it lies, and a path that leads to it and on
from it. Each deviation is measured in its own standard deviations. The sum of their squares is a cost, and the costs give the
probability of each marker, and of none (Bayes' rule). The most certain segments are joined first (`join_fragments`): the marker
is then no longer missing, and its samples help to decide about the next. The `classify_` functions say in a sentence what a
segment is.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.errors import join_words
from mocapfix.labels.label_swaps import undo_label_exchanges
from mocapfix.labels.trajectory_segments import (
    MAX_DUPLICATE_DISTANCE_M,
    MAX_SCREENED_SAMPLES,
    RigidSignatures,
    TrajectorySegment,
    compute_join_cost,
    find_loose_segments,
    is_smoother,
)
from mocapfix.model.faults import JOINED_RELATIONS, Fault, Fragment, FragmentRelation, overlap_in_time
from mocapfix.model.take import Take

MAX_STATIC_EXTENT_M = 0.005  # a point with a smaller extent in each axis is stationary
MAX_RIGID_DISTANCE_SD_M = 0.015  # standard deviation of the distances of a point on the body to its nearest markers
MAX_RIGID_CANDIDATES = 100  # markers compared in all samples: those with the steadiest distances in a few
MIN_DESCRIBED_DURATION_S = 0.25  # the motion of a shorter segment is not described


@dataclass(frozen=True)
class MarkerMatch:
    """How well a segment matches a marker."""

    marker: int  # index of the marker
    cost: float  # cost of the match, infinite if it is ruled out
    distance_error_m: float  # deviation in metres of the distances to the partners
    partners: tuple[int, ...]  # indices of the markers whose distances were compared. Empty if only the path was.


def classify_continuation(
    segment: TrajectorySegment, candidates: Sequence[MarkerMatch], probability: float, take: Take
) -> Fragment:
    """Classify a segment that continues the marker that it matches best."""
    match, evidence = candidates[0], "it begins or ends where that marker ends or begins"
    if match.partners:
        names = join_words([take.bare_labels[m] for m in match.partners])
        evidence = f"its distances to {names} are within {_format_mm(match.distance_error_m)} of that marker's"
    label, duration = take.bare_labels[match.marker], _format_duration(segment, take)
    reason = f"{_get_donor_label(segment, take)} continues {label} for {duration}: {evidence}."
    return _build_fragment("continues", segment, match.marker, match.distance_error_m, probability, reason)


def classify_unassigned(
    segment: TrajectorySegment, candidates: Sequence[MarkerMatch], probability: float, take: Take
) -> Fragment:
    """Classify a segment that matches none of the markers that are missing at that time, or none with a high probability."""
    labels, confidence = take.bare_labels, 1 - probability
    possible = [match for match in candidates if np.isfinite(match.cost)]
    compared = [match for match in candidates if match.partners]
    if len(possible) > 1:
        first, second = labels[possible[0].marker], labels[possible[1].marker]
        evidence = f"{first} and {second} are both missing at that time, and either may match"
    elif possible:
        evidence = f"{labels[possible[0].marker]} is missing at that time, but the match is uncertain"
    elif compared:
        best = min(compared, key=lambda match: match.distance_error_m)
        names, error_mm = join_words([labels[m] for m in best.partners]), _format_mm(best.distance_error_m)
        error = f"its distances to {names} differ by {error_mm}"
        evidence = f"of the markers missing at that time, {labels[best.marker]} fits best, but {error}"
    elif candidates:
        evidence = f"{labels[candidates[0].marker]} is missing at that time, but its position is unknown"
        confidence = 0.5
    elif segment.namesake >= 0:
        evidence = f"{labels[segment.namesake]} is visible elsewhere at that time"
    else:
        evidence = f"no marker is missing at that time; {_describe_motion(segment, take)}"
    reason = f"{_get_donor_label(segment, take)} matches no missing marker ({_format_duration(segment, take)}): {evidence}."
    return _build_fragment("other", segment, segment.donor, np.nan, confidence, reason)


def classify_duplicate(segment: TrajectorySegment, marker: int, distance_m: float, take: Take) -> Fragment:
    """Classify a segment at a median distance of `distance_m` from a marker that is visible as well."""
    donor, label = _get_donor_label(segment, take), take.bare_labels[marker]
    reason = f"{donor} duplicates {label} for {_format_duration(segment, take)} at a distance of {_format_mm(distance_m)}"
    confidence = 1 - 0.5 * distance_m / MAX_DUPLICATE_DISTANCE_M
    if is_smoother(segment, take.markers[:, marker], take.rate):
        reason += " and joins the samples before and after more smoothly."
        return _build_fragment("replaces", segment, marker, distance_m, confidence, reason)
    return _build_fragment("doubles", segment, marker, distance_m, confidence, f"{reason}.")


def merge_unassigned(fragments: Sequence[Fragment]) -> list[Fragment]:
    """Merge successive fragments of one donor that belong to no marker, with the reason of the longest one."""
    merged: list[Fragment] = []
    for (relation, _), group in groupby(fragments, key=lambda fragment: (fragment.relation, fragment.donor)):
        members = list(group)
        if relation == "other" and len(members) > 1:
            longest = max(members, key=lambda fragment: fragment.last - fragment.first)
            reason = f"{longest.reason[:-1]}; this holds for all {len(members)} successive segments."
            members = [replace(longest, first=members[0].first, last=members[-1].last, reason=reason)]
        merged += members
    return merged


def _describe_motion(segment: TrajectorySegment, take: Take) -> str:
    """Describe how the point of a segment moves."""
    if (len(segment.frames) - 1) / take.rate < MIN_DESCRIBED_DURATION_S:
        return "it is visible too briefly to describe its motion"
    if np.ptp(segment.points, axis=0).max() < MAX_STATIC_EXTENT_M:
        return "it is stationary"
    near = np.setdiff1d(np.flatnonzero(take.visible[segment.frames].all(0)), [segment.donor])
    for samples, count in ((segment.pick_samples(MAX_SCREENED_SAMPLES), MAX_RIGID_CANDIDATES), (segment, 3)):
        if len(near) > count:
            near = near[np.argsort(samples.measure_distances(take.markers, near).std(0), kind="stable")[:count]]
    sd_m = segment.measure_distances(take.markers, near).std(0)
    if len(near) == 3 and sd_m.max() < MAX_RIGID_DISTANCE_SD_M:
        return f"it moves rigidly with {join_words([take.bare_labels[m] for m in near.tolist()])}"
    return "it moves independently"


def _build_fragment(
    relation: FragmentRelation, segment: TrajectorySegment, marker: int, severity: float, confidence: float, reason: str
) -> Fragment:
    return Fragment(
        "fragment", marker, segment.first, segment.last, severity, reason, confidence, donor=segment.donor, relation=relation
    )


def _get_donor_label(segment: TrajectorySegment, take: Take) -> str:
    if segment.donor < len(take.labels):
        return take.bare_labels[segment.donor]
    return take.unlabelled.bare_labels[segment.donor - len(take.labels)] if take.unlabelled else ""


def _format_mm(distance_m: float) -> str:
    return f"{distance_m * 1e3:.0f} mm"


def _format_duration(segment: TrajectorySegment, take: Take) -> str:
    count = segment.last - segment.first + 1
    if count >= 0.1 * take.rate:
        return f"{count / take.rate:.2f} s"
    return f"{count} frame{'s' if count > 1 else ''}"


UNASSIGNED_COST = 20.0  # cost of a segment that belongs to none of the markers
MAX_SIGNATURE_DEVIATION_SD = 4.5  # with a larger deviation of the distances or of the side a marker is ruled out
NAMESAKE_SCALE = 0.5  # factor of the deviations from the marker whose label the segment has
UNKNOWN_SIGNATURE_COST = 3.0  # cost of unknown distances
UNKNOWN_JOIN_COST = 1.0  # cost of an unknown path
MIN_JOIN_PROBABILITY = 0.9  # smallest probability with which a segment is joined
MIN_SEGMENT_DURATION_S = 0.015  # a shorter segment is not classified
# Longest gap across which a path is compared, with and without matching distances.
MAX_JOIN_GAP_S = 0.3
MAX_UNSUPPORTED_JOIN_GAP_S = 0.05


def detect_fragments(take: Take) -> list[Fragment]:
    """Classify the segments of the unlabelled trajectories and of the markers with another marker's label.

    A segment is joined if it is one marker, and no other, with a high probability. A marker gets one segment at a time, and
    several one after the other.

    Returns:
        The fragments, ordered by donor and first frame, also of the segments that are not joined.
    """
    segments = find_loose_segments(take)
    donors = [segment.donor for segment in segments if segment.donor < len(take.labels)]
    receivers = np.setdiff1d(np.flatnonzero(take.visible.any(0)), donors)
    fragments = [_classify_directly(segment, take, receivers) for segment in segments]
    if None in fragments:
        markers = take.markers.transpose(1, 0, 2).copy().transpose(1, 0, 2)  # each path in one piece
        markers[:, donors] = np.nan  # a segment must not support itself
        _classify_by_matches(fragments, segments, markers, receivers, take)
    return merge_unassigned([fragment for fragment in fragments if fragment])


def _classify_by_matches(
    fragments: list[Fragment | None], segments: list[TrajectorySegment], markers: np.ndarray, receivers: np.ndarray, take: Take
) -> None:
    """Classify, in place, the fragments that are None. Their segments are joined to `markers` (T, M, 3), which changes as well.

    After each join a segment is compared again only with the markers for which the joined samples are evidence.
    """
    signatures, is_missing = RigidSignatures(markers), np.isnan(markers[..., 0])
    candidates: dict[int, list[MarkerMatch]] = {i: [] for i, fragment in enumerate(fragments) if fragment is None}
    is_new = np.ones(len(take.labels), bool)
    while candidates:
        for i, known in candidates.items():
            kept = [match for match in known if not is_new[match.marker]]
            compared = receivers if segments[i].namesake < 0 else np.array([segments[i].namesake])
            compared = compared[is_new[compared]]
            kept += find_matches(segments[i], markers, is_missing, take.rate, signatures, compared)
            kept.sort(key=lambda match: match.marker)  # the order of equal costs, or of unknown distances
            candidates[i] = sorted(kept, key=lambda match: (match.cost, match.distance_error_m))
        joined = _join_segments(candidates, segments, markers)
        changed = sorted({candidates[i][0].marker for i in joined})
        classify = classify_continuation if joined else classify_unassigned
        for i in joined or list(candidates):
            matches = candidates.pop(i)
            fragments[i] = classify(segments[i], matches, compute_match_probability(matches), take)
        is_missing[:, changed] = np.isnan(markers[:, changed, 0])
        is_new = signatures.update_markers(changed)


def _classify_directly(segment: TrajectorySegment, take: Take, receivers: np.ndarray) -> Fragment | None:
    """Classify a segment that is too short, or that repeats a visible marker; None for any other."""
    if (len(segment.frames) - 1) / take.rate < MIN_SEGMENT_DURATION_S:
        duration = f"is visible for {_format_duration(segment, take)}, too short to match it with a marker"
        reason = f"{_get_donor_label(segment, take)} {duration}."
        return _build_fragment("other", segment, segment.donor, np.nan, 0.5, reason)
    sampled_m = segment.pick_samples(MAX_SCREENED_SAMPLES).measure_distances(take.markers, receivers)
    near = receivers[(sampled_m <= MAX_DUPLICATE_DISTANCE_M).any(0)]
    near = near[take.visible[np.ix_(segment.frames, near)].all(0)]
    distance_m = np.median(segment.measure_distances(take.markers, near), axis=0)
    if distance_m.min(initial=np.inf) > MAX_DUPLICATE_DISTANCE_M:
        return None
    return classify_duplicate(segment, int(near[distance_m.argmin()]), float(distance_m.min()), take)


def find_matches(
    segment: TrajectorySegment,
    markers: Float[np.ndarray, "T M 3"],
    is_missing: Bool[np.ndarray, "T M"],
    rate: float,
    signatures: RigidSignatures,
    receivers: Int[np.ndarray, " R"],
) -> list[MarkerMatch]:
    """Evaluate a segment as each of the receivers that are missing at that time.

    Args:
        is_missing: Whether the positions are NaN.
        receivers: Indices of the markers with which the segment is compared.
    """
    is_possible = is_missing[np.ix_(segment.frames, receivers)].any(0)
    return [_evaluate_match(segment, m, markers[:, m], rate, signatures) for m in receivers[is_possible].tolist()]


def _evaluate_match(
    segment: TrajectorySegment, marker: int, path: np.ndarray, rate: float, signatures: RigidSignatures
) -> MarkerMatch:
    scale = NAMESAKE_SCALE if segment.namesake == marker else 1.0
    signature = signatures.match_samples(segment.frames, segment.points, marker)
    max_gap_s = MAX_JOIN_GAP_S if signature else MAX_UNSUPPORTED_JOIN_GAP_S
    join_cost = scale**2 * compute_join_cost(segment, path, rate, max_gap_s)
    if signature is None:
        return MarkerMatch(marker, np.inf if np.isnan(join_cost) else UNKNOWN_SIGNATURE_COST + join_cost, np.nan, ())
    distance_sd, side_sd = scale * signature.distance_sd, scale * signature.side_sd
    cost = distance_sd**2 + side_sd**2 + (UNKNOWN_JOIN_COST if np.isnan(join_cost) else join_cost)
    is_ruled_out = max(distance_sd, side_sd) > MAX_SIGNATURE_DEVIATION_SD
    return MarkerMatch(marker, np.inf if is_ruled_out else cost, signature.distance_error_m, signature.partners)


def compute_match_probability(candidates: list[MarkerMatch]) -> float:
    """Compute the probability that the segment belongs to the first candidate, rather than to another or to none."""
    if not candidates or not np.isfinite(candidates[0].cost):
        return 0.0
    costs = np.array([match.cost for match in candidates] + [UNASSIGNED_COST])
    return float(1 / np.exp((costs[0] - costs) / 2).sum())


def _join_segments(candidates: dict[int, list[MarkerMatch]], segments: list[TrajectorySegment], markers: np.ndarray) -> list[int]:
    """Join likely segments to `markers` in place, one to a marker at a time, the cheapest first, and return them."""
    certain = [i for i, matches in candidates.items() if compute_match_probability(matches) >= MIN_JOIN_PROBABILITY]
    joined: list[int] = []
    for i in sorted(certain, key=lambda i: candidates[i][0].cost):
        segment, marker = segments[i], candidates[i][0].marker
        if not any(candidates[j][0].marker == marker and overlap_in_time(segments[j], segment) for j in joined):
            joined.append(i)
            is_free = np.isnan(markers[segment.frames, marker, 0])
            markers[segment.frames[is_free], marker] = segment.points[is_free]
    return joined


def join_fragments(take: Take, faults: Iterable[Fault]) -> Take:
    """Join the fragments that belong to a marker to it, and remove their samples from the trajectories they came from.

    A fragment that continues a marker fills it where it is missing. One that replaces a marker takes its place. One that only
    doubles a marker stays where it is.
    """
    fragments = [fault for fault in faults if isinstance(fault, Fragment) and fault.relation in JOINED_RELATIONS]
    if not fragments:
        return take
    count, loose = len(take.labels), take.unlabelled
    markers, sources, computed = take.markers.copy(), take.source_points.copy(), take.measured != take.visible
    uncaptured = np.zeros(take.visible.shape, bool) if take.uncaptured is None else take.uncaptured.copy()
    unlabelled = None if loose is None else loose.markers.copy()
    for fragment in fragments:
        frames = np.arange(fragment.first, fragment.last + 1)
        if fragment.donor < count:
            path, point = markers[:, fragment.donor], sources[:, fragment.donor].copy()
        elif loose is not None and unlabelled is not None:
            path, point = unlabelled[:, fragment.donor - count], loose.source_points[:, fragment.donor - count]
        else:
            continue
        joined = frames[~np.isnan(path[frames, 0])]
        if fragment.relation == "continues":
            joined = joined[np.isnan(markers[joined, fragment.marker, 0])]
        markers[joined, fragment.marker], sources[joined, fragment.marker] = path[joined], point[joined]
        computed[joined, fragment.marker] = uncaptured[joined, fragment.marker] = False
        path[joined] = np.nan
    if loose is not None and unlabelled is not None:
        loose = loose.replace_markers(unlabelled)
    return replace(take, markers=markers, relabelled_points=sources, computed=computed, uncaptured=uncaptured, unlabelled=loose)


def relabel_samples(take: Take, faults: Iterable[Fault]) -> Take:
    """Join fragments and undo exchanges of labels, one after the other in the given order."""
    for are_fragments, group in groupby(faults, key=lambda fault: isinstance(fault, Fragment)):
        repair = join_fragments if are_fragments else undo_label_exchanges
        take = repair(take, group)
    return take
