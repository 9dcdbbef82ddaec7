"""The pose priors that the benchmarks compare, each in the same solve of the same poses with given joint positions."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.errors import SceneError
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.levenberg_marquardt import solve_frames
from mocapfix.kernels.terms import PointTerm
from mocapfix.lab.common_task import build_known_motion
from mocapfix.lab.naturalness import NaturalnessModel, solve_natural_poses
from mocapfix.model.skeleton import Skeleton, load_cmu31_body
from mocapfix.options import DEFAULT_PRIOR_NAME
from mocapfix.solve import kinematics, latent_solver, parallel, pose_solver
from mocapfix.solve.autoencoder import AutoencoderModel
from mocapfix.solve.parallel import run_over_frames
from mocapfix.solve.pose_prior import PoseModel
from mocapfix.solve.pose_solver import PoseSolution
from mocapfix.solve.prior_files import MNN_IK, load_pose_model

NO_PRIOR = "none"
COMPARED_PRIOR_NAMES = (NO_PRIOR, "pca", "gaussian", "mixture", MNN_IK, "autoencoder")
MAX_COMPARED_POSE_ITERATIONS = 50

ComparedPrior = PoseModel | NaturalnessModel | None
ComparedPriors = dict[str, ComparedPrior]
PoseStart = tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N J 3 3"]]  # root position in metres, local rotations


@dataclass(frozen=True)
class JointTask:
    """N poses, and the joints whose positions are given.

    true_rotations   (N, J, 3, 3) local
    is_given         (N, J) which joints' positions are given
    given_positions  (N, J, 3) metres: the true positions plus noise
    sd_m             per axis: standard deviation of a given position that the solver assumes
    """

    skeleton: Skeleton
    true_rotations: np.ndarray
    is_given: np.ndarray
    given_positions: np.ndarray
    sd_m: float

    @property
    def point_term(self) -> PointTerm:
        """The given positions as a term of the solver."""
        weight = np.ascontiguousarray(self.is_given / self.sd_m**2)
        return PointTerm(np.arange(len(self.skeleton.names)), np.zeros_like(self.skeleton.offsets), self.given_positions, weight)

    def build_start(self, reference_rotations: Float[np.ndarray, "J 3 3"]) -> PoseStart:
        """Return the start of every solve: the reference pose with the root at the origin."""
        pose_count = len(self.given_positions)
        return np.zeros((pose_count, 3)), np.tile(reference_rotations, (pose_count, 1, 1, 1))


@dataclass(frozen=True)
class PlacedPoses:
    """Poses and the positions of their joints.

    root_position    (N, 3) metres
    rotations        (N, J, 3, 3) local
    joint_positions  (N, J, 3) metres, in the world
    world_rotations  (N, J, 3, 3)
    codes            (N, P) of the prior; P is 0 without a prior
    iterations       (N,) of the solver
    cost             (N,) half the sum of squares in standard deviations; 0 if it was not computed
    """

    root_position: np.ndarray
    rotations: np.ndarray
    joint_positions: np.ndarray
    world_rotations: np.ndarray
    codes: np.ndarray
    iterations: np.ndarray
    cost: np.ndarray


def place_known_poses(
    skeleton: Skeleton, root_position: Float[np.ndarray, "N 3"], rotations: Float[np.ndarray, "N J 3 3"]
) -> PlacedPoses:
    """Return poses that are known, with the positions of their joints."""
    frame_count = len(root_position)
    zeros = np.zeros(frame_count, int)
    solution = PoseSolution(root_position, rotations, np.zeros((frame_count, 0)), zeros, zeros, np.zeros(frame_count))
    return place_solved_poses(skeleton, solution)


def place_solved_poses(skeleton: Skeleton, solution: PoseSolution) -> PlacedPoses:
    """Return solved poses with the positions of their joints."""
    motion = build_known_motion(solution.root_position, solution.local_rotations)
    positions, world_rotations = kinematics.compute_world_poses(skeleton, motion)
    return PlacedPoses(
        solution.root_position,
        solution.local_rotations,
        positions,
        world_rotations,
        codes=solution.codes,
        iterations=solution.iterations,
        cost=solution.cost,
    )


def build_joint_task(
    rotations: Float[np.ndarray, "N J 3 3"],
    is_given: Bool[np.ndarray, "N J"],
    sd_m: float,
    noise: Float[np.ndarray, "N J 3"] | float = 0.0,
) -> JointTask:
    """Return poses of the average body at the origin with some given joint positions, `noise` in metres."""
    skeleton = load_cmu31_body().skeleton
    positions = place_known_poses(skeleton, np.zeros((len(rotations), 3)), rotations).joint_positions + noise
    return JointTask(skeleton, rotations, is_given, positions, sd_m)


def load_compared_priors(weights_folder: Path | None = None) -> ComparedPriors:
    """Return no prior, and the priors of COMPARED_PRIOR_NAMES whose weights are in a folder, by default the shipped one.

    MNN-IK's network is used as in the paper, by its naturalness.

    Raises SceneError if the default prior is missing, with which the others are compared.
    """
    priors: ComparedPriors = {NO_PRIOR: None}
    for name in COMPARED_PRIOR_NAMES[1:]:
        path = (weights_folder or find_shipped_folder("priors")) / f"{name}.safetensors"
        if path.is_file():
            model = load_pose_model(str(path), load_cmu31_body().skeleton)
            priors[name] = NaturalnessModel(model) if name == MNN_IK and isinstance(model, AutoencoderModel) else model
    if DEFAULT_PRIOR_NAME not in priors:
        message = f"holds no {DEFAULT_PRIOR_NAME}.safetensors, with which the other priors are compared."
        raise SceneError(f"{weights_folder}: {message}")
    return priors


def solve_joint_task(
    task: JointTask, model: ComparedPrior, start: PoseStart, max_iterations: int = MAX_COMPARED_POSE_ITERATIONS
) -> PlacedPoses:
    """Return the poses that the solver finds with a prior from a start, which is not modified."""
    tree, points = kinematics.build_kinematic_tree(task.skeleton), task.point_term
    if model is None:
        solution = solve_without_prior(tree, points, *start, max_iterations)
    elif isinstance(model, NaturalnessModel):
        solution = solve_natural_poses(tree, (points,), model, *start, max_iterations=max_iterations)
    else:
        solution = pose_solver.solve_poses(tree, (points,), model, *start, max_iterations=max_iterations)
    return place_solved_poses(task.skeleton, solution)


def solve_without_prior(
    tree: KinematicTree,
    points: PointTerm,
    root_position: Float[np.ndarray, "N 3"],
    local: Float[np.ndarray, "N J 3 3"],
    max_iterations: int = MAX_COMPARED_POSE_ITERATIONS,
) -> PoseSolution:
    """Return the poses that fit points from a start: numerical inverse kinematics.

    Of the poses that fit, the damped steps find one close to the start.
    """
    frame_count, joint_count = local.shape[:2]
    status, iterations = np.zeros((2, frame_count), int)
    codes, cost = np.zeros((frame_count, 0)), np.zeros(frame_count)
    solution = PoseSolution(root_position.copy(), local.copy(), codes, status, iterations, cost)
    order = parallel.order_independently(frame_count, joint_count)
    run_over_frames(
        solve_frames, frame_count, tree, (points,), order, np.array([np.inf]), latent_solver.INITIAL_CODE_DAMPING,
        max_iterations, None, solution.root_position, solution.local_rotations, solution.codes, status, iterations,
    )  # fmt: skip
    return solution
