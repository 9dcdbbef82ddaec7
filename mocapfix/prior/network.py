"""The network of an autoencoder: what it is made of, and how what its decoder says changes with the code."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from mocapfix.prior.features import KINDS

ACTIVATIONS = {"silu": nn.SiLU, "relu": nn.ReLU}


@dataclass(frozen=True)
class Shape:
    """What a network is made of.

    features    how it is told a pose: a key of KINDS
    gives       how it tells one, likewise
    hidden      widths of the encoder's layers; the decoder's are the same, in reverse
    code        how many numbers it squeezes a pose through
    astray      how many directions poses may stray from it
    activation  a key of ACTIVATIONS, on the hidden layers
    straight    whether the code goes to the decoder's end past all layers too: what is linear need not be learned by bending
    """

    features: str
    gives: str
    hidden: tuple[int, ...]
    code: int
    astray: int
    activation: str
    straight: bool


class Beside(nn.Module):
    """The sum of what layers and one linear map say."""

    def __init__(self, bent: nn.Sequential, straight: nn.Linear):
        super().__init__()
        self.bent, self.straight = bent, straight

    def forward(self, rows: Tensor) -> Tensor:
        return self.bent(rows) + self.straight(rows)


class Network(nn.Module):
    """Fully connected layers down to the code and up again; code and output are not bent."""

    def __init__(self, told: int, given: int, shape: Shape):
        super().__init__()
        self.encoder = layers((told, *shape.hidden, shape.code), shape.activation)
        self.decoder = layers((shape.code, *shape.hidden[::-1], given), shape.activation)
        if shape.straight:
            self.decoder = nn.Sequential(Beside(self.decoder, nn.Linear(shape.code, given, bias=False)))

    def forward(self, features: Tensor) -> Tensor:
        return self.decoder(self.encoder(features))


def built(shape: Shape, middle: np.ndarray) -> Network:
    """-> an untrained network for poses about a middle pose (J, 3, 3)."""
    told, given = (KINDS[kind](torch.as_tensor(middle, dtype=torch.float32)).size for kind in (shape.features, shape.gives))
    return Network(told, given, shape)


def layers(sizes: tuple[int, ...], activation: str) -> nn.Sequential:
    steps: list[nn.Module] = []
    for a, b in pairwise(sizes):
        steps += [nn.Linear(a, b), ACTIVATIONS[activation]()]
    return nn.Sequential(*steps[:-1])


def through(steps: nn.Sequential, rows: Tensor, slopes: Tensor) -> tuple[Tensor, Tensor]:
    """-> what layers make of rows (N, A), and of their slopes (N or 1, P, A) along P directions: (N, B) and (N, P, B).

    The chain rule by hand: matrix products as large as the batch, and none for what is the same in all rows.
    """
    for step in steps:
        if isinstance(step, nn.Linear):
            rows, slopes = step(rows), slopes @ step.weight.T
        elif isinstance(step, Beside):
            (a, b), (c, d) = through(step.bent, rows, slopes), through(nn.Sequential(step.straight), rows, slopes)
            rows, slopes = a + c, b + d
        else:
            bend = each_derivative(step, rows)
            rows, slopes = step(rows), slopes * bend[:, None]
    return rows, slopes


def each_derivative(function, values: Tensor) -> Tensor:
    """-> (...) the derivative of each number that a function makes of one number alone, or of their sum of many such."""
    with torch.enable_grad():
        asked = values.detach().requires_grad_()
        return torch.autograd.grad(function(asked).sum(), asked)[0]
