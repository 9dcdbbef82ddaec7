"""The body fit: a calibrated subject, the columns of its markers in a take, and the motion that was solved from them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mocapfix.model.motion import Motion, PoseEvidence
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take


@dataclass(frozen=True)
class SubjectInTake:
    """A calibrated subject, and where its markers are in a take."""

    subject: Subject  # the calibrated subject
    extended_subject: Subject  # the same with one more marker for every further place of a moved marker: K markers
    marker_columns: Int[np.ndarray, " K"]  # the column of each of these in `Detected.epochs`, -1 where it has none
    take: Take  # the samples that the solver uses, of the K markers


@dataclass(frozen=True, order=True)
class RememberedGap:
    """Joints that are inferred from the memory of the person in some frames, and from which frames of it."""

    first: int
    last: int
    joints: tuple[int, ...]
    source: str  # as in "walk2, 0:31-0:33"


@dataclass(frozen=True)
class BodyFit(SubjectInTake):
    """A subject and its motion.

    Attributes:
        evidence: What the solver needs to know of a solution to improve it; None for a preview, which is not solved.
        remembered: Where limbs are inferred from the memory of the person.
    """

    motion: Motion  # its poses, one a frame
    joint_positions: Float[np.ndarray, "T J 3"]  # metres, Y up
    marker_positions: Float[np.ndarray, "T K 3"]  # metres: where the body carries its markers
    evidence: PoseEvidence | None
    remembered: tuple[RememberedGap, ...] = ()
    has_motion_prior: bool = False  # whether the motion prior may predict limbs that no marker shows

    @property
    def solved_joint_positions(self) -> Float[np.ndarray, "T J 3"]:
        """The joint positions in metres, NaN for joints that the markers do not show."""
        return np.where(self.subject.solved_joints[:, None], self.joint_positions, np.nan)
