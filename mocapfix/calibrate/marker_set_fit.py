"""Learning a marker set: from an initial guess for some markers of a take to the segment and offset of all of them.

Two steps alternate until nothing changes: a person is calibrated on the markers whose segments are known so far, and every marker
is attached to the segment of that person in whose axes it moves least.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from mocapfix.calibrate import refinement
from mocapfix.calibrate.calibration import calibrate_subject, select_candidate_frames
from mocapfix.calibrate.marker_attachment import AttachedMarkers, attach_markers, build_marker_atlas
from mocapfix.errors import TakeError
from mocapfix.marker_set import MarkerSet
from mocapfix.marker_sets.library import load_whole_body_marker_sets
from mocapfix.pose_prior.mean_pose import MeanPosePrior
from mocapfix.skeleton import BodyModel, find_carriers, restrict_body
from mocapfix.solve import kinematics
from mocapfix.stats.sequences import sample_evenly
from mocapfix.subject import Subject
from mocapfix.take import Take

MAX_ATTACHMENT_ROUNDS = 5
"""Rounds of calibration and attachment."""
MAX_LEARNING_FRAMES = 90
"""Frames on which the person is calibrated in each round; the set is learned from more of them."""
MAX_ATTACHMENT_FRAMES = 300
"""Frames, evenly spread, from which markers are attached to segments."""
ONE_TAKE_MARKER_SPREAD_M = 0.02
"""Spread of a marker offset learned from one take: other takes place the marker at least this differently."""


@dataclass(frozen=True)
class MarkerSetFit:
    """A marker set learned from a take.

    marker_set       the markers that are attached to a segment
    subject          the person calibrated on them
    attachment       the segments of all markers of the take, in its order
    mean_residual_m  mean distance of the markers from the body over the frames examined
    joint_rotations  (N, J, 3, 3) world rotations of the joints in these frames
    """

    marker_set: MarkerSet
    subject: Subject
    attachment: AttachedMarkers
    mean_residual_m: float
    joint_rotations: np.ndarray


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

    labels          the names of the take's M markers in the new set
    guess           an initial set of some of these markers, enough to determine a body
    label_log_odds  log odds that the guess names the correct segment

    Raises TakeError if the guess does not fit a person's size, or no marker moves with it.
    """
    atlas, frames = build_marker_atlas(load_whole_body_marker_sets()), select_candidate_frames(take.markers)
    frames = frames[sample_evenly(len(frames), MAX_ATTACHMENT_FRAMES)]
    log_odds = np.zeros((len(labels), len(body.skeleton.names)))
    log_odds[[labels.index(label) for label in guess.labels], guess.joints] = label_log_odds

    def calibrate_and_attach(marker_set: MarkerSet) -> tuple[CalibratedFrames, AttachedMarkers, MarkerSet]:
        part = restrict_body(body, set(marker_set.joints.tolist()))
        fit = calibrate_on_frames(take, labels, marker_set, part, prior, frames)
        size = fit.subject.skeleton.total_length_m / body.skeleton.total_length_m
        attachment = attach_markers(
            take.markers[frames],
            fit.joint_positions,
            fit.joint_rotations,
            atlas.select_joints(find_posed_joints(part, body)).scale(size),
            body.skeleton.names,
            log_odds,
        )
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


def find_posed_joints(part: BodyModel, body: BodyModel) -> Bool[np.ndarray, " J"]:
    """Return the joints (J,) to which markers may be attached: of a part of a body those that it shows, else all."""
    is_posed = part.free_joints | part.shown_segments
    is_posed[0] = part.shown_segments[0]
    return is_posed[find_carriers(part.skeleton.parents, body.free_joints)]


def build_marker_set(attachment: AttachedMarkers, labels: tuple[str, ...], guess: MarkerSet, size: float) -> MarkerSet:
    """Return the attached markers as a set on the average body.

    Where the guess has the correct segment its offset is kept, otherwise the measured one is used.

    size  the person's size relative to the average body
    """
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
    subject = calibrate_subject(sparse, marker_set, body, prior)
    motion = refinement.pose_frames(subject, body, prior, markers)
    joint_positions, joint_rotations = kinematics.compute_world_poses(subject.skeleton, motion)
    predicted = kinematics.compute_joint_and_marker_positions(subject, motion)[1]
    residual = float(np.nanmean(np.linalg.norm(markers - predicted, axis=-1)))
    return CalibratedFrames(subject, joint_positions, joint_rotations, residual)
