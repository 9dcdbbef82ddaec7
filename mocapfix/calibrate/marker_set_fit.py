"""Learning a marker set: from a first guess at some of a take's markers to the segment and the place of all of them.

In turns, a person is calibrated on the markers whose segments are known so far, and every marker is attached to the segment of
that person in whose axes it stays stillest, until nothing changes any more.
"""

from dataclasses import dataclass, replace

import numpy as np

from mocapfix.calibrate import calibration, marker_attachment, refinement
from mocapfix.calibrate.calibration import calibrate_subject
from mocapfix.calibrate.marker_attachment import AttachedMarkers
from mocapfix.marker_sets import MarkerSet, load_shipped_marker_sets
from mocapfix.pose_prior.mean_pose import MeanPosePrior
from mocapfix.skeleton import BodyModel
from mocapfix.solve import kinematics
from mocapfix.subject import Subject
from mocapfix.take import Take

MAX_ATTACHMENT_ROUNDS = 5  # at most
ONE_TAKE_MARKER_SPREAD_M = 0.02  # metres: of one take of one person nobody knows more of the next one's places


@dataclass(frozen=True)
class MarkerSetFit:
    """A marker set learnt from a take.

    marker_set   of the markers that ride on a segment
    subject      the person it was learnt on
    attachment   of all the take's markers, in its order
    residual     metres: how far the markers lie from the body on average, over the frames looked at
    """

    marker_set: MarkerSet
    subject: Subject
    attachment: AttachedMarkers
    mean_residual_m: float


def fit_marker_set(
    take: Take, labels: tuple[str, ...], guess: MarkerSet, label_log_odds: float, body: BodyModel, prior: MeanPosePrior
) -> MarkerSetFit:
    """-> the marker set of a take's M markers, as far as they ride on the body.

    labels  the M markers' names in the set to be
    guess   a first guess at some of them, by these names: enough to show a body
    worth   log odds that the guess is right about a marker's segment, before it is seen to move

    Raises TakeError where the guess lies as on no body that there is.
    """
    worn, looked, known = (
        guess,
        calibration.select_candidate_frames(take.markers),
        marker_attachment.build_marker_atlas(load_shipped_marker_sets()),
    )
    told = np.zeros((len(labels), len(body.skeleton.names)))
    told[[labels.index(label) for label in guess.labels], guess.joints] = label_log_odds
    for _ in range(MAX_ATTACHMENT_ROUNDS):
        person, position, rotation, residual = calibrate_on_frames(take, labels, worn, body, prior, looked)
        size = person.skeleton.total_length_m / body.skeleton.total_length_m
        grown = known.scale(size)
        found = marker_attachment.attach_markers(take.markers[looked], position, rotation, grown, body.skeleton.names, told)
        before, worn = worn, build_marker_set(found, labels, guess, size)
        if worn.labels == before.labels and (worn.joints == before.joints).all():
            break
    return MarkerSetFit(worn, person, found, residual)


def build_marker_set(attachment: AttachedMarkers, labels: tuple[str, ...], guess: MarkerSet, size: float) -> MarkerSet:
    """-> the markers that ride on a segment, as a set on the average body, than which the person is so many times larger: where
    the guess has them if it is right about the segment, else where they were found."""
    guessed = {label: k for k, label in enumerate(guess.labels)}
    on = [m for m, joint in enumerate(attachment.joints) if joint >= 0]
    places, spread = attachment.offsets[on] / size, np.full(len(on), ONE_TAKE_MARKER_SPREAD_M)
    for n, m in enumerate(on):
        k = guessed.get(labels[m], -1)
        if k >= 0 and guess.joints[k] == attachment.joints[m]:
            places[n], spread[n] = guess.marker_offsets[k], guess.marker_spread[k]
    names, aliases = tuple(labels[m] for m in on), ((),) * len(on)
    return replace(
        guess, labels=names, joints=attachment.joints[on], marker_offsets=places, marker_spread=spread, aliases=aliases
    )


def calibrate_on_frames(
    take: Take, labels: tuple[str, ...], marker_set: MarkerSet, body: BodyModel, prior: MeanPosePrior, frames: np.ndarray
) -> tuple[Subject, np.ndarray, np.ndarray, float]:
    """-> the person who wears a set in a take, their joints in the frames `looked` at, position (N, J, 3) in metres and rotation
    (N, J, 3, 3), and the mean distance in metres of the set's markers from that body."""
    columns = np.array([labels.index(label) for label in marker_set.labels])
    markers = take.select(columns, take.visible)
    person = calibrate_subject(markers, marker_set, body, prior)
    motion = refinement.pose_frames(person, body, prior, markers.markers[frames])
    position, rotation = kinematics.compute_world_poses(person.skeleton, motion)
    placed = kinematics.compute_joint_and_marker_positions(person, motion)[1]
    return person, position, rotation, float(np.nanmean(np.linalg.norm(markers.markers[frames] - placed, axis=-1)))
