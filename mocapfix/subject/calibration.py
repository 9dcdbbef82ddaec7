"""Calibration: one person's bone lengths and marker offsets, estimated from a take alone.

The size of the average body is estimated first. Frames that show most markers and differ most in pose are then selected, and
bones, marker offsets and poses are refined together (see `refinement`). These frames are all that the calibration of a person
from several takes needs of a take: a few hundred kilobytes instead of the file.
"""

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float, Int

from mocapfix.errors import ReadError, TakeError
from mocapfix.io.files import replace_atomically
from mocapfix.model.body_fit import BodyFit, SubjectInTake
from mocapfix.model.detected import Detected
from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import BodyModel, load_cmu31_body, restrict_body
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.solve import kinematics
from mocapfix.solve.kinematics import Poses
from mocapfix.solve.mean_pose import MeanPosePrior, load_mean_pose_prior
from mocapfix.stats.sequences import sample_evenly, select_farthest_rows
from mocapfix.subject.average_body import MAX_SIZE_RATIO, MIN_SIZE_RATIO, build_average_subject, estimate_body_size_ratio
from mocapfix.subject.refinement import Refinement, build_refined_subject, pose_frames, refine_body


@dataclass(frozen=True)
class CalibrationFrames:
    """N frames of one subject in a take, with the poses of the average body in them."""

    take: str  # id of the take
    subject_name: str  # name of the subject in the take; "" if its labels have none
    marker_set: str  # name of the marker set
    labels: tuple[str, ...]  # K marker labels, as the marker set names them
    joints: Int[np.ndarray, " K"]  # the joint that carries each marker
    marker_offsets: Float[np.ndarray, "K 3"]  # metres, of the marker set on the average body
    marker_spread: Float[np.ndarray, " K"]  # metres, how much people's marker offsets differ
    size_ratio: float  # size of the body relative to the average one
    times_s: Float[np.ndarray, " N"]  # seconds, of the frames
    markers: Float[np.ndarray, "N K 3"]  # metres, NaN if not visible or an outlier
    root_position: Float[np.ndarray, "N 3"]  # metres
    local_rotations: Float[np.ndarray, "N J 3 3"]  # (N, J, 3, 3)

    @property
    def pose_variation_rad(self) -> float:
        """How much the poses vary: the root mean square deviation of the joints below the root from the take's mean rotation."""
        below_root = self.local_rotations[:, 1:]
        variance = 3 - np.square(below_root.mean(0)).sum((-2, -1))  # of the chordal distance
        return float(np.sqrt(np.maximum(variance, 0.0).mean() / 2))

    @property
    def poses(self) -> Poses:
        """Root positions and local rotations."""
        return self.root_position, self.local_rotations

    @property
    def known_markers(self) -> MarkerSet:
        """The markers as a set."""
        places = self.joints, self.marker_offsets, self.marker_spread
        return MarkerSet(self.marker_set, self.marker_set, "cmu31", self.labels, *places, ((),) * len(self.labels))


def write_calibration_frames(path: Path, frames: CalibrationFrames) -> None:
    """Write frames as a compressed NumPy archive. Raises WriteError."""
    arrays: dict[str, Any] = {each.name: np.asarray(getattr(frames, each.name)) for each in fields(frames)}
    for name in ("markers", "root_position", "local_rotations"):
        arrays[name] = arrays[name].astype(np.float32)
    with replace_atomically(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **arrays)


def read_calibration_frames(path: Path) -> CalibrationFrames:
    """Return the frames in a file. Raises ReadError."""
    try:
        with np.load(path) as archive:
            arrays = {each.name: archive[each.name] for each in fields(CalibrationFrames)}
    except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
        raise ReadError(
            f"{path}: is not an archive of calibration frames ({error}); remove it and survey the take again."
        ) from error
    return CalibrationFrames(**{name: _restore(array) for name, array in arrays.items()})


def _restore(array: np.ndarray) -> Any:
    """Return the value of a field: a word or a number, words, or an array in double precision."""
    if array.ndim == 0:
        return array.item()
    return tuple(array.tolist()) if array.dtype.kind == "U" else array.astype(float) if array.dtype.kind == "f" else array


