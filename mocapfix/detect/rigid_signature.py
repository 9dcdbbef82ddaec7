"""A marker's fingerprint: the distances it keeps to the markers of its segment, and on which side of them it lies.

Which distances are kept, and how well, is learnt from the take (Ringer & Lasenby 2004, "A procedure for automatically estimating
model parameters in optical motion capture"). Distances cannot tell a place from its mirror image: the signed height over the
plane of three of the markers does.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from mocapfix.detect.marker_distances import estimate_distance_statistics

MAX_SIGNATURE_FRAMES = 300  # frames at most, evenly spread, from which fingerprints are learnt
MIN_CORNER_FRAMES = 20  # of these in which the corners and the marker must be seen
MIN_SIGNATURE_SD_M = 0.004  # metres: by which even a distance on one rigid thing varies
RELATIVE_DISTANCE_SD = (
    0.04  # of a distance: by which it may vary in what the take does not show often, so that near markers count for more
)
MAX_SIGNATURE_SD_M = 0.04  # metres: a distance that varies by more tells nothing
MAX_SIGNATURE_PARTNERS, MAX_PLANE_CANDIDATES = 4, 5  # whose distances are asked, and among which three make a plane
MAX_DISTANCE_FOR_SIDE_SD = 10.0  # standard deviations of the distances, from which on the side is no matter
MIN_PARTNER_VISIBLE_FRACTION = 0.8  # part of a piece's frames in which a partner must be seen
SIGNATURE_COVERAGE_FRACTION = 0.9  # of the frames, over which a distance's spread is taken: limbs bend in a part of a take only
LOW_HEIGHT_QUANTILE, HIGH_HEIGHT_QUANTILE, HEIGHT_QUANTILE_WIDTH_SD = (
    0.05,
    0.95,
    3.29,
)  # quantiles of heights, and the standard deviations between them
MAX_COMPARED_SAMPLES = 60  # of a piece that are looked at, at most


@dataclass(frozen=True)
class SignatureMatch:
    """How well a piece bears a marker's fingerprint.

    distance  standard deviations, root mean square over the partners
    side      standard deviations, of the height over the plane of three of them; 0 where none is known, or distances are hopeless
    off       metres, root mean square over the partners
    partners  indices of those asked
    """

    distance_sd: float
    side_sd: float
    distance_error_m: float
    partners: tuple[int, ...]


class RigidSignatures:
    """The fingerprints of a take's markers (T, M, 3) in metres, NaN where not seen."""

    def __init__(self, markers: np.ndarray):
        self.markers = markers
        self.sampled_markers = markers[np.unique(np.linspace(0, len(markers) - 1, MAX_SIGNATURE_FRAMES).astype(int))]
        self.distance_m, spread = estimate_distance_statistics(self.sampled_markers, SIGNATURE_COVERAGE_FRACTION)
        self.distance_sd_m = np.hypot(spread, RELATIVE_DISTANCE_SD * np.where(np.isfinite(self.distance_m), self.distance_m, 0.0))

    def match_samples(self, frames: np.ndarray, points: np.ndarray, marker: int) -> SignatureMatch | None:
        """-> how well points (N, 3) at `frames` (N,) would do as the marker; None where fewer than three others tell."""
        pick = np.unique(np.linspace(0, len(frames) - 1, MAX_COMPARED_SAMPLES).astype(int))
        points, there = points[pick], self.markers[frames[pick]]
        near = np.argsort(self.distance_sd_m[marker], kind="stable")
        near = near[self.distance_sd_m[marker, near] < MAX_SIGNATURE_SD_M]
        near = near[(~np.isnan(there[:, near, 0])).mean(0) >= MIN_PARTNER_VISIBLE_FRACTION]
        if len(near) < 3:
            return None
        asked = near[:MAX_SIGNATURE_PARTNERS]
        miss = np.linalg.norm(there[:, asked] - points[:, None], axis=-1) - self.distance_m[marker, asked]
        off = np.nanmedian(np.abs(miss), axis=0)  # over the frames: a partner's spike has no say
        distance = _compute_rms(off / np.hypot(self.distance_sd_m[marker, asked], MIN_SIGNATURE_SD_M))
        side = (
            self._measure_side(points, there, marker, near[:MAX_PLANE_CANDIDATES]) if distance < MAX_DISTANCE_FOR_SIDE_SD else 0.0
        )
        return SignatureMatch(distance, side, _compute_rms(off), tuple(asked.tolist()))

    def _measure_side(self, points: np.ndarray, others: np.ndarray, marker: int, candidates: np.ndarray) -> float:
        """-> standard deviations: of the height over the plane that tells the sides apart best."""
        surest, side = 0.0, 0.0
        for corners in combinations(candidates, 3):
            low, usual_height, high = _compute_quantiles(
                compute_plane_heights(self.sampled_markers[:, marker], self.sampled_markers[:, corners])[:, None]
            )[:, 0]
            deviation = np.hypot((high - low) / HEIGHT_QUANTILE_WIDTH_SD, MIN_SIGNATURE_SD_M) if np.isfinite(high) else np.inf
            if abs(usual_height) > surest * deviation:
                surest = abs(usual_height) / deviation
                height = float(np.nanmedian(compute_plane_heights(points, others[:, corners])))
                side = abs(height - usual_height) / deviation
        return float(side)


def compute_plane_heights(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """-> (T,) metres: of points (T, 3) over planes of three corners (T, 3, 3), positive on the side of the right-hand normal."""
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    return np.einsum("ta,ta->t", points - a, normal) / np.maximum(np.linalg.norm(normal, axis=1), 1e-9)


def _compute_quantiles(values: np.ndarray) -> np.ndarray:
    """-> (3, N): the low, middle and high quantile of each column (T, N), NaN not counting; infinite where few are known."""
    ordered = np.sort(values, axis=0)  # NaN comes last
    known = (~np.isnan(ordered)).sum(0)
    rows = np.rint(np.outer([LOW_HEIGHT_QUANTILE, 0.5, HIGH_HEIGHT_QUANTILE], np.maximum(known - 1, 0))).astype(int)
    return np.where(known >= min(MIN_CORNER_FRAMES, len(values)), ordered[rows, np.arange(values.shape[1])], np.inf)


def _compute_rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))
