"""Distances between markers, learned from the take itself, and how badly a sample contradicts them.

Two markers on the same segment keep their distance (Ringer & Lasenby 2004, "A procedure for automatically estimating model
parameters in optical motion capture"). Which ones do, and how well, is estimated from the take. A sample under the wrong label
breaks the distances to its label's partners and keeps those to another marker's partners. Each partner has one bounded vote, so
that a faulty or mislabelled partner cannot outvote the others.

The rigid signature of a marker is its distances to the markers of its segment, and on which side of them it lies. Distances do
not distinguish a position from its mirror image. The signed height above the plane of three of the markers does.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import ndtri

# Number of partners of a marker.
MAX_DISTANCE_PARTNERS = 8
# A distance with a larger standard deviation does not identify a marker.
MAX_PARTNER_SD_M = 0.03
# Standard deviation of a distance even on a rigid segment.
MIN_DISTANCE_SD_M = 0.003
# A distance is fully broken from this many standard deviations.
BROKEN_DISTANCE_SD = 3.0
# Number of frames, evenly spread, from which the distances are learned.
MAX_DISTANCE_FRAMES = 300
# Number of these frames, or all of them if there are fewer, in which both markers must be visible.
MIN_JOINT_FRAMES = 20
# Fraction of the frames in which a distance is assumed to be correct.
MIN_CORRECT_FRACTION = 0.55
# No body has more markers. In takes of more, only the distances between markers are estimated that are ever nearer than this,
# in every so many of the frames: a segment is smaller.
MAX_BODY_MARKERS = 250
MAX_NEAR_DISTANCE_M = 1.0
NEAR_FRAME_STEP = 10

# Number of pairs of frames, evenly spread, from which the changes of distances are learned.
MAX_FRAME_PAIRS = 300
# Number of these pairs in which both markers must be visible.
MIN_VISIBLE_FRAME_PAIRS = 20
# Time between the frames of a pair, or half the take if that is shorter.
DISTANCE_CHANGE_INTERVAL_S = 1.0
# Quantile of the changes that is returned: about one standard deviation of a normal distribution.
DISTANCE_CHANGE_QUANTILE = 0.84


class MarkerDistances(NamedTuple):
    """The distances of each of M markers to its K partners with the steadiest distances.

    Attributes:
        partner: Marker indices (M, K), steadiest first, -1 where there are fewer.
        length_m: Distances (M, K) in metres.
        tolerance_m: Deviations (M, K) in metres from which a distance is broken.
    """

    partner: np.ndarray
    length_m: np.ndarray
    tolerance_m: np.ndarray


def estimate_distances(
    markers: Float[np.ndarray, "T M 3"], min_correct_fraction: float = MIN_CORRECT_FRACTION
) -> MarkerDistances:
    """Estimate the distances that markers keep over a fraction of the take.

    Args:
        markers: World positions in metres, NaN where missing.
        min_correct_fraction: Fraction of the frames in which the distances are assumed to be correct.
    """
    count = markers.shape[1]
    length_m, sd_m = estimate_distance_statistics(markers, min_correct_fraction)
    order = np.argsort(sd_m, axis=1, kind="stable")[:, :MAX_DISTANCE_PARTNERS]
    rows = np.arange(count)[:, None]
    is_steady = sd_m[rows, order] < MAX_PARTNER_SD_M
    tolerance_m = BROKEN_DISTANCE_SD * np.hypot(np.where(is_steady, sd_m[rows, order], 0), MIN_DISTANCE_SD_M)
    return MarkerDistances(np.where(is_steady, order, -1), np.where(is_steady, length_m[rows, order], 0), tolerance_m)


def estimate_distance_statistics(
    markers: Float[np.ndarray, "T M 3"], min_correct_fraction: float
) -> tuple[Float[np.ndarray, "M M"], Float[np.ndarray, "M M"]]:
    """Estimate the centre and the robust standard deviation of the distances between markers, in metres.

    Both are taken from the shortest interval that holds `min_correct_fraction` of the frames, so that the size of the other
    deviations does not matter. They are infinite for markers that are hardly ever visible together, for a marker and itself,
    and in a take of several hundred markers for those that are never near one another.
    """
    count = markers.shape[1]
    centre, sd = np.full((count, count), np.inf), np.full((count, count), np.inf)
    coordinates = _sample_coordinates(markers)
    for i in range(1, count):
        others = slice(i) if count <= MAX_BODY_MARKERS else _find_near(i, coordinates[:, : i + 1])
        centre[i, others], sd[i, others] = _estimate_distances_from(i, coordinates, others, min_correct_fraction)
        centre[others, i], sd[others, i] = centre[i, others], sd[i, others]
    return centre, sd


def _sample_coordinates(markers: Float[np.ndarray, "T M 3"]) -> Float[np.ndarray, "3 M S"]:
    """Return the coordinates in the frames, evenly spread, from which distances are learned."""
    frames = len(markers)
    sample = markers[np.unique(np.linspace(0, frames - 1, MAX_DISTANCE_FRAMES).astype(int))] if frames else markers
    return np.ascontiguousarray(sample.transpose(2, 1, 0))


def _find_near(marker: int, coordinates: Float[np.ndarray, "3 M S"]) -> Int[np.ndarray, " N"]:
    """Find the other markers that are less than MAX_NEAR_DISTANCE_M from a marker in any of a few frames."""
    few = coordinates[:, :, ::NEAR_FRAME_STEP]
    x, y, z = (few - few[:, marker, None]) ** 2
    is_near = (x + y + z < MAX_NEAR_DISTANCE_M**2).any(1)
    is_near[marker] = False
    return np.flatnonzero(is_near)


def _estimate_distances_from(
    marker: int, coordinates: Float[np.ndarray, "3 M S"], others: slice | Int[np.ndarray, " N"], min_correct_fraction: float
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Estimate the centres and the standard deviations of a marker's distances to others, in metres."""
    x, y, z = (coordinates[:, others] - coordinates[:, marker, None]) ** 2
    distance = np.sort(np.sqrt(x + y + z), axis=1)  # NaN sorts last
    centre, sd = np.full(len(distance), np.inf), np.full(len(distance), np.inf)
    visible_count = (~np.isnan(distance)).sum(1)
    known = np.flatnonzero(visible_count >= max(2, min(MIN_JOINT_FRAMES, coordinates.shape[2])))
    start_m, width_m = _find_shortest_intervals(distance[known], visible_count[known], min_correct_fraction)
    centre[known] = start_m + width_m / 2
    # the standard deviation of a normal distribution with the same central interval
    sd[known] = width_m / 2 / ndtri((1 + min_correct_fraction) / 2)
    return centre, sd


