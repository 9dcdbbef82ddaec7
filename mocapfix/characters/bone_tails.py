"""Tails of bones whose file does not give them: where their children are."""

import numpy as np
from jaxtyping import Float

MIN_TAIL_FRACTION = 0.5
"""of the distance of a bone's farthest child: nearer children, such as a thumb, do not count for its tail"""


def compute_tail(children: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " 3"]:
    """Return the tail of a bone with children at these positions in its axes: the mean of those that are far from its head.

    It is NaN if no child is at a distance from the head.
    """
    distances = np.linalg.norm(children, axis=1)
    is_far = (distances > MIN_TAIL_FRACTION * distances.max(initial=0.0)) & (distances > 0)
    return children[is_far].mean(0) if is_far.any() else np.full(3, np.nan)
