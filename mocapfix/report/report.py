"""The JSON report of a cleaned take: typed sections with stable keys. `report.build_report` builds them."""

from typing import Any, NotRequired, TypedDict

from mocapfix.labels.label_summary import LabellingSection
from mocapfix.model.faults import FaultKind
from mocapfix.model.stage_timer import PartTime
from mocapfix.model.take import ComputedEvidence


class FloorEntry(TypedDict):
    """The floor on which the feet stand."""

    height_m: float  # of its lowest level above the file's height 0, at the origin
    tilt_deg: float  # angle with the horizontal; 0 if the places of the feet show none
    level_heights_m: list[float]  # heights of all levels at the origin, rising: more than one on steps, stairs and boxes


class JointContactEntry(TypedDict):
    """The contacts of one joint: their number, time, and share of the take."""

    contacts: int
    seconds: float
    share: float
    probability: float | None  # mean over the frames in contact
    inferred: int  # number of contacts in which the joint is not seen for some time
    inferred_s: float  # how long, in all contacts together


class HeldFeetEntry(TypedDict):
    """What was done to standing feet: the option --feet, the farthest that a heel or a ball of a foot was moved, and for how long
    a foot was not held, since that would have moved what visible markers show.
    """

    mode: str
    largest_displacement_mm: float
    yielded_s: float


class GaitEventEntry(TypedDict):
    """An event of gait."""

    side: str
    event: str
    time_s: float  # seconds after the first frame
    frame: float  # the same in the file's own frame numbers, with a fraction
    source: str  # "markers", "joints" of an animation, "file" if the file has it already, or "force plate"


class EventDisagreementEntry(GaitEventEntry):
    """An event of gait, and how much later (ms) another source, which counts less, gives it."""

    other_source: str
    delay_ms: float


class GaitEntry(TypedDict):
    """Steps: a foot strikes within 0.2 to 1.2 s of a strike of the other foot."""

    strikes: dict[str, int]  # number of foot strikes by side
    steps: int  # number of steps
    cadence_steps_per_min: float | None  # by the median duration of a step; None for fewer than four steps


class ContactSection(TypedDict):
    """Contacts of the body with the floor.

    Attributes:
        joints: The joints that can be in contact: LeftFoot stands for the heel, LeftToeBase for the ball of the foot, LeftLeg for
            the knee, LeftFingerBase for the wrist, Hips for the seat, Spine1 for the back; no entries if feet are not seen.
    """

    floor: FloorEntry | None  # none if no foot stands
    joints: dict[str, JointContactEntry]
    feet: HeldFeetEntry
    gait: GaitEntry
    events: list[GaitEventEntry]
    event_disagreements: list[EventDisagreementEntry]


class ErrorSummary(TypedDict):
    """Mean and 95th percentile in millimetres; None without values."""

    mean: float | None
    p95: float | None


class ResidualSummary(ErrorSummary):
    """Distances of the inlier markers from the body, also by marker label."""

    by_marker: dict[str, ErrorSummary]


class ComputedPointEntry(TypedDict):
    """A position in the file that a program computed from markers."""

    label: str
    recognised_by: ComputedEvidence  # "name" (also if the file lists it as computed), or "function" of markers
    computed_from: list[str]  # labels of the markers from which it follows; without entries if that is not known
    updated: int  # number of its samples that were filled or computed again


class UpAxisEntry(TypedDict):
    """The up axis of the file, from what it is known, and whether other axes are far less likely."""

    axis: str
    basis: str
    certain: bool


class RigidGroupEntry(TypedDict):
    """A group of markers outside the solved body that keep their distances, such as a prop."""

    name: str
    markers: list[str]
    spread_mm: float  # largest variation of a distance between two of them, as a standard deviation


