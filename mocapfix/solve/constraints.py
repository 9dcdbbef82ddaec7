"""Constraints on a single pose, each with its standard deviation, and their terms in the kernels.

Lengths are in metres, angles in radians, Y is up. Joints are named as in the skeleton. An offset is a point in the joint's axes,
which in the rest pose (a T-pose facing +Z) are parallel to the world axes; by default it is the joint itself.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias, TypeVar, cast

import numpy as np
from jaxtyping import Float, Int

from mocapfix.errors import ConstraintError, format_name_list
from mocapfix.kernels.terms import DirectionTerm, DistanceTerm, OrientationTerm, PointTerm, ReprojectionTerm, normalise_pixels
from mocapfix.skeleton import Skeleton

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


CONSTRAINT_TYPES = (PositionConstraint, DirectionConstraint, OrientationConstraint, DistanceConstraint, PixelConstraint)
"""The types of constraints, in the order of their terms."""
ROTATION_TOLERANCE = 1e-3
"""Error of the entries of a rotation matrix that is accepted, since people write a few digits."""

ConstraintTerms = tuple[PointTerm, DirectionTerm, OrientationTerm, DistanceTerm, ReprojectionTerm]
JointConstraint = TypeVar("JointConstraint", PositionConstraint, DirectionConstraint, OrientationConstraint, PixelConstraint)
AnyConstraint = TypeVar("AnyConstraint", bound=Constraint)


def build_constraint_terms(constraints: Sequence[Constraint], skeleton: Skeleton, frame_count: int) -> ConstraintTerms:
    """Return the terms that constrain `frame_count` poses equally, one of each type.

    Raises ConstraintError, naming the constraint, for an invalid value.
    """
    if not constraints:
        raise ConstraintError("There is no constraint; give at least the position of one joint.")
    for constraint in constraints:
        if type(constraint) not in CONSTRAINT_TYPES:
            names = ", ".join(kind.__name__ for kind in CONSTRAINT_TYPES)
            raise ConstraintError(f"{constraint!r} is not a constraint; choose from: {names}.")
    return (
        build_point_term([c for c in constraints if isinstance(c, PositionConstraint)], skeleton, frame_count),
        build_direction_term([c for c in constraints if isinstance(c, DirectionConstraint)], skeleton, frame_count),
        build_orientation_term([c for c in constraints if isinstance(c, OrientationConstraint)], skeleton, frame_count),
        build_distance_term([c for c in constraints if isinstance(c, DistanceConstraint)], skeleton),
        build_reprojection_term([c for c in constraints if isinstance(c, PixelConstraint)], skeleton, frame_count),
    )


def build_point_term(constraints: Sequence[PositionConstraint], skeleton: Skeleton, frame_count: int) -> PointTerm:
    """Return position constraints as a term."""
    positions = gather_values(constraints, lambda c: check_numbers(c, "position", c.position, 3), 3)
    offsets = gather_values(constraints, lambda c: check_numbers(c, "offset", c.offset, 3), 3)
    weights = repeat_rows(compute_constraint_weights(constraints), frame_count)
    return PointTerm(find_constrained_joints(constraints, skeleton), offsets, repeat_rows(positions, frame_count), weights)


def build_direction_term(constraints: Sequence[DirectionConstraint], skeleton: Skeleton, frame_count: int) -> DirectionTerm:
    """Return direction constraints as a term."""
    bones = gather_values(
        constraints, lambda c: normalise_direction(c, f"the bone to {c.child}", find_bone_vector(c, skeleton)), 3
    )
    directions = gather_values(
        constraints, lambda c: normalise_direction(c, "direction", check_numbers(c, "direction", c.direction, 3)), 3
    )
    weights = repeat_rows(compute_constraint_weights(constraints), frame_count)
    return DirectionTerm(find_constrained_joints(constraints, skeleton), bones, repeat_rows(directions, frame_count), weights)


def build_orientation_term(constraints: Sequence[OrientationConstraint], skeleton: Skeleton, frame_count: int) -> OrientationTerm:
    """Return orientation constraints as a term."""
    rotations = gather_values(constraints, lambda c: check_rotation(c, c.rotation), 3, 3)
    weights = repeat_rows(compute_constraint_weights(constraints), frame_count)
    return OrientationTerm(find_constrained_joints(constraints, skeleton), repeat_rows(rotations, frame_count), weights)


def build_distance_term(constraints: Sequence[DistanceConstraint], skeleton: Skeleton) -> DistanceTerm:
    """Return distance constraints as a term."""
    joints = np.array([[find_joint(c, name, skeleton) for name in check_joint_pair(c)] for c in constraints], int)
    offsets = gather_values(constraints, lambda c: check_numbers(c, "offsets", c.offsets, 2, 3), 2, 3)
    distances = np.array([float(check_numbers(c, "distance", c.distance)) for c in constraints])
    return DistanceTerm(joints.reshape(-1, 2), offsets, distances[None], compute_constraint_weights(constraints)[None])


def build_reprojection_term(constraints: Sequence[PixelConstraint], skeleton: Skeleton, frame_count: int) -> ReprojectionTerm:
    """Return pixel constraints as a term, with one camera for each of them."""
    for c in constraints:
        if not isinstance(c.camera, Camera):  # pyright: ignore[reportUnnecessaryIsInstance]  # given by users
            raise build_constraint_error(c, f"camera must be a Camera, not {c.camera!r}")
    pixels = gather_values(constraints, lambda c: check_numbers(c, "pixel", c.pixel, 2), 2)
    centres = gather_values(constraints, lambda c: check_numbers(c, "camera.centre", c.camera.centre, 2), 2)
    scales = np.array([check_positive(c, "camera.scale", c.camera.scale) for c in constraints]).reshape(-1, 1)
    return ReprojectionTerm(
        find_constrained_joints(constraints, skeleton),
        gather_values(constraints, lambda c: check_numbers(c, "offset", c.offset, 3), 3),
        np.arange(len(constraints)),
        gather_values(constraints, lambda c: check_rotation(c, c.camera.rotation), 3, 3),
        gather_values(constraints, lambda c: check_numbers(c, "camera.translation", c.camera.translation, 3), 3),
        np.array([c.camera.perspective for c in constraints], bool),
        repeat_rows(normalise_pixels(pixels, scales, centres), frame_count),
        repeat_rows(compute_constraint_weights(constraints) * scales[:, 0] ** 2, frame_count),
    )


def gather_values(
    constraints: Sequence[AnyConstraint], get_value: Callable[[AnyConstraint], np.ndarray], *shape: int
) -> np.ndarray:
    """Return a value of each of K constraints as an array (K, *shape)."""
    return np.array([get_value(constraint) for constraint in constraints], float).reshape(-1, *shape)


def repeat_rows(rows: np.ndarray, frame_count: int) -> np.ndarray:
    """Return the same rows for every frame, (frame_count, ...)."""
    return np.repeat(rows[None], frame_count, axis=0)


def find_constrained_joints(constraints: Sequence[JointConstraint], skeleton: Skeleton) -> Int[np.ndarray, " K"]:
    """Return the index of each constraint's joint."""
    return np.array([find_joint(constraint, constraint.joint, skeleton) for constraint in constraints], int)


