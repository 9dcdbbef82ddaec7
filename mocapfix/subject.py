"""A subject: one person's bones and the places of the markers on them."""

from dataclasses import dataclass, field

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
    joint_sd    (J,) metres: standard deviation per axis by which calibration's own error displaces the joint, poses giving
                way; 0 for a nominal body, whose error nobody knows
    marker_sd   (K,) metres: the same of the marker as the body places it
    """

    skeleton: Skeleton
    marker_set: str
    labels: tuple[str, ...]
    joints: np.ndarray
    marker_offsets: np.ndarray
    marker_spread: np.ndarray
    frame_count: int = 0
    joint_sd: np.ndarray = field(default_factory=lambda: np.zeros(0))
    marker_sd: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self):
        for name, count in (("joint_sd", len(self.skeleton.names)), ("marker_sd", len(self.labels))):
            if not len(getattr(self, name)):
                object.__setattr__(self, name, np.zeros(count))
