"""Learning a marker set: from a first guess at some of a take's markers to the segment and the place of all of them.

In turns, a person is calibrated on the markers whose segments are known so far, and every marker is attached to the segment of
that person in whose axes it stays stillest, until nothing changes any more.
"""

from dataclasses import dataclass, replace

import numpy as np

from mocapfix.calibrate import attach, frames, refine, subject
from mocapfix.calibrate.attach import Attachment
from mocapfix.kernels import kinematics
from mocapfix.marker_set import MarkerSet, shipped
from mocapfix.prior import Prior
from mocapfix.skeleton import Body
from mocapfix.subject import Subject
from mocapfix.take import Take

ROUNDS = 5  # at most
LEARNT_SPREAD = 0.02  # metres: of one take of one person nobody knows more of the next one's places


@dataclass(frozen=True)
class Learnt:
    """A marker set learnt from a take.

    marker_set   of the markers that ride on a segment
    subject      the person it was learnt on
    attachment   of all the take's markers, in its order
    residual     metres: how far the markers lie from the body on average, over the frames looked at
    """

    marker_set: MarkerSet
    subject: Subject
    attachment: Attachment
    residual: float


def learnt(take: Take, labels: tuple[str, ...], guess: MarkerSet, worth: float, body: Body, prior: Prior) -> Learnt:
    """-> the marker set of a take's M markers, as far as they ride on the body.

    labels  the M markers' names in the set to be
    guess   a first guess at some of them, by these names: enough to show a body
    worth   log odds that the guess is right about a marker's segment, before it is seen to move

    Raises TakeError where the guess lies as on no body that there is.
    """
    worn, looked, known = guess, frames.candidates(take.markers), attach.atlas(shipped())
    told = np.zeros((len(labels), len(body.skeleton.names)))
    told[[labels.index(label) for label in guess.labels], guess.joints] = worth
    for _ in range(ROUNDS):
        person, position, rotation, residual = solved(take, labels, worn, body, prior, looked)
        size = person.skeleton.size / body.skeleton.size
        grown = known.grown(size)
        found = attach.attached(take.markers[looked], position, rotation, grown, body.skeleton.names, told)
        before, worn = worn, wearing(found, labels, guess, size)
        if worn.labels == before.labels and (worn.joints == before.joints).all():
            break
    return Learnt(worn, person, found, residual)


def wearing(found: Attachment, labels: tuple[str, ...], guess: MarkerSet, size: float) -> MarkerSet:
    """-> the markers that ride on a segment, as a set on the average body, than which the person is so many times larger: where
    the guess has them if it is right about the segment, else where they were found."""
    guessed = {label: k for k, label in enumerate(guess.labels)}
    on = [m for m, joint in enumerate(found.joints) if joint >= 0]
    places, spread = found.places[on] / size, np.full(len(on), LEARNT_SPREAD)
    for n, m in enumerate(on):
        k = guessed.get(labels[m], -1)
        if k >= 0 and guess.joints[k] == found.joints[m]:
            places[n], spread[n] = guess.places[k], guess.spread[k]
    names, aliases = tuple(labels[m] for m in on), ((),) * len(on)
    return replace(guess, labels=names, joints=found.joints[on], places=places, spread=spread, aliases=aliases)


def solved(
    take: Take, labels: tuple[str, ...], worn: MarkerSet, body: Body, prior: Prior, looked: np.ndarray
) -> tuple[Subject, np.ndarray, np.ndarray, float]:
    """-> the person who wears a set in a take, their joints in the frames `looked` at, position (N, J, 3) in metres and rotation
    (N, J, 3, 3), and the mean distance in metres of the set's markers from that body."""
    columns = np.array([labels.index(label) for label in worn.labels])
    markers = take.worn(columns, take.seen)
    person = subject(markers, worn, body, prior)
    motion = refine.posed(person, body, prior, markers.markers[looked])
    position, rotation = kinematics.world(person.skeleton, motion)
    placed = kinematics.placed(person, motion)[1]
    return person, position, rotation, float(np.nanmean(np.linalg.norm(markers.markers[looked] - placed, axis=-1)))
