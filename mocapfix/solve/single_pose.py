"""A single pose from whatever is known of it: MNN-IK's own use of its prior (section 5)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.errors import ConstraintError
from mocapfix.kernels.covariance import compute_uncertainty_frames
from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.terms import PointTerm, count_rows
from mocapfix.motion import FrameStatus
from mocapfix.pose_prior import io
from mocapfix.pose_prior import mean_pose as priors
from mocapfix.pose_prior.gaussian import GaussianModel
from mocapfix.pose_prior.model import PoseModel, compute_pose_vectors
from mocapfix.skeleton import Skeleton, load_cmu31_body
from mocapfix.solve import kinematics
from mocapfix.solve.constraint_terms import build_constraint_terms, is_rotation
from mocapfix.solve.constraints import Constraint
from mocapfix.solve.latent_solver import build_latent_term
from mocapfix.solve.pose_solver import PoseSolution, solve_poses

MAX_SINGLE_POSE_ITERATIONS = 100  # iterations: a single pose has time
START_HEADINGS_RAD = np.deg2rad(
    [0, 90, 180, 270]
)  # of the starts: from one that faces away, a body would have to turn through itself
REST_POSE_SD_RAD = 3.0  # radians: how far joints stray about the rest pose where no prior is wanted; it only breaks ties


@dataclass(frozen=True)
class SolvedPose:
    """A solved pose.

    skeleton    whose it is
    root        (3,) metres, in the world
    rotations   (J, 3, 3) local: each joint's axes in its parent's, the root's in the world
    joints      (J, 3) metres, the joints' places in the world
    deviation   (J,) metres: predicted standard deviation per axis of those places
    code        (P,) of the prior, each number in its own standard deviations
    cost        half the sum of squares of all residuals, in standard deviations: of k numbers that agree, about k / 2;
                of a mixture see `poses.Posed`
    status      a sentence
    iterations  of the Levenberg-Marquardt solve
    """

    skeleton: Skeleton
    root_position: np.ndarray
    local_rotations: np.ndarray
    joint_positions: np.ndarray
    joint_sd: np.ndarray
    code: np.ndarray
    cost: float
    status: str
    iterations: int


def solve_pose(
    constraints: Sequence[Constraint], prior: str | PoseModel = "autoencoder", *, prior_scale: float = 1.0,
    skeleton: Skeleton | None = None, start: tuple[np.ndarray, np.ndarray] | None = None,
) -> SolvedPose:  # fmt: skip
    """-> the likeliest pose under a prior that agrees with the constraints as well as their standard deviations ask.

        from mocapfix import solve
        found = solve.pose([solve.Position("LeftHand", (0.5, 1.4, 0.3)), solve.Position("Head", (0.0, 1.6, 0.0))])
        found.joints[found.skeleton.index("LeftArm")]      # where the left shoulder is, and how surely: found.deviation

    prior     a trained model or its name, as the files priors/NAME.safetensors; "none" knows nothing but the rest pose
    scale     times the prior's standard deviations: with 2 it is believed half as much
    skeleton  the average body over CMU's subjects where it is left out
    start     root (3,) metres and local rotations (J, 3, 3); else the prior's middle pose, facing four ways, the best of which
              is kept

    Raises ConstraintError where there is no constraint or one does not say what it must, the same for scale and start;
    SceneError for an unknown prior.
    """
    if not 0 < prior_scale < np.inf:
        raise ConstraintError(f"A prior's scale must be more than 0 and finite, and is {prior_scale!r}.")
    skeleton = load_cmu31_body().skeleton if skeleton is None else skeleton
    tree, model = (
        kinematics.build_kinematic_tree(skeleton),
        resolve_pose_model(prior, skeleton) if isinstance(prior, str) else prior,
    )
    frames = len(START_HEADINGS_RAD) if start is None else 1
    terms = build_constraint_terms(constraints, skeleton, frames)
    root, local = build_start_poses(tree, model, terms[0]) if start is None else check_start_pose(start, skeleton)
    found = solve_poses(tree, terms, model, root, local, prior_scale=prior_scale, max_iterations=MAX_SINGLE_POSE_ITERATIONS)
    best = int(np.nanargmin(found.cost))
    one = PoseSolution(*(each[best : best + 1].copy() for each in vars(found).values()))
    joints, deviation = compute_joint_sd(tree, terms, model, prior_scale, one)
    return SolvedPose(
        skeleton, one.root_position[0], one.local_rotations[0], joints, deviation, one.codes[0], float(one.cost[0]), FrameStatus(one.status[0]).description,
        int(one.iterations[0]),
    )  # fmt: skip


def resolve_pose_model(prior_name: str, skeleton: Skeleton) -> PoseModel:
    """-> the model of a name."""
    if prior_name != "none":
        return io.load_pose_model(prior_name, skeleton)
    joints = len(skeleton.names)
    rest, none = priors.load_mean_pose_prior("none", skeleton).mean_rotations, np.zeros((joints, 3))
    return GaussianModel(
        skeleton.names, rest, np.full(joints, REST_POSE_SD_RAD), none, np.zeros((0, joints, 3)), REST_POSE_SD_RAD
    )


def build_start_poses(tree: KinematicTree, model: PoseModel, points: PointTerm) -> tuple[np.ndarray, np.ndarray]:
    """-> root (4, 3) and local rotations (4, J, 3, 3) of the middle pose facing four ways, amidst the points that are given."""
    local = np.repeat(model.reference_rotations[None], len(START_HEADINGS_RAD), axis=0)
    local[:, 0] = Rotation.from_euler("y", START_HEADINGS_RAD[:, None]).as_matrix() @ local[:, 0]
    root = np.zeros((len(START_HEADINGS_RAD), 3))
    if len(points.joints):
        root += points.measured[0].mean(0) - kinematics.compute_tree_poses(tree, root[:1], local[:1])[0][0, points.joints].mean(0)
    return root, local


def check_start_pose(start: tuple[np.ndarray, np.ndarray], skeleton: Skeleton) -> tuple[np.ndarray, np.ndarray]:
    """-> a start as one frame. Raises ConstraintError where it is none."""
    root, local = (np.asarray(each, float) for each in start)
    joints = len(skeleton.names)
    if root.shape != (3,) or local.shape != (joints, 3, 3) or not (np.isfinite(root).all() and np.isfinite(local).all()):
        said = f"this one's are {root.shape} and {local.shape}"
        raise ConstraintError(f"A start is a root (3,) and rotations ({joints}, 3, 3) of finite numbers; {said}.")
    if not all(map(is_rotation, local)):
        raise ConstraintError("A start's rotations must have rows of length one at right angles, right-handed.")
    return root[None].copy(), local[None].copy()


def compute_joint_sd(
    tree: KinematicTree, terms: tuple, model: PoseModel, prior_scale: float, solution: PoseSolution
) -> tuple[np.ndarray, np.ndarray]:
    """-> the joints' places (J, 3), metres, and their standard deviations (J,) per axis, from the curvature of the cost."""
    joints, markers = len(tree.parents), len(terms[0].joints)
    shared, zero = solution.codes / prior_scale, np.zeros(1)
    near = model.select_components(compute_pose_vectors(solution.local_rotations, model.reference_rotations))
    latent = build_latent_term(tree, near, prior_scale, shared, 0.0, np.zeros(1, int))
    deviation, turns = np.empty((1, joints)), np.empty((1, joints))
    compute_uncertainty_frames(
        tree, (*terms, latent), np.inf, count_rows(terms), solution.root_position, solution.local_rotations, shared, np.empty((1, markers)), deviation,
        turns, zero, 0, 1,
    )  # fmt: skip
    return kinematics.compute_tree_poses(tree, solution.root_position, solution.local_rotations)[0][0], deviation[0]
