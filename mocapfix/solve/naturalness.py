"""MNN-IK's measure of the naturalness of a pose (Eq. 3.3)."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mocapfix.solve.autoencoder import AutoencoderModel
from mocapfix.solve.pose_features import compute_euler_tensor, compute_rotation_tensor, compute_tilt_tensor
from mocapfix.solve.prior_network import EVALUATION_BATCH_POSES, use_one_torch_thread

# The standard deviations of a model are inflated by this. In the fourth power that would leave g hardly any weight.
NATURALNESS_SD_INFLATION = 2.0


@dataclass(frozen=True)
class NaturalnessModel:
    """MNN-IK's naturalness measure (Eq. 3.3): the change that an autoencoder of Euler angles makes to a pose.

        g(theta) = |theta - decoder(encoder(theta))|^2,   theta the 93 Euler angles

    It is small for poses like those of the training subjects. It has no code; in the solver it is one dense row
    (`kernels.terms.scalar`).
    """

    autoencoder: AutoencoderModel
    code_size: ClassVar[int] = 0
    is_linear: ClassVar[bool] = False

    def __post_init__(self):
        architecture = self.autoencoder.architecture
        if (architecture.input_features, architecture.output_features) != ("euler", "euler"):
            raise ValueError("naturalness needs a network with Euler angles as input and output features")

    @property
    def naturalness_sd(self) -> float:
        """Standard deviation of g in rad^2 over the poses of held-out subjects: that of a sum of squares of normal angles."""
        sd = self.autoencoder.residual_sd_rad / NATURALNESS_SD_INFLATION
        return float(np.sqrt(6 * (sd**4).sum()))

    def evaluate(self, local: Float[np.ndarray, "N J 3 3"]) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N J 3"]]:
        """Return g of poses in rad^2 and its gradient in rad, given local joint rotations.

        The gradient is with respect to rotation vectors of the joints in the axes of their parents, of the root in the world. The
        root's heading does not affect g.
        """
        with use_one_torch_thread():
            parts = [self._evaluate_batch(part) for part in torch.as_tensor(local).split(EVALUATION_BATCH_POSES)]
        values, gradients = (torch.cat(part).numpy().astype(float) for part in zip(*parts, strict=True))
        return values, gradients

    def _evaluate_batch(self, local: Tensor) -> tuple[Tensor, Tensor]:
        network = self.autoencoder.network
        local = local.to(next(network.parameters()).dtype)
        turn = torch.zeros_like(local[..., 0], requires_grad=True)
        turned = compute_rotation_tensor(turn) @ local
        tilt = compute_rotation_tensor(compute_tilt_tensor(turned[:, :1, 1]))
        theta = compute_euler_tensor(torch.cat([tilt, turned[:, 1:]], 1)).flatten(-2)
        value = ((theta - network(theta)) ** 2).sum(-1)
        return value.detach(), torch.autograd.grad(value.sum(), turn)[0]