MIN_CALIBRATION_MARKERS = 3  # visible markers that at least one frame must have; fewer do not determine the pose of any segment
MAX_CANDIDATE_FRAMES = 600  # posed to select the calibration frames from; all of them take a fraction of a second
CANDIDATE_MARKER_SHARE = 0.9  # markers that a candidate frame must show, as a share of the 90th percentile over all frames
MAX_CALIBRATION_FRAMES = 150  # frames that enter the refinement
MAX_PREVIEW_FRAMES = 24  # the same of a preview: with them the joints of composed takes are as near as with 150
MIN_MOVED_MARKER_FRAMES = 10  # frames in which a moved marker must be visible to get an offset of its own
# Relative decrease of the cost by a further refinement up to which the earlier calibration is kept: that of a few steps after
# which a refinement ends.
MAX_KEPT_IMPROVEMENT = 0.003
# Change of a marker offset, in standard deviations of the calibration, up to which it is kept: a marker that is seldom visible
# hardly affects the cost.
MAX_KEPT_CHANGE_SD = 3.0


@dataclass(frozen=True)
class CalibrationFit:
    """A calibration, from which the next round of detection and calibration goes on."""

    subject: Subject
    start: Subject  # the average body at the size of the subject
    frames: Int[np.ndarray, " N"]  # indices of the calibration frames
    refined: Refinement  # of these frames


def fit_calibration(take: Take, marker_set: MarkerSet, body: BodyModel, prior: MeanPosePrior) -> CalibrationFit:
    """Return the bone lengths and marker offsets that explain the take best.

    Args:
        take: The markers in the order of the marker set, NaN if not visible or an outlier.

    Raises:
        TakeError: If no frame shows three markers, or the markers do not fit a person's size.
    """
    start, frames, poses = choose_calibration_frames(take, marker_set, body, prior)
    return _build_fit(take, start, frames, refine_body(start, body, prior, take.markers[frames], poses))


def _build_fit(take: Take, start: Subject, frames: Int[np.ndarray, " N"], refined: Refinement) -> CalibrationFit:
    subject = build_refined_subject(start, refined.state, refined.curvature, frames / take.rate)
    check_size_ratio(take, subject.skeleton.size_ratio)
    return CalibrationFit(subject, start, frames, refined)


def update_calibration(take: Take, body: BodyModel, prior: MeanPosePrior, previous: CalibrationFit) -> CalibrationFit:
    """Return the calibration with some more or fewer samples: the previous one, whose body is solved, if these hardly count."""
    known, markers = previous.refined, take.markers[previous.frames]
    if np.array_equal(known.state.problem.marker_positions, markers, equal_nan=True):
        return previous
    refined = refine_body(previous.start, body, prior, markers, known.state.poses, known.state.unknowns)
    old, new = (each.state.problem.attachment.offsets for each in (known, refined))
    is_near = np.linalg.norm(new - old, axis=1) <= MAX_KEPT_CHANGE_SD * previous.subject.marker_sd
    if refined.improvement <= MAX_KEPT_IMPROVEMENT and is_near.all():
        return previous
    return _build_fit(take, previous.start, previous.frames, refined)


def choose_calibration_frames(
    take: Take, marker_set: MarkerSet, body: BodyModel, prior: MeanPosePrior
) -> tuple[Subject, Int[np.ndarray, " N"], Poses]:
    """Return the average body at the size of the take, the frames that differ most in pose, and its poses in them."""
    start = scale_average_subject(take, marker_set)
    candidates = select_candidate_frames(take.markers)
    root_position, local_rotations = pose_frames(start, body, prior, take.markers[candidates])
    chosen = select_varied_poses(local_rotations, np.random.default_rng(0))
    return start, candidates[chosen], (root_position[chosen], local_rotations[chosen])


