"""Learning a marker set: from an initial guess for some markers of a take to the segment and offset of all of them.

Two steps alternate until nothing changes: a person is calibrated on the markers whose segments are known so far, and every
marker is attached to the segment of that person in whose axes it moves least. Near a joint two segments fit equally well, and
if a joint hardly turns in a take, they do everywhere. There the position on the body decides: markers are more likely where the
known marker sets place one.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.errors import TakeError
from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.skeleton import BodyModel, find_carriers, restrict_body
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.solve import kinematics
from mocapfix.solve.mean_pose import MeanPosePrior
from mocapfix.stats.sequences import sample_evenly
from mocapfix.subject import refinement
from mocapfix.subject.calibration import fit_calibration, select_candidate_frames
from mocapfix.subject.library import load_whole_body_marker_sets

KEPT_FRAME_SHARE = 0.9  # of a marker's frames; those with the largest residuals may be swaps, ghosts or wrong poses
MIN_SKIN_MOTION_M = 0.005  # motion per axis that a marker shows even on the correct segment
INDEPENDENT_POSE_COUNT = 10.0  # effective number of independent poses in a take, whatever its number of frames
ATLAS_DISTANCE_SD_M = 0.07  # of a marker from the nearest position of the known sets on its segment
MAX_ATTACHED_SD_M = 0.025  # motion per axis above which a marker is not attached to a segment
MAX_ATLAS_DISTANCE_M = 0.15  # above which a marker is taken for a prop, unless its label names the segment
MIN_ATTACHMENT_FRAMES = 30  # frames in which a marker must be visible to be attached
MIN_ATTACHMENT_FRAME_SHARE = 0.3  # the same as a share of the frames, for short takes


@dataclass(frozen=True)
class AttachedMarkers:
    """The segments of M markers."""

    joints: Int[np.ndarray, " M"]  # index of the joint, -1 for none
    offsets: Float[np.ndarray, "M 3"]  # m in the axes of the joint; for unattached markers of the most likely joint
    residual_sd: Float[np.ndarray, " M"]  # m: motion per axis about the offset
    probability: Float[np.ndarray, " M"]  # posterior probability of the joint
    second_joints: Int[np.ndarray, " M"]  # the second most likely joint
    rejection_reasons: tuple[str, ...]  # why each marker is not attached (the predicate of a sentence), "" if it is


@dataclass(frozen=True)
class MarkerAtlas:
    """A marker positions of the known sets, in metres in the axes of their joints, on a body of a given size."""

    joints: Int[np.ndarray, " A"]
    offsets: Float[np.ndarray, "A 3"]

    def compute_distances(self, joint: int, offsets: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, " M"]:
        """Return the distance in metres of each offset in a joint's axes from the nearest known one on that joint."""
        known = self.offsets[self.joints == joint]
        return np.linalg.norm(offsets[:, None] - known[None], axis=-1).min(1)

    def select_joints(self, is_selected: Bool[np.ndarray, " J"]) -> "MarkerAtlas":
        is_kept = is_selected[self.joints]
        return MarkerAtlas(self.joints[is_kept], self.offsets[is_kept])

    def scale(self, size: float) -> "MarkerAtlas":
        """Return the atlas of a body `size` times as large."""
        return MarkerAtlas(self.joints, self.offsets * size)


def build_marker_atlas(marker_sets: tuple[MarkerSet, ...]) -> MarkerAtlas:
    """Return all marker positions of some sets on the average body."""
    joints = np.concatenate([marker_set.joints for marker_set in marker_sets])
    return MarkerAtlas(joints, np.concatenate([marker_set.marker_offsets for marker_set in marker_sets]))


