"""The neural network of an autoencoder as a torch module, and its evaluation in batches."""

from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from mocapfix.solve.autoencoder import NetworkArchitecture
from mocapfix.solve.pose_features import build_features

EVALUATION_BATCH_POSES = 512  # larger batches need more memory and are hardly faster
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
    input_count = build_features(architecture.input_features, reference_rotations).feature_count
    output_count = build_features(architecture.output_features, reference_rotations).feature_count
    return AutoencoderNetwork(input_count, output_count, architecture)


def build_layers(widths: tuple[int, ...], activation: str) -> nn.Sequential:
    """Return fully connected layers of these widths, with an activation between them."""
    layers: list[nn.Module] = []
    for input_width, output_width in pairwise(widths):
        layers += [nn.Linear(input_width, output_width), ACTIVATIONS[activation]()]
    return nn.Sequential(*layers[:-1])


def restore_network(
    architecture: NetworkArchitecture, reference_rotations: Float[np.ndarray, "J 3 3"], weights: Mapping[str, np.ndarray]
) -> AutoencoderNetwork:
    """Return a trained network from its weights."""
    network = build_network(architecture, reference_rotations)
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


def evaluate_in_batches(function: Callable[..., tuple[Tensor, ...]], *rows: np.ndarray) -> list[np.ndarray]:
    """Return the outputs (N, ...) of a torch function for arrays of rows (N, ...), as float64.

    Torch uses one thread. Callers run this in several threads instead, which avoids synchronisation after every layer.
    """
    with torch.no_grad(), use_one_torch_thread():
        batches = [torch.tensor(np.asarray(each, np.float32)).split(EVALUATION_BATCH_POSES) for each in rows]
        parts = [function(*batch) for batch in zip(*batches, strict=True)]
        return [torch.cat(outputs).double().numpy() for outputs in zip(*parts, strict=True)]
