"""Trajectory segments: unbroken parts of trajectories that may belong to another label, and how well one continues a marker.

These are the unlabelled trajectories, and those whose label is another label with a number appended (`RBAC-1` beside `RBAC`) or
a repetition of it. Cameras lose a point and pick up another one under the same label, so a trajectory is split at pauses
and leaps. `compute_join_cost` compares a segment with the trajectory that precedes and follows it.

The rigid signature of a marker is its distances to the markers of its segment, and on which side of them it lies. Distances do
not distinguish a position from its mirror image. The signed height above the plane of three of the markers does.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.model.detected import find_namesakes
from mocapfix.model.take import Take
from mocapfix.stats.marker_distances import estimate_distance_statistics, estimate_distances_from, sample_coordinates
from mocapfix.stats.sequences import compute_known_medians, sample_evenly

# A label with a number appended: "RBAC-1", "RBAC_12", "RBAC (2)".
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

    def _measure_side(self, points: np.ndarray, others: np.ndarray, marker: int, candidates: np.ndarray) -> float:
        """Measure the deviation, in standard deviations, of the height above the plane that separates the sides best.

        Args:
            points: The samples (N, 3).
            others: The positions (N, K, 3) of the candidates in their frames, and maybe of more.
            candidates: Indices of the markers that may be corners.
        """
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
