"""What calibration may change of a body, and how far people and marker places stray from it."""

from dataclasses import dataclass

import numpy as np

from mocapfix.kernels.shared import Directions
from mocapfix.skeleton import Body
from mocapfix.subject import Subject

SIZE_SD = 1e3  # part of the size: free, since the take tells it better than anything
GROUP_SD = 0.08  # part of a bone group's length
PLACE_SD = 0.020  # metres: a person's marker about the average body's place


@dataclass(frozen=True)
class Freedom:
    """The shared unknowns (Q,): P of them along directions, then the K markers' shifts (K, 3) in metres; all zero at first.

    offsets, places  (J, 3), (K, 3) metres: the body that is changed
    directions       what changes with each of the P
    information      (Q,) one over each unknown's variance about zero
    """

    offsets: np.ndarray
    places: np.ndarray
    directions: Directions
    information: np.ndarray

    def body(self, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """-> offsets (J, 3) and places (K, 3) in metres."""
        along, shifts = np.split(unknowns, [len(self.directions.places)])
        places = self.places + np.tensordot(along, self.directions.places, 1) + shifts.reshape(-1, 3)
        return self.offsets + np.tensordot(along, self.directions.offsets, 1), places


def of(start: Subject, body: Body) -> Freedom:
    """-> the size, the scales of bone groups and the marker places of `start`, free to change."""
    offsets, places = start.skeleton.offsets, start.places
    stretches = np.zeros((1 + len(body.groups), *offsets.shape))
    stretches[0] = offsets
    for stretch, joints in zip(stretches[1:], body.groups.values(), strict=True):
        stretch[list(joints)] = offsets[list(joints)]
    directions = Directions(stretches, np.zeros((len(stretches), *places.shape)))
    deviations = np.r_[SIZE_SD, np.full(len(body.groups), GROUP_SD), np.full(places.size, PLACE_SD)]
    return Freedom(offsets, places, directions, 1 / deviations**2)
