"""MNN-IK's measure of the naturalness of a pose (Eq. 3.3), and poses that are solved under it (Eq. 3.1)."""

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.terms import ScalarTerm, TrackingTerm
from mocapfix.lab.networks import AutoencoderNetwork, compute_rotation_tensor, restore_network, use_one_torch_thread
from mocapfix.solve.autoencoder import AutoencoderModel
from mocapfix.solve.latent_solver import LatentSolver, Terms
from mocapfix.solve.pose_solver import PoseSolution, solve_poses

# The standard deviations of a model are inflated by this. In the fourth power that would leave g hardly any weight.
NATURALNESS_SD_INFLATION = 2.0
EVALUATION_BATCH_POSES = 512  # larger batches need more memory and are hardly faster


@dataclass(frozen=True)
class NaturalnessModel:
    """MNN-IK's naturalness measure (Eq. 3.3): the change that an autoencoder of Euler angles makes to a pose.

        g(theta) = |theta - decoder(encoder(theta))|^2,   theta the 93 Euler angles

    It is small for poses like those of the training subjects. It has no code; in the solver it is one dense row
    (`kernels.terms.scalar`).
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


def solve_natural_poses(
    tree: KinematicTree,
    other_terms: Terms,
    naturalness: NaturalnessModel,
    root_position: Float[np.ndarray, "T 3"],
    local_rotations: Float[np.ndarray, "T J 3 3"],
    **settings: Any,
) -> PoseSolution:
    """Return the poses of least cost under the naturalness and other terms, as `solve_poses` does under a pose model."""
    build_solver, no_codes = partial(NaturalnessSolver, naturalness), np.zeros((len(root_position), 0))
    model = naturalness.autoencoder
    return solve_poses(tree, other_terms, model, root_position, local_rotations, no_codes, build_solver=build_solver, **settings)


class NaturalnessSolver(LatentSolver):
    """A solve under the naturalness of MNN-IK, without a code.

    Value and gradient of the naturalness are evaluated between rounds; within a round the joints are kept near the poses of this
    evaluation, as codes are in `LatentSolver`.
    """

    def __init__(self, naturalness: NaturalnessModel, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.naturalness, frames = naturalness, len(self.root_position)
        no_root, reference = np.zeros((frames, 3)), np.empty_like(self.local_rotations)
        weight = np.full(frames, (self.prior_scale * naturalness.naturalness_sd) ** -2)
        self.naturalness_term = ScalarTerm(np.empty(frames), np.empty(reference.shape[:3]), reference, weight)
        self.tracking_term = TrackingTerm(reference, np.empty(reference.shape[:2]), no_root, np.zeros(frames))

    def linearise(self, batch: np.ndarray) -> tuple[ScalarTerm, TrackingTerm]:
        """Return the naturalness, linearised at the poses of a batch, and the term that keeps the joints near these."""
        naturalness, tracking = self.naturalness_term, self.tracking_term
        naturalness.reference[batch], tracking.weight[batch] = self.local_rotations[batch], self.code_stiffness[batch, None]
        naturalness.value[batch], naturalness.gradient[batch] = self.naturalness.evaluate(self.local_rotations[batch])
        return naturalness, tracking

    def relinearise(self, model_terms: Terms, batch: np.ndarray) -> tuple[ScalarTerm, TrackingTerm]:
        """Linearise again."""
        return self.linearise(batch)

    def update_linearisation(self, model_terms: Terms, batch: np.ndarray) -> tuple[ScalarTerm, TrackingTerm]:
        """Linearise again: there is no derivative to update."""
        return self.linearise(batch)
