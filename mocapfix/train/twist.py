"""Training the regressor of twists (HybrIK, section 3.3): joint positions in, the cosine and sine of each joint's twist out."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from mocapfix.errors import WriteError
from mocapfix.initialise.twist_regressor import TwistRegressor, write_twist_regressor
from mocapfix.pose_prior import mean_pose
from mocapfix.pose_prior.network import build_layers
from mocapfix.skeleton import load_cmu31_body
from mocapfix.train import twist_examples
from mocapfix.train.autoencoder import compute_sampling_weights, sample_epoch
from mocapfix.train.cards import TwistScores, write_twist_card
from mocapfix.train.settings import TwistSettings
from mocapfix.train.training_poses import gather_training_poses

TWIST_SD_INFLATION = 2.5  # times what is measured: the few unseen subjects stand for everybody, and what markers say shall stand
MIN_TWIST_SD_RAD = 0.2  # radians: CMU's knees and elbows never twist, people's do


def train_twist_regressor(settings: TwistSettings, folder: Path, target: Path, progress: Callable[[str], None]) -> TwistScores:
    """Train a network and write it to `target`, its card beside it as .md. -> its scores

    Raises ReadError where the folder holds no motion of the subjects that are needed, WriteError where nothing can be written.
    """
    if target.suffix != ".safetensors":
        raise WriteError(f"{target}: weights are kept in the form safetensors; give a name that ends in .safetensors.")
    middle = mean_pose.load_mean_pose_prior("mean-pose", load_cmu31_body().skeleton).mean_rotations
    poses = gather_training_poses(folder, middle, settings.test_subjects, settings.held_out_subjects, progress)
    seen, unseen = (
        twist_examples.compute_local_rotations(each, middle) for each in (poses.training_vectors, poses.held_out_vectors)
    )
    raw = fit_twist_regressor(seen, compute_sampling_weights(poses.subject_index, settings.subject_balance), settings, progress)
    progress("measuring")
    scores, strays = compute_twist_scores(raw, seen, unseen, np.random.default_rng(settings.seed))
    network = replace(raw, sd_rad=raw.sd_rad * np.maximum(TWIST_SD_INFLATION * strays, MIN_TWIST_SD_RAD))
    write_twist_regressor(target, network)
    write_twist_card(target.with_suffix(".md"), settings, network, poses, scores)
    return scores


def fit_twist_regressor(
    poses: np.ndarray, weights: np.ndarray, settings: TwistSettings, progress: Callable[[str], None]
) -> TwistRegressor:
    """-> a network trained on local rotations (N, J, 3, 3), shown as often as weights (N,) say; its sigma is 1.

    Bodies, displacements and losses are drawn anew in every epoch.
    """
    random, generator = np.random.default_rng(settings.seed), torch.Generator().manual_seed(settings.seed)
    network = initialise_twist_network(settings)
    optimizer = torch.optim.AdamW(network.parameters(), settings.learning_rate, weight_decay=settings.weight_decay)
    steps = settings.epochs * -(-len(poses) // settings.batch_poses)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for epoch in range(settings.epochs):
        total, order = 0.0, sample_epoch(torch.as_tensor(weights), generator).numpy()
        inputs, targets = map(torch.as_tensor, twist_examples.build_epoch_examples(poses[order], random))
        for batch in torch.randperm(len(inputs), generator=generator).split(settings.batch_poses):
            loss = compute_twist_loss(network(inputs[batch]), targets[batch])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            total += float(loss.detach()) * len(batch)
        progress(f"epoch {epoch + 1} of {settings.epochs}, loss {total / len(inputs):.4f}")
    return extract_twist_weights(network)


def initialise_twist_network(settings: TwistSettings) -> nn.Sequential:
    """-> the network before training, drawn by the seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        return build_layers(
            (twist_examples.INPUT_COUNT, *settings.hidden_widths, 2 * int(twist_examples.HAS_TWIST.sum())), "relu"
        )


def compute_twist_loss(predicted: Tensor, true: Tensor) -> Tensor:
    """-> the squared distance of cosines and sines (N, 2 B), summed over joints (HybrIK, Eq. 19)."""
    return ((predicted - true) ** 2).sum(1).mean()


def extract_twist_weights(network: nn.Sequential) -> TwistRegressor:
    """-> the network as it is evaluated, its numbers rounded as they are kept."""
    linear = [step.half().float() for step in network if isinstance(step, nn.Linear)]
    weights = tuple(np.ascontiguousarray(step.weight.detach().numpy().T) for step in linear)
    sigma = np.where(twist_examples.HAS_TWIST, 1.0, np.inf)
    return TwistRegressor(weights, tuple(step.bias.detach().numpy() for step in linear), sigma)


def compute_twist_scores(
    network: TwistRegressor, training_rotations: np.ndarray, held_out_rotations: np.ndarray, rng: np.random.Generator
) -> tuple[TwistScores, np.ndarray]:
    """-> the scores on the unseen people's poses, and (J,) radians: by how much they stray from what the network says, root
    mean square, joints displaced and lost as in training."""
    skeleton = load_cmu31_body().skeleton
    inputs, true = twist_examples.build_examples(held_out_rotations, skeleton, None)
    upright, mean = np.array([1.0, 0.0]), twist_examples.compute_twist_targets(training_rotations, skeleton).mean(axis=0)
    away = [compute_angle_errors(each, true) for each in (upright, mean, network.evaluate(inputs))]
    inputs, true = twist_examples.build_examples(held_out_rotations, skeleton, rng)
    away.append(compute_angle_errors(network.evaluate(inputs), true))
    strays = np.zeros(len(skeleton.names))
    strays[twist_examples.HAS_TWIST] = np.sqrt((away[-1] ** 2).mean(axis=0))
    return TwistScores(*(np.degrees(each.mean(axis=0)) for each in away)), strays


def compute_angle_errors(predicted: np.ndarray, true: np.ndarray) -> np.ndarray:
    """-> (N, B) radians between angles given by cosine and sine, (N, B, 2) or one for all."""
    cosine, sine = (predicted * true).sum(-1), predicted[..., 0] * true[..., 1] - predicted[..., 1] * true[..., 0]
    return np.abs(np.arctan2(sine, cosine))
