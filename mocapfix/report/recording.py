"""Rerun recording of a take before and after cleaning.

Entities:

    world                 Y up, metres, with the names of the markers
      before              input markers: grey, red if faulty, violet if under another label
      unlabelled          unlabelled trajectories: grey, violet where joined to a marker
      after               cleaned markers: grey if measured, green if estimated, violet if relabelled
      skeleton            one line from each joint to its parent
      figures/NAME        the bones of each character or robot, as large as the body, beside it
    state/SUBJECT/LABEL   outcome of each sample, for the markers with the most changes
    missing/before|after  number of missing markers
    error/SUBJECT/LABEL   distance of the marker from the body in millimetres, for the markers with the largest distances
    world/contacts        joints while they are in contact with the floor: orange, pale where the contact is inferred
    world/floor/N         a grid on each level of the floor, around the places at which joints are in contact with it
    contacts/left-heel    when each joint is in contact, as a lane of states
    events                events of gait, as a log

The time lines "time" and "frame" have the whole take; "worst moment", on which a viewer opens, has a second before and after it.

All data are sent as whole columns: strips in lists, or one call per frame, take about a hundred times longer. A frame without
markers is a row without points; without such a row rerun keeps showing the previous frame.
"""

import errno
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Bool, Float, Int, UInt32

from mocapfix.contacts.contacts import BodyContacts, Floor
from mocapfix.io.files import replace_atomically
from mocapfix.model.skeleton import Skeleton
from mocapfix.model.take import Take
from mocapfix.model.windows import iterate_blocks, select_block
from mocapfix.report.contact_sheet import ShownFigure
from mocapfix.report.sample_states import (
    AMBER,
    GREEN,
    RED,
    VIOLET,
    CleaningComparison,
    SampleOutcome,
    classify_input_samples,
    find_estimated_samples,
)
from mocapfix.report.stick_figures import MOVING_REACH_S
from mocapfix.report.timeline import CONTACT_NAMES

CONTACT_COLOUR = 0xFF9F40FF
INFERRED_CONTACT_COLOUR = 0xFFD9B0FF
FLOOR_COLOUR = 0x59636EFF
CONTACT_POINT_RADIUS_M = 0.03
FLOOR_LINE_RADIUS_M = 0.003
GRID_SPACING_M = 0.5
GRID_MARGIN_M = 0.5  # distance from the places of contacts to the edge of the grid, at least
MAX_GRID_LINES = 200  # lines of a grid in each direction; of a larger one the spacing is wider
CONTACT_STATES = ("none", "inferred", "contact")
STATE_RGBA = np.array([0x333A43FF, INFERRED_CONTACT_COLOUR, CONTACT_COLOUR], np.uint32)


def _log_contact_points(writer: "_RecordingWriter", contacts: BodyContacts, position: Float[np.ndarray, "T C 3"]) -> None:
    is_contact = contacts.is_contact & np.isfinite(position).all(-1)
    colours = np.where(contacts.is_known, CONTACT_COLOUR, INFERRED_CONTACT_COLOUR).astype(np.uint32)
    columns = rr.Points3D.columns(positions=position[is_contact].astype(np.float32), colors=colours[is_contact])
    writer.recording.log("world/contacts", rr.Points3D.from_fields(radii=CONTACT_POINT_RADIUS_M), static=True)
    writer.send_columns("world/contacts", columns.partition(is_contact.sum(axis=1)))


def build_floor_grids(contacts: BodyContacts, position: Float[np.ndarray, "T C 3"]) -> list[Float[np.ndarray, "N 2 3"]]:
    """Return the lines (N, 2, 3) in metres of a grid on each level of the floor, under the joints that are in contact with it."""
    floor = contacts.floor
    points = position[contacts.is_contact & np.isfinite(position).all(-1)]
    if not len(points) or not floor.level_heights_m:
        return []
    height = points[:, 1] - floor.slope_x * points[:, 0] - floor.slope_z * points[:, 2]
    level = np.abs(height[:, None] - np.array(floor.level_heights_m)).argmin(1)
    return [_build_grid(floor, n, points[level == n]) for n in range(len(floor.level_heights_m)) if (level == n).any()]


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


