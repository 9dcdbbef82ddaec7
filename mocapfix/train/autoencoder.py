"""Training an autoencoder of poses: MNN-IK's (section 3, appendix A), and the denoising one that makes the better prior.

An epoch's randomness depends on the seed and its number alone. So training that was interrupted goes on from the checkpoint
of its last epoch to the same weights.
"""

import math
from collections.abc import Callable
from pathlib import Path
from pickle import UnpicklingError

import numpy as np
import torch
from torch import Generator, Tensor, nn
from torch.optim.lr_scheduler import LambdaLR

from mocapfix.errors import ReadError
from mocapfix.files import replacing
from mocapfix.prior.autoencoder import Network, Shape
from mocapfix.prior.features import KINDS, Features
from mocapfix.train.corruption import limbs, spoiled
from mocapfix.train.poses import slight
from mocapfix.train.settings import AutoencoderSettings

SLIGHT = 0.1  # weight of a slight joint's loss
EVERY = 2000  # steps, after which a falling factor is applied (MNN-IK, appendix A)


def train(
    joints: tuple[str, ...],
    middle: np.ndarray,
    vectors: np.ndarray,
    settings: AutoencoderSettings,
    checkpoint: Path,
    progress: Callable[[str], None],
) -> tuple[Shape, Network]:
    """-> a network trained on poses (N, J, 3), its weights rounded to half precision.

    checkpoint  a file that is written after each epoch; training goes on from it where it is of these settings and poses
    """
    shape = Shape(settings.features, settings.hidden, settings.code, settings.activation)
    features = KINDS[shape.features](torch.as_tensor(middle, dtype=torch.float32))
    network = initial(features, shape, settings)
    poses = torch.as_tensor(vectors, dtype=torch.float32)
    steps = -(-len(poses) // settings.batch)
    optimizer = torch.optim.AdamW(network.parameters(), settings.rate, weight_decay=settings.decay)
    schedule = LambdaLR(optimizer, falling(settings, steps * settings.epochs))
    parts, mark = {"network": network, "optimizer": optimizer, "schedule": schedule}, fingerprint(settings, poses)
    weights, of_limbs = loss_weights(joints, features, settings), limbs()
    for epoch in range(resumed(checkpoint, mark, parts), settings.epochs):
        generator, total = Generator().manual_seed(settings.seed * 1_000_003 + epoch), 0.0
        for batch in torch.randperm(len(poses), generator=generator).split(settings.batch):
            shown = spoiled(poses[batch], of_limbs, generator) if settings.denoising else poses[batch]
            away = network(features.of(shown)) - features.of(poses[batch])
            loss = (weights * away**2).sum(1).mean() + settings.norm * norm(network)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            total += float(loss.detach())
        progress(f"epoch {epoch + 1} of {settings.epochs}, loss {total / steps:.4f}")
        with replacing(checkpoint) as part:
            torch.save({"mark": mark, "epoch": epoch + 1} | {name: each.state_dict() for name, each in parts.items()}, part)
    return shape, network.half().float().eval()


def initial(features: Features, shape: Shape, settings: AutoencoderSettings) -> Network:
    """-> the network before training, drawn by the seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        network = Network(features.size, shape)
        if settings.initial is not None:
            for weight in network.parameters():
                nn.init.normal_(weight, 0.0, settings.initial)
    return network


def falling(settings: AutoencoderSettings, steps: int) -> Callable[[int], float]:
    """-> the learning rate over its first, by step."""
    if settings.falling == "cosine":
        return lambda step: 0.5 * (1 + math.cos(math.pi * min(step / steps, 1.0)))
    factor = float(settings.falling)
    return lambda step: factor ** (step // EVERY)


def loss_weights(joints: tuple[str, ...], features: Features, settings: AutoencoderSettings) -> Tensor:
    """-> (F,) of each feature: less for slight joints where the features are continuous; the paper's loss weighs all alike."""
    if settings.features == "euler":
        return torch.ones(features.size)
    weights = torch.where(torch.as_tensor(slight(joints)), SLIGHT, 1.0)
    return torch.cat([weights[1:].repeat_interleave(6), torch.ones(3)])


def norm(network: Network) -> Tensor:
    """-> the root of the sum of squares of all weights, but for the offsets (MNN-IK, Eq. 3.2)."""
    return torch.cat([w.flatten() for w in network.parameters() if w.ndim > 1]).norm()


def fingerprint(settings: AutoencoderSettings, poses: Tensor) -> str:
    """-> what a checkpoint must be of, to be gone on from."""
    return f"{settings.model_dump_json()} {tuple(poses.shape)} {poses.double().sum():.9g} {poses.double().square().sum():.9g}"


def resumed(checkpoint: Path, mark: str, parts: dict) -> int:
    """-> the epoch to begin with; the parts put back to where they were, if the checkpoint is of the same training.

    Raises ReadError where a file of this name is no checkpoint.
    """
    if not checkpoint.is_file():
        return 0
    try:
        found = torch.load(checkpoint, weights_only=True)
    except (OSError, EOFError, RuntimeError, UnpicklingError) as error:
        raise ReadError(f"{checkpoint}: is no checkpoint of training; move it away.") from error
    if found["mark"] != mark:
        return 0
    for name, part in parts.items():
        part.load_state_dict(found[name])
    return found["epoch"]
