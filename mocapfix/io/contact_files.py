"""The files of contacts and of events of gait (docs/contacts.md): both are written, contacts are also read."""

import json
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from mocapfix.contacts.contacts import CONTACT_JOINTS, OTHER_CONTACT_JOINTS, BodyContacts
from mocapfix.errors import SceneError, format_name_list
from mocapfix.io.files import replace_atomically
from mocapfix.model.motion import FRAME_TOLERANCE

EVENT_COLUMNS = ("time_s", "frame", "side", "event", "source")


def read_contacts(path: Path, frame_count: int) -> Mapping[str, Bool[np.ndarray, " T"]]:
    """Return when joints are in contact, by their names, from a file as `write_contacts` writes it.

    Raises:
        SceneError: If the file is invalid or has frames that the animation lacks. The message names the joint.
    """
    from pydantic import NonNegativeInt, TypeAdapter

    from mocapfix.io.yaml_files import read_validated_yaml

    model = TypeAdapter(dict[str, list[tuple[NonNegativeInt, NonNegativeInt]]])
    contacts, known = dict[str, Bool[np.ndarray, " T"]](), (*CONTACT_JOINTS, *OTHER_CONTACT_JOINTS)
    for joint, ranges in read_validated_yaml(model.validate_python, path).items():
        if joint not in known:
            raise SceneError(f"{path}: {joint}: a file of contacts has no such joint; its joints are {format_name_list(known)}.")
        contacts[joint] = np.zeros(frame_count, bool)
        for first, last in ranges:
            if not first <= last < frame_count:
                raise SceneError(
                    f"{path}: {joint}: [{first}, {last}] is no first and last frame of a contact; frames are counted from 0, and "
                    f"the animation's last one is {frame_count - 1}."
                )
            contacts[joint][first : last + 1] = True
    return contacts


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