def _log_contact_states(writer: "_RecordingWriter", contacts: BodyContacts, is_shown: Bool[np.ndarray, " C"]) -> None:
    """Log the changes of state of the joints that are shown."""
    style = rr.StateConfiguration(values=CONTACT_STATES, labels=(" ", *CONTACT_STATES[1:]), colors=STATE_RGBA)
    for column in np.flatnonzero(is_shown):
        state = np.where(contacts.is_contact[:, column], 1 + contacts.is_known[:, column], 0)
        writer.log_states(f"contacts/{CONTACT_NAMES[contacts.joints[column]].replace(' ', '-')}", state, CONTACT_STATES, style)


def _log_events(writer: "_RecordingWriter", contacts: BodyContacts) -> None:
    frames = [round(event.time_s * contacts.rate) for event in contacts.events]
    shown = [n for n, frame in enumerate(frames) if writer.block.start <= frame < writer.block.stop]
    if shown:
        events, numbers = [contacts.events[n] for n in shown], np.array(frames)[shown] + writer.frame_numbers[0]
        texts = [f"{event.side} {event.kind}, from {event.source}" for event in events]
        columns = rr.TextLog.columns(text=texts, level=["INFO"] * len(texts))
        times = writer.build_times(np.array([event.time_s for event in events]), numbers)
        rr.send_columns("events", times, columns, recording=writer.recording)


MOMENT_TIMELINE = "worst moment"  # the time line on which a recording opens; the others have all frames
MAX_STATE_LANES = 20  # markers in the time line of sample states

# Colours on the dark background of rerun; input markers are darker than cleaned ones.
INPUT_COLOUR = "#6b7480"
FAULTY_COLOUR = "#ff4f4f"
CLEANED_COLOUR = "#c9d0d8"
ESTIMATED_COLOUR = "#2fd07a"
RELABELLED_COLOUR = "#a98bff"
RECORDING_BONE_COLOUR = "#4f8fd6"
FIGURE_COLOUR = "#e6b450"
STATE_COLOURS = ("#333a43", GREEN, AMBER, VIOLET, "#4b4073", RED, RED)  # by SampleOutcome
RESIDUAL_CURVE_COLOURS = ("#ffb454", "#59c2ff", "#d2a6ff", "#aad94c", "#f07178", "#95e6cb")  # one curve each

RECORDING_END = b"RRF2FOOT"
RECORDING_END_BYTES = 16  # of the end of a complete recording, among which RECORDING_END is

INPUT_POINT_RADIUS_M = 0.011
UNLABELLED_POINT_RADIUS_M = 0.008
CLEANED_POINT_RADIUS_M = 0.013
BONE_RADIUS_M = 0.007
BESIDE_M = np.array([0.8, 0.0, 0.8])  # from the body to the first figure that it moves, and from each to the next

FIELD_OF_VIEW_RAD = np.radians(55)  # rerun's vertical field of view
MAX_CAMERA_FRAMES = 1000  # frames used to place the camera
CAMERA_MARGIN_FACTOR = 1.12  # space around the body at the edges of the picture
RESIDUAL_CLIP_FACTOR = 3.0  # upper limit of the residual plot, relative to the 95th percentile


def write_recording(target: Path, comparison: CleaningComparison, figures: Sequence[ShownFigure] = ()) -> None:
    """Write a rerun recording (.rrd) of a take before and after cleaning, with the figures that it moves and its blueprint."""
    with replace_atomically(target) as part:
        recording = rr.RecordingStream("mocapfix")
        try:
            recording.save(part, default_blueprint=build_blueprint(comparison, figures))
            recording.send_recording_name(comparison.input_take.name)
            log_comparison(recording, comparison, figures)
        finally:
            recording.disconnect()
        check_recording_complete(part)


