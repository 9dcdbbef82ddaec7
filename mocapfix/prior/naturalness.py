"""MNN-IK's own way to use its network (Eq. 3.3): one number, g, by how much the network changes a pose.

    g(theta) = |theta - decoder(encoder(theta))|^2,   theta the 93 Euler angles

Small for people's poses, of which the network has seen many. It stands in the solve as one dense row (kernels.terms.whole).
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from mocapfix.prior.autoencoder import BATCH, Autoencoder, one_core
from mocapfix.prior.features import angles, leaning, rotation

MARGIN = 2.0  # of sigma, over what unseen people stray: to the fourth power it would leave g without a say


@dataclass(frozen=True)
class Naturalness:
    """How far from people's a pose is, by an autoencoder on Euler angles; in the solve it has no code."""

    autoencoder: Autoencoder
    size: ClassVar[int] = 0
    linear: ClassVar[bool] = False

    def __post_init__(self):
        if (self.autoencoder.shape.features, self.autoencoder.shape.gives) != ("euler", "euler"):
            raise ValueError("naturalness is measured in Euler angles; this network is told or gives others")

    @property
    def deviation(self) -> float:
        """-> rad^2, by how much g differs among people whom the network has not seen: a sum of squares of normal angles."""
        return float(np.sqrt(6 * ((self.autoencoder.sigma / MARGIN) ** 4).sum()))

    def at(self, local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """-> (N,) rad^2, g of poses, local rotations (N, J, 3, 3), and how it changes as each joint turns, (N, J, 3) rad.

        The turns are rotation vectors in the parents' axes, the root's in the world's. Its heading makes no difference.
        """
        with one_core():
            parts = [self._at(part) for part in torch.as_tensor(local).split(BATCH)]
        value, gradient = (torch.cat(part).numpy().astype(float) for part in zip(*parts, strict=True))
        return value, gradient

    def _at(self, local: Tensor) -> tuple[Tensor, Tensor]:
        network = self.autoencoder.network
        local = local.to(next(network.parameters()).dtype)
        turn = torch.zeros_like(local[..., 0], requires_grad=True)
        turned = rotation(turn) @ local
        tilt = rotation(leaning(turned[:, :1, 1]))
        theta = angles(torch.cat([tilt, turned[:, 1:]], 1)).flatten(-2)
        value = ((theta - network(theta)) ** 2).sum(-1)
        return value.detach(), torch.autograd.grad(value.sum(), turn)[0]
