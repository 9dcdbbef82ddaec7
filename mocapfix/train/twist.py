"""Training the regressor of twists (HybrIK, section 3.3): joint positions in, the cosine and sine of each joint's twist out."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from mocapfix import prior
from mocapfix.errors import WriteError
from mocapfix.initialise.twist import Twists, save
from mocapfix.prior.network import layers
from mocapfix.skeleton import cmu31
from mocapfix.train import twist_examples
from mocapfix.train.autoencoder import drawn, shares
from mocapfix.train.poses import gather
from mocapfix.train.settings import TwistSettings
from mocapfix.train.twist_card import Scores, write

LOOSE = 2.5  # times what is measured: the few unseen subjects stand for everybody, and what markers say shall stand
FLOOR = 0.2  # radians: CMU's knees and elbows never twist, people's do


def train(settings: TwistSettings, folder: Path, target: Path, progress: Callable[[str], None]) -> Scores:
    """Train a network and write it to `target`, its card beside it as .md. -> its scores

    Raises ReadError where the folder holds no motion of the subjects that are needed, WriteError where nothing can be written.
    """
    if target.suffix != ".safetensors":
        raise WriteError(f"{target}: weights are kept in the form safetensors; give a name that ends in .safetensors.")
    middle = prior.load("mean-pose", cmu31().skeleton).rotations
    poses = gather(folder, middle, settings.test, settings.unseen, progress)
    seen, unseen = (twist_examples.turned(each, middle) for each in (poses.seen, poses.unseen))
    raw = fit(seen, shares(poses.whose, settings.balance), settings, progress)
    progress("measuring")
    scores, strays = measured(raw, seen, unseen, np.random.default_rng(settings.seed))
    network = replace(raw, sigma=raw.sigma * np.maximum(LOOSE * strays, FLOOR))
    save(target, network)
    write(target.with_suffix(".md"), settings, network, poses, scores)
    return scores


def fit(poses: np.ndarray, weights: np.ndarray, settings: TwistSettings, progress: Callable[[str], None]) -> Twists:
    """-> a network trained on local rotations (N, J, 3, 3), shown as often as weights (N,) say; its sigma is 1.

    Bodies, displacements and losses are drawn anew in every epoch.
    """
    random, generator = np.random.default_rng(settings.seed), torch.Generator().manual_seed(settings.seed)
    network = initial(settings)
    optimizer = torch.optim.AdamW(network.parameters(), settings.rate, weight_decay=settings.decay)
    steps = settings.epochs * -(-len(poses) // settings.batch)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for epoch in range(settings.epochs):
        total, order = 0.0, drawn(torch.as_tensor(weights), generator).numpy()
        inputs, targets = map(torch.as_tensor, twist_examples.epoch(poses[order], random))
        for batch in torch.randperm(len(inputs), generator=generator).split(settings.batch):
            loss = distance(network(inputs[batch]), targets[batch])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            total += float(loss.detach()) * len(batch)
        progress(f"epoch {epoch + 1} of {settings.epochs}, loss {total / len(inputs):.4f}")
    return packed(network)


def initial(settings: TwistSettings) -> nn.Sequential:
    """-> the network before training, drawn by the seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        return layers((twist_examples.INPUTS, *settings.hidden, 2 * int(twist_examples.HAS.sum())), "relu")


def distance(said: Tensor, true: Tensor) -> Tensor:
    """-> the squared distance of cosines and sines (N, 2 B), summed over joints (HybrIK, Eq. 19)."""
    return ((said - true) ** 2).sum(1).mean()


def packed(network: nn.Sequential) -> Twists:
    """-> the network as it is evaluated, its numbers rounded as they are kept."""
    linear = [step.half().float() for step in network if isinstance(step, nn.Linear)]
    weights = tuple(np.ascontiguousarray(step.weight.detach().numpy().T) for step in linear)
    sigma = np.where(twist_examples.HAS, 1.0, np.inf)
    return Twists(weights, tuple(step.bias.detach().numpy() for step in linear), sigma)


def measured(network: Twists, seen: np.ndarray, unseen: np.ndarray, random: np.random.Generator) -> tuple[Scores, np.ndarray]:
    """-> the scores on the unseen people's poses, and (J,) radians: by how much they stray from what the network says, root
    mean square, joints displaced and lost as in training."""
    skeleton = cmu31().skeleton
    inputs, true = twist_examples.shown(unseen, skeleton, None)
    upright, mean = np.array([1.0, 0.0]), twist_examples.targets(seen, skeleton).mean(axis=0)
    away = [astray(each, true) for each in (upright, mean, network.said(inputs))]
    inputs, true = twist_examples.shown(unseen, skeleton, random)
    away.append(astray(network.said(inputs), true))
    strays = np.zeros(len(skeleton.names))
    strays[twist_examples.HAS] = np.sqrt((away[-1] ** 2).mean(axis=0))
    return Scores(*(np.degrees(each.mean(axis=0)) for each in away)), strays


def astray(said: np.ndarray, true: np.ndarray) -> np.ndarray:
    """-> (N, B) radians between angles given by cosine and sine, (N, B, 2) or one for all."""
    cosine, sine = (said * true).sum(-1), said[..., 0] * true[..., 1] - said[..., 1] * true[..., 0]
    return np.abs(np.arctan2(sine, cosine))
