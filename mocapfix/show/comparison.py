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

from mocapfix.files import replacing
from mocapfix.show import view
from mocapfix.show.cleaning import Cleaning
from mocapfix.show.states import AMBER, DOUBTED, GREEN, MEASURED, RED, RELABELLED, STATES, VIOLET, former, mended
from mocapfix.skeleton import Skeleton
from mocapfix.take import Take

LANES = 20  # markers in the time line of states
# On rerun's dark ground: what was there before recedes behind what is there after.
BEFORE, FAULTY, AFTER, MENDED, OTHER, BONE = "#6b7480", "#ff4f4f", "#c9d0d8", "#2fd07a", "#a98bff", "#4f8fd6"
STATE_COLOURS = ("#333a43", GREEN, AMBER, VIOLET, "#4b4073", RED, RED)
CURVE_COLOURS = ("#ffb454", "#59c2ff", "#d2a6ff", "#aad94c", "#f07178", "#95e6cb")  # of the markers farthest off


def comparison(target: Path, cleaning: Cleaning) -> None:
    """Write a rerun recording (.rrd) of a take before and after, with the view that shows it.

    Raises WriteError where `target` cannot be written.
    """
    import rerun as rr

    before, after, joints, error = cleaning.before, cleaning.after, cleaning.joints, cleaning.error
    with replacing(target) as part:
        recording = rr.RecordingStream("mocapfix")
        try:
            recording.save(part, default_blueprint=view.blueprint(before, after, joints, error))
            recording.send_recording_name(before.name)
            log = _Columns(recording, before)
            log.markers(cleaning)
            if cleaning.skeleton is not None and joints is not None:
                log.skeleton(cleaning.skeleton, joints)
            log.states(cleaning.state)
            log.missing(before, after)
            if error is not None:
                log.errors(error)
        finally:
            recording.disconnect()


class _Columns:
    """A recording, the time line of its columns, and the take's markers under names of their own."""

    def __init__(self, recording, take: Take):
        import rerun as rr

        self.recording = recording
        self.seconds = np.arange(take.frames) / take.rate
        self.numbers = take.first_frame + np.arange(take.frames)
        labels = [*take.labels, *(take.unlabelled.labels if take.unlabelled else ())]
        counts = Counter(labels)  # a file may say one label twice
        self.names = [label if counts[label] == 1 else f"{label} ({m + 1})" for m, label in enumerate(labels)]
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
        recording.log("world", rr.AnnotationContext(list(enumerate(self.names))), static=True)

    def send(self, path: str, columns, frames: slice | np.ndarray = slice(None)) -> None:
        import rerun as rr

        times = [rr.TimeColumn("time", duration=self.seconds[frames]), rr.TimeColumn("frame", sequence=self.numbers[frames])]
        rr.send_columns(path, times, columns, recording=self.recording)

    def markers(self, cleaning: Cleaning) -> None:
        before, after, state = cleaning.before, cleaning.after, cleaning.state
        was = former(before.seen, state)
        self._points("world/before", before, _coloured(BEFORE, {FAULTY: was == DOUBTED, OTHER: was == RELABELLED}), 0.011)
        if before.unlabelled and after.unlabelled:
            given = before.unlabelled.seen & ~after.unlabelled.seen
            colours = _coloured(BEFORE, {OTHER: given})
            self._points("world/unlabelled", before.unlabelled, colours, 0.008, first_id=len(before.labels))
        self._points("world/after", after, _coloured(AFTER, {MENDED: mended(state), OTHER: state == RELABELLED}), 0.013)

    def _points(self, path: str, take: Take, colours: np.ndarray, radius: float, first_id: int = 0) -> None:
        import rerun as rr

        seen = take.seen
        marker = np.broadcast_to(np.arange(first_id, first_id + seen.shape[1], dtype=np.uint16), seen.shape)
        places = take.markers[seen].astype(np.float32)
        columns = rr.Points3D.columns(positions=places, colors=colours[seen], class_ids=marker[seen])
        self.recording.log(path, rr.Points3D.from_fields(radii=radius, show_labels=False), static=True)
        self.send(path, columns.partition(seen.sum(axis=1)))

    def skeleton(self, skeleton: Skeleton, joints: np.ndarray) -> None:
        import rerun as rr

        child = np.flatnonzero(skeleton.parents >= 0)
        bones = np.stack([joints[:, skeleton.parents[child]], joints[:, child]], axis=2)
        there = np.isfinite(bones).all(axis=(2, 3))
        self.recording.log("world/skeleton", rr.LineStrips3D.from_fields(radii=0.007, colors=_rgba(BONE)), static=True)
        self.send("world/skeleton", rr.LineStrips3D.columns(strips=bones[there].astype(np.float32)).partition(there.sum(axis=1)))

    def states(self, state: np.ndarray) -> None:
        import rerun as rr

        look = rr.StateConfiguration(values=STATES, labels=(" ", *STATES[1:]), colors=[_rgba(colour) for colour in STATE_COLOURS])
        count = (state != MEASURED).sum(axis=0)
        for m in sorted(np.argsort(-count, kind="stable")[:LANES]):
            if count[m]:
                path = rr.new_entity_path(["state", self.names[m]])
                turns = np.flatnonzero(np.diff(state[:, m], prepend=-1))
                self.recording.log(path, look, static=True)
                self.send(path, rr.StateChange.columns(state=[STATES[s] for s in state[turns, m]]), turns)

    def missing(self, before: Take, after: Take) -> None:
        import rerun as rr

        for name, take, colour in (("before", before, RED), ("after", after, GREEN)):
            self.recording.log(f"missing/{name}", rr.SeriesLines(colors=_rgba(colour), widths=2, names=name), static=True)
            self.send(f"missing/{name}", rr.Scalars.columns(scalars=(~take.seen).sum(axis=1).astype(float)))

    def errors(self, error: np.ndarray) -> None:
        import rerun as rr

        known = np.flatnonzero(np.isfinite(error).any(axis=0))
        worst = known[np.argsort(-np.nanpercentile(error[:, known], 95, axis=0))]
        for m, colour in zip(worst, CURVE_COLOURS, strict=False):
            path = rr.new_entity_path(["error", self.names[m]])
            self.recording.log(path, rr.SeriesLines(colors=_rgba(colour), widths=1, names=self.names[m]), static=True)
            self.send(path, rr.Scalars.columns(scalars=error[:, m] * 1e3))


def _rgba(colour: str) -> np.uint32:
    """-> "#rrggbb" as rerun takes it, 0xRRGGBBAA."""
    return np.uint32(int(colour[1:] + "ff", 16))


def _coloured(usual: str, colours: dict[str, np.ndarray]) -> np.ndarray:
    """-> (T, M) colours as rerun takes them: each where its mask (T, M) is, else the usual one."""
    return np.select(list(colours.values()), [_rgba(colour) for colour in colours], _rgba(usual))
