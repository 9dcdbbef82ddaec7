"""Shared motion: whether a deviation of a marker is shared by its neighbours.

A strike, a landing or a whirled limb bends the paths of all markers of a segment at once, and where the solved body is wrong,
the whole limb lies off it. A fault of the samples concerns one marker. So a deviation that several neighbours have in the
same direction is motion, or an error of the body, and no fault of the marker. So is one in which a segment turns: its markers
deviate in different directions and keep their distances.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

# Smallest cosine of the angle between two deviations that are alike.
MIN_SHARED_COSINE = 0.8
# Smallest and largest length of a neighbour's deviation, relative to the marker's own, of deviations that are alike.
MIN_SHARED_LENGTH_RATIO = 0.25
MAX_SHARED_LENGTH_RATIO = 4.0
# Number of neighbours with deviations that are alike: a fault of one neighbour may agree by chance.
MIN_SHARING_NEIGHBOURS = 2
# Largest difference between two deviations that are almost equal, relative to the marker's own deviation.
MAX_EQUAL_DIFFERENCE_RATIO = 0.3
# With fewer neighbours visible, one with an almost equal deviation is sufficient.
MIN_COMPARED_NEIGHBOURS = 3
# Largest change of the distances between the markers of a rigid segment that is struck, in metres.
MAX_RIGID_CHANGE_M = 0.0015
# Number of neighbours by which the noise of a marker is explained.
MAX_EXPLAINING_NEIGHBOURS = 4
# Smallest fraction of the frames in which such a neighbour is visible.
MIN_EXPLAINING_FRACTION = 0.8


def find_shared_deviations(own: Float[np.ndarray, "N 3"], neighbours: Float[np.ndarray, "N K 3"]) -> Bool[np.ndarray, " N"]:
    """Find the deviations of a marker that its neighbours share.

    Args:
        own: Deviations of the marker in metres.
        neighbours: Deviations of K neighbours in metres at the same times, NaN where unknown.
    """
    own_length, length = np.linalg.norm(own, axis=-1)[:, None], np.linalg.norm(neighbours, axis=-1)
    product = np.einsum("nx,nkx->nk", own, neighbours)
    is_similar = (
        (product > MIN_SHARED_COSINE * own_length * length)
        & (length > MIN_SHARED_LENGTH_RATIO * own_length)
        & (length < MAX_SHARED_LENGTH_RATIO * own_length)
    )
    is_equal = np.linalg.norm(neighbours - own[:, None], axis=-1) < MAX_EQUAL_DIFFERENCE_RATIO * own_length
    has_few_neighbours = (~np.isnan(length)).sum(1) < MIN_COMPARED_NEIGHBOURS
    return (is_similar.sum(1) >= MIN_SHARING_NEIGHBOURS) | (has_few_neighbours & is_equal.any(1))


def find_rigid_deviations(
    own: Float[np.ndarray, "N 3 3"], neighbours: Float[np.ndarray, "N 3 K 3"], fraction: Float[np.ndarray, " N"]
) -> Bool[np.ndarray, " N"]:
    """Find the deviations of a marker in which a rigid segment moves with it: a struck hand turns as well.

    The markers of a turning segment deviate in different directions and keep their distances. That a neighbour deviates as well
    and three markers keep their distances is no coincidence of faults.

    Args:
        own: Positions of the marker in metres: before, at and after each deviation.
        neighbours: Positions of K neighbours in metres at the same times, NaN where missing.
        fraction: The time of the deviation as a fraction of the time from before to after.
    """
    own_length = np.linalg.norm(_measure_bend(own, fraction), axis=-1)
    length = np.linalg.norm(_measure_bend(neighbours, fraction), axis=-1)
    is_moved = length > MIN_SHARED_LENGTH_RATIO * own_length[:, None]
    distance = np.linalg.norm(neighbours - own[:, :, None], axis=-1)
    is_kept = np.abs(_measure_bend(distance, fraction)) < MAX_RIGID_CHANGE_M
    mutual = np.linalg.norm(neighbours[:, :, :, None] - neighbours[:, :, None], axis=-1)
    is_pair_kept = np.abs(_measure_bend(mutual, fraction)) < MAX_RIGID_CHANGE_M
    is_other = ~np.eye(neighbours.shape[2], dtype=bool)
    is_triangle = is_other & is_pair_kept & is_kept[:, :, None] & is_kept[:, None] & (is_moved[:, :, None] | is_moved[:, None])
    return np.any(is_triangle, axis=(1, 2))


def _measure_bend(values: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """Return the difference (N, ...) of middle values from those interpolated between the first and the last (N, 3, ...)."""
    first, middle, last = values[:, 0], values[:, 1], values[:, 2]
    share = fraction.reshape(len(values), *[1] * (first.ndim - 1))
    return middle - (1 - share) * first - share * last


def compute_weighted_deviations(
    markers: Float[np.ndarray, "T M 3"],
    frames: Int[np.ndarray, " N"],
    fitted_frames: Int[np.ndarray, "N S"],
    weight: Float[np.ndarray, "N S"],
) -> Float[np.ndarray, "N M 3"]:
    """Compute the deviations of markers in some frames from weighted means of their positions in other frames.

    Args:
        markers: World positions in metres, NaN where missing.
        frames: Frame indices.
        fitted_frames: For each of these, S other frame indices.
        weight: The weights of the positions there; their sum is 1.

    Returns:
        The deviations in metres, NaN where a sample with a weight is missing.
    """
    is_used = weight != 0
    around = np.where(is_used[..., None, None], markers[fitted_frames], 0.0)
    return markers[frames] - np.einsum("ns,nsmx->nmx", weight, around)


def remove_shared_noise(own: Float[np.ndarray, "N 3"], neighbours: Float[np.ndarray, "N K 3"]) -> Float[np.ndarray, "N 3"]:
    """Remove from a marker's residuals what is proportional to those of its neighbours (least squares).

    Args:
        own: Residuals of the marker in metres.
        neighbours: Residuals of K neighbours in metres, the steadiest first, NaN where unknown.
    """
    is_known = ~np.isnan(neighbours[..., 0])
    columns = np.flatnonzero(is_known.mean(0) >= MIN_EXPLAINING_FRACTION)[:MAX_EXPLAINING_NEIGHBOURS]
    basis = np.nan_to_num(neighbours[:, columns]).transpose(0, 2, 1).reshape(own.size, len(columns))
    gain = np.linalg.lstsq(basis, own.ravel(), rcond=None)[0]
    return own - (basis @ gain).reshape(own.shape)
