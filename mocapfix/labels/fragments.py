"""Fragments: trajectories that continue a marker under another label (`*12`, `C_123`, `RBAC-1`).

Trajectory segments are unbroken parts of trajectories that may belong to another label: of the unlabelled ones, and of those
whose label is another label with a number appended (`RBAC-1` beside `RBAC`) or a repetition of it. Cameras lose a point and pick
up another one under the same label, so a trajectory is split at pauses and leaps. `compute_join_cost` compares a segment with the
trajectory that precedes and follows it.

The rigid signature of a marker is its distances to the markers of its segment, and on which side of them it lies. Distances do
not distinguish a position from its mirror image. The signed height above the plane of three of the markers does.

`detect_fragments` compares each segment of such a trajectory with the markers that are missing at that time, by their rigid
signatures and by a path that leads to it and on from it. Each deviation is measured in its own standard deviations. The sum of
their squares is a cost, and the costs give the probability of each marker, and of none (Bayes' rule). The most certain segments
are joined first (`join_fragments`): the marker is then no longer missing, and its samples help to decide about the next. The
`classify_` functions say in a sentence what a segment is.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, groupby

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.errors import join_words
from mocapfix.labels.label_swaps import undo_label_exchanges
from mocapfix.model.detected import find_namesakes
from mocapfix.model.faults import JOINED_RELATIONS, Fault, Fragment, FragmentRelation, overlap_in_time
from mocapfix.model.take import Take
from mocapfix.stats.marker_distances import estimate_distance_statistics, estimate_distances_from, sample_coordinates
from mocapfix.stats.sequences import compute_known_medians, sample_evenly

MAX_PAUSE_S = 0.025  # a longer pause ends a segment
# A step that deviates more from a straight path belongs to another point: a constant, and a term in the square of its time.
SEGMENT_STEP_TOLERANCE_M = 0.015
SEGMENT_STEP_TOLERANCE_M_PER_S2 = 200.0


@dataclass(frozen=True)
class TrajectorySegment:
    """An unbroken part of one trajectory."""

    donor: int  # index into the take's labels or, from their number on, into its unlabelled trajectories
    namesake: int  # index of the marker whose label it has, -1 if none
    frames: np.ndarray  # frame indices (N,)
    points: np.ndarray  # world positions (N, 3) in metres

    @property
    def first(self) -> int:
        return int(self.frames[0])

    @property
    def last(self) -> int:
        return int(self.frames[-1])

    def pick_samples(self, max_count: int) -> "TrajectorySegment":
        """Return the segment with at most `max_count` of its samples, evenly spread."""
        pick = sample_evenly(len(self.frames), max_count)
        return replace(self, frames=self.frames[pick], points=self.points[pick])

    def measure_distances(self, markers: Float[np.ndarray, "T M 3"], columns: Int[np.ndarray, " K"]) -> Float[np.ndarray, "N K"]:
        """Measure the distances in metres from each sample to the positions of some markers in its frame."""
        return np.linalg.norm(markers[np.ix_(self.frames, columns)] - self.points[:, None], axis=-1)


def find_loose_segments(take: Take) -> list[TrajectorySegment]:
    """Split the trajectories that may belong to another label into segments, ordered by donor and first frame."""
    loose = [(donor, marker, take.markers[:, donor]) for donor, marker in find_namesakes(take).items()]
    if take.unlabelled is not None:
        loose += [(len(take.labels) + u, -1, take.unlabelled.markers[:, u]) for u in range(len(take.unlabelled.labels))]
    return [
        TrajectorySegment(donor, marker, frames, path[frames])
        for donor, marker, path in loose
        for frames in split_trajectory(np.flatnonzero(~np.isnan(path[:, 0])), path, take.rate)
    ]


def split_trajectory(frames: Int[np.ndarray, " N"], path: Float[np.ndarray, "T 3"], rate: float) -> list[Int[np.ndarray, " _"]]:
    """Split the frames at which a path is visible at pauses, and at steps that are leaps as seen from both sides."""
    if not len(frames):
        return []
    lag, step = np.diff(frames)[:, None] / rate, np.diff(path[frames], axis=0)
    error_before, error_after = np.full(len(step), np.inf), np.full(len(step), np.inf)
    error_before[1:] = np.linalg.norm(step[1:] - step[:-1] / lag[:-1] * lag[1:], axis=1)
    error_after[:-1] = np.linalg.norm(step[:-1] - step[1:] / lag[1:] * lag[:-1], axis=1)
    error, lag = np.minimum(error_before, error_after), lag[:, 0]
    is_leap = np.isfinite(error) & (error > SEGMENT_STEP_TOLERANCE_M + SEGMENT_STEP_TOLERANCE_M_PER_S2 * lag**2)
    return np.split(frames, np.flatnonzero(is_leap | (lag > MAX_PAUSE_S)) + 1)


MAX_SCREENED_SAMPLES = 60  # of a segment, by which the markers are chosen that are compared with all samples
MAX_DUPLICATE_DISTANCE_M = 0.010  # two trajectories of the same marker are at most this far apart
VELOCITY_WINDOW_S = 0.03  # part of a trajectory, next to its end, to which the velocity is fitted
# Standard deviation of the join error: a constant, and a term that grows with the square of the time across the join.
JOIN_TOLERANCE_M = 0.002
JOIN_TOLERANCE_M_PER_S2 = 2.5
MAX_END_DEVIATION_SD = 3.5  # largest join error of one end: the last sample of a label is often an outlier


def compute_join_cost(segment: TrajectorySegment, path: Float[np.ndarray, "T 3"], rate: float, max_gap_s: float) -> float:
    """Compute the cost of joining a trajectory segment to a marker's path.

    Returns:
        The mean square of the join errors at both ends, in standard deviations. NaN if the path has no sample within
        `max_gap_s` of either end. Infinite if the segment and the path are visible together but apart.
    """
    visible = ~np.isnan(path[:, 0])
    is_shared = visible[segment.frames]
    if is_shared.any():
        shared = replace(segment, frames=segment.frames[is_shared], points=segment.points[is_shared])
        few = shared.pick_samples(MAX_SCREENED_SAMPLES)
        if np.linalg.norm(few.points - path[few.frames], axis=1).min() > MAX_DUPLICATE_DISTANCE_M:
            return np.inf
        distance = float(np.median(np.linalg.norm(shared.points - path[shared.frames], axis=1)))
        return (2 * distance / MAX_DUPLICATE_DISTANCE_M) ** 2 if distance <= MAX_DUPLICATE_DISTANCE_M else np.inf
    first, last, reach = segment.frames[0], segment.frames[-1], round(max_gap_s * rate) + 1
    start = max(0, first - reach)
    early = start + np.flatnonzero(visible[start:first])
    late = last + 1 + np.flatnonzero(visible[last + 1 : last + 1 + reach])
    ends: list[tuple[float, float]] = []
    if len(early):
        ends.append(measure_join_error(early, path[early], segment.frames, segment.points, rate))
    if len(late):
        ends.append(measure_join_error(segment.frames, segment.points, late, path[late], rate))
    if not ends:
        return np.nan
    return float(
        np.mean(
            [min(MAX_END_DEVIATION_SD, error / (JOIN_TOLERANCE_M + JOIN_TOLERANCE_M_PER_S2 * lag**2)) ** 2 for error, lag in ends]
        )
    )


def measure_join_error(
    early_frames: Int[np.ndarray, " N"],
    early_points: Float[np.ndarray, "N 3"],
    late_frames: Int[np.ndarray, " K"],
    late_points: Float[np.ndarray, "K 3"],
    rate: float,
) -> tuple[float, float]:
    """Measure how far the extrapolation of one path misses the first point of the next.

    The extrapolation goes from the last early point at the mean of the velocities on both sides.

    Returns:
        The distance in metres and the time across the join in seconds.
    """
    lag = (late_frames[0] - early_frames[-1]) / rate
    velocity = (
        _fit_end_velocity(early_frames[::-1], early_points[::-1], rate) + _fit_end_velocity(late_frames, late_points, rate)
    ) / 2
    return float(np.linalg.norm(late_points[0] - early_points[-1] - velocity * lag)), float(lag)


def _fit_end_velocity(frames: np.ndarray, points: np.ndarray, rate: float) -> np.ndarray:
    """Fit a straight line to the points (N, 3) nearest to the first frame; return its velocity (3,) in m/s, 0 for one point."""
    count = max(2, int(np.searchsorted(np.abs(frames - frames[0]), VELOCITY_WINDOW_S * rate, side="right")))
    time = (frames[:count] - frames[:count].mean()) / rate
    return time @ points[:count] / max(float(time @ time), 1e-12)


def is_smoother(segment: TrajectorySegment, path: Float[np.ndarray, "T 3"], rate: float) -> bool:
    """Return whether a marker's path continues more smoothly, at both ends, with the segment than with its own samples."""
    first, last = segment.frames[0], segment.frames[-1]
    visible = np.flatnonzero(~np.isnan(path[:, 0]))
    early, late = visible[visible < first], visible[visible > last]
    own = visible[(visible >= first) & (visible <= last)]
    ends: list[tuple[float, float]] = []
    for frames, points in ((segment.frames, segment.points), (own, path[own])):
        into = measure_join_error(early, path[early], frames, points, rate)[0] if len(early) else 0.0
        out = measure_join_error(frames, points, late, path[late], rate)[0] if len(late) else 0.0
        ends.append((into, out))
    (into, out), (own_into, own_out) = ends
    return max(own_into, own_out) > JOIN_TOLERANCE_M and into < own_into and out < own_out


