"""A point as an exact function of other points: a weighted mean of them, or a place in a frame that three of them span."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

MIN_FRAME_SINE = 0.05  # least sine of an angle of three points that span a frame


@dataclass(frozen=True)
class PointFunction:
    """A point as a function of n other points: a weighted mean of them, and an offset in a frame that they span."""

    parents: tuple[int, ...]  # indices of the n points
    weights: Float[np.ndarray, " n"]  # their weights (n,), with the sum 1
    # Offset (3,) in metres along the axes of the frame; 0 if the point is a mean of its parents.
    offset_frame: Float[np.ndarray, "3"]
    # Weights (3, n) of the points in the corners of the frame. Its first axis points from the first corner to the second, its
    # third is normal to the plane of the three. None for a mean.
    corner_weights: Float[np.ndarray, "3 n"] | None = None

    def evaluate(self, parents: Float[np.ndarray, "T n 3"]) -> Float[np.ndarray, "T 3"]:
        """Return the positions of the point for positions of its parents, NaN where one is missing."""
        mean = np.einsum("n,tnx->tx", self.weights, parents)
        if self.corner_weights is None:
            return mean
        return mean + np.einsum("i,tix->tx", self.offset_frame, build_frame_axes(self.corner_weights @ parents))


def build_frame_axes(corners: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Return the axes, one a row, of the frame that three points span; NaN where they are nearly on a line."""
    first, second = corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]
    normal = np.cross(first, second)
    with np.errstate(invalid="ignore", divide="ignore"):
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        first_length = np.linalg.norm(first, axis=-1, keepdims=True)
        is_plane = length > MIN_FRAME_SINE * first_length * np.linalg.norm(second, axis=-1, keepdims=True)
        normal, first = np.where(is_plane, normal / length, np.nan), first / first_length
    return np.stack([first, np.cross(normal, first), normal], axis=-2)
