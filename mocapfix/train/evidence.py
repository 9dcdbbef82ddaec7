"""How likely a network makes poses: the lower bound on the evidence that variational autoencoders learn by (Kingma and Welling,
2014, Eq. 10).

The code of a pose is not one point but known only so far, and drawn about the encoder's: so neighbouring codes must mean
neighbouring poses, and all codes together are normal, which is what the solve takes them for. How far, and how poses stray
from what their codes mean, each axis by itself and many together, is learned with the network; joints that nobody can
tell weigh little by themselves.
"""

import math

import torch
from torch import Generator, Tensor, nn

from mocapfix.prior.features import Features
from mocapfix.prior.network import Network

LEAST = math.radians(1.0)  # what a pose strays by at least: the solve that it comes from is not better
BEGIN = 0.1, 0.3  # radians of the pose, deviations of the code: how far they are known before any training


class Doubt(nn.Module):
    """How poses stray from what their codes mean, and codes from the encoder's.

    pose    (F,) logarithms of each feature's deviation by itself
    astray  (R, F) directions in which they stray together, each as long as its deviation
    code    (P,) logarithms of the code's deviations
    """

    def __init__(self, given: int, astray: int, code: int):
        super().__init__()
        self.pose = nn.Parameter(torch.full((given,), math.log(BEGIN[0])))
        self.astray = nn.Parameter(BEGIN[0] * torch.randn(astray, given) / math.sqrt(given))
        self.code = nn.Parameter(torch.full((code,), math.log(BEGIN[1])))

    @property
    def noise(self) -> Tensor:
        """-> (F,) each feature's deviation by itself."""
        return self.pose.clamp_min(math.log(LEAST)).exp()

    def cost(self, away: Tensor) -> Tensor:
        """-> (N,) minus the logarithm of how likely poses stray so (N, F), but for a constant."""
        covariance = torch.diag(self.noise**2) + self.astray.T @ self.astray
        root = torch.linalg.cholesky(covariance)
        alike = torch.linalg.solve_triangular(root, away.T, upper=False)
        return 0.5 * (alike**2).sum(0) + root.diagonal().log().sum()


def loss(network: Network, doubt: Doubt, shown: Tensor, poses: Tensor, given: Features, generator: Generator) -> Tensor:
    """-> minus the bound, per pose, but for a constant.

    shown  (N, F) features of poses, perhaps corrupted, as the encoder is told them; poses (N, J, 3): which those were
    """
    code = network.encoder(shown)
    drawn = code + doubt.code.exp() * torch.randn(code.shape, generator=generator)
    spent = 0.5 * (code**2 + (2 * doubt.code).exp()) - doubt.code
    return doubt.cost(network.decoder(drawn) - given.of(poses)).mean() + spent.sum(1).mean()
