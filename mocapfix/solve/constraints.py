"""What may be said of a single pose, each with its standard deviation.

Metres and radians, Y up. A joint is named as the skeleton names it; a place is a point in the joint's axes, which in the rest
pose (a T-pose facing +Z) are the world's: the joint itself where it is left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

Vector: TypeAlias = Sequence[float] | np.ndarray
HERE = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Position:
    """A point of a joint's body is `at` (3,) metres in the world; sd metres per axis."""

    joint: str
    at: Vector
    sd: float = 0.01
    place: Vector = HERE


@dataclass(frozen=True)
class Direction:
    """The bone from a joint to its child `to` points along `seen` (3,), of whatever length; sd radians."""

    joint: str
    to: str
    seen: Vector
    sd: float = 0.1


@dataclass(frozen=True)
class Orientation:
    """A joint's axes in the world are `rotation` (3, 3): it carries the joint's axes into the world's; sd radians per axis."""

    joint: str
    rotation: np.ndarray
    sd: float = 0.1


@dataclass(frozen=True)
class Distance:
    """Points of two joints' bodies are `length` metres apart; sd metres."""

    joints: tuple[str, str]
    length: float
    sd: float = 0.01
    places: tuple[Vector, Vector] = (HERE, HERE)


@dataclass(frozen=True)
class Camera:
    """A camera whose axes are x to the right, y down, z ahead: camera = rotation @ world + translation.

    rotation     (3, 3)
    translation  (3,) metres
    scale        focal length in pixels; of one that is not perspective (scaled orthographic): pixels per metre
    centre       (2,) pixels, the principal point
    """

    rotation: np.ndarray
    translation: Vector
    scale: float
    centre: Vector = (0.0, 0.0)
    perspective: bool = True


@dataclass(frozen=True)
class Seen:
    """A point of a joint's body as a camera sees it, at `pixel` (2,); sd pixels per axis."""

    joint: str
    camera: Camera
    pixel: Vector
    sd: float = 3.0
    place: Vector = HERE


Constraint: TypeAlias = Position | Direction | Orientation | Distance | Seen