def attach_markers(
    markers: Float[np.ndarray, "N M 3"],
    joint_positions: Float[np.ndarray, "N J 3"],
    joint_rotations: Float[np.ndarray, "N J 3 3"],
    atlas: MarkerAtlas,
    joint_names: tuple[str, ...],
    label_log_odds: Float[np.ndarray, "M J"],
) -> AttachedMarkers:
    """Return the most likely segment of each marker.

    Args:
        markers: In metres in N different frames, NaN if not visible.
        joint_positions, joint_rotations: The joints in the world, in metres.
        atlas: Marker positions of the known sets at the size of this body.
        label_log_odds: Log odds of each joint given the marker's label.
    """
    candidates, each = np.unique(atlas.joints), np.arange(markers.shape[1])
    offsets, sd = measure_marker_offsets(markers, joint_positions[:, candidates], joint_rotations[:, candidates])
    distance = np.stack([atlas.compute_distances(int(joint), offsets[c]) for c, joint in enumerate(candidates)])
    log_likelihood = (
        -1.5 * INDEPENDENT_POSE_COUNT * np.log(sd**2 + MIN_SKIN_MOTION_M**2)
        - 0.5 * (distance / ATLAS_DISTANCE_SD_M) ** 2
        + label_log_odds.T[candidates]
    )
    order = (-np.nan_to_num(log_likelihood, nan=-np.inf)).argsort(0, kind="stable")
    best, second = order[0], order[1]
    frame_count = (~np.isnan(markers[..., 0])).sum(0)
    min_frames = min(float(MIN_ATTACHMENT_FRAMES), MIN_ATTACHMENT_FRAME_SHARE * len(markers))
    atlas_distance = np.where(label_log_odds[each, candidates[best]] > 0, 0.0, distance[best, each])
    reasons = [""] * len(each)
    for m in each:
        name, least = joint_names[candidates[best[m]]], int(sd[:, m].argmin()) if frame_count[m] else 0
        if frame_count[m] < max(min_frames, 1):
            few = f"is visible in {frame_count[m]} of the frames examined, which is too few"
            reasons[m] = few if frame_count[m] else "is never visible"
        elif sd[best[m], m] > MAX_ATTACHED_SD_M:
            against = f"moves by {sd[least, m] * 1e3:.0f} mm against {joint_names[candidates[least]]}"
            reasons[m] = f"{against} and by more against every other segment"
        elif atlas_distance[m] > MAX_ATLAS_DISTANCE_M:
            distance_mm = f"{atlas_distance[m] * 1e3:.0f} mm"
            reasons[m] = f"is rigid with {name}, but {distance_mm} from the body: on a prop or another segment"
    return AttachedMarkers(
        joints=np.where([bool(reason) for reason in reasons], -1, candidates[best]),
        offsets=offsets[best, each],
        residual_sd=sd[best, each],
        probability=np.nan_to_num(1 / np.exp(log_likelihood - log_likelihood[best, each]).sum(0)),
        second_joints=candidates[second],
        rejection_reasons=tuple(reasons),
    )


def measure_marker_offsets(
    markers: Float[np.ndarray, "N M 3"],
    joint_positions: Float[np.ndarray, "N C 3"],
    joint_rotations: Float[np.ndarray, "N C 3 3"],
) -> tuple[Float[np.ndarray, "C M 3"], Float[np.ndarray, "C M"]]:
    """Return each marker's median position in the axes of each joint, in metres, and its root mean square motion per axis.

    The motion is measured over the KEPT_FRAME_SHARE of the frames with the smallest residuals. NaN if never visible.
    """
    shape = (joint_positions.shape[1], markers.shape[1])
    offsets, sd = np.full((*shape, 3), np.nan), np.full(shape, np.nan)
    for m in range(markers.shape[1]):
        visible = ~np.isnan(markers[:, m, 0])
        if not visible.any():
            continue
        local = np.einsum("tcba,tcb->tca", joint_rotations[visible], markers[visible, None, m] - joint_positions[visible])
        offsets[:, m] = np.median(local, axis=0)
        squared = np.sort(((local - offsets[:, m]) ** 2).sum(-1), axis=0)[: max(1, round(KEPT_FRAME_SHARE * visible.sum()))]
        sd[:, m] = np.sqrt(squared.mean(0) / 3)
    return offsets, sd


MAX_ATTACHMENT_ROUNDS = 5  # rounds of calibration and attachment
MAX_LEARNING_FRAMES = 90  # frames on which the person is calibrated in each round; the set is learned from more of them
MAX_ATTACHMENT_FRAMES = 300  # frames, evenly spread, from which markers are attached to segments
ONE_TAKE_MARKER_SPREAD_M = 0.02  # of an offset learned from one take: others place it at least this differently


@dataclass(frozen=True)
class MarkerSetFit:
    """A marker set learned from a take."""

    marker_set: MarkerSet  # the markers that are attached to a segment
    subject: Subject  # the person calibrated on them
    attachment: AttachedMarkers  # the segments of all markers of the take, in its order
    mean_residual_m: float  # mean distance of the markers from the body over the frames examined
    joint_rotations: np.ndarray  # (N, J, 3, 3) world rotations of the joints in these frames


class CalibratedFrames(NamedTuple):
    """A calibrated person and the world poses of N frames.

    joint_positions (N, J, 3) m, joint_rotations (N, J, 3, 3), mean_residual_m: mean marker distance from the body
    """

    subject: Subject
    joint_positions: np.ndarray
    joint_rotations: np.ndarray
    mean_residual_m: float


