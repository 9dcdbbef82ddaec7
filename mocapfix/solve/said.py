"""Constraints as the kernels' terms, and whether each says what it must."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mocapfix.errors import ConstraintError
from mocapfix.kernels.terms import Directions, Distances, Orientations, Points, Views, normalised
from mocapfix.skeleton import Skeleton
from mocapfix.solve.constraints import Camera, Constraint, Direction, Distance, Orientation, Position, Seen

KINDS = (Position, Direction, Orientation, Distance, Seen)
SQUARE = 1e-3  # how far the entries of a rotation may be off: somebody wrote it down to a few digits


def terms_of(constraints: Sequence[Constraint], skeleton: Skeleton, frames: int) -> tuple:
    """-> the terms that hold `frames` poses alike, always of the same kinds.

    Raises ConstraintError, saying which constraint does not say what it must.
    """
    if not constraints:
        raise ConstraintError("There is no constraint; say at least where one joint is.")
    of: dict[type, list] = {kind: [] for kind in KINDS}
    for each in constraints:
        if type(each) not in of:
            raise ConstraintError(f"{each!r} is no constraint; choose of: {', '.join(kind.__name__ for kind in KINDS)}.")
        of[type(each)].append(each)
    return (
        points(of[Position], skeleton, frames), directions(of[Direction], skeleton, frames),
        orientations(of[Orientation], skeleton, frames), distances(of[Distance], skeleton), views(of[Seen], skeleton, frames),
    )  # fmt: skip


def points(said: list[Position], skeleton: Skeleton, frames: int) -> Points:
    seen = gathered(said, lambda c: numbers(c, "at", c.at, 3), 3)
    places = gathered(said, lambda c: numbers(c, "place", c.place, 3), 3)
    return Points(joints_of(said, skeleton), places, repeated(seen, frames), repeated(weights(said), frames))


def directions(said: list[Direction], skeleton: Skeleton, frames: int) -> Directions:
    along = gathered(said, lambda c: unit(c, f"the bone to {c.to}", bone(c, skeleton)), 3)
    seen = gathered(said, lambda c: unit(c, "seen", numbers(c, "seen", c.seen, 3)), 3)
    return Directions(joints_of(said, skeleton), along, repeated(seen, frames), repeated(weights(said), frames))


def orientations(said: list[Orientation], skeleton: Skeleton, frames: int) -> Orientations:
    seen = gathered(said, lambda c: turn(c, c.rotation), 3, 3)
    return Orientations(joints_of(said, skeleton), repeated(seen, frames), repeated(weights(said), frames))


def distances(said: list[Distance], skeleton: Skeleton) -> Distances:
    joints = np.array([[index(c, name, skeleton) for name in pair(c)] for c in said], int).reshape(-1, 2)
    places = gathered(said, lambda c: numbers(c, "places", c.places, 2, 3), 2, 3)
    length = np.array([float(numbers(c, "length", c.length)) for c in said])
    return Distances(joints, places, length[None], weights(said)[None])


def views(said: list[Seen], skeleton: Skeleton, frames: int) -> Views:
    """Every point brings its own camera along: they are few."""
    for c in said:
        if not isinstance(c.camera, Camera):
            raise wrong(c, f"camera must be a solve.Camera, and is {c.camera!r}")
    pixels = gathered(said, lambda c: numbers(c, "pixel", c.pixel, 2), 2)
    centres = gathered(said, lambda c: numbers(c, "camera.centre", c.camera.centre, 2), 2)
    scales = np.array([positive(c, "camera.scale", c.camera.scale) for c in said]).reshape(-1, 1)
    return Views(
        joints_of(said, skeleton),
        gathered(said, lambda c: numbers(c, "place", c.place, 3), 3),
        np.arange(len(said)),
        gathered(said, lambda c: turn(c, c.camera.rotation), 3, 3),
        gathered(said, lambda c: numbers(c, "camera.translation", c.camera.translation, 3), 3),
        np.array([c.camera.perspective for c in said], bool),
        repeated(normalised(pixels, scales, centres), frames),
        repeated(weights(said) * scales[:, 0] ** 2, frames),
    )


def gathered(said: Sequence[Any], what: Callable[[Any], np.ndarray], *shape: int) -> np.ndarray:
    """-> (K, *shape) what each constraint says."""
    return np.array([what(each) for each in said], float).reshape(-1, *shape)


def repeated(rows: np.ndarray, frames: int) -> np.ndarray:
    """-> (frames, ...) the same in every frame."""
    return np.repeat(rows[None], frames, axis=0)


def joints_of(said: Sequence[Any], skeleton: Skeleton) -> np.ndarray:
    return np.array([index(each, each.joint, skeleton) for each in said], int)


def index(constraint: Constraint, joint: str, skeleton: Skeleton) -> int:
    if joint not in skeleton.names:
        raise wrong(constraint, f"there is no joint {joint!r}; the skeleton has: {', '.join(skeleton.names)}")
    return skeleton.index(joint)


def pair(constraint: Distance) -> tuple[str, str]:
    if not isinstance(constraint.joints, tuple | list) or len(constraint.joints) != 2:
        raise wrong(constraint, "joints must be the names of two")
    return constraint.joints


def weights(said: Sequence[Any]) -> np.ndarray:
    """-> (K,) one over the squares of the standard deviations."""
    return np.array([positive(each, "sd", each.sd) ** -2.0 for each in said])


def numbers(constraint: Constraint, name: str, value: Any, *shape: int) -> np.ndarray:
    """-> a field as finite numbers of a shape."""
    try:
        found = np.asarray(value, float)
    except (TypeError, ValueError):
        found = np.full(0, np.nan)
    if found.shape != shape or not np.isfinite(found).all():
        much = " x ".join(map(str, shape)) or "one"
        raise wrong(constraint, f"{name} must be {much} finite number{'s' * bool(shape)}, and is {value!r}")
    return found


def positive(constraint: Constraint, name: str, value: Any) -> float:
    number = float(numbers(constraint, name, value))
    if number <= 0:
        raise wrong(constraint, f"{name} must be more than 0, and is {value!r}")
    return number


def turn(constraint: Constraint, value: Any) -> np.ndarray:
    """-> (3, 3) a rotation."""
    matrix = numbers(constraint, "rotation", value, 3, 3)
    if not turns(matrix):
        raise wrong(constraint, "rotation must have rows of length one at right angles, right-handed")
    return matrix


def turns(matrix: np.ndarray) -> bool:
    """-> whether (3, 3) is a rotation."""
    return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() < SQUARE and np.linalg.det(matrix) > 0)


def unit(constraint: Constraint, name: str, vector: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector)
    if length == 0:
        raise wrong(constraint, f"{name} has no length, and so no direction")
    return vector / length


def bone(constraint: Direction, skeleton: Skeleton) -> np.ndarray:
    """-> (3,) metres, from a joint to its child in its own axes."""
    child, parent = index(constraint, constraint.to, skeleton), index(constraint, constraint.joint, skeleton)
    if skeleton.parents[child] != parent:
        raise wrong(constraint, f"{constraint.to} is no child of {constraint.joint}; its parent is {above(child, skeleton)}")
    return skeleton.offsets[child]


def above(child: int, skeleton: Skeleton) -> str:
    return skeleton.names[skeleton.parents[child]] if child else "none"


def wrong(constraint: Constraint, why: str) -> ConstraintError:
    where = constraint.joints if isinstance(constraint, Distance) else constraint.joint
    where = " and ".join(map(str, where)) if isinstance(where, tuple | list) else where
    return ConstraintError(f"{type(constraint).__name__} of {where}: {why}.")