def _find_shortest_intervals(
    ordered: np.ndarray, counts: np.ndarray, fraction: float
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Find in each row (N, S) the shortest interval that holds a fraction of its values; return its start and width.

    Args:
        ordered: The values, which ascend in each row and end with its NaN.
        counts: The number (N,) of values of each row.
        fraction: The fraction.
    """
    if not len(counts):
        return np.empty(0), np.empty(0)
    rows, inside = np.arange(len(counts)), np.ceil(fraction * counts).astype(int)
    first = np.arange((counts - inside).max() + 1)
    last = first + inside[:, None] - 1
    width = ordered[rows[:, None], np.minimum(last, counts[:, None] - 1)] - ordered[:, : len(first)]
    width[last >= counts[:, None]] = np.inf
    start = width.argmin(1)
    return ordered[rows, start], width[rows, start]


def estimate_distance_changes(markers: Float[np.ndarray, "T M 3"], rate: float) -> Float[np.ndarray, "M M"]:
    """Estimate by how much the distances between markers change within a second.

    Unlike the standard deviation of a distance, this ignores a marker that moves on its segment once, and responds to
    joints and skin.

    Args:
        markers: World positions in metres, NaN where missing or not an inlier.
        rate: Frame rate in Hz.

    Returns:
        The usual change in metres. Infinite for markers that are hardly ever visible together, and for a marker and itself.
    """
    frames, count = markers.shape[:2]
    usual_change = np.full((count, count), np.inf)
    lag = min(round(DISTANCE_CHANGE_INTERVAL_S * rate), frames // 2)
    starts = np.unique(np.linspace(0, frames - lag - 1, MAX_FRAME_PAIRS).astype(int)) if lag else np.zeros(0, int)
    before, after = markers[starts], markers[starts + lag]
    for i in range(1, count):
        old, new = (np.linalg.norm(sample[:, :i] - sample[:, i, None], axis=-1) for sample in (before, after))
        change = np.sort(np.abs(new - old), axis=0)  # NaN sorts last
        visible_count = (~np.isnan(change)).sum(0)
        others = np.flatnonzero(visible_count >= min(MIN_VISIBLE_FRAME_PAIRS, max(2, len(starts))))
        row = np.rint(DISTANCE_CHANGE_QUANTILE * (visible_count[others] - 1)).astype(int)
        usual_change[i, others] = usual_change[others, i] = change[row, others]
    return usual_change


MAX_SIGNATURE_FRAMES = 300
# Number of these frames, or all of them if there are fewer, in which a plane's corners and the marker must be visible.
MIN_CORNER_FRAMES = 20
# Standard deviation of a distance even on a rigid segment.
MIN_SIGNATURE_SD_M = 0.004
# Standard deviation relative to the distance, for motion that the take rarely shows: near markers weigh more.
RELATIVE_DISTANCE_SD = 0.04
# A distance with a larger standard deviation does not identify a marker.
MAX_SIGNATURE_SD_M = 0.04
# Number of partners whose distances are compared, and of those from which three form a plane.
MAX_SIGNATURE_PARTNERS = 4
MAX_PLANE_CANDIDATES = 5
# With a larger deviation of the distances, in standard deviations, the side is not computed.
MAX_DISTANCE_FOR_SIDE_SD = 10.0
# Fraction of the compared frames in which a partner must be visible.
MIN_PARTNER_VISIBLE_FRACTION = 0.8
# Fraction of the frames from which the spread of a distance is estimated: limbs bend only in a part of a take.
SIGNATURE_COVERAGE_FRACTION = 0.9
# Quantiles of the heights, and the number of standard deviations between them.
LOW_HEIGHT_QUANTILE = 0.05
HIGH_HEIGHT_QUANTILE = 0.95
HEIGHT_QUANTILE_WIDTH_SD = 3.29
# Number of samples, evenly spread, that are compared with a signature.
MAX_COMPARED_SAMPLES = 60


@dataclass(frozen=True)
class SignatureMatch:
    """How well samples match the signature of a marker.

    Attributes:
        distance_sd: Root mean square deviation of the distances to the partners, in standard deviations.
        side_sd: Deviation of the height above the plane of three markers, in standard deviations. 0 if no plane is known,
            or if the distances do not match at all.
        distance_error_m: Root mean square deviation of the distances in metres.
        partners: Indices of the partners.
    """

    distance_sd: float
    side_sd: float
    distance_error_m: float
    partners: tuple[int, ...]


class RigidSignatures:
    """The signatures of the markers of a take."""

    def __init__(self, markers: Float[np.ndarray, "T M 3"]):
        """Estimate the signatures from world positions in metres, NaN where missing."""
        self.markers = markers
        self.sampled_frames = np.unique(np.linspace(0, len(markers) - 1, MAX_SIGNATURE_FRAMES).astype(int))
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
        coordinates, is_affected = _sample_coordinates(self.sampled_markers), np.isin(np.arange(count), changed)
        for m in changed:
            is_affected |= self.distance_sd_m[m] < MAX_SIGNATURE_SD_M
            distance_m, sd_m = _estimate_distances_from(m, coordinates, slice(count), SIGNATURE_COVERAGE_FRACTION)
            distance_m[m] = sd_m[m] = np.inf
            self.distance_m[m] = self.distance_m[:, m] = distance_m
            self.distance_sd_m[m] = self.distance_sd_m[:, m] = _add_motion_sd(distance_m, sd_m)
            is_affected |= self.distance_sd_m[m] < MAX_SIGNATURE_SD_M
        return is_affected

    def match_samples(
        self, frames: Int[np.ndarray, " N"], points: Float[np.ndarray, "N 3"], marker: int
    ) -> SignatureMatch | None:
        """Compare samples at the given frames with the signature of a marker; None if it has fewer than three partners."""
        pick = np.unique(np.linspace(0, len(frames) - 1, MAX_COMPARED_SAMPLES).astype(int))
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
        typical_m = _compute_known_medians(np.abs(error_m))  # the median over the frames ignores a partner's spikes
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
            marker: Index of the marker.
            candidates: Indices of the markers that may be corners.
        """
        best_separation, side_sd = 0.0, 0.0
        for corners in combinations(range(len(candidates)), 3):
            heights = compute_plane_heights(self.sampled_markers[:, marker], self.sampled_markers[:, candidates[list(corners)]])
            low, median, high = _compute_quantiles(heights[:, None])[:, 0]
            sd = np.hypot((high - low) / HEIGHT_QUANTILE_WIDTH_SD, MIN_SIGNATURE_SD_M) if np.isfinite(high) else np.inf
            if abs(median) > best_separation * sd:
                best_separation = abs(median) / sd
                height = float(_compute_known_medians(compute_plane_heights(points, others[:, corners])[:, None])[0])
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


def _compute_known_medians(values: Float[np.ndarray, "T K"]) -> Float[np.ndarray, " K"]:
    """Return what `np.nanmedian` does over the first axis, which takes ten times as long for few values."""
    ordered = np.sort(values, axis=0)  # NaN sorts last
    count = np.asarray((~np.isnan(ordered)).sum(0))
    middle = np.stack([np.maximum(count - 1, 0) // 2, count // 2])
    return np.take_along_axis(ordered, middle, axis=0).mean(0)


def _compute_rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))