MAX_SIGNATURE_FRAMES = 300
MIN_CORNER_FRAMES = 20  # or all of them if fewer, in which a plane's corners and the marker are visible
MIN_SIGNATURE_SD_M = 0.004  # standard deviation of a distance even on a rigid segment
RELATIVE_DISTANCE_SD = 0.04  # of the distance, for motion that the take rarely shows: near markers weigh more
MAX_SIGNATURE_SD_M = 0.04  # a distance with a larger standard deviation does not identify a marker
# Number of partners whose distances are compared, and of those from which three form a plane.
MAX_SIGNATURE_PARTNERS = 4
MAX_PLANE_CANDIDATES = 5
MAX_DISTANCE_FOR_SIDE_SD = 10.0  # with a larger deviation of the distances, in standard deviations, the side is not computed
MIN_PARTNER_VISIBLE_FRACTION = 0.8  # fraction of the compared frames in which a partner must be visible
SIGNATURE_COVERAGE_FRACTION = 0.9  # of the frames that give a distance's spread: limbs bend in a part of a take
# Quantiles of the heights, and the number of standard deviations between them.
LOW_HEIGHT_QUANTILE = 0.05
HIGH_HEIGHT_QUANTILE = 0.95
HEIGHT_QUANTILE_WIDTH_SD = 3.29
MAX_COMPARED_SAMPLES = 60  # number of samples, evenly spread, that are compared with a signature


