"""Shared motion: whether a deviation of a marker is shared by its neighbours.

A strike, a landing or a whirled limb bends the paths of all markers of a segment at once, and where the solved body is wrong,
the whole limb lies off it. A fault of the samples concerns one marker. So a deviation that several neighbours have in the
same direction is motion, or an error of the body, and no fault of the marker.
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
