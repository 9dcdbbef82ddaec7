"""A single pose from constraints and a prior, as in MNN-IK (section 5)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mocapfix.errors import ConstraintError
from mocapfix.kernels.covariance import compute_uncertainty_frames
from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.terms import PointTerm, count_rows
from mocapfix.motion import FrameStatus
from mocapfix.pose_prior import io, mean_pose
from mocapfix.pose_prior.gaussian_models import GaussianModel
from mocapfix.pose_prior.model import PoseModel, compute_pose_vectors
from mocapfix.skeleton import Skeleton, load_cmu31_body
from mocapfix.solve import kinematics
from mocapfix.solve.constraints import Constraint, ConstraintTerms, build_constraint_terms, is_rotation
from mocapfix.solve.latent_solver import build_latent_term
from mocapfix.solve.pose_solver import PoseSolution, solve_poses

MAX_SINGLE_POSE_ITERATIONS = 100
"""Iterations of the solve; a single pose may take more time than a frame."""
START_HEADINGS_RAD = np.deg2rad([0, 90, 180, 270])
"""Headings of the starts; from the opposite heading a body would have to turn through itself."""
REST_POSE_SD_RAD = 3.0
"""Standard deviation of joints about the rest pose without a prior, which only makes the problem determinate."""


@dataclass(frozen=True)
class SolvedPose:
    """A solved pose.

    root_position    (3,) m in the world
    local_rotations  (J, 3, 3): joint axes to parent axes, for the root to world axes
    joint_positions  (J, 3) m in the world
    joint_sd         (J,) m: predicted standard deviation per axis of the joint positions
    code             (P,) of the prior, each number in its own standard deviations
    cost             half the sum of squares of all residuals in standard deviations: about k / 2 for k consistent numbers; for a
                     mixture see `PoseSolution`
    status           how the solve ended, as text
    iterations       Levenberg-Marquardt iterations
    """

    skeleton: Skeleton
    root_position: Float[np.ndarray, "3"]
    local_rotations: Float[np.ndarray, "J 3 3"]
    joint_positions: Float[np.ndarray, "J 3"]
    joint_sd: Float[np.ndarray, " J"]
    code: Float[np.ndarray, " P"]
    cost: float
    status: str
    iterations: int


def solve_pose(
    constraints: Sequence[Constraint],
    prior: str | PoseModel = "autoencoder",
    *,
    prior_scale: float = 1.0,
    skeleton: Skeleton | None = None,
    start: tuple[np.ndarray, np.ndarray] | None = None,
) -> SolvedPose:
    """Return the most likely pose given constraints with standard deviations and a prior.

        from mocapfix.solve.constraints import PositionConstraint
        from mocapfix.solve.single_pose import solve_pose

        pose = solve_pose([PositionConstraint("LeftHand", (0.5, 1.4, 0.3)), PositionConstraint("Head", (0.0, 1.6, 0.0))])
        shoulder = pose.joint_positions[pose.skeleton.find_joint("LeftArm")]

    prior        a trained model or its name, as the files priors/NAME.safetensors; "none" assumes only the rest pose
    prior_scale  factor of the prior's standard deviations (2: weaker prior)
    skeleton     by default the average body of the CMU subjects
    start        root position (3,) m and local rotations (J, 3, 3); by default the best result of four starts from the prior's
                 reference pose in different headings is returned

    Raises ConstraintError for missing or invalid constraints, an invalid scale or start; SceneError for an unknown prior.
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
    solutions = solve_poses(
        tree,
        terms,
        model,
        root_position,
        local_rotations,
        prior_scale=prior_scale,
        max_iterations=MAX_SINGLE_POSE_ITERATIONS,
    )
    best = int(np.nanargmin(solutions.cost))
    solution = PoseSolution(*(each[best : best + 1].copy() for each in vars(solutions).values()))
    joint_positions, joint_sd = compute_joint_sd(tree, terms, model, prior_scale, solution)
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
        return io.load_pose_model(prior_name, skeleton)
    joint_count = len(skeleton.names)
    rest_rotations = mean_pose.load_mean_pose_prior("none", skeleton).mean_rotations
    residual_sd, no_components = np.full(joint_count, REST_POSE_SD_RAD), np.zeros((0, joint_count, 3))
    return GaussianModel(skeleton.names, rest_rotations, residual_sd, np.zeros((joint_count, 3)), no_components, REST_POSE_SD_RAD)


def build_start_poses(
    tree: KinematicTree, model: PoseModel, points: PointTerm
) -> tuple[Float[np.ndarray, "H 3"], Float[np.ndarray, "H J 3 3"]]:
    """Return the model's reference pose in four headings, centred at the constrained points: root in metres, local rotations."""
    local_rotations = np.repeat(model.reference_rotations[None], len(START_HEADINGS_RAD), axis=0)
    local_rotations[:, 0] = Rotation.from_euler("y", START_HEADINGS_RAD[:, None]).as_matrix() @ local_rotations[:, 0]
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


def compute_joint_sd(
    tree: KinematicTree, terms: ConstraintTerms, model: PoseModel, prior_scale: float, solution: PoseSolution
) -> tuple[Float[np.ndarray, "J 3"], Float[np.ndarray, " J"]]:
    """Return the joint positions of a solution, and their standard deviations per axis from the curvature; both in metres."""
    joint_count, point_count = len(tree.parents), len(terms[0].joints)
    scaled_codes, root_variance = solution.codes / prior_scale, np.zeros(1)
    selected = model.select_components(compute_pose_vectors(solution.local_rotations, model.reference_rotations))
    latent = build_latent_term(tree, selected, prior_scale, scaled_codes, 0.0, np.zeros(1, int))
    point_sd, joint_sd, rotation_variance = np.empty((1, point_count)), np.empty((1, joint_count)), np.empty((1, joint_count))
    compute_uncertainty_frames(
        tree, (*terms, latent), np.inf, count_rows(terms), solution.root_position, solution.local_rotations, scaled_codes,
        point_sd, joint_sd, rotation_variance, root_variance, 0, 1,
    )  # fmt: skip
    return kinematics.compute_tree_poses(tree, solution.root_position, solution.local_rotations)[0][0], joint_sd[0]
