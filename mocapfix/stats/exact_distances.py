"""Distances between points that are constant to the resolution of the file, and what measures them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from mocapfix.kernels.function_screening import measure_pair_sds
from mocapfix.stats.sequences import sample_evenly

# Numbers of frames, evenly spread: in which points are compared, and by which it is decided what is worth comparing.
MAX_FUNCTION_FRAMES = 240
MAX_SCREENED_FRAMES = 20
# Number of comparisons of a point with another. Of more than 1,400 points, each is compared with those that are nearest to it.
MAX_COMPARED_PAIRS = 2_000_000
# Fraction of the frames in which a point and its parents must be visible, and number of them.
MIN_COMMON_FRAME_FRACTION = 0.2
MIN_COMMON_FRAMES = 10
# Largest median distance of a point from its function, in multiples of the resolution, and the least such limit in metres.
MAX_MISFIT_RESOLUTIONS = 3.0
MIN_MISFIT_LIMIT_M = 2e-6
# Largest such distance in the screening by functions of the right form, in multiples of that limit.
EXACT_SCREENING_LIMITS = 5.0
# Number of measured markers with which a point moves that is placed on their segment, and standard deviation of the distances.
MIN_CARRIERS = 3
MAX_CARRIER_SD_M = 0.002
SCREENED_CARRIER_SD_M = 0.004  # in the frames of the screening
# Coarsest resolution in metres at which exact distances differ from those of a rigid segment.
MAX_EXACT_RESOLUTION_M = 5e-6
# Smallest median deviation of a coordinate in metres of a point that moves.
MIN_TRAVEL_M = 0.01


@dataclass(frozen=True)
class PartnerDistances:
    """How steady the distances of each point to others are.

    Attributes:
        partner: Indices (P, K) of the points, rising, with which each of P points is compared.
        sd_m: Robust standard deviations of the distances; infinite where two are rarely seen together and for one and itself.
    """

    partner: Int[np.ndarray, "P K"]
    sd_m: Float[np.ndarray, "P K"]

    def get_group_sd(self, points: Float[np.ndarray, "T P 3"], group: Sequence[int] | Int[np.ndarray, " n"]) -> np.ndarray:
        """Return the standard deviations (n, n) within a group of the compared `points`."""
        if self.partner.shape[1] == len(self.partner):
            return self.sd_m[np.array(group)[:, None], group]
        return measure_distance_sd(points[:, group])


def compare_points(points: Float[np.ndarray, "T P 3"]) -> PartnerDistances:
    """Compare each point with all others or, of many points, with those that are nearest to it in its median position."""
    count = points.shape[1]
    if count * (count - 1) <= MAX_COMPARED_PAIRS:
        return PartnerDistances(np.broadcast_to(np.arange(count), (count, count)), measure_distance_sd(points))
    from scipy.spatial import KDTree  # few takes need it

    centre = compute_known_median(points)
    seen = np.flatnonzero(np.isfinite(centre[:, 0]))
    near = min(len(seen), MAX_COMPARED_PAIRS // count)
    partner = np.tile(np.arange(near), (count, 1))  # of points that are never seen: any
    partner[seen] = np.sort(seen[KDTree(centre[seen]).query(centre[seen], near)[1].reshape(-1, near)], axis=1)
    rows = np.repeat(np.arange(count), near)
    sd_m = measure_pair_distance_sd(points, rows, partner.ravel()).reshape(count, near)
    return PartnerDistances(partner, np.where(partner == np.arange(count)[:, None], np.inf, sd_m))


def find_exactly_rigid_points(
    points: Float[np.ndarray, "T P 3"], resolution_m: float, partners: PartnerDistances | None = None
) -> Bool[np.ndarray, " P"]:
    """Find the points that keep their distances to each other exactly, as the landmarks do that a program places on a segment.

    They are no parents of a function if they move with three or more other points. All are false if they are the majority: then
    the whole take was solved, and its markers are all alike.

    Args:
        points: Positions in metres, NaN where missing.
        resolution_m: Smallest difference that the coordinates resolve.
        partners: The points in few frames, compared by `compare_points`, by which pairs are screened.
    """
    is_visible = ~np.isnan(points[..., 0]).all(0)
    if resolution_m > MAX_EXACT_RESOLUTION_M or len(points) < MIN_COMMON_FRAMES:
        return np.zeros_like(is_visible)
    sampled = points[sample_evenly(len(points), MAX_FUNCTION_FRAMES)]
    partners = partners or compare_points(sampled[sample_evenly(len(sampled), MAX_SCREENED_FRAMES)])
    limit_m = max(MAX_MISFIT_RESOLUTIONS * resolution_m, MIN_MISFIT_LIMIT_M)
    is_exact = np.zeros_like(is_visible)
    row, column = np.nonzero(partners.sd_m <= EXACT_SCREENING_LIMITS * limit_m)
    one, other = row, partners.partner[row, column]
    exact_pair = measure_pair_distance_sd(sampled, one, other) <= limit_m
    is_exact[one[exact_pair]] = is_exact[other[exact_pair]] = True
    if not is_exact.any() or 2 * is_exact.sum() > is_visible.sum():
        return np.zeros_like(is_visible)
    row, column = np.nonzero(is_exact[:, None] & ~is_exact[partners.partner] & (partners.sd_m < SCREENED_CARRIER_SD_M))
    is_carrier = measure_pair_distance_sd(sampled, row, partners.partner[row, column]) < MAX_CARRIER_SD_M
    has_carriers = np.bincount(row[is_carrier], minlength=len(is_exact)) >= MIN_CARRIERS
    travel_m = compute_known_median(np.abs(sampled - compute_known_median(sampled))).max(1)
    return is_exact & has_carriers & np.isfinite(travel_m) & (travel_m > MIN_TRAVEL_M)


def measure_distance_sd(points: Float[np.ndarray, "T P 3"]) -> Float[np.ndarray, "P P"]:
    """Return a robust standard deviation of the distances between points; infinite where they are rarely seen together."""
    one, other = np.triu_indices(points.shape[1], 1)
    sd_m = np.full((points.shape[1], points.shape[1]), np.inf)
    sd_m[one, other] = sd_m[other, one] = measure_pair_distance_sd(points, one, other)
    return sd_m


def measure_pair_distance_sd(
    points: Float[np.ndarray, "T P 3"], one: Int[np.ndarray, " N"], other: Int[np.ndarray, " N"]
) -> Float[np.ndarray, " N"]:
    """Return what `measure_distance_sd` does, for N pairs of points."""
    min_count = max(2, int(np.ceil(MIN_COMMON_FRAME_FRACTION * len(points))))
    return measure_pair_sds(np.ascontiguousarray(points.transpose(2, 1, 0), float), one, other, min_count)


def compute_known_median(values: Shaped[np.ndarray, "T ..."]) -> Shaped[np.ndarray, "..."]:
    """Return the medians over the first axis without NaN; infinite where nothing is known."""
    ordered = np.sort(values, axis=0)  # NaN sorts last
    count = (~np.isnan(ordered)).sum(0)
    middle = np.take_along_axis(ordered, np.maximum(count - 1, 0)[None] // 2, axis=0)[0]
    return np.where(count > 0, middle, np.inf)
