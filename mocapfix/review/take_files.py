"""The cleaned takes in an output folder: their approvals, and what the page of a review shows of them."""

import glob
import json
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from pydantic import Field, ValidationError

from mocapfix.errors import MocapfixError, ReadError, SceneError
from mocapfix.io.c3d import read_fill_sd
from mocapfix.io.capture import read_capture
from mocapfix.io.changes_file import CHANGES_SUFFIX
from mocapfix.io.conventions import change_convention
from mocapfix.io.files import JSON_REPORT_SUFFIX, get_source_suffixes, replace_atomically, return_free_memory
from mocapfix.io.yaml_files import ChangeModel, ChangesFileModel, StrictModel
from mocapfix.model.animation import Animation, build_tip_take
from mocapfix.model.take import Take
from mocapfix.model.windows import iterate_blocks
from mocapfix.options import CHARACTER_PRESETS, RIG_NAMES, CleanOptions, ReadOptions, parse_arguments
from mocapfix.output_formats import OPTIONAL_FORMATS
from mocapfix.report.sample_states import SampleOutcome, find_estimated_samples
from mocapfix.review.edits import hash_changes
from mocapfix.stats.sequences import find_runs, sample_evenly

MARKER_FORMATS = ("c3d", "trc", "csv")
KEPT_REPORT_KEYS = ("take", "arguments", "corrections", "notes", "times")


@dataclass(frozen=True)
class CleanedTake:
    """A cleaned take, or one subject of it, and its files."""

    id: str  # path of its outputs without their suffixes, relative to the folder that is reviewed, with "/"
    folder: Path  # of its outputs
    stem: str  # of the names of its outputs
    report: dict[str, Any]  # the parts of the JSON report that a review needs: a session may have thousands

    @property
    def name(self) -> str:
        return str(self.report["take"]["file"])

    @property
    def subject(self) -> str:
        """The subject, "" for a take of one subject."""
        return str(self.report["take"].get("person", ""))

    @property
    def arguments(self) -> list[str]:
        """The input and the options with which the take was cleaned; empty if the report does not have them."""
        return list(self.report.get("arguments", ()))

    @cached_property
    def options(self) -> CleanOptions:
        """The options with which the take was cleaned; the files that they name are relative to the folder."""
        return parse_arguments(self.arguments[1:])[0]

    @property
    def input_path(self) -> Path | None:
        """The input file; None if the report does not name it, or it is not there any more."""
        path = self.folder / self.arguments[0] if self.arguments else None
        return path if path and path.is_file() else None

    @property
    def cleaned_path(self) -> Path:
        return self.folder / f"{Path(self.name).stem}.{get_source_suffixes(Path(self.name))[0]}"

    def get_path(self, suffix: str) -> Path:
        """Return the path of an output of this take or subject."""
        return self.folder / f"{self.stem}.{suffix}"

    def find_characters(self) -> dict[str, Path]:
        """Return the glTF files of the characters that were written beside this take, by name."""
        beginning, end = f"{self.stem}.", ".map.yaml"
        names = sorted(path.name[len(beginning) : -len(end)] for path in self.folder.glob(f"{glob.escape(beginning)}*{end}"))
        paths = [(name, self.get_path(f"{name}.{suffix}")) for name in names for suffix in ("glb", "vrm")]
        return {name: path for name, path in paths if path.is_file()}

    @property
    def export_choices(self) -> dict[str, list[str]]:
        """The formats, programs and characters that fit: without a body there is no motion, and joints are no markers."""
        has_body, is_animation = self.get_path("bvh").is_file(), bool(self.report["take"].get("animation"))
        fitting = [name for name, each in OPTIONAL_FORMATS.items() if has_body or not each.needs_body]
        formats = [name for name in fitting if not (is_animation and name in MARKER_FORMATS)]
        return {"extra_formats": formats, "rigs": [*RIG_NAMES] * has_body, "characters": [*CHARACTER_PRESETS] * has_body}

    @property
    def changes_path(self) -> Path:
        return self.get_path(CHANGES_SUFFIX)

    @property
    def approval_path(self) -> Path:
        return self.get_path("approval.json")


