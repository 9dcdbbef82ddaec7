"""A subject: one person's bones and the positions of the markers on them."""

from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.model.skeleton import BodyModel, Skeleton, load_cmu31_body, restrict_body


@dataclass(frozen=True)
class Subject:
    """The result of a calibration, which can be reused for other takes of the same person.

    Attributes:
        skeleton: This person's skeleton, lengths in metres.
        marker_set: The name of the marker set.
        labels: K marker labels as the marker set names them.
        joints: Index of the joint to which each marker is attached.
        marker_offsets: Metres: the position of each marker relative to its joint, in the joint's own axes.
        marker_spread: Metres: the typical distance per axis of the marker from its offset over the calibration frames.
        frame_count: Number of frames used for calibration; 0 for a nominal body.
        joint_sd: Metres: standard deviation per axis of the joint position due to the calibration error, after the poses have
            adapted; 0 for a nominal body, whose error is unknown.
        marker_sd: Metres: the same for the marker as the body places it.
        notes: Sentences for the reports of the takes that are cleaned with the subject.
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
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, count in (("joint_sd", len(self.skeleton.names)), ("marker_sd", len(self.labels))):
            if not len(getattr(self, name)):
                object.__setattr__(self, name, np.zeros(count))

    @property
    def body_model(self) -> BodyModel:
        """The average body as far as the markers of the subject show it."""
        return restrict_body(load_cmu31_body(), set(self.joints.tolist()))

    @property
    def solved_joints(self) -> Bool[np.ndarray, " J"]:
        """The joints (J,) whose positions the markers of the subject determine."""
        return self.body_model.solved_joints

    def select_markers(self, labels: Collection[str]) -> "Subject":
        """Return the subject with those of its markers that are among `labels`."""
        kept = [k for k, label in enumerate(self.labels) if label in labels]
        return replace(
            self,
            labels=tuple(self.labels[k] for k in kept),
            joints=self.joints[kept],
            marker_offsets=self.marker_offsets[kept],
            marker_spread=self.marker_spread[kept],
            marker_sd=self.marker_sd[kept],
        )
