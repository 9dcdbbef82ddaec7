"""Distances between points that are constant to the resolution of the file, and what measures them."""

import numpy as np
from jaxtyping import Bool, Float, Shaped

from mocapfix.stats.sequences import sample_evenly

# Number of frames, evenly spread, in which points are compared.
MAX_FUNCTION_FRAMES = 240
# Fraction of the frames in which a point and its parents must be visible, and number of them.
MIN_COMMON_FRAME_FRACTION = 0.2
MIN_COMMON_FRAMES = 10
# Largest median distance of a point from its function, in multiples of the resolution, and the least such limit in metres.
MAX_MISFIT_RESOLUTIONS = 3.0
MIN_MISFIT_LIMIT_M = 2e-6
# Number of measured markers with which a point moves that is placed on their segment, and standard deviation of the distances.
MIN_CARRIERS = 3
MAX_CARRIER_SD_M = 0.002
# Coarsest resolution in metres at which exact distances differ from those of a rigid segment.
MAX_EXACT_RESOLUTION_M = 5e-6
# Smallest median deviation of a coordinate in metres of a point that moves.
MIN_TRAVEL_M = 0.01


def find_exactly_rigid_points(points: Float[np.ndarray, "T P 3"], resolution_m: float) -> Bool[np.ndarray, " P"]:
    """Find the points that keep their distances to each other exactly, as the landmarks do that a program places on a segment.

    They are no parents of a function if they move with three or more other points. All are false if they are the majority: then
    the whole take was solved, and its markers are all alike.

    Args:
        points: Positions in metres, NaN where missing.
        resolution_m: Smallest difference that the coordinates resolve.
    """
    is_visible = ~np.isnan(points[..., 0]).all(0)
    if resolution_m > MAX_EXACT_RESOLUTION_M or len(points) < MIN_COMMON_FRAMES:
        return np.zeros_like(is_visible)
    sampled = points[sample_evenly(len(points), MAX_FUNCTION_FRAMES)]
    sd_m = measure_distance_sd(sampled)
    is_exact = (sd_m <= max(MAX_MISFIT_RESOLUTIONS * resolution_m, MIN_MISFIT_LIMIT_M)).any(1)
    if not is_exact.any() or 2 * is_exact.sum() > is_visible.sum():
        return np.zeros_like(is_visible)
    has_carriers = (np.where(is_exact, np.inf, sd_m) < MAX_CARRIER_SD_M).sum(1) >= MIN_CARRIERS
    travel_m = compute_known_median(np.abs(sampled - compute_known_median(sampled))).max(1)
    return is_exact & has_carriers & np.isfinite(travel_m) & (travel_m > MIN_TRAVEL_M)


def measure_distance_sd(points: Float[np.ndarray, "T P 3"]) -> Float[np.ndarray, "P P"]:
    """Return a robust standard deviation of the distances between points; infinite where they are rarely seen together."""
    distance = np.linalg.norm(points[:, :, None] - points[:, None], axis=-1)
    sd_m = 1.5 * compute_known_median(np.abs(distance - compute_known_median(distance)))
    is_seen = (~np.isnan(distance)).sum(0) >= max(2, MIN_COMMON_FRAME_FRACTION * len(points))
    sd_m = np.where(is_seen, sd_m, np.inf)
    np.fill_diagonal(sd_m, np.inf)
    return sd_m


def compute_known_median(values: Shaped[np.ndarray, "T ..."]) -> Shaped[np.ndarray, "..."]:
    """Return the medians over the first axis without NaN; infinite where nothing is known."""
    ordered = np.sort(values, axis=0)  # NaN sorts last
    count = (~np.isnan(ordered)).sum(0)
    middle = np.take_along_axis(ordered, np.maximum(count - 1, 0)[None] // 2, axis=0)[0]
    return np.where(count > 0, middle, np.inf)
