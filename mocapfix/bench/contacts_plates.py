"""Benchmark of gait events: those from markers compared with force plates, on captures that have both.

The plates and the events of the file are hidden from the cleaning. Only loads by one foot that stands on its plate with heel and
toes count.
"""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

import mocapfix
from mocapfix.animation import Animation
from mocapfix.contacts.contacts import FOOT_JOINTS, BodyContacts
from mocapfix.contacts.foot_points import FootPoints, build_foot_points
from mocapfix.contacts.plate_contacts import PlateContact, find_plate_contacts
from mocapfix.contacts.standing import compute_speed
from mocapfix.errors import MocapfixError
from mocapfix.files.layouts import C3dLayout
from mocapfix.files.option_choices import FEET_OFF
from mocapfix.options import CleanOptions
from mocapfix.read.capture import read_capture
from mocapfix.read.force_plates import read_force_plates
from mocapfix.solve import kinematics
from mocapfix.write.c3d_events import HEADER_EVENT_COUNT

if TYPE_CHECKING:
    from mocapfix.result import CleaningResult

HIDDEN_GROUPS = {b"FORCE_PLATFORM": b"HIDDEN_PLATFOR", b"EVENT": b"HIDEV"}
"""names of the groups of the plates and of events, and others of the same length"""
MAX_EVENT_ERROR_S = 0.15
"""Time from an event of a plate up to which an event of markers is the same."""
JUDGED_MARGIN_S = 0.3
"""Time before and after a load in which frames are compared."""
RULE_HEIGHT_M, RULE_SPEED_M_S = 0.114, 0.93
"""The height-and-speed rule: below both an ankle or a toe base is in contact (UnderPressure, 2022, baseline)."""


@dataclass(frozen=True)
class PlateEventError:
    """An event of a plate, and how much later that of the markers is; NaN where the markers have none."""

    capture: str
    side: str
    kind: str
    error_ms: float


@dataclass(frozen=True)
class PlateAgreement:
    """Frames about loads in which a foot is in contact: by the plate, by a method, and by both."""

    capture: str
    method: str
    true_frames: int
    found_frames: int
    common_frames: int


def measure_plate_events(
    captures: Path, report_progress: Callable[[str], None] = lambda _: None
) -> tuple[list[PlateEventError], list[PlateAgreement]]:
    """Return the errors of events and the agreement of frames, for every C3D file in a folder that has usable loads.

    captures  a folder, or a file; files that cannot be cleaned with a body are left out
    """
    errors, agreements = list[PlateEventError](), list[PlateAgreement]()
    for path in sorted(captures.glob("*.c3d")) if captures.is_dir() else [captures]:
        report_progress(path.name)
        try:
            result = clean_without_plates(path)
        except MocapfixError:
            continue
        if result is None or result.contacts is None or result.subject is None or not result.contacts.has_feet:
            continue
        loads = find_loads(path, result)
        errors += [each for load in loads for each in compare_events(path.stem, load, result.contacts)]
        agreements += [each for load in loads for each in compare_frames(path.stem, load, result)]
    return errors, agreements


def clean_without_plates(path: Path) -> "CleaningResult | None":
    """Return the result for a copy of a C3D file that hides its plates and events; None for a file without plates."""
    data = path.read_bytes()
    capture = read_capture(path)
    layout = None if isinstance(capture, Animation) else capture.layout
    if not isinstance(layout, C3dLayout) or not read_force_plates(data, layout, capture.rate):
        return None
    with TemporaryDirectory() as folder:
        hidden = Path(folder) / path.name
        shutil.copyfile(path, hidden)
        head = data[:HEADER_EVENT_COUNT] + bytes(2) + data[HEADER_EVENT_COUNT + 2 : layout.data_start_byte]
        for name, other in HIDDEN_GROUPS.items():
            head = head.replace(name, other)
        hidden.write_bytes(head + data[layout.data_start_byte :])
        return mocapfix.clean(hidden, CleanOptions().change(feet=FEET_OFF))


def find_loads(path: Path, result: "CleaningResult") -> list[PlateContact]:
    """Return the loads of the plates of a capture by single feet that stand on them."""
    assert result.contacts is not None
    layout = result.input_take.layout
    assert isinstance(layout, C3dLayout)
    plates = read_force_plates(path.read_bytes(), layout, result.input_take.rate)
    return find_plate_contacts(plates, get_foot_points(result), result.contacts.floor, result.contacts.rate)


