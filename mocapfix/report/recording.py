"""The recording: a take before and after, on one time line, to turn and play in rerun.

    world                 Y up, metres; the markers' names
      before              as the file labels them: grey, red where judged faulty, violet where under another's label
      unlabelled          what bears no name in the file: grey, violet where it was put under a label
      after               grey where measured, green where mended, violet where put under their own label
      skeleton            one line from each joint to its parent
    state/LABEL           what became of the marker, for those with the most faults
    missing/before|after  how many markers are not there
    error/LABEL           how far the marker was seen from the body, millimetres, for those farthest off

Everything goes in as whole columns (a list of strips, or a call per frame, takes a hundred times longer), and a frame without
a marker is a row without points, or rerun would go on showing the frame before.
"""

from collections import Counter
from pathlib import Path

import numpy as np

from mocapfix.files.output_files import replace_atomically
from mocapfix.report import recording_view
from mocapfix.report.comparison import CleaningComparison
from mocapfix.report.sample_states import (
    AMBER,
    GREEN,
    RED,
    SAMPLE_MEASURED,
    SAMPLE_RELABELLED,
    SAMPLE_STATE_NAMES,
    SAMPLE_SUSPECT,
    VIOLET,
    classify_input_samples,
    find_estimated_samples,
)
from mocapfix.skeleton import Skeleton
from mocapfix.take import Take

MAX_STATE_LANES = 20  # markers in the time line of states
# On rerun's dark ground: what was there before recedes behind what is there after.
INPUT_COLOUR, FAULTY_COLOUR, CLEANED_COLOUR, ESTIMATED_COLOUR, RELABELLED_COLOUR, RECORDING_BONE_COLOUR = (
    "#6b7480",
    "#ff4f4f",
    "#c9d0d8",
    "#2fd07a",
    "#a98bff",
    "#4f8fd6",
)
STATE_COLOURS = ("#333a43", GREEN, AMBER, VIOLET, "#4b4073", RED, RED)
RESIDUAL_CURVE_COLOURS = ("#ffb454", "#59c2ff", "#d2a6ff", "#aad94c", "#f07178", "#95e6cb")  # of the markers farthest off


def write_recording(target: Path, comparison: CleaningComparison) -> None:
    """Write a rerun recording (.rrd) of a take before and after, with the view that shows it.

    Raises WriteError where `target` cannot be written.
    """
    import rerun as rr

    before, after, joints, error = (
        comparison.input_take,
        comparison.cleaned_take,
        comparison.joint_position_world,
        comparison.residual_m,
    )
    with replace_atomically(target) as part:
        recording = rr.RecordingStream("mocapfix")
        try:
            recording.save(part, default_blueprint=recording_view.build_blueprint(before, after, joints, error))
            recording.send_recording_name(before.name)
            log = _RecordingWriter(recording, before)
            log.log_markers(comparison)
            if comparison.skeleton is not None and joints is not None:
                log.skeleton(comparison.skeleton, joints)
            log.log_sample_states(comparison.sample_states)
            log.log_missing_counts(before, after)
            if error is not None:
                log.log_residuals(error)
        finally:
            recording.disconnect()


