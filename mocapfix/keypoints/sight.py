"""What an orthographic camera says of poses, under a model of poses: the problem that is solved again and again."""

from dataclasses import dataclass, replace

import numpy as np

from mocapfix.kernels import kinematics
from mocapfix.kernels.pose import Tree
from mocapfix.kernels.terms import Courses, Views
from mocapfix.keypoints.detector import Detector
from mocapfix.motion import Motion
from mocapfix.prior.contract import PoseModel
from mocapfix.skeleton import Skeleton
from mocapfix.solve.poses import Posed, under

ROOM = 10.0  # metres: how far the root may be from where it starts; an orthographic camera does not tell its distance
WIDE, NARROW = 10.0, 6.0  # standard deviations: a keypoint farther from its point hardly counts (Geman-McClure)
NOT_FOUND = 0.1  # a confidence below which a keypoint is none


@dataclass(frozen=True)
class Sight:
    """T frames of keypoints, to be solved each for itself.

    rotation  (3, 3) world to camera
    strength  times the model's standard deviations
    pixels    (T, V, 2)
    weight    (T, V) 1/m^2; 0 where not seen
    robust    standard deviations beyond which a keypoint hardly counts, wide to narrow: one scale after the other
    """

    skeleton: Skeleton
    detector: Detector
    model: PoseModel
    strength: float
    rotation: np.ndarray
    pixels: np.ndarray
    weight: np.ndarray
    robust: tuple[float, ...] = (WIDE, NARROW)

    def at(self, frames: np.ndarray) -> "Sight":
        """-> some of the frames alone, by index, also more than once."""
        return replace(self, pixels=self.pixels[frames], weight=self.weight[frames])

    @property
    def tree(self) -> Tree:
        return kinematics.tree_of(self.skeleton)

    def solved(self, scale: float, root: np.ndarray, local: np.ndarray, course: Courses | None = None) -> Posed:
        """-> the poses at `scale` pixels per metre, from root (T, 3) and local (T, J, 3, 3), pulled to a course if given."""
        d, joints = self.detector, len(self.skeleton.names)
        views = Views(
            d.joints, d.places, np.zeros(len(d.joints), int), self.rotation[None], np.zeros((1, 3)), np.zeros(1, bool),
            np.ascontiguousarray(self.pixels / scale), self.weight,
        )  # fmt: skip
        near = Courses(np.zeros((1, joints, 3, 3)), np.zeros((1, joints)), root, np.full(1, ROOM**-2))
        scales2 = np.array(self.robust) ** 2
        return under(self.tree, (views, course or near), self.model, root, local, scale=self.strength, scales2=scales2)

    def placed(self, root: np.ndarray, local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """-> joints (T, J, 3) and the detector's points (T, V, 3), in metres, in the world."""
        none, nothing = np.zeros(len(root), int), np.zeros((len(root), 0))
        joints, turns = kinematics.world(self.skeleton, Motion(root, local, none, none, nothing, nothing))
        return joints, self.detector.placed(joints, turns)

    def flat(self, places: np.ndarray) -> np.ndarray:
        """-> (..., 2) metres, of places (..., 3), as the camera's axes see them."""
        return places @ self.rotation[:2].T

    def trust(self, scale: float, places: np.ndarray) -> np.ndarray:
        """-> (T, V) in 1/m^2, how much each keypoint counts beside points (T, V, 3), as the solve counts it in the end."""
        square = self.weight * ((self.pixels / scale - self.flat(places)) ** 2).sum(axis=-1)
        return self.weight / (1 + square / self.robust[-1] ** 2) ** 2