def scale_average_subject(take: Take, marker_set: MarkerSet) -> Subject:
    """Return the average body at the size estimated from the take, the start of `fit_calibration`; raises like it."""
    if not ((~np.isnan(take.markers[..., 0])).sum(1) >= MIN_CALIBRATION_MARKERS).any():
        raise TakeError(f"{take.name}: no frame shows three markers of the body, so it cannot be calibrated.")
    ratio = estimate_body_size_ratio(marker_set, take.markers)
    check_size_ratio(take, ratio)
    return build_average_subject(marker_set, ratio)


def check_size_ratio(take: Take, ratio: float) -> None:
    """Raise TakeError if no person can be `ratio` times the size of the average body."""
    if not MIN_SIZE_RATIO < ratio < MAX_SIZE_RATIO:
        problem = "near together" if ratio < 1 else "far apart"
        raise TakeError(f"{take.name}: the markers lie too {problem} for a person; check the unit (--unit) and the labels.")


def select_candidate_frames(markers: Float[np.ndarray, "T K 3"], max_count: int = MAX_CANDIDATE_FRAMES) -> Int[np.ndarray, " N"]:
    """Return up to `max_count` frames, evenly spaced among those that show the most markers (NaN if not visible)."""
    count = (~np.isnan(markers[..., 0])).sum(1)
    enough = np.flatnonzero(count >= CANDIDATE_MARKER_SHARE * np.percentile(count, 90))
    return enough[sample_evenly(len(enough), max_count)]


