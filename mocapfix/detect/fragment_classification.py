"""What a piece of a trajectory is held to be, and why, in a sentence for a technician."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Literal

import numpy as np

from mocapfix.detect.continuity import MAX_DUPLICATE_DISTANCE_M, is_smoother
from mocapfix.detect.trajectory_segments import TrajectorySegment
from mocapfix.faults import Fragment
from mocapfix.take import Take

MAX_STATIC_EXTENT_M = 0.005  # metres: what does not move at all moves no more
MAX_RIGID_DISTANCE_SD_M = 0.015  # metres: by which the distances of what rides on the body to its nearest markers vary
MIN_DESCRIBED_DURATION_S = 0.25  # seconds: what is seen for less shows too little of how it moves

FragmentRelation = Literal["continues", "replaces", "doubles", "other"]


@dataclass(frozen=True)
class MarkerMatch:
    """How a piece would do as a marker: at what cost (infinite: not at all), how far its distances to the `partners`, by whom
    that is told, are off in metres; without partners its course alone tells.
    """

    marker: int
    cost: float
    distance_error_m: float
    partners: tuple[int, ...]


def classify_continuation(
    segment: TrajectorySegment, candidates: Sequence[MarkerMatch], probability: float, take: Take
) -> Fragment:
    """-> a piece that goes on as the marker it matches best."""
    match, why = candidates[0], "it begins or ends where that ends or begins"
    if match.partners:
        why = f"its distances to {_join_labels(match.partners, take)} stay within {_format_mm(match.distance_error_m)} of that marker's"
    reason = f"{_get_donor_label(segment, take)} goes on as {take.bare_labels[match.marker]} for {_format_duration(segment, take)}: {why}."
    return _build_fragment("continues", segment, match.marker, match.distance_error_m, probability, reason)


def classify_unassigned(
    segment: TrajectorySegment, candidates: Sequence[MarkerMatch], probability: float, take: Take
) -> Fragment:
    """-> a piece that is none of the markers that are missing meanwhile, or not surely one."""
    labels, confidence = take.bare_labels, 1 - probability
    likely = [match for match in candidates if np.isfinite(match.cost)]
    known = [match for match in candidates if match.partners]
    if len(likely) > 1:
        why = f"{labels[likely[0].marker]} and {labels[likely[1].marker]} are missing meanwhile, and it may be either"
    elif likely:
        why = f"{labels[likely[0].marker]} is missing meanwhile, but that it is this one is not sure"
    elif known:
        best = min(known, key=lambda match: match.distance_error_m)
        off = f"{_format_mm(best.distance_error_m)} off that marker's distances to {_join_labels(best.partners, take)}"
        why = f"the likeliest of those missing meanwhile is {labels[best.marker]}, and it is {off}"
    elif candidates:
        why, confidence = f"while {labels[candidates[0].marker]} is missing nothing tells where that is", 0.5
    elif segment.namesake >= 0:
        why = f"{labels[segment.namesake]} is seen meanwhile, elsewhere"
    else:
        why = f"none is missing meanwhile; {_describe_motion(segment, take)}"
    reason = f"{_get_donor_label(segment, take)} continues no marker in its {_format_duration(segment, take)}: {why}."
    return _build_fragment("other", segment, segment.donor, np.nan, confidence, reason)


def classify_duplicate(segment: TrajectorySegment, marker: int, distance_m: float, take: Take) -> Fragment:
    """-> a piece that lies, by the median, `off` metres beside a marker that is seen as well."""
    reason = f"{_get_donor_label(segment, take)} is {take.bare_labels[marker]} a second time for {_format_duration(segment, take)}, {_format_mm(distance_m)} beside it"
    better = is_smoother(segment, take.markers[:, marker], take.rate)
    relation, end = ("replaces", ", and leads on more smoothly before and after.") if better else ("doubles", ".")
    return _build_fragment(relation, segment, marker, distance_m, 1 - 0.5 * distance_m / MAX_DUPLICATE_DISTANCE_M, reason + end)


def classify_short(segment: TrajectorySegment, take: Take) -> Fragment:
    """-> a piece that shows too little."""
    reason = f"{_get_donor_label(segment, take)} is seen for {_format_duration(segment, take)}, too short to tell of what."
    return _build_fragment("other", segment, segment.donor, np.nan, 0.5, reason)


def merge_unassigned(fragments: Sequence[Fragment]) -> list[Fragment]:
    """-> the fragments, those of one donor in a row that are none of the markers as one, by the longest one's reason."""
    told = []
    for (relation, _), group in groupby(fragments, key=lambda fragment: (fragment.relation, fragment.donor)):
        each = list(group)
        if relation == "other" and len(each) > 1:
            longest = max(each, key=lambda fragment: fragment.last - fragment.first)
            reason = f"{longest.reason[:-1]}; so with its {len(each)} pieces in a row."
            each = [replace(longest, first=each[0].first, last=each[-1].last, reason=reason)]
        told += each
    return told


def _describe_motion(segment: TrajectorySegment, take: Take) -> str:
    """-> what kind of thing a piece shows, from how it moves."""
    if (len(segment.frames) - 1) / take.rate < MIN_DESCRIBED_DURATION_S:
        return "it is seen for too short to tell how it moves"
    if np.ptp(segment.points, axis=0).max() < MAX_STATIC_EXTENT_M:
        return "it stands still"
    spread = np.std(np.linalg.norm(take.markers[segment.frames] - segment.points[:, None], axis=-1), axis=0)
    near = [m for m in np.argsort(spread).tolist() if m != segment.donor][:3]  # NaN, of a marker not seen throughout, comes last
    if len(near) == 3 and spread[near[-1]] < MAX_RIGID_DISTANCE_SD_M:
        return f"it rides on the body with {_join_labels(near, take)}"
    return "it moves by itself"


def _build_fragment(
    relation: FragmentRelation, segment: TrajectorySegment, marker: int, severity: float, confidence: float, reason: str
) -> Fragment:
    first, last = int(segment.frames[0]), int(segment.frames[-1])
    return Fragment("fragment", marker, first, last, severity, reason, confidence, donor=segment.donor, relation=relation)


def _get_donor_label(segment: TrajectorySegment, take: Take) -> str:
    if segment.donor < len(take.labels):
        return take.bare_labels[segment.donor]
    return take.unlabelled.bare_labels[segment.donor - len(take.labels)] if take.unlabelled else ""


def _join_labels(markers: Sequence[int], take: Take) -> str:
    *first, last = [take.bare_labels[m] for m in markers]
    return f"{', '.join(first)} and {last}"


def _format_mm(metres: float) -> str:
    return f"{metres * 1e3:.0f} mm"


def _format_duration(segment: TrajectorySegment, take: Take) -> str:
    count = int(segment.frames[-1] - segment.frames[0]) + 1
    if count >= 0.1 * take.rate:
        return f"{count / take.rate:.2f} s"
    return f"{count} frame{'s' if count > 1 else ''}"
