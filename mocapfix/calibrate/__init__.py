"""Calibration: this person's bones and marker places, from the take alone."""

from dataclasses import replace

import numpy as np

from mocapfix.calibrate import frames, refine, size
from mocapfix.errors import TakeError
from mocapfix.marker_set import MarkerSet
from mocapfix.prior import Prior
from mocapfix.skeleton import Body, Skeleton
from mocapfix.subject import Subject
from mocapfix.take import Take


def subject(worn: Take, marker_set: MarkerSet, body: Body, prior: Prior) -> Subject:
    """-> bone lengths and marker places that, with each frame's own pose, explain the take best.

    worn  the take's markers in the marker set's order (K of them), NaN where not seen or not believed

    Raises TakeError where no frame shows three markers or more.
    """
    markers = worn.markers
    if not ((~np.isnan(markers[..., 0])).sum(1) >= 3).any():
        raise TakeError(f"{worn.name}: no frame shows three markers of the body; there is nothing to calibrate from.")
    whole = scaled(body.skeleton, size.ratio(body.skeleton, marker_set, markers))
    places = marker_set.places * (whole.offsets[4, 1] / body.skeleton.offsets[4, 1])
    start = Subject(whole, marker_set.name, marker_set.labels, marker_set.joints, places, marker_set.spread)
    looked = frames.candidates(markers)
    motion = refine.posed(start, body, prior, markers[looked])
    chosen = frames.varied(motion.rotations, np.random.default_rng(0))
    return refine.refined(start, body, prior, markers[looked[chosen]], motion.at(chosen))


def scaled(skeleton: Skeleton, factor: float) -> Skeleton:
    """-> the skeleton with every length times `factor`."""
    return replace(skeleton, offsets=skeleton.offsets * factor, ends=skeleton.ends * factor)
