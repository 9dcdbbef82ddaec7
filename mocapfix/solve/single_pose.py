"""A single pose from constraints and a prior, as in MNN-IK (section 5): `solve_pose`.

Each constraint has a standard deviation; `build_constraint_terms` makes terms of the kernels of them. Lengths are in metres,
angles in radians, Y is up. Joints are named as in the skeleton. An offset is a point in the joint's axes, which in the rest
pose (a T-pose facing +Z) are parallel to the world axes; by default it is the joint itself.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias, TypeVar, cast

import numpy as np
from jaxtyping import Float, Int

from mocapfix.errors import ConstraintError, format_name_list
from mocapfix.model.motion import FrameStatus
from mocapfix.model.skeleton import Skeleton, load_cmu31_body
from mocapfix.solve import kinematics, mean_pose, trained_priors
from mocapfix.solve.minimise import SolverSettings, compute_uncertainty, minimise
from mocapfix.solve.model_terms import INITIAL_CODE_DAMPING, PoseModelTerm, linearise_model_term
from mocapfix.solve.pose_prior import GaussianModel, PoseModel, compute_pose_vectors
from mocapfix.solve.terms import (
    DirectionTerm,
    DistanceTerm,
    KinematicTree,
    OrientationTerm,
    PointTerm,
    ReprojectionTerm,
    normalise_pixels,
)
from mocapfix.stats.rigid_alignment import compute_rotations

ConstraintVector: TypeAlias = Sequence[float] | np.ndarray

JOINT_ORIGIN = (0.0, 0.0, 0.0)  # the offset of the joint itself, in metres


@dataclass(frozen=True)
class PositionConstraint:
    """A point fixed to a joint is at a position."""

    joint: str
    position: ConstraintVector  # metres, in the world
    sd: float = 0.01  # metres per axis
    offset: ConstraintVector = JOINT_ORIGIN  # the point in the axes of the joint, in metres


@dataclass(frozen=True)
class DirectionConstraint:
    """The bone from a joint to its child points in a direction."""

    joint: str
    child: str
    direction: ConstraintVector  # in the world, of any length
    sd: float = 0.1  # radians


@dataclass(frozen=True)
class OrientationConstraint:
    """A joint has an orientation in the world."""

    joint: str
    rotation: np.ndarray  # (3, 3), joint axes to world axes
    sd: float = 0.1  # radians per axis


@dataclass(frozen=True)
class DistanceConstraint:
    """Points fixed to two joints have a distance."""

    joints: tuple[str, str]
    distance: float  # metres
    sd: float = 0.01  # metres
    offsets: tuple[ConstraintVector, ConstraintVector] = (JOINT_ORIGIN, JOINT_ORIGIN)  # metres, in the axes of the joints


@dataclass(frozen=True)
class Camera:
    """A camera with axes x to the right, y down, z ahead: camera = rotation @ world + translation."""

    rotation: Float[np.ndarray, "3 3"]  # world axes to camera axes
    translation: ConstraintVector  # metres, in the axes of the camera
    scale: float  # focal length in pixels; for a scaled orthographic camera pixels per metre
    centre: ConstraintVector = (0.0, 0.0)  # pixels: the principal point
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
    """A camera images a point fixed to a joint at a pixel."""

    joint: str
    camera: Camera
    pixel: ConstraintVector  # (2,)
    sd: float = 3.0  # pixels per axis
    offset: ConstraintVector = JOINT_ORIGIN  # the point in the axes of the joint, in metres


Constraint: TypeAlias = PositionConstraint | DirectionConstraint | OrientationConstraint | DistanceConstraint | PixelConstraint


CONSTRAINT_TYPES = (PositionConstraint, DirectionConstraint, OrientationConstraint, DistanceConstraint, PixelConstraint)
"""The types of constraints, in the order of their terms."""
ROTATION_TOLERANCE = 1e-3  # error of the entries of a rotation matrix that is accepted, since people write a few digits

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
    positions = gather_values(constraints, lambda c: check_numbers(c, "position", c.position, 3), 3)
    offsets = gather_values(constraints, lambda c: check_numbers(c, "offset", c.offset, 3), 3)
    weights = repeat_rows(compute_constraint_weights(constraints), frame_count)
    return PointTerm(find_constrained_joints(constraints, skeleton), offsets, repeat_rows(positions, frame_count), weights)


def build_direction_term(constraints: Sequence[DirectionConstraint], skeleton: Skeleton, frame_count: int) -> DirectionTerm:
    bones = gather_values(
        constraints, lambda c: normalise_direction(c, f"the bone to {c.child}", find_bone_vector(c, skeleton)), 3
    )
    directions = gather_values(
        constraints, lambda c: normalise_direction(c, "direction", check_numbers(c, "direction", c.direction, 3)), 3
    )
    weights = repeat_rows(compute_constraint_weights(constraints), frame_count)
    return DirectionTerm(find_constrained_joints(constraints, skeleton), bones, repeat_rows(directions, frame_count), weights)


def build_orientation_term(constraints: Sequence[OrientationConstraint], skeleton: Skeleton, frame_count: int) -> OrientationTerm:
    rotations = gather_values(constraints, lambda c: check_rotation(c, c.rotation), 3, 3)
    weights = repeat_rows(compute_constraint_weights(constraints), frame_count)
    return OrientationTerm(find_constrained_joints(constraints, skeleton), repeat_rows(rotations, frame_count), weights)


def build_distance_term(constraints: Sequence[DistanceConstraint], skeleton: Skeleton) -> DistanceTerm:
    for each in constraints:
        if not isinstance(each.joints, tuple | list) or len(each.joints) != 2:  # pyright: ignore[reportUnnecessaryIsInstance]
            raise build_constraint_error(each, "joints must be the names of two joints")
    joints = np.array([[find_joint(c, name, skeleton) for name in c.joints] for c in constraints], int)
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
    return np.array([find_joint(constraint, constraint.joint, skeleton) for constraint in constraints], int)


def find_joint(constraint: Constraint, joint: str, skeleton: Skeleton) -> int:
    """Return the index of a joint named by a constraint. Raises ConstraintError for an unknown name."""
    if joint not in skeleton.names:
        raise build_constraint_error(
            constraint, f"there is no joint {joint!r}; the skeleton has: {format_name_list(skeleton.names)}"
        )
    return skeleton.find_joint(joint)


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
    joints: object = constraint.joints if isinstance(constraint, DistanceConstraint) else constraint.joint
    names = " and ".join(map(str, cast("Sequence[object]", joints))) if isinstance(joints, tuple | list) else joints
    return ConstraintError(f"{type(constraint).__name__} of {names}: {problem}.")


MAX_SINGLE_POSE_ITERATIONS = 100  # iterations of the solve; a single pose may take more time than a frame
START_HEADINGS_RAD = np.deg2rad([0, 90, 180, 270])  # from the opposite heading a body would have to turn through itself
REST_POSE_SD_RAD = 3.0  # of joints about the rest pose without a prior, which only makes the problem determinate


@dataclass(frozen=True)
class SolvedPose:
    """A solved pose."""

    skeleton: Skeleton
    root_position: Float[np.ndarray, "3"]  # metres, in the world
    local_rotations: Float[np.ndarray, "J 3 3"]  # joint axes to parent axes, for the root to world axes
    joint_positions: Float[np.ndarray, "J 3"]  # metres, in the world
    joint_sd: Float[np.ndarray, " J"]  # metres: predicted standard deviation per axis of the joint positions
    code: Float[np.ndarray, " P"]  # of the prior, each number in its own standard deviations
    # half the sum of squares of all residuals in standard deviations: about k / 2 for k consistent numbers; for a mixture see
    # `PoseSolution`
    cost: float
    status: str  # how the solve ended, as text
    iterations: int  # Levenberg-Marquardt iterations


def solve_pose(
    constraints: Sequence[Constraint],
    prior: str | PoseModel = "autoencoder",
    *,
    prior_scale: float = 1.0,
    skeleton: Skeleton | None = None,
    start: tuple[np.ndarray, np.ndarray] | None = None,
) -> SolvedPose:
    """Return the most likely pose given constraints with standard deviations and a prior.

        from mocapfix.solve.single_pose import PositionConstraint
        from mocapfix.solve.single_pose import solve_pose

        pose = solve_pose([PositionConstraint("LeftHand", (0.5, 1.4, 0.3)), PositionConstraint("Head", (0.0, 1.6, 0.0))])
        shoulder = pose.joint_positions[pose.skeleton.find_joint("LeftArm")]

    Args:
        prior: A trained model or its name, as the files priors/NAME.safetensors; "none" assumes only the rest pose.
        prior_scale: Factor of the prior's standard deviations (2: weaker prior).
        skeleton: By default the average body of the CMU subjects.
        start: Root position (3,) m and local rotations (J, 3, 3); by default the best result of four starts from the prior's
            reference pose in different headings is returned.

    Raises:
        ConstraintError: For missing or invalid constraints, an invalid scale or start.
        SceneError: For an unknown prior.
    """
    if not 0 < prior_scale < np.inf:
        raise ConstraintError(f"prior_scale must be greater than 0 and finite, not {prior_scale!r}.")
    skeleton = load_cmu31_body().skeleton if skeleton is None else skeleton
    tree = kinematics.build_kinematic_tree(skeleton)
    model = resolve_pose_model(prior, skeleton) if isinstance(prior, str) else prior
    terms = build_constraint_terms(constraints, skeleton, len(START_HEADINGS_RAD) if start is None else 1)
    if start is None:
        root_position, local_rotations = build_start_poses(tree, model, terms[0])
    else:
        root_position, local_rotations = check_start_pose(start, skeleton)
    settings = SolverSettings(max_iterations=MAX_SINGLE_POSE_ITERATIONS, damping_ratio=INITIAL_CODE_DAMPING)
    solutions = minimise(tree, (*terms, PoseModelTerm(model, prior_scale)), (root_position, local_rotations), settings)
    best = int(np.nanargmin(solutions.cost))
    solution = solutions.select_frames(slice(best, best + 1))
    scaled_codes = solution.codes / prior_scale
    selected = model.select_components(compute_pose_vectors(solution.local_rotations, model.reference_rotations))
    latent = linearise_model_term(tree, selected, prior_scale, scaled_codes, 0.0, np.zeros(1, int))
    joint_sd = compute_uncertainty(tree, (*terms, latent), solution.poses, codes=scaled_codes).joint_sd[0]
    joint_positions = kinematics.compute_tree_poses(tree, *solution.poses)[0][0]
    return SolvedPose(
        skeleton=skeleton,
        root_position=solution.root_position[0],
        local_rotations=solution.local_rotations[0],
        joint_positions=joint_positions,
        joint_sd=joint_sd,
        code=solution.codes[0],
        cost=float(solution.cost[0]),
        status=FrameStatus(solution.status[0]).description,
        iterations=int(solution.iterations[0]),
    )


def resolve_pose_model(prior_name: str, skeleton: Skeleton) -> PoseModel:
    """Return the pose model of a name; "none" is the rest pose with a standard deviation of REST_POSE_SD_RAD."""
    if prior_name != "none":
        return trained_priors.load_pose_model(prior_name, skeleton)
    joint_count = len(skeleton.names)
    rest_rotations = mean_pose.load_mean_pose_prior("none", skeleton).mean_rotations
    residual_sd, no_components = np.full(joint_count, REST_POSE_SD_RAD), np.zeros((0, joint_count, 3))
    return GaussianModel(skeleton.names, rest_rotations, residual_sd, np.zeros((joint_count, 3)), no_components, REST_POSE_SD_RAD)


def build_start_poses(
    tree: KinematicTree, model: PoseModel, points: PointTerm
) -> tuple[Float[np.ndarray, "H 3"], Float[np.ndarray, "H J 3 3"]]:
    """Return the model's reference pose in four headings, centred at the constrained points: root in metres, local rotations."""
    local_rotations = np.repeat(model.reference_rotations[None], len(START_HEADINGS_RAD), axis=0)
    local_rotations[:, 0] = compute_rotations(np.array(START_HEADINGS_RAD)[:, None] * [0.0, 1.0, 0.0]) @ local_rotations[:, 0]
    root_position = np.zeros((len(START_HEADINGS_RAD), 3))
    if len(points.joints):
        positions = kinematics.compute_tree_poses(tree, root_position[:1], local_rotations[:1])[0]
        root_position += points.measured[0].mean(0) - positions[0, points.joints].mean(0)
    return root_position, local_rotations


def check_start_pose(
    start: tuple[np.ndarray, np.ndarray], skeleton: Skeleton
) -> tuple[Float[np.ndarray, "1 3"], Float[np.ndarray, "1 J 3 3"]]:
    """Return a start as one frame. Raises ConstraintError if it is not a pose of the skeleton."""
    root_position, local_rotations = (np.asarray(each, float) for each in start)
    joint_count = len(skeleton.names)
    has_shape = root_position.shape == (3,) and local_rotations.shape == (joint_count, 3, 3)
    if not has_shape or not (np.isfinite(root_position).all() and np.isfinite(local_rotations).all()):
        shapes = f"shapes {root_position.shape} and {local_rotations.shape}"
        raise ConstraintError(
            f"start must be a root (3,) and rotations ({joint_count}, 3, 3) of finite numbers; it has {shapes}."
        )
    if not all(map(is_rotation, local_rotations)):
        raise ConstraintError("The rotations of start must be right-handed matrices with orthonormal rows.")
    return root_position[None].copy(), local_rotations[None].copy()
