"""The priors that are compared, each in the same solve of the same poses: the given joints' places, and what the prior says."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mocapfix.bench.common_task import build_pose_motion
from mocapfix.errors import SceneError
from mocapfix.files.shipped import find_shipped_folder
from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.levenberg_marquardt import solve_frames
from mocapfix.kernels.terms import PointTerm
from mocapfix.options import DEFAULT_PRIOR_NAME
from mocapfix.pose_prior import io
from mocapfix.pose_prior.autoencoder import AutoencoderModel, NaturalnessModel
from mocapfix.pose_prior.model import PoseModel
from mocapfix.skeleton import Skeleton, load_cmu31_body
from mocapfix.solve import frame_order, kinematics, latent_solver, pose_solver
from mocapfix.solve.parallel import run_over_frames
from mocapfix.solve.pose_solver import PoseSolution

NO_PRIOR = "none"
COMPARED_PRIOR_NAMES = (NO_PRIOR, "pca", "gaussian", "mixture", io.MNN_IK, "autoencoder")
MAX_POSE_ITERATIONS = 50  # iterations of a pose

ComparedPrior = PoseModel | NaturalnessModel | None
ComparedPriors = dict[str, ComparedPrior]


@dataclass(frozen=True)
class JointTask:
    """N poses, and the joints whose places are given.

    rotations  (N, J, 3, 3) the truth, local
    joints     (N, J) bool: which joints' places are given
    places     (N, J, 3) metres: the truth, and what is given unless there is noise
    sd         metres per axis: how sure a given place is said to be
    """

    skeleton: Skeleton
    true_rotations: np.ndarray
    is_given: np.ndarray
    given_positions: np.ndarray
    sd_m: float

    @property
    def point_term(self) -> PointTerm:
        weight = np.ascontiguousarray(self.is_given / self.sd_m**2)
        return PointTerm(np.arange(len(self.skeleton.names)), np.zeros_like(self.skeleton.offsets), self.given_positions, weight)

    def build_start(self, reference_rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """-> root (N, 3) at the origin, and rotations (N, J, 3, 3): every pose the middle one, from which all are solved."""
        return np.zeros((len(self.given_positions), 3)), np.tile(reference_rotations, (len(self.given_positions), 1, 1, 1))


@dataclass(frozen=True)
class PlacedPoses:
    """Poses that a solve found.

    root       (N, 3) metres
    rotations  (N, J, 3, 3) local
    joints     (N, J, 3) metres, in the world
    world      (N, J, 3, 3) the joints' rotations there
    codes      (N, P) of the prior; of none where there is none
    iterations (N,) that were spent
    cost       (N,) half the sum of squares in standard deviations; 0 where nobody asked
    """

    root_position: np.ndarray
    rotations: np.ndarray
    joint_positions: np.ndarray
    world_rotations: np.ndarray
    codes: np.ndarray
    iterations: np.ndarray
    cost: np.ndarray


def place_known_poses(skeleton: Skeleton, root_position: np.ndarray, rotations: np.ndarray) -> PlacedPoses:
    """-> poses that nobody had to look for, with where they put the joints."""
    nothing = np.zeros(len(root_position), int)
    return place_solved_poses(
        skeleton,
        PoseSolution(root_position, rotations, np.zeros((len(root_position), 0)), nothing, nothing, np.zeros(len(root_position))),
    )


def place_solved_poses(skeleton: Skeleton, solution: PoseSolution) -> PlacedPoses:
    """-> solved poses with where they put the joints."""
    where = kinematics.compute_world_poses(skeleton, build_pose_motion(solution.root_position, solution.local_rotations))
    return PlacedPoses(
        solution.root_position, solution.local_rotations, *where, solution.codes, solution.iterations, solution.cost
    )


def build_joint_task(rotations: np.ndarray, is_given: np.ndarray, sd_m: float, noise: np.ndarray | float = 0.0) -> JointTask:
    """-> poses (N, J, 3, 3) of the average body at the origin, some joints' places given, with `noise` (N, J, 3) metres."""
    skeleton = load_cmu31_body().skeleton
    places = place_known_poses(skeleton, np.zeros((len(rotations), 3)), rotations).joint_positions + noise
    return JointTask(skeleton, rotations, is_given, places, sd_m)


def load_compared_priors(weights_folder: Path | None = None) -> ComparedPriors:
    """-> none at all, and the priors of NAMES whose weights are there: in a folder, or among those that ship.

    MNN-IK's network stands in the solve as the paper has it, as one number.

    Raises SceneError where the default's are not, with which the others are compared.
    """
    found: ComparedPriors = {NO_PRIOR: None}
    for name in COMPARED_PRIOR_NAMES[1:]:
        path = (weights_folder or find_shipped_folder("priors")) / f"{name}.safetensors"
        if path.is_file():
            model = io.load_pose_model(str(path), load_cmu31_body().skeleton)
            found[name] = NaturalnessModel(model) if name == io.MNN_IK and isinstance(model, AutoencoderModel) else model
    if DEFAULT_PRIOR_NAME not in found:
        raise SceneError(
            f"{weights_folder}: holds no {DEFAULT_PRIOR_NAME}.safetensors, with which the other priors are compared."
        )
    return found


def solve_joint_task(
    task: JointTask, model: ComparedPrior, start: tuple[np.ndarray, np.ndarray], max_iterations: int = MAX_POSE_ITERATIONS
) -> PlacedPoses:
    """-> the poses that a prior finds from a start, root (N, 3) and rotations (N, J, 3, 3), which stays as it is."""
    tree = kinematics.build_kinematic_tree(task.skeleton)
    if model is None:
        return place_solved_poses(task.skeleton, solve_without_prior(tree, task.point_term, *start, max_iterations))
    return place_solved_poses(
        task.skeleton, pose_solver.solve_poses(tree, (task.point_term,), model, *start, max_iterations=max_iterations)
    )


def solve_without_prior(
    tree: KinematicTree,
    points: PointTerm,
    root_position: np.ndarray,
    local: np.ndarray,
    max_iterations: int = MAX_POSE_ITERATIONS,
) -> PoseSolution:
    """-> the poses that points alone say, from a start, root (N, 3) and local (N, J, 3, 3): numerical inverse kinematics.

    Of the poses that fit, the damped steps find one near the start.
    """
    frames, joints = local.shape[:2]
    status, iterations = np.zeros((2, frames), int)
    found = PoseSolution(root_position.copy(), local.copy(), np.zeros((frames, 0)), status, iterations, np.zeros(frames))
    run_over_frames(
        solve_frames, frames, tree, (points,), frame_order.order_independently(frames, joints), np.array([np.inf]), latent_solver.INITIAL_CODE_DAMPING, max_iterations, None,
        found.root_position, found.local_rotations, found.codes, status, iterations,
    )  # fmt: skip
    return found
