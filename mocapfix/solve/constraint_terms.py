"""Constraints as the kernels' terms, and whether each says what it must."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mocapfix.errors import ConstraintError
from mocapfix.kernels.terms import DirectionTerm, DistanceTerm, OrientationTerm, PointTerm, ReprojectionTerm, normalise_pixels
from mocapfix.skeleton import Skeleton
from mocapfix.solve.constraints import (
    Constraint,
    ConstraintCamera,
    DirectionConstraint,
    DistanceConstraint,
    OrientationConstraint,
    PixelConstraint,
    PositionConstraint,
)

CONSTRAINT_TYPES = (PositionConstraint, DirectionConstraint, OrientationConstraint, DistanceConstraint, PixelConstraint)
ROTATION_TOLERANCE = 1e-3  # how far the entries of a rotation may be off: somebody wrote it down to a few digits


def build_constraint_terms(constraints: Sequence[Constraint], skeleton: Skeleton, frame_count: int) -> tuple:
    """-> the terms that hold `frames` poses alike, always of the same kinds.

    Raises ConstraintError, saying which constraint does not say what it must.
    """
    if not constraints:
        raise ConstraintError("There is no constraint; say at least where one joint is.")
    of: dict[type, list] = {kind: [] for kind in CONSTRAINT_TYPES}
    for each in constraints:
        if type(each) not in of:
            raise ConstraintError(
                f"{each!r} is no constraint; choose of: {', '.join(kind.__name__ for kind in CONSTRAINT_TYPES)}."
            )
        of[type(each)].append(each)
    return (
        build_point_term(of[PositionConstraint], skeleton, frame_count), build_direction_term(of[DirectionConstraint], skeleton, frame_count),
        build_orientation_term(of[OrientationConstraint], skeleton, frame_count), build_distance_term(of[DistanceConstraint], skeleton), build_reprojection_term(of[PixelConstraint], skeleton, frame_count),
    )  # fmt: skip


def build_point_term(constraints: list[PositionConstraint], skeleton: Skeleton, frame_count: int) -> PointTerm:
    seen = gather_values(constraints, lambda c: check_numbers(c, "at", c.position, 3), 3)
    places = gather_values(constraints, lambda c: check_numbers(c, "place", c.offset, 3), 3)
    return PointTerm(
        find_constrained_joints(constraints, skeleton),
        places,
        repeat_rows(seen, frame_count),
        repeat_rows(compute_constraint_weights(constraints), frame_count),
    )


def build_direction_term(constraints: list[DirectionConstraint], skeleton: Skeleton, frame_count: int) -> DirectionTerm:
    along = gather_values(
        constraints, lambda c: normalise_direction(c, f"the bone to {c.child}", find_bone_vector(c, skeleton)), 3
    )
    seen = gather_values(constraints, lambda c: normalise_direction(c, "seen", check_numbers(c, "seen", c.direction, 3)), 3)
    return DirectionTerm(
        find_constrained_joints(constraints, skeleton),
        along,
        repeat_rows(seen, frame_count),
        repeat_rows(compute_constraint_weights(constraints), frame_count),
    )


def build_orientation_term(constraints: list[OrientationConstraint], skeleton: Skeleton, frame_count: int) -> OrientationTerm:
    seen = gather_values(constraints, lambda c: check_rotation(c, c.rotation), 3, 3)
    return OrientationTerm(
        find_constrained_joints(constraints, skeleton),
        repeat_rows(seen, frame_count),
        repeat_rows(compute_constraint_weights(constraints), frame_count),
    )


def build_distance_term(constraints: list[DistanceConstraint], skeleton: Skeleton) -> DistanceTerm:
    joints = np.array([[find_joint(c, name, skeleton) for name in check_joint_pair(c)] for c in constraints], int).reshape(-1, 2)
    places = gather_values(constraints, lambda c: check_numbers(c, "places", c.offsets, 2, 3), 2, 3)
    length = np.array([float(check_numbers(c, "length", c.distance)) for c in constraints])
    return DistanceTerm(joints, places, length[None], compute_constraint_weights(constraints)[None])


def build_reprojection_term(constraints: list[PixelConstraint], skeleton: Skeleton, frame_count: int) -> ReprojectionTerm:
    """Every point brings its own camera along: they are few."""
    for c in constraints:
        if not isinstance(c.camera, ConstraintCamera):
            raise build_constraint_error(c, f"camera must be a solve.Camera, and is {c.camera!r}")
    pixels = gather_values(constraints, lambda c: check_numbers(c, "pixel", c.pixel, 2), 2)
    centres = gather_values(constraints, lambda c: check_numbers(c, "camera.centre", c.camera.centre, 2), 2)
    scales = np.array([check_positive(c, "camera.scale", c.camera.scale) for c in constraints]).reshape(-1, 1)
    return ReprojectionTerm(
        find_constrained_joints(constraints, skeleton),
        gather_values(constraints, lambda c: check_numbers(c, "place", c.offset, 3), 3),
        np.arange(len(constraints)),
        gather_values(constraints, lambda c: check_rotation(c, c.camera.rotation), 3, 3),
        gather_values(constraints, lambda c: check_numbers(c, "camera.translation", c.camera.translation, 3), 3),
        np.array([c.camera.perspective for c in constraints], bool),
        repeat_rows(normalise_pixels(pixels, scales, centres), frame_count),
        repeat_rows(compute_constraint_weights(constraints) * scales[:, 0] ** 2, frame_count),
    )


def gather_values(constraints: Sequence[Any], get_value: Callable[[Any], np.ndarray], *shape: int) -> np.ndarray:
    """-> (K, *shape) what each constraint says."""
    return np.array([get_value(each) for each in constraints], float).reshape(-1, *shape)


def repeat_rows(rows: np.ndarray, frame_count: int) -> np.ndarray:
    """-> (frames, ...) the same in every frame."""
    return np.repeat(rows[None], frame_count, axis=0)


def find_constrained_joints(constraints: Sequence[Any], skeleton: Skeleton) -> np.ndarray:
    return np.array([find_joint(each, each.joint, skeleton) for each in constraints], int)


def find_joint(constraint: Constraint, joint: str, skeleton: Skeleton) -> int:
    if joint not in skeleton.names:
        raise build_constraint_error(constraint, f"there is no joint {joint!r}; the skeleton has: {', '.join(skeleton.names)}")
    return skeleton.find_joint(joint)


def check_joint_pair(constraint: DistanceConstraint) -> tuple[str, str]:
    if not isinstance(constraint.joints, tuple | list) or len(constraint.joints) != 2:
        raise build_constraint_error(constraint, "joints must be the names of two")
    return constraint.joints


def compute_constraint_weights(constraints: Sequence[Any]) -> np.ndarray:
    """-> (K,) one over the squares of the standard deviations."""
    return np.array([check_positive(each, "sd", each.sd) ** -2.0 for each in constraints])


def check_numbers(constraint: Constraint, name: str, value: Any, *shape: int) -> np.ndarray:
    """-> a field as finite numbers of a shape."""
    try:
        found = np.asarray(value, float)
    except (TypeError, ValueError):
        found = np.full(0, np.nan)
    if found.shape != shape or not np.isfinite(found).all():
        much = " x ".join(map(str, shape)) or "one"
        raise build_constraint_error(constraint, f"{name} must be {much} finite number{'s' * bool(shape)}, and is {value!r}")
    return found


def check_positive(constraint: Constraint, name: str, value: Any) -> float:
    number = float(check_numbers(constraint, name, value))
    if number <= 0:
        raise build_constraint_error(constraint, f"{name} must be more than 0, and is {value!r}")
    return number


def check_rotation(constraint: Constraint, value: Any) -> np.ndarray:
    """-> (3, 3) a rotation."""
    matrix = check_numbers(constraint, "rotation", value, 3, 3)
    if not is_rotation(matrix):
        raise build_constraint_error(constraint, "rotation must have rows of length one at right angles, right-handed")
    return matrix


def is_rotation(matrix: np.ndarray) -> bool:
    """-> whether (3, 3) is a rotation."""
    return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() < ROTATION_TOLERANCE and np.linalg.det(matrix) > 0)


def normalise_direction(constraint: Constraint, name: str, vector: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector)
    if length == 0:
        raise build_constraint_error(constraint, f"{name} has no length, and so no direction")
    return vector / length


def find_bone_vector(constraint: DirectionConstraint, skeleton: Skeleton) -> np.ndarray:
    """-> (3,) metres, from a joint to its child in its own axes."""
    child, parent = find_joint(constraint, constraint.child, skeleton), find_joint(constraint, constraint.joint, skeleton)
    if skeleton.parents[child] != parent:
        raise build_constraint_error(
            constraint, f"{constraint.child} is no child of {constraint.joint}; its parent is {get_parent_name(child, skeleton)}"
        )
    return skeleton.offsets[child]


def get_parent_name(child: int, skeleton: Skeleton) -> str:
    return skeleton.names[skeleton.parents[child]] if child else "none"


def build_constraint_error(constraint: Constraint, problem: str) -> ConstraintError:
    where = constraint.joints if isinstance(constraint, DistanceConstraint) else constraint.joint
    where = " and ".join(map(str, where)) if isinstance(where, tuple | list) else where
    return ConstraintError(f"{type(constraint).__name__} of {where}: {problem}.")