def fit_marker_set(
    take: Take, labels: tuple[str, ...], guess: MarkerSet, label_log_odds: float, body: BodyModel, prior: MeanPosePrior
) -> MarkerSetFit:
    """Return the marker set of a take, as far as its markers are attached to the body.

    Args:
        labels: The names of the take's M markers in the new set.
        guess: An initial set of some of these markers, enough to determine a body.
        label_log_odds: Log odds that the guess names the correct segment.

    Raises:
        TakeError: If the guess does not fit a person's size, or no marker moves with it.
    """
    atlas, frames = build_marker_atlas(load_whole_body_marker_sets()), select_candidate_frames(take.markers)
    frames = frames[sample_evenly(len(frames), MAX_ATTACHMENT_FRAMES)]
    log_odds = np.zeros((len(labels), len(body.skeleton.names)))
    log_odds[[labels.index(label) for label in guess.labels], guess.joints] = label_log_odds

    def calibrate_and_attach(marker_set: MarkerSet) -> tuple[CalibratedFrames, AttachedMarkers, MarkerSet]:
        part = restrict_body(body, set(marker_set.joints.tolist()))
        fit = calibrate_on_frames(take, labels, marker_set, part, prior, frames)
        size = fit.subject.skeleton.size_ratio
        is_posed = part.free_joints | part.shown_segments
        is_posed[0] = part.shown_segments[0]
        places = atlas.select_joints(is_posed[find_carriers(part.skeleton.parents, body.free_joints)]).scale(size)
        poses = fit.joint_positions, fit.joint_rotations
        attachment = attach_markers(take.markers[frames], *poses, places, body.skeleton.names, log_odds)
        return fit, attachment, build_marker_set(attachment, labels, guess, size)

    previous = guess
    fit, attachment, marker_set = calibrate_and_attach(guess)
    for _ in range(MAX_ATTACHMENT_ROUNDS - 1):
        if marker_set.labels == previous.labels and (marker_set.joints == previous.joints).all():
            break
        if not marker_set.labels:
            raise TakeError(f"{take.name}: no marker set can be learned: no marker moves with the body that was assumed.")
        previous = marker_set
        fit, attachment, marker_set = calibrate_and_attach(marker_set)
    return MarkerSetFit(marker_set, fit.subject, attachment, fit.mean_residual_m, fit.joint_rotations)


def build_marker_set(attachment: AttachedMarkers, labels: tuple[str, ...], guess: MarkerSet, size: float) -> MarkerSet:
    """Return the attached markers as a set on the average body; where the guess has the right segment, with its offset."""
    guessed = {label: k for k, label in enumerate(guess.labels)}
    attached = [m for m, joint in enumerate(attachment.joints) if joint >= 0]
    offsets, spread = attachment.offsets[attached] / size, np.full(len(attached), ONE_TAKE_MARKER_SPREAD_M)
    for n, m in enumerate(attached):
        k = guessed.get(labels[m], -1)
        if k >= 0 and guess.joints[k] == attachment.joints[m]:
            offsets[n], spread[n] = guess.marker_offsets[k], guess.marker_spread[k]
    return replace(
        guess,
        labels=tuple(labels[m] for m in attached),
        joints=attachment.joints[attached],
        marker_offsets=offsets,
        marker_spread=spread,
        aliases=((),) * len(attached),
    )


def calibrate_on_frames(
    take: Take, labels: tuple[str, ...], marker_set: MarkerSet, body: BodyModel, prior: MeanPosePrior, frames: np.ndarray
) -> CalibratedFrames:
    """Calibrate the wearer of a marker set and pose the given frames of the take."""
    columns = np.array([labels.index(label) for label in marker_set.labels])
    selected = take.select(columns, take.visible)
    markers = selected.markers[frames]
    sparse = selected.replace_markers(markers[sample_evenly(len(frames), MAX_LEARNING_FRAMES)])
    subject = fit_calibration(sparse, marker_set, body, prior).subject
    poses = refinement.pose_frames(subject, body, prior, markers)
    joint_poses = kinematics.compute_tree_poses(kinematics.build_kinematic_tree(subject.skeleton), *poses)
    predicted = kinematics.predict_markers(subject, poses)
    residual = float(np.nanmean(np.linalg.norm(markers - predicted, axis=-1)))
    return CalibratedFrames(subject, *joint_poses, residual)