def find_cleaned_takes(folder: Path) -> list[CleanedTake]:
    """Return the cleaned takes in an output folder of `clean` or `batch`, by their ids. Raises ReadError if there are none."""
    if not folder.is_dir():
        raise ReadError(f"{folder}: is no folder; name the output folder of `mocapfix clean` or `mocapfix batch`.")
    takes: list[CleanedTake] = []
    for parent, folders, names in os.walk(folder, followlinks=True):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in names:
            if name.endswith(JSON_REPORT_SUFFIX) and not name.startswith("."):
                stem = name.removesuffix(JSON_REPORT_SUFFIX)
                take = read_cleaned_take(folder, Path(parent), stem)
                if take.changes_path.is_file():
                    takes.append(take)
    if not takes:
        raise ReadError(f"{folder}: holds no cleaned take; name the output folder of `mocapfix clean` or `mocapfix batch`.")
    return sorted(takes, key=lambda take: take.id)


def read_cleaned_take(root: Path, folder: Path, stem: str) -> CleanedTake:
    """Return the take whose outputs have a stem, in a folder below `root`. Raises ReadError if its report cannot be read."""
    path = folder / f"{stem}{JSON_REPORT_SUFFIX}"
    try:
        report = cast("dict[str, Any]", json.loads(path.read_bytes()))
        kept = {key: report[key] for key in KEPT_REPORT_KEYS if key in report}
        take = CleanedTake((folder.relative_to(root) / stem).as_posix(), folder, stem, kept)
        Path(take.name, take.subject, *take.arguments)  # raises TypeError if they are no texts
        _ = take.options
    except (MocapfixError, OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise ReadError(f"{path}: is damaged; clean the take again.") from error
    return take


MAX_NAME_LENGTH = 200
ReviewState = Literal["untouched", "in review", "approved"]


class Approval(StrictModel):
    """An approval, as in its file."""

    name: str = Field(min_length=1, max_length=MAX_NAME_LENGTH)  # who approved
    date: str  # when, in ISO 8601 with time zone
    changes_sha256: str  # hash of the changes file that was approved: the approval ends with any further decision or cleaning


def read_approval(take: CleanedTake) -> Approval | None:
    """Return the approval of a take, None if there is none. Raises ReadError if it cannot be read."""
    try:
        return Approval.model_validate_json(take.approval_path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValidationError) as error:
        raise ReadError(f"{take.approval_path}: is damaged; remove it, and approve the take again.") from error


def write_approval(take: CleanedTake, name: str) -> Approval:
    """Approve a take with its changes file as it is. Raises SceneError for a name that is not allowed, WriteError."""
    name = name.strip()
    if not 0 < len(name) <= MAX_NAME_LENGTH:
        raise SceneError(f"An approval needs a name of at most {MAX_NAME_LENGTH} characters.")
    date = datetime.now().astimezone().isoformat(timespec="seconds")
    approval = Approval(name=name, date=date, changes_sha256=hash_changes(take.changes_path))
    with replace_atomically(take.approval_path) as part:
        part.write_text(approval.model_dump_json(indent=1) + "\n", encoding="utf-8")
    return approval


def determine_state(file: ChangesFileModel, approval: Approval | None, revision: str) -> ReviewState:
    """Return how far the review of a take is. `revision` is the hash of its changes file."""
    if approval and approval.changes_sha256 == revision:
        return "approved"
    is_touched = bool(file.corrections) or any(change.reviewed or change.note for change in file.changes)
    return "in review" if is_touched or approval else "untouched"


JOINT_BLOCK_FRAMES = 1000
STICK_VARIATION_WEIGHT, MAX_STICK_M = 5.0, 0.7  # longer sticks would join two people
MAX_SAMPLES_COMPARED_AT_ONCE = 20_000  # samples that are compared with all others of their frame at a time
NO_INPUT_NOTE = "The input file {name} is not where it was, so the markers before cleaning are not shown."
LABELLED_NOTE = "The input file has no labels, so the markers before cleaning are shown without those that were filled."


@dataclass(frozen=True)
class TakeView:
    """A take as the page shows it, T frames of M markers, U unlabelled trajectories and J joints, in metres, Y up."""

    rate: float
    first_frame: int
    labels: tuple[str, ...]
    unlabelled_labels: tuple[str, ...]
    before: Float32[np.ndarray, "T M 3"]  # before, after: positions, NaN where missing
    after: Float32[np.ndarray, "T M 3"]
    unlabelled: Float32[np.ndarray, "T U 3"]  # positions of the unlabelled trajectories of the input
    body: Animation | None  # the motion of the solved body, or the animation that was cleaned
    body_height_m: float  # by which the body is moved up
    sd: Float32[np.ndarray, "T M"]  # standard deviation per axis of the estimated samples, NaN for all others
    states: UInt8[np.ndarray, "T M"]  # SampleOutcome of each sample
    notes: tuple[str, ...] = ()  # sentences on what is not shown

    @property
    def frame_count(self) -> int:
        return len(self.after)

    @cached_property
    def floor_height_m(self) -> float:
        """Height of the lowest marker in an ordinary frame, which is near the floor."""
        sampled = self.after[sample_evenly(self.frame_count, 200), :, 1]
        lowest = np.array([heights.min() for row in sampled if len(heights := row[np.isfinite(row)])])
        return float(np.percentile(lowest, 5)) if len(lowest) else 0.0

    @cached_property
    def sticks(self) -> list[tuple[int, int]]:
        """Pairs of markers to which no third is nearer, by mean distance plus STICK_VARIATION_WEIGHT standard deviations."""
        rows = self.after[sample_evenly(self.frame_count, 50)].astype(float)
        lengths = np.linalg.norm(rows[:, :, None] - rows[:, None], axis=-1)
        known = np.isfinite(lengths)
        mean, square = (np.where(known, lengths**power, 0.0).sum(0) / np.maximum(known.sum(0), 1) for power in (1, 2))
        distance = mean + STICK_VARIATION_WEIGHT * np.sqrt(np.maximum(square - mean**2, 0.0))
        distance[~known.any(0) | np.eye(len(distance), dtype=bool)] = np.inf
        is_joined = (distance <= [np.maximum(row, distance).min(axis=1) for row in distance]) & (distance < MAX_STICK_M)
        return [(int(one), int(other)) for one, other in np.argwhere(np.triu(is_joined))]

    def compute_poses(self, frames: slice) -> tuple[Float[np.ndarray, "F J 3"], Float[np.ndarray, "F J 3 3"]]:
        """Return positions and rotations of the joints in some frames. Those of all are not kept: they take time and memory."""
        numbers = np.arange(self.frame_count)[frames]
        if self.body is None:
            return np.zeros((len(numbers), 0, 3)), np.zeros((len(numbers), 0, 3, 3))
        numbers = np.minimum(np.rint(numbers * (self.body.rate / self.rate)).astype(int), self.body.frame_count - 1)
        positions, rotations = self.body.replace_values(self.body.values[numbers].astype(float)).compute_world_poses()
        return positions + [0.0, self.body_height_m, 0.0], rotations

    def encode_frames(self, first: int, count: int) -> bytes:
        """Return the samples of some frames as the page reads them: one array after the other, little-endian."""
        frames = slice(max(first, 0), max(first, 0) + max(count, 0))
        joints, loose = self.compute_poses(frames)[0], self.unlabelled[frames]
        arrays = (self.before[frames], self.after[frames], loose, joints, self.sd[frames])
        return b"".join(each.astype("<f4", copy=False).tobytes() for each in arrays) + self.states[frames].tobytes()


def load_take_view(take: CleanedTake, changes: Sequence[ChangeModel] = ()) -> TakeView:
    """Return what the page shows of a cleaned take.

    Args:
        changes: Those in its changes file: their predicted errors stand in for uncertainties that are too large for the cleaned
            file.

    Raises:
        ReadError: If its files are damaged or do not belong together.
    """
    options = replace(take.options.read, accept_contradictions=True)  # the take was cleaned
    with ThreadPoolExecutor(1) as beside:
        body_read = None if take.report["take"].get("animation") else beside.submit(_read_body, take)
        before = _read_take(take.input_path, options, None)[0] if take.input_path else None
        after, fill_sd, animation = _read_take(take.cleaned_path, options, before)
    notes = [] if before else [NO_INPUT_NOTE.format(name=take.name)]
    if before and before.frame_count != after.frame_count:
        raise ReadError(f"{take.input_path}: is not the file that was cleaned; its number of frames differs. Clean it again.")
    after, fill_sd = _select_labels(after, fill_sd, take)
    if before is not None:
        try:
            before, _ = _select_labels(before, fill_sd, take)
        except ReadError:
            before, notes = None, [*notes, LABELLED_NOTE]
    is_estimated = ~np.isnan(fill_sd)
    if before is None:
        before = replace(after, markers=np.where(is_estimated[..., None], np.nan, after.markers), unlabelled=None)
    unlabelled = before.unlabelled.markers if before.unlabelled else np.zeros((after.frame_count, 0, 3), np.float32)
    view = TakeView(
        rate=after.rate,
        first_frame=after.first_frame,
        labels=after.labels,
        unlabelled_labels=before.unlabelled.labels if before.unlabelled else (),
        before=before.markers.astype(np.float32, copy=False),
        after=after.markers.astype(np.float32, copy=False),
        unlabelled=unlabelled.astype(np.float32, copy=False),
        body=animation or (body_read and body_read.result()),
        body_height_m=0.0 if animation else take.options.output.floor_height_m,
        sd=fill_sd.astype(np.float32, copy=False),
        states=np.zeros(fill_sd.shape, np.uint8),
        notes=tuple(notes),
    )
    blocks = [each for _, each in iterate_blocks(view, view.frame_count)]  # all at once would need much memory
    states = np.concatenate([classify_shown_samples(each.before, each.after, each.unlabelled) for each in blocks])
    return_free_memory()
    sd = np.where(find_estimated_samples(states), replace_unstored_sd(view, changes), np.float32(np.nan))
    return replace(view, states=states, sd=sd)


def replace_unstored_sd(view: TakeView, changes: Sequence[ChangeModel]) -> Float32[np.ndarray, "T M"]:
    """Return the standard deviations, with that of its change for each sample for which the file could store none (infinite).

    The predicted error of a change is the root mean square of a distance, that of three axes.
    """
    sd = view.sd.copy()
    for change in changes:
        frames = slice(change.first - view.first_frame, change.last - view.first_frame + 1)
        for m in (view.labels.index(label) for label in change.markers if label in view.labels):
            if change.predicted_mm is not None:
                part = sd[frames, m]
                part[np.isposinf(part)] = change.predicted_mm / (1e3 * np.sqrt(3))
    return np.where(np.isinf(sd), np.float32(np.nan), sd)


def classify_shown_samples(
    before: Float32[np.ndarray, "T M 3"], after: Float32[np.ndarray, "T M 3"], unlabelled: Float32[np.ndarray, "T U 3"]
) -> UInt8[np.ndarray, "T M"]:
    """Return the SampleOutcome of each sample, from the positions alone.

    A sample is of another label if a different trajectory of the input is at exactly its position in this frame.
    """
    was_visible, is_visible = np.isfinite(before[..., 0]), np.isfinite(after[..., 0])
    is_same = (before == after).all(-1)
    states = np.full(before.shape[:2], SampleOutcome.MEASURED, np.uint8)
    states[~is_visible] = SampleOutcome.EMPTY
    states[is_visible & ~was_visible] = SampleOutcome.FILLED
    states[is_visible & was_visible & ~is_same] = SampleOutcome.REPLACED
    in_input = np.concatenate([before, unlabelled], axis=1)
    states[_find_positions(after, is_visible & ~is_same, in_input)] = SampleOutcome.RELABELLED
    states[_find_positions(before, was_visible & ~is_visible, after)] = SampleOutcome.REASSIGNED
    return states


def _find_positions(
    positions: Float32[np.ndarray, "T M 3"], selected: Bool[np.ndarray, "T M"], trajectories: Float32[np.ndarray, "T N 3"]
) -> Bool[np.ndarray, "T M"]:
    """Return which of the selected samples are exactly at the position of a trajectory in their frame."""
    found = np.zeros(selected.shape, bool)
    samples = np.argwhere(selected)
    for part in np.array_split(samples, 1 + len(samples) // MAX_SAMPLES_COMPARED_AT_ONCE):
        frames, markers = part.T
        is_near = (trajectories[frames, :, 0] == positions[frames, markers, :1]).any(-1)  # nearly all differ in one coordinate
        frames, markers = frames[is_near], markers[is_near]
        found[frames, markers] = (trajectories[frames] == positions[frames, markers][:, None]).all(-1).any(-1)
    return found


def _read_take(path: Path, options: ReadOptions, like: Take | None) -> tuple[Take, Float32[np.ndarray, "T M"], Animation | None]:
    """Return the points of a file in single precision, the standard deviations that it stores, and its animation if it is one.

    The unit and the axes are those of the input, which may be decided otherwise from the cleaned markers. Raises ReadError.
    """
    try:
        capture = read_capture(path, options)
    except MocapfixError as error:
        raise ReadError(f"{error} Clean the take again if its outputs are damaged.") from error
    if isinstance(capture, Animation):
        take = _drop_precision(build_tip_take(capture))
        return take, np.full(take.visible.shape, np.nan, np.float32), capture
    fill_sd = read_fill_sd(capture).astype(np.float32)
    if like is not None and like.layout is not None:
        capture = change_convention(capture, like.layout.unit_m, like.layout.rotation_y_up_file, like.up_axis)
    return _drop_precision(capture), fill_sd, None


def _drop_precision(take: Take) -> Take:
    """Return a take with positions in single precision, and without what the page does not show."""
    loose = take.unlabelled
    loose = loose and Take(loose.markers.astype(np.float32), loose.labels, loose.rate, loose.first_frame)
    kept = Take(take.markers.astype(np.float32), take.labels, take.rate, take.first_frame, take.path, unlabelled=loose)
    return replace(kept, layout=take.layout, up_axis=take.up_axis)


def _read_body(take: CleanedTake) -> Animation | None:
    """Return the motion of the solved body, None without one."""
    path = take.get_path("bvh")
    body = read_capture(path, ReadOptions(unit="cm", up_axis="Y")) if path.is_file() else None
    return replace(body, values=body.values.astype(np.float32), value_byte_offsets=None) if isinstance(body, Animation) else None


def _select_labels(take: Take, fill_sd: Float[np.ndarray, "T M"], cleaned: CleanedTake) -> tuple[Take, Float[np.ndarray, "T M"]]:
    """Return the markers that the report names, with their standard deviations. Raises ReadError if one is not there."""
    index = {label: m for m, label in reversed(list(enumerate(take.labels)))}
    labels = cast("list[str]", cleaned.report["take"].get("labels", list(take.labels)))
    if cleaned.report["take"].get("animation"):
        labels = list(take.labels)
    if missing := [label for label in labels if label not in index]:
        raise ReadError(f"{take.name}: has no marker {', '.join(missing[:3])}, which the report names; clean the take again.")
    columns: Int[np.ndarray, " K"] = np.array([index[label] for label in labels], int)
    selected = replace(take, markers=take.markers[:, columns], labels=tuple(labels), relabelled_points=None)
    return selected, fill_sd[:, columns] if fill_sd.shape[1] == len(take.labels) else np.full(selected.visible.shape, np.nan)


def trace_marker(take: CleanedTake, view: TakeView, label: str) -> Float[np.ndarray, "T C"]:
    """Return what curves of a marker need besides its samples: where the body has it (T, 3), in metres, no columns if nowhere.

    Of a joint of an animation it is the angles in degrees about its axes x, y and z, before and after (T, 6).
    """
    if take.report["take"].get("animation"):
        angles = np.full((view.frame_count, 6), np.nan)
        for n, path in enumerate((take.input_path or take.cleaned_path, take.cleaned_path)):
            if isinstance(each := read_capture(path, take.options.read), Animation) and label in each.names:
                columns, axes = each.get_rotation_channels(each.names.index(label))
                angles[:, 3 * n + axes] = each.values[:, columns]
        return angles
    from mocapfix.subject.library import choose_marker_set, read_subject  # slow to import

    subject = read_subject(take.get_path("subject.yaml")) if view.body else None
    found = marker_set.match_labels(view.labels) if (marker_set := choose_marker_set(view.labels).marker_set) else {}
    name = {view.labels[m]: name for name, m in found.items()}.get(label, label.rpartition(":")[2])
    if view.body is None or subject is None or name not in subject.labels:
        return np.zeros((view.frame_count, 0))
    k, trace = subject.labels.index(name), np.zeros((view.frame_count, 3))
    joint = view.body.names.index(subject.skeleton.names[subject.joints[k]])
    for first in range(0, len(trace), JOINT_BLOCK_FRAMES):
        block = slice(first, first + JOINT_BLOCK_FRAMES)
        positions, rotations = view.compute_poses(block)
        trace[block] = positions[:, joint] + rotations[:, joint] @ subject.marker_offsets[k]
    return trace


MAX_LISTED_DIFFERENCES = 200  # markers and changes in the list of what differs from the cleaning before


def compare_cleanings(one: TakeView, before_ids: list[str], other: TakeView, after_ids: list[str]) -> dict[str, Any]:
    """Return what differs between two cleanings of a take, of which views and ids of changes are given: samples and changes."""
    markers, total = list[dict[str, Any]](), 0
    if one.after.shape == other.after.shape and one.labels == other.labels:
        differs = ~((one.after == other.after) | (np.isnan(one.after) & np.isnan(other.after))).all(-1)
        distance_mm = np.linalg.norm(one.after - other.after, axis=-1) * 1e3
        total = int(differs.sum())
        for m in np.argsort(-differs.sum(0), kind="stable")[:MAX_LISTED_DIFFERENCES]:
            known, runs = distance_mm[differs[:, m], m], find_runs(differs[:, m])
            if runs:
                largest = round(float(np.nanmax(known)), 1) if np.isfinite(known).any() else None
                markers.append({"label": one.labels[m], "samples": len(known), "largest_mm": largest, "runs": runs})
    return {
        "samples": total,
        "markers": markers,
        "added": [name for name in after_ids if name not in before_ids][:MAX_LISTED_DIFFERENCES],
        "removed": [name for name in before_ids if name not in after_ids][:MAX_LISTED_DIFFERENCES],
    }
