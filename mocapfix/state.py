"""The state of a cleaning: everything that the stages of the pipeline have found so far.

A stage takes a `CleaningState` and returns it with more fields filled. The fields are listed in the order in which the stages
fill them. Nothing is changed in place.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from mocapfix.contacts.contacts import BodyContacts
from mocapfix.detect.moved_markers import MarkerEpochs, split_moved_markers
from mocapfix.io.changes_file import NO_REVIEW, Review
from mocapfix.labels.trajectory_segments import find_namesakes
from mocapfix.model.changes import Change, UnfilledRun
from mocapfix.model.faults import REPLACED_SAMPLE_KINDS, Fault, FaultKind, Faults
from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.motion import Motion, PoseEvidence
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.solve.frame_windows import FrameChanges
from mocapfix.solve.prior_conditioner import PriorConditioner
from mocapfix.stats.marker_distances import RigidGroup


def _accept_every_fault(fault: Fault) -> bool:
    return True


@dataclass(frozen=True)
class DetectionState:
    """The detected faults of a take, and the take with its labels corrected.

    Attributes:
        take: the take with its labels corrected.
        label_faults: faults of labels, in the order in which they were corrected.
        sample_faults: faults of samples, found under the corrected labels.
        replaced_kinds: the kinds of fault whose samples are replaced.
        body_faults: those of `sample_faults` that only the solved body showed.
        unconfirmed_shifts: marker shifts that the solved body did not confirm.
    """

    take: Take
    label_faults: tuple[Fault, ...] = ()
    sample_faults: Faults = field(default_factory=Faults)
    replaced_kinds: tuple[FaultKind, ...] = REPLACED_SAMPLE_KINDS
    body_faults: tuple[Fault, ...] = ()
    unconfirmed_shifts: tuple[Fault, ...] = ()

    @cached_property
    def faults(self) -> Faults:
        """All faults, of labels and of samples."""
        return self.sample_faults.add_faults(self.label_faults)

    @cached_property
    def inlier_mask(self) -> Bool[np.ndarray, "T M"]:
        """The samples that were measured and are not faulty."""
        return self.sample_faults.compute_inlier_mask(self.take, self.replaced_kinds) & self.take.measured

    @cached_property
    def inlier_take(self) -> Take:
        """The take with its inliers only."""
        return self.take.masked(self.inlier_mask)

    @cached_property
    def solver_mask(self) -> Bool[np.ndarray, "T M"]:
        """The samples that the solver uses (see `Faults.compute_solver_mask`)."""
        return self.sample_faults.compute_solver_mask(self.take, self.replaced_kinds) & self.take.measured

    def select_solver_take(self, marker_columns: Int[np.ndarray, " K"]) -> Take:
        """Return the samples that the solver uses, of the markers in K columns of `epochs`; -1 for a marker without samples."""
        return self.epochs.take.select(marker_columns, self.epochs.split_mask(self.solver_mask))

    @cached_property
    def donor_markers(self) -> tuple[int, ...]:
        """The markers whose labels only name fragments of other markers. They are neither judged nor filled."""
        return tuple(sorted(find_namesakes(self.take)))

    @cached_property
    def epochs(self) -> MarkerEpochs:
        """The take with a column for every place of a marker that moved on its segment."""
        return split_moved_markers(self.take, self.faults.items)


@dataclass(frozen=True)
class CalibrationFit:
    """A calibration, from which the next round of detection and calibration goes on.

    Attributes:
        subject: the calibrated subject.
        start: the average body at the size of the subject.
        unknowns: (Q,) the calibration parameters, all 0 for `start`.
        frames: (N,) indices of the calibration frames.
        markers: (N, K, 3) metres, the samples in these frames.
        root_positions: (N, 3) metres, the poses in these frames.
        local_rotations: (N, J, 3, 3), the same.
        improvement: by how much the refinement decreased its cost, relative to the result.
    """

    subject: Subject
    start: Subject
    unknowns: Float[np.ndarray, " Q"]
    frames: Int[np.ndarray, " N"]
    markers: Float[np.ndarray, "N K 3"]
    root_positions: Float[np.ndarray, "N 3"]
    local_rotations: Float[np.ndarray, "N J 3 3"]
    improvement: float


@dataclass(frozen=True)
class BodyFit:
    """A subject and its motion, solved from the inliers of a take.

    C is the number of columns of the take's `MarkerEpochs`, K the number of markers of `extended_subject`.

    Attributes:
        subject: the calibrated subject.
        extended_subject: the same with one more marker for every further place of a moved marker.
        motion: its poses, one a frame.
        marker_columns: the epoch column of each of `extended_subject`'s markers, -1 where it has none.
        joint_positions: metres, Y up.
        marker_positions: metres: where the body carries its markers.
        detection: the detection whose inliers it was solved from; None for a body that is not solved again.
        evidence: what the solver needs to know of a solution to improve it.
        contacts: when the body's joints are in contact with the floor; None before they are found.
        filling_motion: the motion from which lost markers are filled, if it is another: its standing feet are held also where
            those of `motion` yield to visible markers.
    """

    subject: Subject
    extended_subject: Subject
    motion: Motion
    marker_columns: Int[np.ndarray, " K"]
    joint_positions: Float[np.ndarray, "T J 3"]
    marker_positions: Float[np.ndarray, "T K 3"]
    detection: DetectionState | None = None
    evidence: PoseEvidence | None = None
    contacts: BodyContacts | None = None
    filling_motion: Motion | None = None

    @property
    def solved_joint_positions(self) -> Float[np.ndarray, "T J 3"]:
        """The joint positions in metres, NaN for joints that the markers do not show."""
        return np.where(self.subject.solved_joints[:, None], self.joint_positions, np.nan)

    def expand_to_take(self, epochs: MarkerEpochs) -> Float[np.ndarray, "T M 3"]:
        """Return where the body carries the take's markers, in metres; NaN for markers that it does not carry."""
        has_column = self.marker_columns >= 0
        positions = np.full(epochs.take.markers.shape, np.nan)
        positions[:, self.marker_columns[has_column]] = self.marker_positions[:, has_column]
        return epochs.merge_columns(positions)


