"""Neural networks as torch modules, for training: the layers that all have, the autoencoder, and rotations of tensors."""

from collections.abc import Generator, Mapping
from contextlib import contextmanager
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from mocapfix.solve.trained_priors import FEATURE_COUNTS, NetworkArchitecture

ACTIVATIONS: dict[str, type[nn.Module]] = {"silu": nn.SiLU, "relu": nn.ReLU}


class SkipConnection(nn.Module):
    """The sum of a stack of layers and a linear map."""

    def __init__(self, layers: nn.Sequential, skip: nn.Linear):
        super().__init__()
        self.layers, self.skip = layers, skip

    def forward(self, rows: Tensor) -> Tensor:
        return self.layers(rows) + self.skip(rows)


class AutoencoderNetwork(nn.Module):
    """A fully connected encoder and decoder; code and output have no activation."""

    def __init__(self, architecture: NetworkArchitecture, joint_count: int):
        super().__init__()
        code_size, hidden_widths = architecture.code_size, architecture.hidden_widths
        inputs, outputs = (
            FEATURE_COUNTS[kind](joint_count) for kind in (architecture.input_features, architecture.output_features)
        )
        self.encoder = build_layers((inputs, *hidden_widths, code_size), architecture.activation)
        self.decoder = build_layers((code_size, *hidden_widths[::-1], outputs), architecture.activation)
        if architecture.skip_connection:
            self.decoder = nn.Sequential(SkipConnection(self.decoder, nn.Linear(code_size, outputs, bias=False)))

    def forward(self, features: Tensor) -> Tensor:
        return self.decoder(self.encoder(features))


def build_layers(widths: tuple[int, ...], activation: str) -> nn.Sequential:
    """Return fully connected layers of these widths, with an activation between them."""
    layers: list[nn.Module] = []
    for input_width, output_width in pairwise(widths):
        layers += [nn.Linear(input_width, output_width), ACTIVATIONS[activation]()]
    return nn.Sequential(*layers[:-1])


def restore_network(architecture: NetworkArchitecture, joint_count: int, weights: Mapping[str, np.ndarray]) -> AutoencoderNetwork:
    """Return a trained network from its weights."""
    network = AutoencoderNetwork(architecture, joint_count)
    network.load_state_dict({name: torch.tensor(values) for name, values in weights.items()}, strict=True)
    return network.eval()


def copy_weights(network: AutoencoderNetwork) -> dict[str, np.ndarray]:
    """Return the weights of a network by their names."""
    return {name: weight.numpy().copy() for name, weight in network.state_dict().items()}


@contextmanager
def use_one_torch_thread() -> Generator[None]:
    """Limit torch to one thread inside the context."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def compute_rotation_tensor(vectors: Tensor) -> Tensor:
    """Return the rotations (..., 3, 3) of rotation vectors (..., 3), by Rodrigues' formula."""
    square = (vectors**2).sum(-1)[..., None, None]
    angle = torch.where(square < 1e-12, 1.0, square).sqrt()  # the square root has no derivative at zero
    x, y, z = vectors.unbind(-1)
    o = torch.zeros_like(x)
    k = torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).unflatten(-1, (3, 3))
    first = torch.where(square < 1e-12, 1.0, torch.sin(angle) / angle)
    second = torch.where(square < 1e-12, 0.5, (1 - torch.cos(angle)) / angle**2)
    return torch.eye(3, dtype=vectors.dtype) + first * k + second * (k @ k)