def find_joint(constraint: Constraint, joint: str, skeleton: Skeleton) -> int:
    """Return the index of a joint named by a constraint. Raises ConstraintError for an unknown name."""
    if joint not in skeleton.names:
        raise build_constraint_error(
            constraint, f"there is no joint {joint!r}; the skeleton has: {format_name_list(skeleton.names)}"
        )
    return skeleton.find_joint(joint)


def check_joint_pair(constraint: DistanceConstraint) -> tuple[str, str]:
    """Return the two joints of a constraint. Raises ConstraintError unless there are two."""
    joints: object = constraint.joints  # users may give something else
    if not isinstance(joints, tuple | list) or len(constraint.joints) != 2:  # pyright: ignore[reportUnnecessaryIsInstance]
        raise build_constraint_error(constraint, "joints must be the names of two joints")
    return constraint.joints


def compute_constraint_weights(constraints: Sequence[AnyConstraint]) -> Float[np.ndarray, " K"]:
    """Return the inverse squares of the standard deviations."""
    return np.array([check_positive(constraint, "sd", constraint.sd) ** -2.0 for constraint in constraints])


def check_numbers(constraint: Constraint, name: str, value: object, *shape: int) -> np.ndarray:
    """Return a field of a constraint as finite numbers of a given shape. Raises ConstraintError if it is something else."""
    try:
        numbers = np.asarray(value, float)
    except (TypeError, ValueError):
        numbers = np.full(0, np.nan)
    if numbers.shape != shape or not np.isfinite(numbers).all():
        count = " x ".join(map(str, shape)) or "one"
        raise build_constraint_error(constraint, f"{name} must be {count} finite number{'s' * bool(shape)}, not {value!r}")
    return numbers


def check_positive(constraint: Constraint, name: str, value: object) -> float:
    """Return a field of a constraint as a positive number. Raises ConstraintError if it is something else."""
    number = float(check_numbers(constraint, name, value))
    if number <= 0:
        raise build_constraint_error(constraint, f"{name} must be greater than 0, not {value!r}")
    return number


def check_rotation(constraint: Constraint, value: object) -> Float[np.ndarray, "3 3"]:
    """Return a field of a constraint as a rotation matrix. Raises ConstraintError if it is something else."""
    matrix = check_numbers(constraint, "rotation", value, 3, 3)
    if not is_rotation(matrix):
        raise build_constraint_error(constraint, "rotation must be a right-handed matrix with orthonormal rows")
    return matrix


def is_rotation(matrix: Float[np.ndarray, "3 3"]) -> bool:
    """Return whether a matrix is a rotation, within ROTATION_TOLERANCE."""
    return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() < ROTATION_TOLERANCE and np.linalg.det(matrix) > 0)


def normalise_direction(constraint: Constraint, name: str, vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Return a vector at unit length. Raises ConstraintError if it has length zero."""
    length = np.linalg.norm(vector)
    if length == 0:
        raise build_constraint_error(constraint, f"{name} has length zero and therefore no direction")
    return vector / length


def find_bone_vector(constraint: DirectionConstraint, skeleton: Skeleton) -> Float[np.ndarray, "3"]:
    """Return the bone from a joint to its child, in metres in the joint's axes. Raises ConstraintError if there is none."""
    child, parent = find_joint(constraint, constraint.child, skeleton), find_joint(constraint, constraint.joint, skeleton)
    if skeleton.parents[child] != parent:
        actual = skeleton.names[skeleton.parents[child]] if child else "none"
        raise build_constraint_error(constraint, f"{constraint.child} is no child of {constraint.joint}; its parent is {actual}")
    return skeleton.offsets[child]


def build_constraint_error(constraint: Constraint, problem: str) -> ConstraintError:
    """Return the error for a problem with a constraint."""
    joints: object = constraint.joints if isinstance(constraint, DistanceConstraint) else constraint.joint
    names = " and ".join(map(str, cast("Sequence[object]", joints))) if isinstance(joints, tuple | list) else joints
    return ConstraintError(f"{type(constraint).__name__} of {names}: {problem}.")
