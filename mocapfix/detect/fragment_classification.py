"""Classification of trajectory segments: what each one is, and why, in a sentence for a technician."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from mocapfix.detect.trajectory_segments import MAX_DUPLICATE_DISTANCE_M, MAX_SCREENED_SAMPLES, TrajectorySegment, is_smoother
from mocapfix.faults import Fragment, FragmentRelation
from mocapfix.take import Take

# A point with a smaller extent in each axis is stationary.
MAX_STATIC_EXTENT_M = 0.005
# Standard deviation of the distances of a point on the body to its nearest markers.
MAX_RIGID_DISTANCE_SD_M = 0.015
# Number of markers whose distances are compared in all samples: those with the steadiest distances in a few.
MAX_RIGID_CANDIDATES = 100
# The motion of a shorter segment is not described.
MIN_DESCRIBED_DURATION_S = 0.25


@dataclass(frozen=True)
class MarkerMatch:
    """How well a segment matches a marker.

    Attributes:
        marker: Index of the marker.
        cost: Cost of the match, infinite if it is ruled out.
        distance_error_m: Deviation in metres of the distances to the partners.
        partners: Indices of the markers whose distances were compared. Empty if only the path was.
    """

    marker: int
    cost: float
    distance_error_m: float
    partners: tuple[int, ...]


def classify_continuation(
    segment: TrajectorySegment, candidates: Sequence[MarkerMatch], probability: float, take: Take
) -> Fragment:
    """Classify a segment that continues the marker that it matches best."""
    match, evidence = candidates[0], "it begins or ends where that marker ends or begins"
    if match.partners:
        names = _join_labels(match.partners, take)
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
        error = f"its distances to {_join_labels(best.partners, take)} differ by {_format_mm(best.distance_error_m)}"
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


def classify_short(segment: TrajectorySegment, take: Take) -> Fragment:
    """Classify a segment that is too short to be compared."""
    duration = _format_duration(segment, take)
    reason = f"{_get_donor_label(segment, take)} is visible for {duration}, too short to match it with a marker."
    return _build_fragment("other", segment, segment.donor, np.nan, 0.5, reason)


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
        return f"it moves rigidly with {_join_labels(near.tolist(), take)}"
    return "it moves independently"


def _build_fragment(
    relation: FragmentRelation, segment: TrajectorySegment, marker: int, severity: float, confidence: float, reason: str
) -> Fragment:
    return Fragment(
        "fragment",
        marker,
        segment.first,
        segment.last,
        severity,
        reason,
        confidence,
        donor=segment.donor,
        relation=relation,
    )


def _get_donor_label(segment: TrajectorySegment, take: Take) -> str:
    if segment.donor < len(take.labels):
        return take.bare_labels[segment.donor]
    return take.unlabelled.bare_labels[segment.donor - len(take.labels)] if take.unlabelled else ""


def _join_labels(markers: Sequence[int], take: Take) -> str:
    *first, last = [take.bare_labels[m] for m in markers]
    return f"{', '.join(first)} and {last}"


def _format_mm(distance_m: float) -> str:
    return f"{distance_m * 1e3:.0f} mm"


def _format_duration(segment: TrajectorySegment, take: Take) -> str:
    count = segment.last - segment.first + 1
    if count >= 0.1 * take.rate:
        return f"{count / take.rate:.2f} s"
    return f"{count} frame{'s' if count > 1 else ''}"
