"""The frames of a take in which a body is searched for: those with most points, from the lowest to those of a standing person."""

import numpy as np
from jaxtyping import Int

from mocapfix.labelling.sampled_points import SampledPoints

KEY_FRAME_COUNT = 8
"""Frames in which a body is searched for."""
KEY_FRAME_POINT_SHARE = 0.9
"""Points that such a frame shows, as a share of the 90th percentile over all frames."""
KEY_FRAME_HEIGHT_QUANTILES = (0.2, 1.0)
"""Range of the heights of these frames: the lowest show people who crouch or lie."""
STANDING_HEIGHT_QUANTILE = 0.7
"""Quantile of the heights that a standing person has; the highest are those of raised arms."""


def select_key_frames(sampled: SampledPoints) -> tuple[Int[np.ndarray, " F"], float]:
    """Return frames in which to search for a body, and the height of the standing person's points in metres."""
    count = (sampled.tracklets >= 0).sum(1)
    full = np.flatnonzero(count >= KEY_FRAME_POINT_SHARE * np.quantile(count, 0.9))
    height = sampled.positions[full, :, 1]
    height = np.nanmax(height, axis=1) - np.nanmin(height, axis=1)
    order = full[np.argsort(height, kind="stable")]
    places = np.linspace(*KEY_FRAME_HEIGHT_QUANTILES, KEY_FRAME_COUNT) * (len(order) - 1)
    return np.unique(order[places.astype(int)]), float(np.quantile(height, STANDING_HEIGHT_QUANTILE))