class TakeSection(TypedDict):
    """The input file.

    Attributes:
        computed_points: The positions in the file that a program computed from markers, if there are any.
    """

    file: str
    person: NotRequired[str]  # subject whose markers these are, in a take of several subjects
    frames: int
    first_frame: int
    rate_hz: float
    markers: int
    marker_set: str | None  # none if no marker set matches
    labels: list[str]
    up_axis: NotRequired[UpAxisEntry]  # the axis of the file that points up
    labelling: NotRequired[LabellingSection]
    computed_points: NotRequired[list[ComputedPointEntry]]
    animation: NotRequired[bool]  # true if the points are the joints of an animation
    laboratory: NotRequired[str]  # what suggests that the take is that of a laboratory


class FaultEntry(TypedDict):
    """A fault; frame numbers are the file's own, inclusive."""

    kind: FaultKind
    marker: str
    first: int
    last: int
    severity_m: float | None  # None for a gap without a second edge and for rotations
    severity_deg: NotRequired[float | None]  # for rotations of a joint
    confidence: float
    reason: str


class SubjectSection(TypedDict):
    """The calibrated subject."""

    marker_set: str
    frames: int  # number of frames used for the calibration
    bones_m: dict[str, float]  # length from the parent by solved joint
    spread_m: dict[str, float]  # standard deviation of the marker on its segment by label


class PriorEntry(TypedDict):
    """A pose prior, and the factor of its standard deviations."""

    name: str
    scale: float


class SolveSection(TypedDict):
    """The solve.

    Attributes:
        joint_deviation_mm: Predicted standard deviation per axis by joint; without numbers for joints that are not solved.
        lost_in_sight: Number of frames in which a part of the body lies more than 60 mm from at least three of its markers that
            are seen and keep possible distances from one another, by part; without entries if there are none. A frame counts for
            one part of a limb: with the arm, not also with its forearm.
    """

    marker_residual_mm: ResidualSummary
    solved_joints: list[str]  # the joints that the markers show; the others stay at rest
    joint_deviation_mm: dict[str, ErrorSummary]
    start: str  # method that initialises each pose
    prior: PriorEntry | None  # pose prior for occluded limbs; None without one
    iterations_mean: float
    lost_in_sight: dict[str, int]
    status: dict[str, int]  # number of frames by final status


class UnfilledEntry(TypedDict):
    """An interval that stays empty; frame numbers are the file's own, inclusive."""

    marker: str
    first: int
    last: int
    reason: str


class LeftEmptyEntry(TypedDict):
    """The samples of a marker that stay empty: their number, and how many of them for each reason."""

    marker: str
    samples: int
    reasons: dict[str, int]


class FillSection(TypedDict):
    """Numbers of samples."""

    missing_before: int  # missing in the input
    filled: int  # estimated where the correctly labelled input has no sample
    replaced: int  # faulty and replaced by an estimate
    relabelled: int  # measured, but under another label in the input
    left_empty: int  # missing in the output
    unfilled: list[UnfilledEntry]  # the empty intervals
    left_by_marker: list[LeftEmptyEntry]  # the same by marker, those with the most samples first


class InspectionReport(TypedDict):
    """Report of a take that was inspected only."""

    take: TakeSection
    faults: list[FaultEntry]
    notes: list[str]


class Report(TypedDict):
    """Report of a cleaned take."""

    take: TakeSection
    faults: list[FaultEntry]
    changes: list[dict[str, Any]]  # as in the changes file
    subject: SubjectSection | None  # None without a body
    solve: SolveSection | None  # None without a body
    fill: FillSection
    contacts: NotRequired[ContactSection]  # contacts with the floor, of a take or an animation with a body
    rigid_groups: NotRequired[list[RigidGroupEntry]]  # props; without a body also segments that are rigid, if there are any
    arguments: NotRequired[list[str]]  # the input and the options of `mocapfix clean`, files relative to the folder of the report
    corrections: NotRequired[list[dict[str, Any]]]  # those of the reviewer that were made, as in the changes file
    seconds: dict[str, float]  # time by stage, and "total"
    times: dict[str, PartTime]  # the same by part, such as "solve/poses", with processor time
    notes: list[str]  # sentences on what else needs attention


class MultiSubjectReport(TypedDict):
    """Reports of a take of several subjects, by name."""

    people: dict[str, Report]