@dataclass(frozen=True)
class SignatureMatch:
    """How well samples match the signature of a marker."""

    distance_sd: float  # root mean square deviation of the distances to the partners, in standard deviations
    # Deviation of the height above the plane of three markers, in standard deviations. 0 if no plane is known, or if the
    # distances do not match at all.
    side_sd: float
    distance_error_m: float  # root mean square deviation of the distances in metres
    partners: tuple[int, ...]  # indices of the partners


class RigidSignatures:
    """The signatures of the markers of a take."""

    def __init__(self, markers: Float[np.ndarray, "T M 3"]):
        """Estimate the signatures from world positions in metres, NaN where missing."""
        self.markers = markers
        self.sampled_frames = sample_evenly(len(markers), MAX_SIGNATURE_FRAMES)
        self.sampled_markers = markers[self.sampled_frames]
        self.distance_m, sd_m = estimate_distance_statistics(self.sampled_markers, SIGNATURE_COVERAGE_FRACTION)
        self.distance_sd_m = _add_motion_sd(self.distance_m, sd_m)

    def update_markers(self, changed: Sequence[int]) -> Bool[np.ndarray, " M"]:
        """Estimate the distances of markers again whose positions have changed in place.

        Returns:
            The markers of which a comparison may have another result than before: these, and those whose partners they were or
            have become.
        """
        count = self.markers.shape[1]
        self.sampled_markers[:, changed] = self.markers[self.sampled_frames][:, changed]
        coordinates, is_affected = sample_coordinates(self.sampled_markers), np.isin(np.arange(count), changed)
        for m in changed:
            is_affected |= self.distance_sd_m[m] < MAX_SIGNATURE_SD_M
            distance_m, sd_m = estimate_distances_from(m, coordinates, slice(count), SIGNATURE_COVERAGE_FRACTION)
            distance_m[m] = sd_m[m] = np.inf
            self.distance_m[m] = self.distance_m[:, m] = distance_m
            self.distance_sd_m[m] = self.distance_sd_m[:, m] = _add_motion_sd(distance_m, sd_m)
            is_affected |= self.distance_sd_m[m] < MAX_SIGNATURE_SD_M
        return is_affected

    def match_samples(
        self, frames: Int[np.ndarray, " N"], points: Float[np.ndarray, "N 3"], marker: int
    ) -> SignatureMatch | None:
        """Compare samples at the given frames with the signature of a marker; None if it has fewer than three partners."""
        pick = sample_evenly(len(frames), MAX_COMPARED_SAMPLES)
        candidates = np.flatnonzero(self.distance_sd_m[marker] < MAX_SIGNATURE_SD_M)
        candidates = candidates[np.argsort(self.distance_sd_m[marker, candidates], kind="stable")]
        points, others = points[pick], self.markers[np.ix_(frames[pick], candidates)]
        is_seen = (~np.isnan(others[..., 0])).mean(0) >= MIN_PARTNER_VISIBLE_FRACTION
        candidates, others = candidates[is_seen], others[:, is_seen]
        if len(candidates) < 3:
            return None
        partners = candidates[:MAX_SIGNATURE_PARTNERS]
        offset = others[:, : len(partners)] - points[:, None]
        error_m = np.linalg.norm(offset, axis=-1) - self.distance_m[marker, partners]
        typical_m = compute_known_medians(np.abs(error_m))  # the median over the frames ignores a partner's spikes
        distance_sd = _compute_rms(typical_m / np.hypot(self.distance_sd_m[marker, partners], MIN_SIGNATURE_SD_M))
        side_sd = 0.0
        if distance_sd < MAX_DISTANCE_FOR_SIDE_SD:
            side_sd = self._measure_side(points, others, marker, candidates[:MAX_PLANE_CANDIDATES])
        return SignatureMatch(distance_sd, side_sd, _compute_rms(typical_m), tuple(partners.tolist()))

    def _measure_side(
        self, points: Float[np.ndarray, "N 3"], others: Float[np.ndarray, "N K 3"], marker: int, candidates: np.ndarray
    ) -> float:
        """Measure the deviation, in standard deviations, of the height above the plane that separates the sides best."""
        best_separation, side_sd = 0.0, 0.0
        for corners in combinations(range(len(candidates)), 3):
            heights = compute_plane_heights(self.sampled_markers[:, marker], self.sampled_markers[:, candidates[list(corners)]])
            low, median, high = _compute_quantiles(heights[:, None])[:, 0]
            sd = np.hypot((high - low) / HEIGHT_QUANTILE_WIDTH_SD, MIN_SIGNATURE_SD_M) if np.isfinite(high) else np.inf
            if abs(median) > best_separation * sd:
                best_separation = abs(median) / sd
                height = float(compute_known_medians(compute_plane_heights(points, others[:, corners])[:, None])[0])
                side_sd = abs(height - median) / sd
        return float(side_sd)


