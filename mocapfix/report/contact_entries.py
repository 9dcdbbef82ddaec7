"""The report's keys of contacts with the floor."""

from typing import TypedDict


class FloorEntry(TypedDict):
    """The floor on which the feet stand.

    height_m         of its lowest level above the file's height 0, at the origin
    tilt_deg         angle with the horizontal; 0 if the places of the feet show none
    level_heights_m  heights of all levels at the origin, rising: more than one on steps, stairs and boxes
    """

    height_m: float
    tilt_deg: float
    level_heights_m: list[float]


class JointContactEntry(TypedDict):
    """The contacts of one joint: their number, time, and share of the take.

    inferred    number of contacts in which the joint is not seen for some time
    inferred_s  how long, in all contacts together
    """

    contacts: int
    seconds: float
    share: float
    inferred: int
    inferred_s: float


class HeldFeetEntry(TypedDict):
    """What was done to standing feet: the option --feet, the farthest that a heel or a ball of a foot was moved, and for how long
    a foot was not held, since that would have moved what visible markers show."""

    mode: str
    largest_displacement_mm: float
    yielded_s: float


class GaitEventEntry(TypedDict):
    """An event of gait.

    time_s  seconds after the first frame
    frame   the same in the file's own frame numbers, with a fraction
    source  "markers", "joints" of an animation, "file" if the file has it already, or "force plate"
    """

    side: str
    event: str
    time_s: float
    frame: float
    source: str


class EventDisagreementEntry(GaitEventEntry):
    """An event of gait, and how much later (ms) another source, which counts less, gives it."""

    other_source: str
    delay_ms: float


class GaitEntry(TypedDict):
    """Steps: a foot strikes within 0.2 to 1.2 s of a strike of the other foot.

    strikes                number of foot strikes by side
    steps                  number of steps
    cadence_steps_per_min  by the median duration of a step; None for fewer than four steps
    """

    strikes: dict[str, int]
    steps: int
    cadence_steps_per_min: float | None


class ContactSection(TypedDict):
    """Contacts of the body with the floor.

    floor   None if no foot stands
    joints  the joints that can be in contact: LeftFoot stands for the heel, LeftToeBase for the ball of the foot, LeftLeg for
            the knee, LeftHand for the wrist; without entries if the feet are not seen
    """

    floor: FloorEntry | None
    joints: dict[str, JointContactEntry]
    feet: HeldFeetEntry
    gait: GaitEntry
    events: list[GaitEventEntry]
    event_disagreements: list[EventDisagreementEntry]
