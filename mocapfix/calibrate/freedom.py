"""What calibration may change of a body, and how far people, marker places and the poses of one take stray from it."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from mocapfix.kernels.shared import Deformations
from mocapfix.prior import Prior
from mocapfix.skeleton import Body, Skeleton
from mocapfix.subject import Subject

SIZE_SD = 1e3  # part of the size: free, since the take tells it better than anything
GROUP_SD = 0.05  # part of a bone group's length, left and right together: likeliest of each CMU subject, given the others
LENGTH_SD = 0.03  # part of a bone's length that it has for itself, left and right apart: CMU's subjects are that crooked
HABIT_SD = 0.02  # radians: so far a take's mean pose strays from people's about axes where none is known to
SHORT = 0.02  # metres: what is shorter is no bone


@dataclass(frozen=True)
class Freedom:
    """The shared unknowns (Q,): P of them along deformations, then the K markers' shifts (K, 3) in metres, then the take's mean
    pose: by how much the free joints below the root are turned from people's (F, 3), radians; all zero at first.

    offsets, places  (J, 3), (K, 3) metres: the body that is changed
    free             (J,) bool, joints that turn
    deformations     what changes with each of the P
    information      (Q, Q) the unknowns' inverse covariance about zero
    """

    offsets: np.ndarray
    places: np.ndarray
    free: np.ndarray
    deformations: Deformations
    information: np.ndarray

    def body(self, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """-> offsets (J, 3) and places (K, 3) in metres, and the mean pose's turns (J, 3) in radians."""
        dense = len(self.deformations.places)
        along, shifts, turned = np.split(unknowns, [dense, dense + self.places.size])
        places = self.places + np.tensordot(along, self.deformations.places, 1) + shifts.reshape(-1, 3)
        turns = np.zeros_like(self.offsets)
        turns[np.flatnonzero(self.free)[1:]] = turned.reshape(-1, 3)
        return self.offsets + np.tensordot(along, self.deformations.offsets, 1), places, turns


def of(start: Subject, body: Body, prior: Prior) -> Freedom:
    """-> size, shape, scales of bone groups, each bone's own length and marker places of `start`, and the mean pose, free.

    start  `body` at some size; its spread is by how far people's markers lie from its places
    """
    offsets, places = start.skeleton.offsets, start.places
    shapes = body.shapes * np.linalg.norm(offsets) / np.linalg.norm(body.skeleton.offsets)
    groups = np.zeros((len(body.groups), *offsets.shape))
    for g, joints in enumerate(map(list, body.groups.values())):
        groups[g, joints] = offsets[joints]
    lengths = bones(start.skeleton)
    along = np.concatenate([offsets[None], shapes, groups, lengths])
    with_size = np.concatenate([places[None], np.zeros((len(along) - 1, *places.shape))])
    own = *[GROUP_SD] * len(groups), *[LENGTH_SD] * len(lengths)
    deviations = (SIZE_SD, *[1.0] * len(shapes), *own, *np.repeat(start.spread, 3))
    habits = np.linalg.inv(prior.between[np.flatnonzero(body.free)[1:]] + HABIT_SD**2 * np.eye(3))
    information = np.asarray(block_diag(np.diag(1 / np.square(deviations)), *habits))
    return Freedom(offsets, places, body.free, Deformations(along, with_size), information)


def bones(skeleton: Skeleton) -> np.ndarray:
    """-> (B, J, 3) metres: the offsets of one bone each, as long as it is.

    Joints at the same offset from one parent hang on one bone: the thorax carries the neck and both shoulders.
    """
    offsets, found = skeleton.offsets, []
    for j in np.flatnonzero(np.linalg.norm(offsets, axis=1) > SHORT):
        same = (skeleton.parents == skeleton.parents[j]) & np.isclose(offsets, offsets[j]).all(1)
        if np.flatnonzero(same)[0] == j:
            found.append(np.where(same[:, None], offsets, 0.0))
    return np.array(found)