@dataclass(frozen=True)
class FillProposal:
    """The take with every gap and faulty sample filled or emptied, before decisions are applied.

    Attributes:
        take: the filled take.
        unfilled_reasons: the reason why each sample stays empty, else "".
        methods: for each filled sample the name of its fill method, else "".
        body_markers: metres: where the solved body carries the markers; None without a body.
    """

    take: Take
    unfilled_reasons: Shaped[np.ndarray, "T M"]
    methods: Shaped[np.ndarray, "T M"]
    body_markers: Float[np.ndarray, "T M 3"] | None


@dataclass(frozen=True)
class CleaningState:
    """Everything known of the take of one subject while it is cleaned.

    Attributes:
        original_take: the take as it was read.
        detection: the faults that were found, and the take with its labels corrected.
        marker_set: the marker set of the take; None where no set fits: the take is then cleaned without a body.
        has_learned_set: whether the marker set was learned from this take; it is withdrawn where it contradicts the take.
        known_subject: the subject from an earlier calibration; None: it is calibrated from the take.
        prior_conditioner: the trained pose prior; None: no prior is used.
        review: what a reviewer decided about the changes of an earlier cleaning, and corrected.
        accepts_fault: False for a fault whose samples the reviewer decided to keep, or a marker shift that the reviewer declined.
        notes: sentences for the report.
        calibration: the calibration from the take. None where the subject is known, and after a correction of labels.
        subject: the calibrated subject, and `extended_subject` the same with the further places of moved markers.
        marker_columns: (K,) the epoch column of each marker of `extended_subject`, -1 where it has none.
        initial_motion: the poses from which the solver starts. None once it has.
        frame_changes: the frames that the solver has to solve. None once it has.
        body: the solved body.
        rigid_groups: groups of markers that are not on the body, such as props, as columns of `detection.epochs`.
        fill: the proposed fill.
        cleaned_take: the result.
        changes: every change, with its decision.
        unfilled_runs: the runs of samples that stay empty, each with the reason.
    """

    original_take: Take
    detection: DetectionState
    marker_set: MarkerSet | None = None
    has_learned_set: bool = False
    known_subject: Subject | None = None
    prior_conditioner: PriorConditioner | None = None
    review: Review = NO_REVIEW
    accepts_fault: Callable[[Fault], bool] = _accept_every_fault
    notes: tuple[str, ...] = ()
    calibration: CalibrationFit | None = None
    subject: Subject | None = None
    extended_subject: Subject | None = None
    marker_columns: Int[np.ndarray, " K"] | None = None
    initial_motion: Motion | None = None
    frame_changes: FrameChanges | None = None
    body: BodyFit | None = None
    rigid_groups: tuple[RigidGroup, ...] = ()
    fill: FillProposal | None = None
    cleaned_take: Take | None = None
    changes: tuple[Change, ...] = ()
    unfilled_runs: tuple[UnfilledRun, ...] = ()

    @property
    def solver_take(self) -> Take:
        """The samples that the solver uses, with the markers in the order of `extended_subject`. Needs `marker_columns`."""
        assert self.marker_columns is not None
        return self.detection.select_solver_take(self.marker_columns)

    @property
    def residual_m(self) -> Float[np.ndarray, "T M"] | None:
        """The distance of each inlier from its place on the solved body in metres, NaN for other samples; None without a body."""
        if self.fill is None or self.fill.body_markers is None:
            return None
        return np.linalg.norm(self.detection.inlier_take.markers - self.fill.body_markers, axis=-1)
