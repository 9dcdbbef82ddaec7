"""The pose priors that the benchmarks compare, each in the same solve of the same poses with given joint positions.

Among them is MNN-IK's measure of the naturalness of a pose (Eq. 3.3), and poses that are solved under it (Eq. 3.1).
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mocapfix.errors import SceneError
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.kernels.terms import ScalarTerm
from mocapfix.lab.networks import AutoencoderNetwork, compute_rotation_tensor, restore_network, use_one_torch_thread
from mocapfix.lab.sound_takes import build_known_motion
from mocapfix.model.skeleton import Skeleton, load_cmu31_body
from mocapfix.options import DEFAULT_PRIOR_NAME
from mocapfix.solve import kinematics
from mocapfix.solve.kinematics import Poses
from mocapfix.solve.minimise import IteratedTerm, KernelTerms, PoseSolution, SolverSettings, minimise
from mocapfix.solve.model_terms import INITIAL_CODE_DAMPING, ModelRounds, PoseModelTerm
from mocapfix.solve.pose_prior import PoseModel
from mocapfix.solve.terms import KinematicTree, PointTerm, TrackingTerm
from mocapfix.solve.trained_priors import MNN_IK, AutoencoderModel, load_pose_model

NO_PRIOR = "none"
COMPARED_PRIOR_NAMES = (NO_PRIOR, "pca", "gaussian", "mixture", MNN_IK, "autoencoder")
MAX_COMPARED_POSE_ITERATIONS = 50
# The standard deviations of a model are inflated by this. In the fourth power that would leave g hardly any weight.
NATURALNESS_SD_INFLATION = 2.0
EVALUATION_BATCH_POSES = 512  # larger batches need more memory and are hardly faster


@dataclass(frozen=True)
class NaturalnessModel:
    """MNN-IK's naturalness measure (Eq. 3.3): the change that an autoencoder of Euler angles makes to a pose.

        g(theta) = |theta - decoder(encoder(theta))|^2,   theta the 93 Euler angles

    It is small for poses like those of the training subjects. It has no code; in the solver it is one dense row
    (`ScalarTerm`).
    """

    autoencoder: AutoencoderModel

    def __post_init__(self):
        architecture = self.autoencoder.architecture
        if (architecture.input_features, architecture.output_features) != ("euler", "euler"):
            raise ValueError("naturalness needs a network with Euler angles as input and output features")

    @cached_property
    def network(self) -> AutoencoderNetwork:
        """The network as a torch module."""
        model = self.autoencoder
        return restore_network(model.architecture, len(model.joint_names), model.weights)

    @property
    def naturalness_sd(self) -> float:
        """Standard deviation of g in rad^2 over the poses of held-out subjects: that of a sum of squares of normal angles."""
        sd = self.autoencoder.residual_sd_rad / NATURALNESS_SD_INFLATION
        return float(np.sqrt(6 * (sd**4).sum()))

    def evaluate(self, local: Float[np.ndarray, "N J 3 3"]) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N J 3"]]:
        """Return g of poses in rad^2 and its gradient in rad, given local joint rotations.

        The gradient is with respect to rotation vectors of the joints in the axes of their parents, of the root in the world. The
        root's heading does not affect g. Torch uses one thread: callers run this in several threads instead.
        """
        with use_one_torch_thread():
            parts = [self._evaluate_batch(part) for part in torch.as_tensor(local).split(EVALUATION_BATCH_POSES)]
        values, gradients = (torch.cat(part).numpy().astype(float) for part in zip(*parts, strict=True))
        return values, gradients

    def _evaluate_batch(self, local: Tensor) -> tuple[Tensor, Tensor]:
        local = local.to(next(self.network.parameters()).dtype)
        turn = torch.zeros_like(local[..., 0], requires_grad=True)
        turned = compute_rotation_tensor(turn) @ local
        tilt = compute_rotation_tensor(compute_tilt_tensor(turned[:, :1, 1]))
        theta = compute_euler_tensor(torch.cat([tilt, turned[:, 1:]], 1)).flatten(-2)
        value = ((theta - self.network(theta)) ** 2).sum(-1)
        return value.detach(), torch.autograd.grad(value.sum(), turn)[0]


def compute_euler_tensor(rotations: Tensor) -> Tensor:
    """Return the Euler angles z, y, x (..., 3) in radians of rotations (..., 3, 3), with y within a quarter turn."""
    z = torch.atan2(rotations[..., 1, 0], rotations[..., 0, 0])
    x = torch.atan2(rotations[..., 2, 1], rotations[..., 2, 2])
    y = torch.atan2(-rotations[..., 2, 0], torch.hypot(rotations[..., 0, 0], rotations[..., 1, 0]))
    return torch.stack([z, y, x], -1)


def compute_tilt_tensor(up: Tensor) -> Tensor:
    """Return the rotation vectors (..., 3) of the root's tilt, given the unit up vectors (..., 3) in the axes of the root."""
    axis = torch.stack([-up[..., 2], torch.zeros_like(up[..., 0]), up[..., 0]], -1)  # as long as the sine of the angle
    square = (axis**2).sum(-1)
    sine = torch.where(square < 1e-14, 1.0, square).sqrt()
    return axis * torch.where(square < 1e-14, 1.0, torch.atan2(sine, up[..., 1]) / sine)[..., None]


