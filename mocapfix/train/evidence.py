"""How likely a network makes poses: the lower bound on the evidence that variational autoencoders learn by (Kingma and Welling,
2014, Eq. 10).

The code of a pose is not one point but known only so far, and drawn about the encoder's: so neighbouring codes must mean
neighbouring poses, and all codes together are normal, which is what the solve takes them for. How far, and how far each
axis of each joint strays from what its code means, is learned with the network; joints that nobody can tell weigh little
by themselves.
"""

import math

import torch
from torch import Generator, Tensor, nn

from mocapfix.prior.autoencoder import Network
from mocapfix.prior.features import Features

LEAST = math.radians(1.0)  # what a pose strays by at least: the solve that it comes from is not better
BEGIN = 0.1, 0.3  # radians of the pose, deviations of the code: how far they are known before any training


class Doubt(nn.Module):
    """Logarithms of deviations: of the axes of poses about what their codes mean, and of codes about the encoder's."""

    def __init__(self, given: int, code: int):
        super().__init__()
        self.pose = nn.Parameter(torch.full((given,), math.log(BEGIN[0])))
        self.code = nn.Parameter(torch.full((code,), math.log(BEGIN[1])))


def loss(network: Network, doubt: Doubt, shown: Tensor, poses: Tensor, given: Features, generator: Generator) -> Tensor:
    """-> minus the bound, per pose, but for a constant.

    shown  (N, F) features of poses, perhaps corrupted, as the encoder is told them; poses (N, J, 3): which those were
    """
    code = network.encoder(shown)
    drawn = code + doubt.code.exp() * torch.randn(code.shape, generator=generator)
    noise = doubt.pose.clamp_min(math.log(LEAST))
    away = (network.decoder(drawn) - given.of(poses)) * torch.exp(-noise)
    spent = 0.5 * (code**2 + (2 * doubt.code).exp()) - doubt.code
    return (0.5 * away**2 + noise).sum(1).mean() + spent.sum(1).mean()
