"""What the page of a review shows of a take: the markers before and after cleaning, the body, and the state of every sample."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import cast

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from mocapfix.animations.joint_mapping import build_tip_take
from mocapfix.errors import MocapfixError, ReadError
from mocapfix.io.c3d import read_fill_sd
from mocapfix.io.capture import read_capture
from mocapfix.io.changes_file import ChangeModel
from mocapfix.io.conventions import change_convention
from mocapfix.io.files import return_free_memory
from mocapfix.model.animation import Animation
from mocapfix.model.take import Take
from mocapfix.options import ReadOptions
from mocapfix.report.sample_states import SampleOutcome, find_estimated_samples
from mocapfix.review.take_files import CleanedTake
from mocapfix.stats.sequences import sample_evenly

JOINT_BLOCK_FRAMES = 1000
MAX_SAMPLES_COMPARED_AT_ONCE = 20_000  # samples that are compared with all others of their frame at a time
NO_INPUT_NOTE = (
    "The input file {name} is not where it was when the take was cleaned, so the markers before cleaning are not shown."
)
LABELLED_NOTE = "The input file has no labels, so the markers before cleaning are shown without those that were filled."


@dataclass(frozen=True)
class TakeView:
    """A take as the page shows it, T frames of M markers, U unlabelled trajectories and J joints, in metres, Y up."""

    rate: float
    first_frame: int
    labels: tuple[str, ...]
    unlabelled_labels: tuple[str, ...]
    joint_names: tuple[str, ...]
    bones: tuple[tuple[int, int], ...]
    before: Float32[np.ndarray, "T M 3"]  # before, after: positions, NaN where missing
    after: Float32[np.ndarray, "T M 3"]
    unlabelled: Float32[np.ndarray, "T U 3"]  # positions of the unlabelled trajectories of the input
    # positions of the joints of the body, and `bones` the indices of parent and child of each bone
    joints: Float32[np.ndarray, "T J 3"]
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

    def encode_frames(self, first: int, count: int) -> bytes:
        """Return the samples of some frames as the page reads them: one array after the other, little-endian."""
        frames = slice(max(first, 0), max(first, 0) + max(count, 0))
        arrays = (self.before, self.after, self.unlabelled, self.joints, self.sd)
        return b"".join(each[frames].astype("<f4", copy=False).tobytes() for each in arrays) + self.states[frames].tobytes()


def load_take_view(take: CleanedTake, changes: Sequence[ChangeModel] = ()) -> TakeView:
    """Return what the page shows of a cleaned take.

    changes  those in its changes file: their predicted errors stand in for uncertainties that are too large for the cleaned file

    Raises ReadError if its files are damaged or do not belong together.
    """
    options = replace(take.options.read, accept_contradictions=True)  # the take was cleaned
    captured = _read_file(take.input_path, options) if take.input_path else None
    after, fill_sd, animation = _select_points(_read_file(take.cleaned_path, options), captured)
    notes: list[str] = []
    before: Take | None = None
    if captured is not None:
        before, _, _ = _select_points(captured, None)
        if before.frame_count != after.frame_count:
            raise ReadError(f"{take.input_path}: is not the file that was cleaned; its number of frames differs. Clean it again.")
    else:
        notes.append(NO_INPUT_NOTE.format(name=take.name))
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
    joints, names, parents = _compute_joints(take, after, animation)
    view = TakeView(
        rate=after.rate,
        first_frame=after.first_frame,
        labels=after.labels,
        unlabelled_labels=before.unlabelled.labels if before.unlabelled else (),
        joint_names=names,
        bones=tuple((int(parent), joint) for joint, parent in enumerate(parents) if parent >= 0),
        before=before.markers.astype(np.float32, copy=False),
        after=after.markers.astype(np.float32, copy=False),
        unlabelled=unlabelled.astype(np.float32, copy=False),
        joints=joints.astype(np.float32, copy=False),
        sd=fill_sd.astype(np.float32, copy=False),
        states=np.zeros(fill_sd.shape, np.uint8),
        notes=tuple(notes),
    )
    states = classify_shown_samples(view.before, view.after, view.unlabelled)
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
        frames, markers = part[:, 0], part[:, 1]
        found[frames, markers] = (trajectories[frames] == positions[frames, markers][:, None]).all(-1).any(-1)
    return found


def _read_file(path: Path, options: ReadOptions) -> Take | Animation:
    try:
        return read_capture(path, options)
    except MocapfixError as error:
        raise ReadError(f"{error} Clean the take again if its outputs are damaged.") from error


def _select_points(
    capture: Take | Animation, like: Take | Animation | None
) -> tuple[Take, Float[np.ndarray, "T M"], Animation | None]:
    """Return the points of a file, the standard deviations that it stores for fills, and its animation if it is one.

    The unit and the axes are those of the input, which may be decided otherwise from the cleaned markers.
    """
    if isinstance(capture, Animation):
        take = _drop_precision(build_tip_take(capture))
        return take, np.full(take.visible.shape, np.nan, np.float32), capture
    fill_sd = read_fill_sd(capture).astype(np.float32)
    if isinstance(like, Take) and like.layout is not None:
        capture = change_convention(capture, like.layout.unit_m, like.layout.rotation_y_up_file, like.up_axis)
    return _drop_precision(capture), fill_sd, None


def _drop_precision(take: Take) -> Take:
    """Return a take with positions in single precision, and without what the page does not show."""
    loose = take.unlabelled
    if loose is not None:
        loose = Take(loose.markers.astype(np.float32), loose.labels, loose.rate, loose.first_frame)
    return Take(take.markers.astype(np.float32), take.labels, take.rate, take.first_frame, take.path, unlabelled=loose)


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


def _compute_joints(
    take: CleanedTake, after: Take, animation: Animation | None
) -> tuple[Float[np.ndarray, "T J 3"], tuple[str, ...], list[int]]:
    """Return joint positions at the frames of the take in metres, names and parents; no joints without a body."""
    shift_m = 0.0
    if animation is None:
        path = take.get_path("bvh")
        if not path.is_file():
            return np.zeros((after.frame_count, 0, 3), np.float32), (), []
        written = read_capture(path, ReadOptions(unit="cm", up_axis="Y"))
        assert isinstance(written, Animation)
        animation = written
        shift_m = take.options.output.floor_height_m
    frames = np.rint(np.arange(after.frame_count) * (animation.rate / after.rate)).astype(int)
    frames = np.minimum(frames, animation.frame_count - 1)
    positions = np.zeros((after.frame_count, len(animation.names), 3), np.float32)
    for first in range(0, len(frames), JOINT_BLOCK_FRAMES):  # the rotations of all frames need much memory
        block = slice(first, first + JOINT_BLOCK_FRAMES)
        positions[block] = animation.replace_values(animation.values[frames[block]]).compute_world_poses()[0]
    positions[..., 1] += shift_m
    return positions, animation.names, animation.parents.tolist()