@dataclass(frozen=True)
class NaturalnessTerm(IteratedTerm):
    """The naturalness as a term; `prior_scale` is a factor of its standard deviation."""

    model: NaturalnessModel
    prior_scale: float = 1.0

    def minimise_in_rounds(
        self, tree: KinematicTree, other_terms: KernelTerms, start: Poses, settings: SolverSettings
    ) -> PoseSolution:
        """Return the poses of least cost under the naturalness and other terms, each frame independently."""
        return NaturalnessRounds(tree, other_terms, self.model, self.prior_scale, start).minimise(settings)


class NaturalnessRounds(ModelRounds):
    """A solve under the naturalness of MNN-IK, without a code.

    Value and gradient of the naturalness are evaluated between rounds; within a round the joints are kept near the poses of this
    evaluation, as codes are in `ModelRounds`.
    """

    def __init__(
        self, tree: KinematicTree, other_terms: KernelTerms, naturalness: NaturalnessModel, prior_scale: float, start: Poses
    ) -> None:
        frames = len(start[0])
        super().__init__(tree, other_terms, naturalness.autoencoder, prior_scale, start, np.zeros((frames, 0)))
        self.naturalness = naturalness
        no_root, reference = np.zeros((frames, 3)), np.empty_like(self.local_rotations)
        weight = np.full(frames, (prior_scale * naturalness.naturalness_sd) ** -2)
        self.naturalness_term = ScalarTerm(np.empty(frames), np.empty(reference.shape[:3]), reference, weight)
        self.tracking_term = TrackingTerm(reference, np.empty(reference.shape[:2]), no_root, np.zeros(frames))

    def linearise(self, batch: np.ndarray) -> KernelTerms:
        """Return the naturalness, linearised at the poses of a batch, and the term that keeps the joints near these."""
        naturalness, tracking = self.naturalness_term, self.tracking_term
        naturalness.reference[batch], tracking.weight[batch] = self.local_rotations[batch], self.code_stiffness[batch, None]
        naturalness.value[batch], naturalness.gradient[batch] = self.naturalness.evaluate(self.local_rotations[batch])
        return naturalness, tracking

    def relinearise(self, model_terms: KernelTerms, batch: np.ndarray) -> KernelTerms:
        """Linearise again."""
        return self.linearise(batch)

    def update_linearisation(self, model_terms: KernelTerms, batch: np.ndarray) -> KernelTerms:
        """Linearise again: there is no derivative to update."""
        return self.linearise(batch)


ComparedPrior = PoseModel | NaturalnessModel | None
ComparedPriors = dict[str, ComparedPrior]
PoseStart = tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N J 3 3"]]  # root position in metres, local rotations


@dataclass(frozen=True)
class JointTask:
    """N poses, and the joints whose positions are given."""

    skeleton: Skeleton
    true_rotations: np.ndarray  # (N, J, 3, 3) local
    is_given: np.ndarray  # (N, J) which joints' positions are given
    given_positions: np.ndarray  # (N, J, 3) metres: the true positions plus noise
    sd_m: float  # per axis: standard deviation of a given position that the solver assumes

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
    """Poses and the positions of their joints."""

    root_position: np.ndarray  # (N, 3) metres
    rotations: np.ndarray  # (N, J, 3, 3) local
    joint_positions: np.ndarray  # (N, J, 3) metres, in the world
    world_rotations: np.ndarray  # (N, J, 3, 3)


def place_with_joints(
    skeleton: Skeleton, root_position: Float[np.ndarray, "N 3"], rotations: Float[np.ndarray, "N J 3 3"]
) -> PlacedPoses:
    """Return poses with the positions of their joints."""
    positions, world_rotations = kinematics.compute_world_poses(skeleton, build_known_motion(root_position, rotations))
    return PlacedPoses(root_position, rotations, positions, world_rotations)


def build_joint_task(
    rotations: Float[np.ndarray, "N J 3 3"],
    is_given: Bool[np.ndarray, "N J"],
    sd_m: float,
    noise: Float[np.ndarray, "N J 3"] | float = 0.0,
) -> JointTask:
    """Return poses of the average body at the origin with some given joint positions, `noise` in metres."""
    skeleton = load_cmu31_body().skeleton
    positions = place_with_joints(skeleton, np.zeros((len(rotations), 3)), rotations).joint_positions + noise
    return JointTask(skeleton, rotations, is_given, positions, sd_m)


def load_compared_priors(weights_folder: Path | None = None) -> ComparedPriors:
    """Return no prior, and the priors of COMPARED_PRIOR_NAMES whose weights are in a folder, by default the shipped one.

    MNN-IK's network is used as in the paper, by its naturalness.

    Raises:
        SceneError: If the default prior is missing, with which the others are compared.
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
    """Return the poses that the solver finds with a prior from a start, which is not modified.

    Of the poses that fit without a prior, the damped steps find one close to the start: numerical inverse kinematics.
    """
    terms: list[Any] = [task.point_term]
    settings = SolverSettings(max_iterations=max_iterations, damping_ratio=INITIAL_CODE_DAMPING)
    if model is not None:
        terms.append(PoseModelTerm(model) if isinstance(model, PoseModel) else NaturalnessTerm(model))
    solution = minimise(kinematics.build_kinematic_tree(task.skeleton), tuple(terms), start, settings)
    return place_with_joints(task.skeleton, solution.root_position, solution.local_rotations)
