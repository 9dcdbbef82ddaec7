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

    Raises TakeError where no frame shows three markers or more, or the markers lie as on no body that there is.
    """
    start, markers = average(worn, marker_set, body), worn.markers
    looked = frames.candidates(markers)
    motion = refine.posed(start, body, prior, markers[looked])
    chosen = frames.varied(motion.rotations, np.random.default_rng(0))
    found = refine.refined(start, body, prior, markers[looked[chosen]], motion.at(chosen))
    check_size(worn, found.skeleton.size / body.skeleton.size)
    return found


def average(worn: Take, marker_set: MarkerSet, body: Body) -> Subject:
    """-> the average body at the size that the take tells, from where `subject` sets out; raises as it does."""
    if not ((~np.isnan(worn.markers[..., 0])).sum(1) >= 3).any():
        raise TakeError(f"{worn.name}: no frame shows three markers of the body; there is nothing to calibrate from.")
    ratio = size.ratio(body.skeleton, marker_set, worn.markers)
    check_size(worn, ratio)
    places = marker_set.places * ratio
    whole = scaled(body.skeleton, ratio)
    return Subject(whole, marker_set.name, marker_set.labels, marker_set.joints, places, marker_set.spread)


def check_size(worn: Take, ratio: float) -> None:
    """Raise TakeError where nobody is so many times the size of the average body."""
    if not size.SMALLEST < ratio < size.LARGEST:
        apart = "near together" if ratio < 1 else "far apart"
        raise TakeError(f"{worn.name}: the markers lie too {apart} for a person's; are the file's unit and the labels right?")


def scaled(skeleton: Skeleton, factor: float) -> Skeleton:
    """-> the skeleton with every length times `factor`."""
    return replace(skeleton, offsets=skeleton.offsets * factor, ends=skeleton.ends * factor)
