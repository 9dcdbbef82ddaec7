"""A subject: one person's bones and the places of the markers on them."""

from dataclasses import dataclass

import numpy as np

from mocapfix.skeleton import Skeleton


@dataclass(frozen=True)
class Subject:
    """What calibration finds and a second take of the same person can be given.

    skeleton    this person's skeleton, lengths in metres
    marker_set  the name of the marker set the places come from
    labels      K marker labels as the marker set names them
    joints      (K,) index of the joint each marker rides on
    places      (K, 3) metres: the marker in its joint's axes
    spread      (K,) metres: how far the marker strays from its place on average over the calibration frames
    frames      how many frames the calibration used; 0 for a nominal body
    """

    skeleton: Skeleton
    marker_set: str
    labels: tuple[str, ...]
    joints: np.ndarray
    places: np.ndarray
    spread: np.ndarray
    frames: int = 0
