"""A subject: one person's bones and the positions of the markers on them."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from mocapfix.skeleton import Skeleton


@dataclass(frozen=True)
class Subject:
    """The result of a calibration, which can be reused for other takes of the same person.

    skeleton        this person's skeleton, lengths in metres
    marker_set      the name of the marker set
    labels          K marker labels as the marker set names them
    joints          (K,) index of the joint to which each marker is attached
    marker_offsets  (K, 3) m: the position of each marker relative to its joint, in the joint's own axes
    marker_spread   (K,) m: the typical distance per axis of the marker from its offset over the calibration frames
    frame_count     number of frames used for calibration; 0 for a nominal body
    joint_sd        (J,) m: standard deviation per axis of the joint position due to the calibration error, after the poses have
                    adapted; 0 for a nominal body, whose error is unknown
    marker_sd       (K,) m: the same for the marker as the body places it
    """

    skeleton: Skeleton
    marker_set: str
    labels: tuple[str, ...]
    joints: Int[np.ndarray, " K"]
    marker_offsets: Float[np.ndarray, "K 3"]
    marker_spread: Float[np.ndarray, " K"]
    frame_count: int = 0
    joint_sd: Float[np.ndarray, " J"] = field(default_factory=lambda: np.zeros(0))
    marker_sd: Float[np.ndarray, " K"] = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        for name, count in (("joint_sd", len(self.skeleton.names)), ("marker_sd", len(self.labels))):
            if not len(getattr(self, name)):
                object.__setattr__(self, name, np.zeros(count))
