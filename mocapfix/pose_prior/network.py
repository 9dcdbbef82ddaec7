"""The neural network of an autoencoder: its architecture, and the derivative of its decoder with respect to the code."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from mocapfix.pose_prior.pose_features import FEATURE_TYPES

ACTIVATIONS: dict[str, type[nn.Module]] = {"silu": nn.SiLU, "relu": nn.ReLU}


@dataclass(frozen=True)
class NetworkArchitecture:
    """The architecture of a network.

    input_features       features that the encoder takes: a key of FEATURE_TYPES
    output_features      features that the decoder returns: a key of FEATURE_TYPES
    hidden_widths        widths of the encoder's hidden layers; the decoder has the same in reverse order
    code_size            dimensions of the network's code
    residual_directions  number of further code dimensions, along the directions of the decoded poses' residuals
    activation           activation of the hidden layers: a key of ACTIVATIONS
    skip_connection      whether a linear map from the code is added to the decoder's output
    """

    input_features: str
    output_features: str
    hidden_widths: tuple[int, ...]
    code_size: int
    residual_directions: int
    activation: str
    skip_connection: bool


class SkipConnection(nn.Module):
    """The sum of a stack of layers and a linear map."""

    def __init__(self, layers: nn.Sequential, skip: nn.Linear):
        super().__init__()
        self.layers, self.skip = layers, skip

    def forward(self, rows: Tensor) -> Tensor:
        return self.layers(rows) + self.skip(rows)


class AutoencoderNetwork(nn.Module):
    """A fully connected encoder and decoder; code and output have no activation."""

    def __init__(self, input_count: int, output_count: int, architecture: NetworkArchitecture):
        super().__init__()
        code_size, hidden_widths = architecture.code_size, architecture.hidden_widths
        self.encoder = build_layers((input_count, *hidden_widths, code_size), architecture.activation)
        self.decoder = build_layers((code_size, *hidden_widths[::-1], output_count), architecture.activation)
        if architecture.skip_connection:
            self.decoder = nn.Sequential(SkipConnection(self.decoder, nn.Linear(code_size, output_count, bias=False)))

    def forward(self, features: Tensor) -> Tensor:
        return self.decoder(self.encoder(features))


def build_network(architecture: NetworkArchitecture, reference_rotations: Float[np.ndarray, "J 3 3"]) -> AutoencoderNetwork:
    """Return an untrained network for poses relative to a reference pose."""
    reference = torch.as_tensor(reference_rotations, dtype=torch.float32)
    input_count = FEATURE_TYPES[architecture.input_features](reference).feature_count
    output_count = FEATURE_TYPES[architecture.output_features](reference).feature_count
    return AutoencoderNetwork(input_count, output_count, architecture)


def build_layers(widths: tuple[int, ...], activation: str) -> nn.Sequential:
    """Return fully connected layers of these widths, with an activation between them."""
    layers: list[nn.Module] = []
    for input_width, output_width in pairwise(widths):
        layers += [nn.Linear(input_width, output_width), ACTIVATIONS[activation]()]
    return nn.Sequential(*layers[:-1])


def propagate_slopes(layers: Iterable[nn.Module], rows: Tensor, slopes: Tensor) -> tuple[Tensor, Tensor]:
    """Return the output (N, B) of layers for rows (N, A), and the derivatives (N, P, B) of the output along P directions.

    slopes  (N, P, A) or (1, P, A) derivatives of the rows along the directions

    The chain rule is applied explicitly: its matrix products span the whole batch, and derivatives that are equal for all rows
    are computed once.
    """
    for layer in layers:
        if isinstance(layer, nn.Linear):
            rows, slopes = layer(rows), slopes @ layer.weight.T
        elif isinstance(layer, SkipConnection):
            nonlinear_rows, nonlinear_slopes = propagate_slopes(layer.layers, rows, slopes)
            linear_rows, linear_slopes = propagate_slopes([layer.skip], rows, slopes)
            rows, slopes = nonlinear_rows + linear_rows, nonlinear_slopes + linear_slopes
        else:
            derivative = compute_elementwise_derivative(layer, rows)
            rows, slopes = layer(rows), slopes * derivative[:, None]
    return rows, slopes


def compute_elementwise_derivative(function: nn.Module, values: Tensor) -> Tensor:
    """Return the derivative (...) of a function that acts on each element of `values` (...) separately."""
    with torch.enable_grad():
        variable = values.detach().requires_grad_()
        return torch.autograd.grad(function(variable).sum(), variable)[0]