def log_comparison(recording: rr.RecordingStream, comparison: CleaningComparison, figures: Sequence[ShownFigure]) -> None:
    """Log a take before and after cleaning, a long one block by block, and its worst moment again on a time line of its own."""
    writer, length = _RecordingWriter(recording, comparison.input_take), comparison.input_take.frame_count
    states, residual_m, contacts = comparison.sample_states, comparison.residual_m, comparison.contacts
    lanes, worst = writer.prepare_state_lanes(states), [] if residual_m is None else writer.prepare_residual_curves(residual_m)
    is_joint_shown = np.array([] if contacts is None else contacts.is_contact.any(0), bool)

    def log_block(frames: slice, block: CleaningComparison) -> None:
        writer.block = frames
        writer.log_markers(block, states[frames])
        if block.skeleton is not None and block.joint_position_world is not None:
            writer.log_skeleton(block.skeleton, block.joint_position_world)
        for n, figure in enumerate(figures, start=1):
            path = f"world/figures/{name_entities([figure.character.name])[0]}"
            writer.log_bones(path, FIGURE_COLOUR, figure.locate_bones(writer.time_s[frames]) + n * BESIDE_M)
        writer.log_sample_states(states[frames], lanes)
        writer.log_missing_counts(block.input_take, block.cleaned_take)
        if block.residual_m is not None:
            writer.log_residuals(block.residual_m, worst)
        if block.contacts is not None and (position := block.locate_contacts()) is not None:
            _log_contact_points(writer, block.contacts, position)
            _log_contact_states(writer, block.contacts, is_joint_shown)
            _log_events(writer, block.contacts)

    for frames, block in iterate_blocks(comparison, length):
        log_block(frames, block)
    position = comparison.locate_contacts()
    grids = [] if contacts is None or position is None else build_floor_grids(contacts, position)
    for level, lines in enumerate(grids):
        strips = rr.LineStrips3D(lines.astype(np.float32), radii=FLOOR_LINE_RADIUS_M, colors=np.uint32(FLOOR_COLOUR))
        recording.log(f"world/floor/{level + 1}", strips, static=True)
    if length:
        writer.is_moment, moment = True, find_moment_frames(comparison)
        log_block(moment, select_block(comparison, length, moment))


def find_moment_frames(comparison: CleaningComparison) -> slice:
    """Return the frames of the worst moment: up to MOVING_REACH_S before and after it."""
    take = comparison.cleaned_take
    worst, reach = comparison.worst_moment[0] if take.visible.size else 0, round(MOVING_REACH_S * take.rate)
    return slice(max(0, worst - reach), min(take.frame_count, worst + reach + 1))


def check_recording_complete(path: Path) -> None:
    """Raise OSError if a recording has no end: rerun writes in a thread of its own, which only logs that the disk is full."""
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - RECORDING_END_BYTES, 0))
        if RECORDING_END not in file.read():
            raise OSError(errno.ENOSPC, "the recording is incomplete; is the disk full?")