def get_foot_points(result: "CleaningResult") -> dict[str, FootPoints]:
    """Return the heel and the toes of each foot of a result."""
    subject, motion, take = result.subject, result.motion, result.relabelled_take
    assert subject is not None
    assert motion is not None
    assert result.contacts is not None
    _, body_markers = kinematics.compute_joint_and_marker_positions(subject, motion)
    markers = np.full(body_markers.shape, np.nan)
    for k, label in enumerate(subject.labels):
        if label in take.bare_labels:
            markers[:, k] = take.markers[:, take.bare_labels.index(label)]
    return dict(build_foot_points(subject, motion, markers, body_markers, result.contacts.is_known))


def compare_events(capture: str, load: PlateContact, contacts: BodyContacts) -> list[PlateEventError]:
    """Return how far the events from markers are from those of a load."""
    errors: list[PlateEventError] = []
    for kind, time_s in (("foot strike", load.strike_s), ("foot off", load.off_s)):
        if np.isnan(time_s):
            continue
        late_s = [each.time_s - time_s for each in contacts.events if (each.side, each.kind) == (load.side, kind)]
        nearest_s = min(late_s, key=abs, default=np.nan)
        errors.append(
            PlateEventError(capture, load.side, kind, 1e3 * nearest_s if abs(nearest_s) <= MAX_EVENT_ERROR_S else np.nan)
        )
    return errors


def compare_frames(capture: str, load: PlateContact, result: "CleaningResult") -> list[PlateAgreement]:
    """Return in how many frames about a load the foot is in contact by the plate, by the events, and by a simple rule."""
    contacts = result.contacts
    assert contacts is not None
    frame_s = np.arange(len(contacts.is_contact)) / contacts.rate
    strike_s, off_s = np.nan_to_num(load.strike_s, nan=-np.inf), np.nan_to_num(load.off_s, nan=np.inf)
    is_judged = (frame_s >= strike_s - JUDGED_MARGIN_S) & (frame_s <= off_s + JUDGED_MARGIN_S)
    is_loaded = (frame_s >= strike_s) & (frame_s <= off_s)
    found = {"events": find_contact_between_events(contacts, load.side), "height and speed": apply_simple_rule(result, load.side)}
    return [
        PlateAgreement(
            capture,
            method,
            int(is_loaded[is_judged].sum()),
            int(is_found[is_judged].sum()),
            int((is_loaded & is_found)[is_judged].sum()),
        )
        for method, is_found in found.items()
    ]


def find_contact_between_events(contacts: BodyContacts, side: str) -> Bool[np.ndarray, " T"]:
    """Return the frames from each strike of a foot to its next off; the take may begin and end in contact."""
    frame_s = np.arange(len(contacts.is_contact)) / contacts.rate
    own = [event for event in contacts.events if event.side == side]
    if not own:
        return contacts.find_foot_contact(side)
    is_contact = np.zeros(len(frame_s), bool)
    start_s = -np.inf if own[0].kind == "foot off" else np.nan
    for event in own:
        if event.kind == "foot strike":
            start_s = event.time_s
        else:
            is_contact |= (frame_s >= start_s) & (frame_s <= event.time_s)
            start_s = np.nan
    return is_contact | (frame_s >= start_s)


def apply_simple_rule(result: "CleaningResult", side: str) -> Bool[np.ndarray, " T"]:
    """Return the frames in which the height-and-speed rule finds the ankle or the toe base of a foot in contact."""
    position, contacts, subject = result.joint_position_world, result.contacts, result.subject
    assert position is not None
    assert contacts is not None
    assert subject is not None
    is_contact = np.zeros(len(position), bool)
    for joint in FOOT_JOINTS[side]:
        path: Float[np.ndarray, "T 3"] = position[:, subject.skeleton.find_joint(joint)]
        is_low = contacts.floor.compute_height_above(path) < RULE_HEIGHT_M
        is_contact |= is_low & (compute_speed(path, contacts.rate) < RULE_SPEED_M_S)
    return is_contact


def compute_frame_f1(agreements: Sequence[PlateAgreement], method: str) -> float:
    """Return the F1 by frame of a method over all loads; NaN without any."""
    own = [each for each in agreements if each.method == method]
    total = sum(each.true_frames + each.found_frames for each in own)
    return 2 * sum(each.common_frames for each in own) / total if total else np.nan