def _add_motion_sd(distance_m: np.ndarray, sd_m: np.ndarray) -> np.ndarray:
    """Add the deviations for motion that the take rarely shows to the standard deviations of distances."""
    return np.hypot(sd_m, RELATIVE_DISTANCE_SD * np.where(np.isfinite(distance_m), distance_m, 0.0))


def compute_plane_heights(points: Float[np.ndarray, "T 3"], corners: Float[np.ndarray, "T 3 3"]) -> Float[np.ndarray, " T"]:
    """Compute the heights in metres of points above planes of three corners, positive along the right-hand normal."""
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    return np.einsum("ta,ta->t", points - a, normal) / np.maximum(np.linalg.norm(normal, axis=1), 1e-9)


def _compute_quantiles(values: np.ndarray) -> np.ndarray:
    """Compute the low, middle and high quantile (3, N) of each column (T, N) without NaN; infinite with too few values."""
    ordered = np.sort(values, axis=0)  # NaN sorts last
    count = (~np.isnan(ordered)).sum(0)
    rows = np.rint(np.outer([LOW_HEIGHT_QUANTILE, 0.5, HIGH_HEIGHT_QUANTILE], np.maximum(count - 1, 0))).astype(int)
    return np.where(count >= min(MIN_CORNER_FRAMES, len(values)), ordered[rows, np.arange(values.shape[1])], np.inf)


def _compute_rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


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
