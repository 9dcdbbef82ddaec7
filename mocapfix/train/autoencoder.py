"""Training an autoencoder of poses: MNN-IK's (section 3, appendix A), and the denoising one that makes the better prior.

An epoch's randomness depends on the seed and its number alone. So training that was interrupted goes on from the checkpoint
of its last epoch to the same weights.
"""

import math
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from pickle import UnpicklingError

import numpy as np
import torch
from torch import Generator, Tensor, nn
from torch.optim.lr_scheduler import LambdaLR

from mocapfix.errors import ReadError
from mocapfix.files import replacing
from mocapfix.prior.features import KINDS
from mocapfix.prior.network import Network, Shape, built
from mocapfix.train import evidence
from mocapfix.train.corruption import limbs, spoiled
from mocapfix.train.evidence import Doubt
from mocapfix.train.settings import AutoencoderSettings

EVERY = 2000  # steps, after which a falling factor is applied (MNN-IK, appendix A)


def train(
    joints: tuple[str, ...],
    middle: np.ndarray,
    vectors: np.ndarray,
    whose: np.ndarray,
    settings: AutoencoderSettings,
    checkpoint: Path,
    progress: Callable[[str], None],
) -> tuple[Shape, Network, Doubt]:
    """-> a network trained on poses (N, J, 3), its weights rounded to half precision, and how poses stray from it.

    whose       (N,) the number of the subject of each pose
    checkpoint  a file that is written after each epoch; training goes on from it where it is of these settings and poses
    """
    shape = Shape(**{field.name: getattr(settings, field.name) for field in fields(Shape)})
    features, given = (KINDS[kind](torch.as_tensor(middle, dtype=torch.float32)) for kind in (shape.features, shape.gives))
    network, doubt = initial(given.size, middle, shape, settings)
    poses, weights = torch.as_tensor(vectors, dtype=torch.float32), torch.as_tensor(shares(whose, settings.balance))
    steps = -(-len(poses) // settings.batch)
    learned = [*network.parameters(), *doubt.parameters()]
    optimizer = torch.optim.AdamW(learned, settings.rate, weight_decay=settings.decay)
    schedule = LambdaLR(optimizer, falling(settings, steps * settings.epochs))
    parts = {"network": network, "doubt": doubt, "optimizer": optimizer, "schedule": schedule}
    mark, of_limbs = fingerprint(settings, poses), limbs()
    for epoch in range(resumed(checkpoint, mark, parts), settings.epochs):
        generator, total = Generator().manual_seed(settings.seed * 1_000_003 + epoch), 0.0
        for batch in drawn(weights, generator).split(settings.batch):
            shown = features.of(partly_spoiled(poses[batch], settings.denoising, of_limbs, generator))
            if settings.loss == "evidence":
                loss = evidence.loss(network, doubt, shown, poses[batch], given, generator)
            else:
                away = network(shown) - given.of(poses[batch])
                loss = (away**2).sum(1).mean() + settings.norm * norm(network)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            total += float(loss.detach())
        progress(f"epoch {epoch + 1} of {settings.epochs}, loss {total / steps:.4f}")
        with replacing(checkpoint) as part:
            torch.save({"mark": mark, "epoch": epoch + 1} | {name: each.state_dict() for name, each in parts.items()}, part)
    return shape, network.half().float().eval(), doubt


def shares(whose: np.ndarray, balance: float) -> np.ndarray:
    """-> (N,) how often each pose is to be shown: subjects with few poses the oftener, as `balance` says."""
    return np.bincount(whose)[whose] ** -float(balance)


def drawn(weights: Tensor, generator: Generator) -> Tensor:
    """-> (N,) an epoch's poses: all, in random order, where they weigh alike; else as many, drawn by their weights (N,)."""
    if weights.min() == weights.max():
        return torch.randperm(len(weights), generator=generator)
    reach = weights.cumsum(0)
    return torch.searchsorted(reach, reach[-1] * torch.rand(len(weights), generator=generator, dtype=reach.dtype))


def partly_spoiled(vectors: Tensor, part: float, of_limbs: Tensor, generator: Generator) -> Tensor:
    """-> the poses (N, J, 3), that part of them corrupted."""
    if part == 0:
        return vectors
    which = torch.rand((len(vectors), 1, 1), generator=generator) < part
    return torch.where(which, spoiled(vectors, of_limbs, generator), vectors)


def initial(given: int, middle: np.ndarray, shape: Shape, settings: AutoencoderSettings) -> tuple[Network, Doubt]:
    """-> the network before training and what is learned with it, drawn by the seed; given: features of a decoded pose."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        network, doubt = built(shape, middle), Doubt(given, shape.astray, shape.code)
        if settings.initial is not None:
            for weight in network.parameters():
                nn.init.normal_(weight, 0.0, settings.initial)
    return network, doubt


def falling(settings: AutoencoderSettings, steps: int) -> Callable[[int], float]:
    """-> the learning rate over its first, by step."""
    if settings.falling == "cosine":
        return lambda step: 0.5 * (1 + math.cos(math.pi * min(step / steps, 1.0)))
    factor = float(settings.falling)
    return lambda step: factor ** (step // EVERY)


def norm(network: Network) -> Tensor:
    """-> the root of the sum of squares of all weights, but for the offsets (MNN-IK, Eq. 3.2)."""
    return torch.cat([w.flatten() for w in network.parameters() if w.ndim > 1]).norm()


def fingerprint(settings: AutoencoderSettings, poses: Tensor) -> str:
    """-> what a checkpoint must be of, to be gone on from."""
    said = settings.model_dump(exclude={"test", "unseen"})  # sets, which come in any order; the poses tell of them
    return f"{said} {tuple(poses.shape)} {poses.double().sum():.9g} {poses.double().square().sum():.9g}"


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
