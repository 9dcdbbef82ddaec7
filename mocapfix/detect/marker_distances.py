"""Distances between markers, learned from the take itself, and how badly a sample contradicts them.

Two markers on the same segment keep their distance (Ringer & Lasenby 2004, "A procedure for automatically estimating model
parameters in optical motion capture"). Which ones do, and how well, is estimated from the take. A sample under the wrong label
breaks the distances to its label's partners and keeps those to another marker's partners. Each partner has one bounded vote, so
that a faulty or mislabelled partner cannot outvote the others.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
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
    deviations does not matter. They are infinite for markers that are hardly ever visible together, and for a marker and itself.
    """
    frames, count = markers.shape[:2]
    centre, sd = np.full((count, count), np.inf), np.full((count, count), np.inf)
    sample = markers[np.unique(np.linspace(0, frames - 1, MAX_DISTANCE_FRAMES).astype(int))] if frames else markers
    for i in range(1, count):
        distance = np.sort(np.linalg.norm(sample[:, i, None] - sample[:, :i], axis=-1), axis=0)  # NaN sorts last
        visible_count = (~np.isnan(distance)).sum(0)
        for j in np.flatnonzero(visible_count >= max(2, min(MIN_JOINT_FRAMES, len(sample)))):
            inside = int(np.ceil(min_correct_fraction * visible_count[j]))
            width = distance[inside - 1 : visible_count[j], j] - distance[: visible_count[j] - inside + 1, j]
            start = int(np.argmin(width))
            centre[i, j] = centre[j, i] = distance[start, j] + width[start] / 2
            # the standard deviation of a normal distribution with the same central interval
            sd[i, j] = sd[j, i] = width[start] / 2 / ndtri((1 + min_correct_fraction) / 2)
    return centre, sd


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
