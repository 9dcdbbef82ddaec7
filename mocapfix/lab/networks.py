"""Neural networks as torch modules, for training: the layers that all have, the autoencoder, and rotations of tensors."""

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from mocapfix.lab.settings import PerceptronSettings
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


def initialise_perceptron(input_count: int, output_count: int, settings: PerceptronSettings) -> nn.Sequential:
    """Return untrained layers with rectifiers between them, drawn with the seed of the settings."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        return build_layers((input_count, *settings.hidden_widths, output_count), "relu")


def fit_perceptron(
    network: nn.Sequential,
    settings: PerceptronSettings,
    pose_count: int,
    draw_epoch: Callable[[torch.Generator], Sequence[Tensor]],
    compute_loss: Callable[..., Tensor],
    progress: Callable[[str], object],
) -> None:
    """Train layers.

    Args:
        pose_count: Of an epoch.
        draw_epoch: Returns the inputs of an epoch's examples, and what the loss needs besides the outputs.
    """
    generator = torch.Generator().manual_seed(settings.seed)
    optimizer = torch.optim.AdamW(network.parameters(), settings.learning_rate, weight_decay=settings.weight_decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, settings.epochs * -(-pose_count // settings.batch_poses))
    for epoch in range(settings.epochs):
        total_loss, (inputs, *others) = 0.0, draw_epoch(generator)
        for batch in torch.randperm(len(inputs), generator=generator).split(settings.batch_poses):
            loss = compute_loss(network(inputs[batch]), *(each[batch] for each in others))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            total_loss += float(loss.detach()) * len(batch)
        progress(f"epoch {epoch + 1} of {settings.epochs}, loss {total_loss / len(inputs):.4f}")


def extract_layers(layers: nn.Sequential) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """Return weights, inputs by outputs, and biases, rounded to the precision of the files."""
    linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
    weights = tuple(np.ascontiguousarray(each.weight.detach().half().float().numpy().T) for each in linear)
    return weights, tuple(each.bias.detach().half().float().numpy() for each in linear)


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
    return torch.eye(3, dtype=vectors.dtype, device=vectors.device) + first * k + second * (k @ k)
