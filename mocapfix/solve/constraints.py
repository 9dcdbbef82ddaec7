"""Constraints on a single pose, each with its standard deviation.

Lengths are in metres, angles in radians, Y is up. Joints are named as in the skeleton. An offset is a point in the joint's axes,
which in the rest pose (a T-pose facing +Z) are parallel to the world axes; by default it is the joint itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

ConstraintVector: TypeAlias = Sequence[float] | np.ndarray

JOINT_ORIGIN = (0.0, 0.0, 0.0)
"""The offset of the joint itself, in metres."""


@dataclass(frozen=True)
class PositionConstraint:
    """A point fixed to a joint is at `position` (3,) m in the world; sd in metres per axis."""

    joint: str
    position: ConstraintVector
    sd: float = 0.01
    offset: ConstraintVector = JOINT_ORIGIN


@dataclass(frozen=True)
class DirectionConstraint:
    """The bone from a joint to its child points along `direction` (3,), a vector of any length; sd in radians."""

    joint: str
    child: str
    direction: ConstraintVector
    sd: float = 0.1


@dataclass(frozen=True)
class OrientationConstraint:
    """The world rotation of a joint is `rotation` (3, 3), joint axes to world axes; sd in radians per axis."""

    joint: str
    rotation: np.ndarray
    sd: float = 0.1


@dataclass(frozen=True)
class DistanceConstraint:
    """The distance in metres between points fixed to two joints; sd in metres."""

    joints: tuple[str, str]
    distance: float
    sd: float = 0.01
    offsets: tuple[ConstraintVector, ConstraintVector] = (JOINT_ORIGIN, JOINT_ORIGIN)


@dataclass(frozen=True)
class Camera:
    """A camera with axes x to the right, y down, z ahead: camera = rotation @ world + translation.

    rotation     (3, 3)
    translation  (3,) m
    scale        focal length in pixels; for a scaled orthographic camera pixels per metre
    centre       (2,) pixels: the principal point
    """

    rotation: Float[np.ndarray, "3 3"]
    translation: ConstraintVector
    scale: float
    centre: ConstraintVector = (0.0, 0.0)
    perspective: bool = True

    def project(self, positions: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
        """Return the pixels of world positions in metres; of a perspective camera only for positions in front of it."""
        translation = np.asarray(self.translation, float)
        flat = positions @ self.rotation[:2].T + translation[:2]
        if self.perspective:
            flat = flat / (positions @ self.rotation[2] + translation[2])[..., None]
        return np.asarray(self.centre, float) + self.scale * flat


@dataclass(frozen=True)
class PixelConstraint:
    """A camera images a point fixed to a joint at `pixel` (2,); sd in pixels per axis."""

    joint: str
    camera: Camera
    pixel: ConstraintVector
    sd: float = 3.0
    offset: ConstraintVector = JOINT_ORIGIN


Constraint: TypeAlias = PositionConstraint | DirectionConstraint | OrientationConstraint | DistanceConstraint | PixelConstraint
