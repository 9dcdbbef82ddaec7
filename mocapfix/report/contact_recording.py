"""Contacts with the floor in a rerun recording.

Entities:

    world/contacts       joints while they are in contact: orange, pale where the contact is inferred
    world/floor/N        a grid on each level of the floor, around the places at which joints are in contact with it
    contacts/left-heel   when each joint is in contact, as a lane of states
    events               events of gait, as a log
"""

from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from mocapfix.contacts.contacts import BodyContacts
from mocapfix.contacts.floor import Floor
from mocapfix.report.contact_timeline import CONTACT_NAMES

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

CONTACT_COLOUR = 0xFF9F40FF
INFERRED_CONTACT_COLOUR = 0xFFD9B0FF
FLOOR_COLOUR = 0x59636EFF
CONTACT_POINT_RADIUS_M = 0.03
FLOOR_LINE_RADIUS_M = 0.003
GRID_SPACING_M = 0.5
GRID_MARGIN_M = 0.5
"""Distance from the places of contacts to the edge of the grid, at least."""
MAX_GRID_LINES = 200
"""Lines of a grid in each direction; of a larger one the spacing is wider."""
CONTACT_STATES = ("none", "inferred", "contact")
STATE_RGBA = np.array([0x333A43FF, INFERRED_CONTACT_COLOUR, CONTACT_COLOUR], np.uint32)


@runtime_checkable
class TakeRecording(Protocol):
    """A recording with the time columns of a take."""

    recording: "rr.RecordingStream"
    time_s: Float[np.ndarray, " T"]
    frame_numbers: Int[np.ndarray, " T"]

    def send_columns(self, path: str, columns: "rr.ComponentColumnList", frames: slice | np.ndarray = ...) -> None:
        """Send columns with one row for each of `frames`."""
        ...


def log_contacts(writer: TakeRecording, contacts: BodyContacts, position: Float[np.ndarray, "T C 3"]) -> None:
    """Log the contacts, whose joints are at `position` (T, C, 3) in metres, the floor and the events."""
    _log_contact_points(writer, contacts, position)
    for level, lines in enumerate(build_floor_grids(contacts, position)):
        _log_floor(writer, f"world/floor/{level + 1}", lines)
    _log_contact_states(writer, contacts)
    _log_events(writer, contacts)


def _log_contact_points(writer: TakeRecording, contacts: BodyContacts, position: Float[np.ndarray, "T C 3"]) -> None:
    import rerun as rr

    is_contact = contacts.is_contact & np.isfinite(position).all(-1)
    colours = np.where(contacts.is_known, CONTACT_COLOUR, INFERRED_CONTACT_COLOUR).astype(np.uint32)
    columns = rr.Points3D.columns(positions=position[is_contact].astype(np.float32), colors=colours[is_contact])
    writer.recording.log("world/contacts", rr.Points3D.from_fields(radii=CONTACT_POINT_RADIUS_M), static=True)
    writer.send_columns("world/contacts", columns.partition(is_contact.sum(axis=1)))


def _log_floor(writer: TakeRecording, path: str, lines: Float[np.ndarray, "N 2 3"]) -> None:
    import rerun as rr

    strips = rr.LineStrips3D(lines.astype(np.float32), radii=FLOOR_LINE_RADIUS_M, colors=np.uint32(FLOOR_COLOUR))
    writer.recording.log(path, strips, static=True)


def build_floor_grids(contacts: BodyContacts, position: Float[np.ndarray, "T C 3"]) -> list[Float[np.ndarray, "N 2 3"]]:
    """Return the lines (N, 2, 3) in metres of a grid on each level of the floor, under the joints that are in contact with it.

    position  (T, C, 3) m: of the joints
    """
    floor = contacts.floor
    points = position[contacts.is_contact & np.isfinite(position).all(-1)]
    if not len(points) or not floor.level_heights_m:
        return []
    height = points[:, 1] - floor.slope_x * points[:, 0] - floor.slope_z * points[:, 2]
    level = np.abs(height[:, None] - np.array(floor.level_heights_m)).argmin(1)
    grids = (_build_grid(floor, n, points[level == n]) for n in range(len(floor.level_heights_m)) if (level == n).any())
    return list(grids)


def _build_grid(floor: Floor, level: int, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "N 2 3"]:
    """Return the lines of a grid under points on one level."""
    low, high = points[:, [0, 2]].min(0) - GRID_MARGIN_M, points[:, [0, 2]].max(0) + GRID_MARGIN_M
    spacing = max(GRID_SPACING_M, float((high - low).max()) / MAX_GRID_LINES)
    x, z = (np.arange(np.floor(a / spacing), np.ceil(b / spacing) + 1) * spacing for a, b in zip(low, high, strict=True))
    along_z = np.stack([np.column_stack([x, np.full(len(x), end)]) for end in (z[0], z[-1])], axis=1)
    along_x = np.stack([np.column_stack([np.full(len(z), end), z]) for end in (x[0], x[-1])], axis=1)
    ends = np.concatenate([along_z, along_x])
    height = floor.level_heights_m[level] + floor.slope_x * ends[..., 0] + floor.slope_z * ends[..., 1]
    return np.stack([ends[..., 0], height, ends[..., 1]], axis=-1)


def _log_contact_states(writer: TakeRecording, contacts: BodyContacts) -> None:
    """Log the changes of state of each joint that is ever in contact."""
    import rerun as rr

    style = rr.StateConfiguration(values=CONTACT_STATES, labels=(" ", *CONTACT_STATES[1:]), colors=STATE_RGBA)
    for column in np.flatnonzero(contacts.is_contact.any(0)):
        state = np.where(contacts.is_contact[:, column], 1 + contacts.is_known[:, column], 0)
        starts = np.flatnonzero(np.diff(state, prepend=-1))
        path = f"contacts/{CONTACT_NAMES[contacts.joints[column]].replace(' ', '-')}"
        writer.recording.log(path, style, static=True)
        writer.send_columns(path, rr.StateChange.columns(state=[CONTACT_STATES[s] for s in state[starts]]), starts)


def _log_events(writer: TakeRecording, contacts: BodyContacts) -> None:
    import rerun as rr

    if not contacts.events:
        return
    time_s = np.array([event.time_s for event in contacts.events])
    frame = np.rint(time_s * contacts.rate).astype(int) + writer.frame_numbers[0]
    texts = [f"{event.side} {event.kind}, from {event.source}" for event in contacts.events]
    times = [rr.TimeColumn("time", duration=time_s), rr.TimeColumn("frame", sequence=frame)]
    columns = rr.TextLog.columns(text=texts, level=["INFO"] * len(texts))
    rr.send_columns("events", times, columns, recording=writer.recording)


def build_contact_views(contacts: BodyContacts) -> "list[rrb.View]":
    """Return the views of the contacts' lanes and of the events, as far as there are any."""
    import rerun.blueprint as rrb

    views: list[rrb.View] = []
    if contacts.is_contact.any():
        views.append(rrb.StateTimelineView(origin="contacts", name="Contacts with the floor"))
    if contacts.events:
        views.append(rrb.TextLogView(origin="events", name="Events of gait"))
    return views