class _RecordingWriter:
    """A recording, the time line of its columns, and the take's markers under names of their own."""

    def __init__(self, recording, take: Take):
        import rerun as rr

        self.recording = recording
        self.time_s = np.arange(take.frame_count) / take.rate
        self.frame_numbers = take.first_frame + np.arange(take.frame_count)
        labels = [*take.labels, *(take.unlabelled.labels if take.unlabelled else ())]
        counts = Counter(labels)  # a file may say one label twice
        self.point_names = [label if counts[label] == 1 else f"{label} ({m + 1})" for m, label in enumerate(labels)]
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
        recording.log("world", rr.AnnotationContext(list(enumerate(self.point_names))), static=True)

    def send_columns(self, path: str, columns, frames: slice | np.ndarray = slice(None)) -> None:
        import rerun as rr

        times = [rr.TimeColumn("time", duration=self.time_s[frames]), rr.TimeColumn("frame", sequence=self.frame_numbers[frames])]
        rr.send_columns(path, times, columns, recording=self.recording)

    def log_markers(self, comparison: CleaningComparison) -> None:
        before, after, state = comparison.input_take, comparison.cleaned_take, comparison.sample_states
        was = classify_input_samples(before.visible, state)
        self._log_points(
            "world/before",
            before,
            _select_colours(INPUT_COLOUR, {FAULTY_COLOUR: was == SAMPLE_SUSPECT, RELABELLED_COLOUR: was == SAMPLE_RELABELLED}),
            0.011,
        )
        if before.unlabelled and after.unlabelled:
            given = before.unlabelled.visible & ~after.unlabelled.visible
            colours = _select_colours(INPUT_COLOUR, {RELABELLED_COLOUR: given})
            self._log_points("world/unlabelled", before.unlabelled, colours, 0.008, first_id=len(before.labels))
        self._log_points(
            "world/after",
            after,
            _select_colours(
                CLEANED_COLOUR, {ESTIMATED_COLOUR: find_estimated_samples(state), RELABELLED_COLOUR: state == SAMPLE_RELABELLED}
            ),
            0.013,
        )

    def _log_points(self, path: str, take: Take, colours: np.ndarray, radius: float, first_id: int = 0) -> None:
        import rerun as rr

        seen = take.visible
        marker = np.broadcast_to(np.arange(first_id, first_id + seen.shape[1], dtype=np.uint16), seen.shape)
        places = take.markers[seen].astype(np.float32)
        columns = rr.Points3D.columns(positions=places, colors=colours[seen], class_ids=marker[seen])
        self.recording.log(path, rr.Points3D.from_fields(radii=radius, show_labels=False), static=True)
        self.send_columns(path, columns.partition(seen.sum(axis=1)))

    def log_skeleton(self, skeleton: Skeleton, joint_position_world: np.ndarray) -> None:
        import rerun as rr

        child = np.flatnonzero(skeleton.parents >= 0)
        bones = np.stack([joint_position_world[:, skeleton.parents[child]], joint_position_world[:, child]], axis=2)
        there = np.isfinite(bones).all(axis=(2, 3))
        self.recording.log(
            "world/skeleton",
            rr.LineStrips3D.from_fields(radii=0.007, colors=_convert_to_rgba(RECORDING_BONE_COLOUR)),
            static=True,
        )
        self.send_columns(
            "world/skeleton", rr.LineStrips3D.columns(strips=bones[there].astype(np.float32)).partition(there.sum(axis=1))
        )

    def log_sample_states(self, sample_states: np.ndarray) -> None:
        import rerun as rr

        look = rr.StateConfiguration(
            values=SAMPLE_STATE_NAMES,
            labels=(" ", *SAMPLE_STATE_NAMES[1:]),
            colors=[_convert_to_rgba(colour) for colour in STATE_COLOURS],
        )
        count = (sample_states != SAMPLE_MEASURED).sum(axis=0)
        for m in sorted(np.argsort(-count, kind="stable")[:MAX_STATE_LANES]):
            if count[m]:
                path = rr.new_entity_path(["state", self.point_names[m]])
                turns = np.flatnonzero(np.diff(sample_states[:, m], prepend=-1))
                self.recording.log(path, look, static=True)
                self.send_columns(
                    path, rr.StateChange.columns(state=[SAMPLE_STATE_NAMES[s] for s in sample_states[turns, m]]), turns
                )

    def log_missing_counts(self, input_take: Take, cleaned_take: Take) -> None:
        import rerun as rr

        for name, take, colour in (("before", input_take, RED), ("after", cleaned_take, GREEN)):
            self.recording.log(
                f"missing/{name}", rr.SeriesLines(colors=_convert_to_rgba(colour), widths=2, names=name), static=True
            )
            self.send_columns(f"missing/{name}", rr.Scalars.columns(scalars=(~take.visible).sum(axis=1).astype(float)))

    def log_residuals(self, residual_m: np.ndarray) -> None:
        import rerun as rr

        known = np.flatnonzero(np.isfinite(residual_m).any(axis=0))
        worst = known[np.argsort(-np.nanpercentile(residual_m[:, known], 95, axis=0))]
        for m, colour in zip(worst, RESIDUAL_CURVE_COLOURS, strict=False):
            path = rr.new_entity_path(["error", self.point_names[m]])
            self.recording.log(
                path, rr.SeriesLines(colors=_convert_to_rgba(colour), widths=1, names=self.point_names[m]), static=True
            )
            self.send_columns(path, rr.Scalars.columns(scalars=residual_m[:, m] * 1e3))


def _convert_to_rgba(colour: str) -> np.uint32:
    """-> "#rrggbb" as rerun takes it, 0xRRGGBBAA."""
    return np.uint32(int(colour[1:] + "ff", 16))


def _select_colours(default: str, colours: dict[str, np.ndarray]) -> np.ndarray:
    """-> (T, M) colours as rerun takes them: each where its mask (T, M) is, else the usual one."""
    return np.select(list(colours.values()), [_convert_to_rgba(colour) for colour in colours], _convert_to_rgba(default))