class _RecordingWriter:
    """A recording with the time columns of a take and unique names of its trajectories."""

    def __init__(self, recording: rr.RecordingStream, take: Take):
        self.recording, self.block, self.is_moment = recording, slice(0, take.frame_count), False  # what is logged
        self.time_s = np.arange(take.frame_count) / take.rate
        self.frame_numbers = take.first_frame + np.arange(take.frame_count)
        labels = [*take.labels, *(take.unlabelled.labels if take.unlabelled else ())]
        counts = Counter(labels)  # a file may contain a label twice
        self.point_names = [label if counts[label] == 1 else f"{label} ({m + 1})" for m, label in enumerate(labels)]
        self.point_paths = name_entities(labels)
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
        recording.log("world", rr.AnnotationContext(list(enumerate(self.point_names))), static=True)

    def send_columns(self, path: str, columns: rr.ComponentColumnList, frames: slice | np.ndarray = slice(None)) -> None:
        """Send columns of some frames of the block."""
        time_s, numbers = self.time_s[self.block][frames], self.frame_numbers[self.block][frames]
        rr.send_columns(path, self.build_times(time_s, numbers), columns, recording=self.recording)

    def build_times(self, time_s: Float[np.ndarray, " N"], number: Int[np.ndarray, " N"]) -> list[rr.TimeColumn]:
        """Return the time lines of rows: those of the take, or that of the worst moment."""
        if self.is_moment:
            return [rr.TimeColumn(MOMENT_TIMELINE, duration=time_s)]
        return [rr.TimeColumn("time", duration=time_s), rr.TimeColumn("frame", sequence=number)]

    def log_markers(self, comparison: CleaningComparison, outcome: Int[np.ndarray, "T M"]) -> None:
        """Log input markers, unlabelled trajectories and cleaned markers."""
        before, after = comparison.input_take, comparison.cleaned_take
        input_state = classify_input_samples(before.visible, outcome)
        is_faulty, is_relabelled = (input_state == each for each in (SampleOutcome.SUSPECT, SampleOutcome.RELABELLED))
        colours = _select_colours(INPUT_COLOUR, {FAULTY_COLOUR: is_faulty, RELABELLED_COLOUR: is_relabelled})
        self._log_points("world/before", before, colours, INPUT_POINT_RADIUS_M)
        if before.unlabelled and after.unlabelled:
            colours = _select_colours(INPUT_COLOUR, {RELABELLED_COLOUR: before.unlabelled.visible & ~after.unlabelled.visible})
            path = "world/unlabelled"
            self._log_points(path, before.unlabelled, colours, UNLABELLED_POINT_RADIUS_M, first_id=len(before.labels))
        masks = {ESTIMATED_COLOUR: find_estimated_samples(outcome), RELABELLED_COLOUR: outcome == SampleOutcome.RELABELLED}
        self._log_points("world/after", after, _select_colours(CLEANED_COLOUR, masks), CLEANED_POINT_RADIUS_M)

    def _log_points(self, path: str, take: Take, colours: UInt32[np.ndarray, "T M"], radius_m: float, first_id: int = 0) -> None:
        visible = take.visible
        marker = np.broadcast_to(np.arange(first_id, first_id + visible.shape[1], dtype=np.uint16), visible.shape)
        positions = take.markers[visible].astype(np.float32)
        columns = rr.Points3D.columns(positions=positions, colors=colours[visible], class_ids=marker[visible])
        self.recording.log(path, rr.Points3D.from_fields(radii=radius_m, show_labels=False), static=True)
        self.send_columns(path, columns.partition(visible.sum(axis=1)))

    def log_skeleton(self, skeleton: Skeleton, joint_position_world: Float[np.ndarray, "T J 3"]) -> None:
        """Log one line from each joint to its parent, in the frames where both are known."""
        child = np.flatnonzero(skeleton.parents >= 0)
        parent = skeleton.parents[child]
        bones = np.stack([joint_position_world[:, parent], joint_position_world[:, child]], axis=2)
        self.log_bones("world/skeleton", RECORDING_BONE_COLOUR, bones)

    def log_bones(self, path: str, colour: str, bones: Float[np.ndarray, "T L 2 3"]) -> None:
        """Log lines, in the frames where both ends are known."""
        known = ~np.isnan(bones[..., 0]).any(axis=2)
        style = rr.LineStrips3D.from_fields(radii=BONE_RADIUS_M, colors=_convert_to_rgba(colour))
        self.recording.log(path, style, static=True)
        strips = _build_strips(bones[known].astype(np.float32))
        self.send_columns(path, rr.LineStrips3D.columns(strips=strips).partition(known.sum(axis=1)))

    def prepare_state_lanes(self, outcome: Int[np.ndarray, "T M"]) -> dict[str, int]:
        """Return the paths of the lanes of the markers with the most samples that are not simply measured."""
        count = (outcome != SampleOutcome.MEASURED).sum(axis=0)
        markers = sorted(m for m in np.argsort(-count, kind="stable")[:MAX_STATE_LANES].tolist() if count[m])
        return {f"state/{self.point_paths[m]}": m for m in markers}

    def log_sample_states(self, outcome: Int[np.ndarray, "T M"], lanes: Mapping[str, int]) -> None:
        """Log the changes of state of markers."""
        names = [each.label for each in SampleOutcome]
        colours = [_convert_to_rgba(colour) for colour in STATE_COLOURS]
        style = rr.StateConfiguration(values=names, labels=(" ", *names[1:]), colors=colours)
        for path, m in lanes.items():
            self.log_states(path, outcome[:, m], names, style)

    def log_states(self, path: str, state: Int[np.ndarray, " T"], names: Sequence[str], style: rr.StateConfiguration) -> None:
        """Log the changes of a state, given by its index among the names."""
        starts = np.flatnonzero(np.diff(state, prepend=-1))
        self.recording.log(path, style, static=True)
        self.send_columns(path, rr.StateChange.columns(state=[names[s] for s in state[starts]]), starts)

    def log_missing_counts(self, input_take: Take, cleaned_take: Take) -> None:
        """Log the number of missing markers per frame, before and after."""
        for name, take, colour in (("before", input_take, RED), ("after", cleaned_take, GREEN)):
            style = rr.SeriesLines(colors=_convert_to_rgba(colour), widths=2, names=name)
            self.recording.log(f"missing/{name}", style, static=True)
            self.send_columns(f"missing/{name}", rr.Scalars.columns(scalars=(~take.visible).sum(axis=1).astype(float)))

    def prepare_residual_curves(self, residual_m: Float[np.ndarray, "T M"]) -> list[int]:
        """Return the markers with the largest 95th percentiles of the distance from the body."""
        known = np.flatnonzero(np.isfinite(residual_m).any(axis=0))
        percentiles = [np.nanpercentile(residual_m[:, m], 95) for m in known]
        return known[np.argsort(-np.array(percentiles))][: len(RESIDUAL_CURVE_COLOURS)].tolist()

    def log_residuals(self, residual_m: Float[np.ndarray, "T M"], markers: Sequence[int]) -> None:
        """Log the distance from the body of markers."""
        for m, colour in zip(markers, RESIDUAL_CURVE_COLOURS, strict=False):
            path = f"error/{self.point_paths[m]}"
            style = rr.SeriesLines(colors=_convert_to_rgba(colour), widths=1, names=self.point_names[m])
            self.recording.log(path, style, static=True)
            self.send_columns(path, rr.Scalars.columns(scalars=residual_m[:, m] * 1e3))


