"""Write the contacts of a body as JSON, and the events of gait as CSV.

walk.contacts.json   {"LeftFoot": [[first, last], ...], "LeftToeBase": ..., ...}: frames of walk.bvh, from 0, inclusive.
                     LeftFoot stands for the heel, LeftToeBase for the ball of the foot; also knees (LeftLeg) and wrists
                     (LeftHand), where the body has them
walk.events.csv      time_s (after the first frame), frame (the file's own, with a fraction), side, event, source
"""

import json
import math
from pathlib import Path

from mocapfix.contacts.contacts import BodyContacts
from mocapfix.files.output_files import replace_atomically
from mocapfix.write.resampling import FRAME_TOLERANCE

EVENT_COLUMNS = ("time_s", "frame", "side", "event", "source")


def write_contacts(target: Path, contacts: BodyContacts, rate: float) -> None:
    """Write the contacts of every joint as intervals of frames at `rate` frames per second. Raises WriteError."""
    intervals = {joint: list_intervals_at_rate(contacts, joint, rate) for joint in contacts.joints}
    with replace_atomically(target) as part:
        part.write_text(json.dumps(intervals, indent=1) + "\n", encoding="utf-8")


def list_intervals_at_rate(contacts: BodyContacts, joint: str, rate: float) -> list[tuple[int, int]]:
    """Return the contacts of a joint as (first, last) frames at another rate; contacts between two frames are left out."""
    step = rate / contacts.rate
    scaled = [
        (math.ceil(first * step - FRAME_TOLERANCE), math.floor(last * step + FRAME_TOLERANCE))
        for first, last in contacts.list_intervals(joint)
    ]
    return [(first, last) for first, last in scaled if first <= last]


def write_gait_events(target: Path, contacts: BodyContacts, first_frame: int) -> None:
    """Write the events of gait; `first_frame` is the file's number of its first frame. Raises WriteError."""
    lines = [",".join(EVENT_COLUMNS)]
    for event in contacts.events:
        frame = first_frame + event.time_s * contacts.rate
        lines.append(f"{event.time_s:.4f},{frame:.2f},{event.side},{event.kind},{event.source}")
    with replace_atomically(target) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")