def select_varied_poses(
    local_rotations: Float[np.ndarray, "N J 3 3"], rng: np.random.Generator | None, max_count: int = MAX_CALIBRATION_FRAMES
) -> Int[np.ndarray, " C"]:
    """Return the indices of up to `max_count` poses: half the most different, half others, at random or else evenly spaced.

    The different ones are found by farthest-point selection in the chordal distance over the joints below the root.
    """
    flat = local_rotations[:, 1:].reshape(len(local_rotations), -1)
    if len(flat) <= max_count:
        return np.arange(len(flat))
    chosen = select_farthest_rows(flat, max_count // 2)
    rest, count = np.setdiff1d(np.arange(len(flat)), chosen), max_count - len(chosen)
    others = rng.choice(rest, count, replace=False) if rng else rest[np.linspace(0, len(rest) - 1, count).astype(int)]
    return np.sort(np.r_[chosen, others])


def select_calibration_frames(
    take_id: str, take: Take, marker_set: MarkerSet, body: BodyModel, prior: MeanPosePrior
) -> CalibrationFrames:
    """Return the frames of a take that show most markers and differ most in pose.

    Args:
        take: The markers in the order of the marker set, NaN if not visible or an outlier.

    Raises:
        TakeError: If no frame shows three markers, or the markers do not fit a person's size.
    """
    start, frames, (root_position, local_rotations) = choose_calibration_frames(take, marker_set, body, prior)
    return CalibrationFrames(
        take=take_id,
        subject_name=take.subject_name,
        marker_set=marker_set.name,
        labels=marker_set.labels,
        joints=marker_set.joints,
        marker_offsets=marker_set.marker_offsets,
        marker_spread=marker_set.marker_spread,
        size_ratio=start.skeleton.size_ratio,
        times_s=frames / take.rate,
        markers=take.markers[frames],
        root_position=root_position,
        local_rotations=local_rotations,
    )


def add_moved_markers(
    subject: Subject, motion: Motion, markers: np.ndarray, marker_indices: np.ndarray
) -> tuple[Subject, np.ndarray]:
    """Add to a subject a marker for each new position of a marker that was moved on the body.

    A new offset is the median of the visible samples in the axes of the joint; its spread is that of the original marker.

    Returns the extended subject, and (E,) bool: the positions visible in enough frames to be added.

    Args:
        markers: (T, E, 3) m: the samples at the new positions, NaN elsewhere.
        marker_indices: (E,) the subject's marker that was moved.
    """
    position, rotation = kinematics.compute_world_poses(subject.skeleton, motion)
    enough = (~np.isnan(markers[..., 0])).sum(0) >= MIN_MOVED_MARKER_FRAMES
    marker_indices, joints = marker_indices[enough], subject.joints[marker_indices[enough]]
    relative = markers[:, enough] - position[:, joints]
    offsets = np.nanmedian(np.einsum("tkba,tkb->tka", rotation[:, joints], relative), axis=0).reshape(-1, 3)
    extended = replace(
        subject,
        labels=(*subject.labels, *(subject.labels[k] for k in marker_indices)),
        joints=np.r_[subject.joints, joints],
        marker_offsets=np.r_[subject.marker_offsets, offsets],
        marker_spread=np.r_[subject.marker_spread, subject.marker_spread[marker_indices]],
        marker_sd=np.r_[subject.marker_sd, subject.marker_sd[marker_indices]],
    )
    return extended, enough


@dataclass(frozen=True)
class Calibrated(SubjectInTake):
    """A subject that was calibrated from a take, or is known, in this take."""

    marker_set: MarkerSet  # that of the joints that the inliers show
    detected: Detected  # the faults of the take
    fit: CalibrationFit | None  # the calibration; None for a known subject


def calibrate_body(
    detected: Detected, marker_set: MarkerSet, subject: Subject | None, previous: Calibrated | None, is_preview: bool = False
) -> Calibrated:
    """Calibrate a subject from the inliers of a take.

    Args:
        subject: The subject if it is known: it is not calibrated.
        previous: The result of the round before. Its calibration goes on, unless labels were corrected since.
        is_preview: Whether fewer frames are enough.

    Raises:
        TakeError: Where the markers do not allow a calibration.
    """
    columns = marker_set.find_columns(detected.epochs.take.labels)
    is_visible = (columns >= 0) & detected.epochs.split_mask(detected.solver_mask)[:, columns].any(0)
    is_visible |= (columns >= 0) & (detected.take.part is not None)  # the subject is that of the whole take
    shown = marker_set.select_shown_part([label for label, each in zip(marker_set.labels, is_visible, strict=True) if each])
    visible = shown if shown.labels else marker_set  # without joints that no sample shows: labels may have no samples at all
    columns = visible.find_columns(detected.epochs.take.labels)
    take = detected.select_columns(columns, detected.solver_mask)
    if subject is not None:
        if len(subject.labels) > len(visible.labels):
            subject = subject.select_markers(visible.labels)
        return Calibrated(subject, subject, columns, take, visible, detected, None)
    body = restrict_body(load_cmu31_body(), set(visible.joints.tolist()))
    prior = load_mean_pose_prior("mean-pose", body.skeleton)
    goes_on = previous is not None and visible is marker_set and detected.label_faults == previous.detected.label_faults
    few = take.markers[select_candidate_frames(take.markers, MAX_PREVIEW_FRAMES)] if is_preview else take.markers
    sampled = replace(take.replace_markers(few), rate=take.rate * len(few) / take.frame_count)
    known = previous.fit if previous and goes_on else None
    fit = update_calibration(sampled, body, prior, known) if known else fit_calibration(sampled, visible, body, prior)
    return Calibrated(fit.subject, fit.subject, columns, take, visible, detected, fit)


def place_moved_markers(calibrated: Calibrated, body: BodyFit) -> Calibrated:
    """Find where the solved body carries each marker after it moved, and add these places to `extended_subject`.

    The poses must be solved again if any was added. Returns `calibrated` itself where no marker moved.
    """
    detected, columns = calibrated.detected, calibrated.marker_columns
    epochs = detected.epochs
    marker_of_column = {int(column): k for k, column in enumerate(columns)}
    added = np.array([c for c in epochs.added_columns if int(epochs.column_marker[c]) in marker_of_column], int)
    if not len(added):
        return calibrated
    markers = detected.select_columns(added, detected.solver_mask).markers
    subject_markers = np.array([marker_of_column[int(epochs.column_marker[column])] for column in added])
    extended, is_placed = add_moved_markers(body.subject, body.motion, markers, subject_markers)
    columns = np.r_[columns, added[is_placed]]
    take = detected.select_columns(columns, detected.solver_mask)
    return replace(calibrated, extended_subject=extended, marker_columns=columns, take=take)