def name_entities(labels: Sequence[str]) -> list[str]:
    """Return a different path for each label: parts at colons, as of a subject, without the characters that rerun escapes."""
    paths: dict[str, None] = {}
    for label in labels:
        path = "/".join(re.sub(r"[^a-zA-Z0-9_.-]+", "-", part).strip("-_") or "unnamed" for part in label.split(":"))
        paths[next(name for n in count(1) if (name := path if n == 1 else f"{path}-{n}") not in paths)] = None
    return list(paths)


def build_blueprint(comparison: CleaningComparison, figures: Sequence[ShownFigure]) -> rrb.Blueprint:
    """Return the blueprint of the recording: a 3-D view of the worst moment, which plays in a loop, beside plots."""
    moment = find_moment_frames(comparison)
    shown = slice(moment.start, moment.stop, 1 + (moment.stop - moment.start) // MAX_CAMERA_FRAMES)
    position_world = comparison.cleaned_take.markers[shown]
    if comparison.joint_position_world is not None:
        position_world = np.concatenate([position_world, comparison.joint_position_world[shown]], axis=1)
    times_s = np.arange(comparison.input_take.frame_count)[shown] / comparison.input_take.rate
    for n, figure in enumerate(figures, start=1):
        bones = figure.locate_bones(times_s) + n * BESIDE_M
        position_world = np.concatenate([position_world, bones.reshape(len(bones), -1, 3)], axis=1)
    eye, target = _compute_eye_position(position_world)
    controls = rrb.EyeControls3D(position=eye, look_target=target, eye_up=(0, 1, 0))
    body = rrb.Spatial3DView(origin="world", name=f"{comparison.input_take.name}: before and after", eye_controls=controls)
    legend = rrb.PlotLegend(rrb.Corner2D.RightTop)
    points = comparison.terms.points
    plots: list[rrb.View] = [
        rrb.StateTimelineView(origin="state", name=f"State of the {points}"),
        rrb.TimeSeriesView(origin="missing", name=f"Missing {points}", plot_legend=legend),
    ]
    residual_m = comparison.residual_m
    if residual_m is not None and np.isfinite(residual_m).any():
        axis = rrb.ScalarAxis(range=(0, RESIDUAL_CLIP_FACTOR * 1e3 * float(np.nanpercentile(residual_m, 95))), zoom_lock=False)
        name = "Largest distances from the body, mm"
        plots.append(rrb.TimeSeriesView(origin="error", name=name, axis_y=axis, plot_legend=legend))
    shares, views = [3, 1, 2][: len(plots)], list[rrb.View | rrb.Container](plots)
    if (contacts := comparison.contacts) and (contacts.is_contact.any() or contacts.events):
        lanes = [rrb.StateTimelineView(origin="contacts", name="Contacts with the floor")] * bool(contacts.is_contact.any())
        events = [rrb.TextLogView(origin="events", name="Events of gait")] * bool(contacts.events)
        shares, views = [*shares, 2], [*views, rrb.Tabs(*lanes, *events)]
    beside = rrb.Vertical(*views, row_shares=shares)
    time = rrb.TimePanel(timeline=MOMENT_TIMELINE, state="collapsed", play_state="playing", loop_mode="all")
    return rrb.Blueprint(rrb.Horizontal(body, beside, column_shares=[3, 2]), time, collapse_panels=True)


def _compute_eye_position(position_world: Float[np.ndarray, "T N 3"]) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]:
    """Return the eye and its target in metres such that all points are in a picture at least as wide as high.

    The view is perpendicular to the main direction of travel and slightly from above.
    """
    points = position_world[np.isfinite(position_world).all(axis=-1)]
    if not len(points):
        return np.array([0.0, 1.5, 4.0]), np.array([0.0, 1.0, 0.0])
    target = (points.min(axis=0) + points.max(axis=0)) / 2
    x, _, z = np.ptp(points, axis=0)
    towards = np.array([0.35, 0.3, 1.0]) if x >= z else np.array([1.0, 0.3, 0.35])
    towards /= np.linalg.norm(towards)
    right = np.cross([0.0, 1.0, 0.0], towards)
    right /= np.linalg.norm(right)
    position_eye = (points - target) @ np.stack([right, np.cross(towards, right), towards], axis=1)
    half_width = CAMERA_MARGIN_FACTOR * np.abs(position_eye[:, :2]).max(axis=1)
    return target + (position_eye[:, 2] + half_width / np.tan(FIELD_OF_VIEW_RAD / 2)).max() * towards, target


def _convert_to_rgba(colour: str) -> np.uint32:
    return np.uint32(int(colour[1:] + "ff", 16))


def _build_strips(lines: Float[np.ndarray, "N 2 3"]) -> Any:
    """Return straight lines as an Arrow array in rerun's type. Its own conversion of an array calls Python once for each line."""
    if not len(lines):
        return rr.components.LineStrip3DBatch(lines).as_arrow_array()
    strip_type = rr.components.LineStrip3DBatch(lines[:1]).as_arrow_array().type
    points = rr.encodings.Vec3DBatch(lines.reshape(-1)).as_arrow_array()
    return pa.ListArray.from_arrays(np.arange(0, 2 * len(lines) + 1, 2, dtype=np.int32), points, type=strip_type)


def _select_colours(default: str, masks: dict[str, Bool[np.ndarray, "T M"]]) -> UInt32[np.ndarray, "T M"]:
    """Return the RGBA colours of samples: of the first mask that holds, else the default."""
    return np.select(list(masks.values()), [_convert_to_rgba(colour) for colour in masks], _convert_to_rgba(default))
