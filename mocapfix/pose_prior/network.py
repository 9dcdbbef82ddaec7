"""The network of an autoencoder: what it is made of, and how what its decoder says changes with the code."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from mocapfix.pose_prior.pose_features import FEATURE_TYPES

ACTIVATIONS = {"silu": nn.SiLU, "relu": nn.ReLU}


@dataclass(frozen=True)
class NetworkArchitecture:
    """What a network is made of.

    features    how it is told a pose: a key of KINDS
    gives       how it tells one, likewise
    hidden      widths of the encoder's layers; the decoder's are the same, in reverse
    code        how many numbers it squeezes a pose through
    astray      how many directions poses may stray from it
    activation  a key of ACTIVATIONS, on the hidden layers
    straight    whether the code goes to the decoder's end past all layers too: what is linear need not be learned by bending
    """

    input_features: str
    output_features: str
    hidden_widths: tuple[int, ...]
    code_size: int
    residual_directions: int
    activation: str
    skip_connection: bool


class SkipConnection(nn.Module):
    """The sum of what layers and one linear map say."""

    def __init__(self, layers: nn.Sequential, skip: nn.Linear):
        super().__init__()
        self.layers, self.skip = layers, skip

    def forward(self, rows: Tensor) -> Tensor:
        return self.layers(rows) + self.skip(rows)


class AutoencoderNetwork(nn.Module):
    """Fully connected layers down to the code and up again; code and output are not bent."""

    def __init__(self, input_count: int, output_count: int, architecture: NetworkArchitecture):
        super().__init__()
        self.encoder = build_layers((input_count, *architecture.hidden_widths, architecture.code_size), architecture.activation)
        self.decoder = build_layers(
            (architecture.code_size, *architecture.hidden_widths[::-1], output_count), architecture.activation
        )
        if architecture.skip_connection:
            self.decoder = nn.Sequential(
                SkipConnection(self.decoder, nn.Linear(architecture.code_size, output_count, bias=False))
            )

    def forward(self, features: Tensor) -> Tensor:
        return self.decoder(self.encoder(features))


def build_network(architecture: NetworkArchitecture, reference_rotations: np.ndarray) -> AutoencoderNetwork:
    """-> an untrained network for poses about a middle pose (J, 3, 3)."""
    told, given = (
        FEATURE_TYPES[kind](torch.as_tensor(reference_rotations, dtype=torch.float32)).size
        for kind in (architecture.input_features, architecture.output_features)
    )
    return AutoencoderNetwork(told, given, architecture)


def build_layers(sizes: tuple[int, ...], activation: str) -> nn.Sequential:
    steps: list[nn.Module] = []
    for a, b in pairwise(sizes):
        steps += [nn.Linear(a, b), ACTIVATIONS[activation]()]
    return nn.Sequential(*steps[:-1])


def propagate_slopes(layers: nn.Sequential, rows: Tensor, slopes: Tensor) -> tuple[Tensor, Tensor]:
    """-> what layers make of rows (N, A), and of their slopes (N or 1, P, A) along P directions: (N, B) and (N, P, B).

    The chain rule by hand: matrix products as large as the batch, and none for what is the same in all rows.
    """
    for step in layers:
        if isinstance(step, nn.Linear):
            rows, slopes = step(rows), slopes @ step.weight.T
        elif isinstance(step, SkipConnection):
            (a, b), (c, d) = propagate_slopes(step.layers, rows, slopes), propagate_slopes(nn.Sequential(step.skip), rows, slopes)
            rows, slopes = a + c, b + d
        else:
            bend = compute_elementwise_derivative(step, rows)
            rows, slopes = step(rows), slopes * bend[:, None]
    return rows, slopes


def compute_elementwise_derivative(function, values: Tensor) -> Tensor:
    """-> (...) the derivative of each number that a function makes of one number alone, or of their sum of many such."""
    with torch.enable_grad():
        asked = values.detach().requires_grad_()
        return torch.autograd.grad(function(asked).sum(), asked)[0]
