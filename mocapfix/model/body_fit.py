"""The body fit: a calibrated subject, the columns of its markers in a take, and the motion that was solved from them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mocapfix.model.motion import Motion, PoseEvidence
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take


@dataclass(frozen=True)
class SubjectInTake:
    """A calibrated subject, and where its markers are in a take.

    Attributes:
        subject: The calibrated subject.
        extended_subject: The same with one more marker for every further place of a moved marker: K markers.
        marker_columns: The column of each of these in `Detected.epochs`, -1 where it has none.
        take: The samples that the solver uses, of the K markers.
    """

    subject: Subject
    extended_subject: Subject
    marker_columns: Int[np.ndarray, " K"]
    take: Take


@dataclass(frozen=True)
class BodyFit(SubjectInTake):
    """A subject and its motion.

    Attributes:
        motion: Its poses, one a frame.
        joint_positions: Metres, Y up.
        marker_positions: Metres: where the body carries its markers.
        evidence: What the solver needs to know of a solution to improve it; None for a preview, which is not solved.
    """

    motion: Motion
    joint_positions: Float[np.ndarray, "T J 3"]
    marker_positions: Float[np.ndarray, "T K 3"]
    evidence: PoseEvidence | None

    @property
    def solved_joint_positions(self) -> Float[np.ndarray, "T J 3"]:
        """The joint positions in metres, NaN for joints that the markers do not show."""
        return np.where(self.subject.solved_joints[:, None], self.joint_positions, np.nan)
