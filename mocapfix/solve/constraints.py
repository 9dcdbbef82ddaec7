"""What may be said of a single pose, each with its standard deviation.

Metres and radians, Y up. A joint is named as the skeleton names it; a place is a point in the joint's axes, which in the rest
pose (a T-pose facing +Z) are the world's: the joint itself where it is left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

ConstraintVector: TypeAlias = Sequence[float] | np.ndarray
JOINT_ORIGIN = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class PositionConstraint:
    """A point of a joint's body is `at` (3,) metres in the world; sd metres per axis."""

    joint: str
    position: ConstraintVector
    sd: float = 0.01
    offset: ConstraintVector = JOINT_ORIGIN


@dataclass(frozen=True)
class DirectionConstraint:
    """The bone from a joint to its child `to` points along `seen` (3,), of whatever length; sd radians."""

    joint: str
    child: str
    direction: ConstraintVector
    sd: float = 0.1


@dataclass(frozen=True)
class OrientationConstraint:
    """A joint's axes in the world are `rotation` (3, 3): it carries the joint's axes into the world's; sd radians per axis."""

    joint: str
    rotation: np.ndarray
    sd: float = 0.1


@dataclass(frozen=True)
class DistanceConstraint:
    """Points of two joints' bodies are `length` metres apart; sd metres."""

    joints: tuple[str, str]
    distance: float
    sd: float = 0.01
    offsets: tuple[ConstraintVector, ConstraintVector] = (JOINT_ORIGIN, JOINT_ORIGIN)


@dataclass(frozen=True)
class ConstraintCamera:
    """A camera whose axes are x to the right, y down, z ahead: camera = rotation @ world + translation.

    rotation     (3, 3)
    translation  (3,) metres
    scale        focal length in pixels; of one that is not perspective (scaled orthographic): pixels per metre
    centre       (2,) pixels, the principal point
    """

    rotation: np.ndarray
    translation: ConstraintVector
    scale: float
    centre: ConstraintVector = (0.0, 0.0)
    perspective: bool = True


@dataclass(frozen=True)
class PixelConstraint:
    """A point of a joint's body as a camera sees it, at `pixel` (2,); sd pixels per axis."""

    joint: str
    camera: ConstraintCamera
    pixel: ConstraintVector
    sd: float = 3.0
    offset: ConstraintVector = JOINT_ORIGIN


Constraint: TypeAlias = PositionConstraint | DirectionConstraint | OrientationConstraint | DistanceConstraint | PixelConstraint
