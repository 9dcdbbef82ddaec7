"""What calibration may change of a body, and how far people and marker places stray from it."""

from dataclasses import dataclass

import numpy as np

from mocapfix.kernels.shared import Deformations
from mocapfix.skeleton import Body
from mocapfix.subject import Subject

SIZE_SD = 1e3  # part of the size: free, since the take tells it better than anything
GROUP_SD = 0.08  # part of a bone group's length
PLACE_SD = 0.020  # metres: a person's marker about the average body's place


@dataclass(frozen=True)
class Freedom:
    """The shared unknowns (Q,): P of them along deformations, then the K markers' shifts (K, 3) in metres; all zero at first.

    offsets, places  (J, 3), (K, 3) metres: the body that is changed
    deformations       what changes with each of the P
    information      (Q,) one over each unknown's variance about zero
    """

    offsets: np.ndarray
    places: np.ndarray
    deformations: Deformations
    information: np.ndarray

    def body(self, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """-> offsets (J, 3) and places (K, 3) in metres."""
        along, shifts = np.split(unknowns, [len(self.deformations.places)])
        places = self.places + np.tensordot(along, self.deformations.places, 1) + shifts.reshape(-1, 3)
        return self.offsets + np.tensordot(along, self.deformations.offsets, 1), places


def of(start: Subject, body: Body) -> Freedom:
    """-> the size, the scales of bone groups, the shape and the marker places of `start`, free to change.

    start  `body` at some size
    """
    offsets, places = start.skeleton.offsets, start.places
    groups = np.zeros((len(body.groups), *offsets.shape))
    for g, joints in enumerate(map(list, body.groups.values())):
        groups[g, joints] = offsets[joints]
    shapes = body.shapes * np.linalg.norm(offsets) / np.linalg.norm(body.skeleton.offsets)
    along = np.concatenate([offsets[None], groups, shapes])
    with_size = np.concatenate([places[None], np.zeros((len(along) - 1, *places.shape))])
    deviations = (SIZE_SD, *[GROUP_SD] * len(groups), *[1.0] * len(shapes), *[PLACE_SD] * places.size)
    return Freedom(offsets, places, Deformations(along, with_size), 1 / np.square(deviations))
