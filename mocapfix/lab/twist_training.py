"""Training of the twist regressor (HybrIK, section 3.3): from joint positions to cosine and sine of each bone's twist."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mocapfix.lab.autoencoder_training import sample_epoch
from mocapfix.lab.cards import format_table, write_card, write_twist_regressor
from mocapfix.lab.frame_pairs import (
    HAS_TWIST,
    INPUT_COUNT,
    build_epoch_examples,
    build_examples,
    compute_local_rotations,
    compute_twist_targets,
)
from mocapfix.lab.networks import extract_layers, fit_perceptron, initialise_perceptron
from mocapfix.lab.pose_prior_training import SD_INFLATION, build_card_data, describe_pose_use, select_measured_poses
from mocapfix.lab.settings import TwistSettings
from mocapfix.lab.training_poses import compute_sampling_weights, conform_training_poses, gather_training_poses, mirror_joint_name
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve.hybrik import TwistRegressor
from mocapfix.solve.mean_pose import load_mean_pose_prior

MIN_TWIST_SD_RAD = 0.2  # lower bound of a twist's standard deviation: knees and elbows twist, though not in CMU's skeleton


TWIST_TRAINING = """\
The twist of a bone is its rotation about itself. HybrIK regresses it from images (section 3.3, Eq. 19), this network from joint
positions alone. Trained by `mocapfix train twist` on"""
TWIST_SCORES = """\
Error of the predicted twists of held-out subjects in degrees, mean over frames; equal for both sides, because every pose is also
mirrored. For "displaced", joints are up to 30 mm off along each axis and some are missing. "SD" is the standard deviation that
the solver assumes: larger than the error, so that markers outweigh the prediction.

{table}

Joints that cannot twist in CMU's skeleton (hip stubs, knees, clavicles, elbows) show no error here, though real ones twist. Leaf
joints (head, toes, fingertips, thumbs) are not regressed, because no joint beyond them shows their rotation."""


@dataclass(frozen=True)
class TwistScores:
    """(B,) degrees: mean error of each joint's twist."""

    no_twist_deg: np.ndarray  # of no twist
    mean_twist_deg: np.ndarray  # of the mean twist of the training poses
    regressed_deg: np.ndarray  # of the prediction from true joint positions
    displaced_deg: np.ndarray  # of the prediction from displaced joints, some of them missing


def format_twist_scores(scores: TwistScores, sd_deg: Float[np.ndarray, " B"]) -> str:
    """Return the scores of a card: the joints of the left side and the middle, and the mean over all joints."""
    columns = np.stack([*vars(scores).values(), sd_deg], axis=1)
    names = [name for name, has_twist in zip(load_cmu31_body().skeleton.names, HAS_TWIST, strict=True) if has_twist]
    rows = {name: row.tolist() for name, row in zip(names, columns, strict=True) if name <= mirror_joint_name(name)}
    rows["mean"] = [*columns[:, :-1].mean(axis=0), np.nan]
    return TWIST_SCORES.format(table=format_table(["joint", "no twist", "mean twist", "regressed", "displaced", "SD"], rows))


def train_twist_regressor(
    settings: TwistSettings, folders: Sequence[Path], target: Path, progress: Callable[[str], object]
) -> TwistScores:
    """Train a network, write it to `target` and its card to the same path with the suffix .md, and return its scores.

    Raises:
        ReadError: If the folders hold no motion of the required subjects.
        WriteError: If the files cannot be written.
    """
    skeleton = load_cmu31_body().skeleton
    reference_rotations = load_mean_pose_prior("mean-pose", skeleton).mean_rotations
    test, held_out = settings.test_subjects, settings.held_out_subjects
    gathered = gather_training_poses(folders, reference_rotations, test, held_out, progress)
    poses = conform_training_poses(gathered, skeleton.names, settings.subject_balance)
    training_rotations, held_out_rotations = (
        compute_local_rotations(each, reference_rotations) for each in (poses.training_vectors, select_measured_poses(poses))
    )
    balance, weight = settings.subject_balance, settings.retargeted_weight
    weights = compute_sampling_weights(poses.subject_index, balance, poses.is_retargeted, weight)
    unscaled = fit_twist_regressor(training_rotations, weights, settings, progress)
    progress("measuring")
    rng = np.random.default_rng(settings.seed)
    scores, error_rad = compute_twist_scores(unscaled, training_rotations, held_out_rotations, rng)
    network = replace(unscaled, sd_rad=unscaled.sd_rad * np.maximum(SD_INFLATION * error_rad, MIN_TWIST_SD_RAD))
    write_twist_regressor(target, network)
    data, scored = build_card_data(settings, poses), format_twist_scores(scores, np.degrees(network.sd_rad[HAS_TWIST]))
    write_card(target.with_suffix(".md"), settings, data, TWIST_TRAINING, describe_pose_use(poses), scored)
    return scores


def fit_twist_regressor(
    rotations: Float[np.ndarray, "N J 3 3"],
    weights: Float[np.ndarray, " N"],
    settings: TwistSettings,
    progress: Callable[[str], object],
) -> TwistRegressor:
    """Return a network trained on local rotations, which are sampled by their weights; its standard deviations are 1.

    Bodies, displacements and missing joints are drawn again in every epoch.
    """
    rng, network = np.random.default_rng(settings.seed), initialise_perceptron(INPUT_COUNT, 2 * int(HAS_TWIST.sum()), settings)

    def draw_epoch(generator: torch.Generator) -> list[Tensor]:
        order = sample_epoch(torch.as_tensor(weights), generator).numpy()
        return [torch.as_tensor(each) for each in build_epoch_examples(rotations[order], rng)]

    fit_perceptron(network, settings, len(rotations), draw_epoch, compute_twist_loss, progress)
    return TwistRegressor(*extract_layers(network), np.where(HAS_TWIST, 1.0, np.inf))


def compute_twist_loss(predicted: Tensor, true: Tensor) -> Tensor:
    """Return the mean squared distance of cosines and sines (N, 2 B), summed over bones (HybrIK, Eq. 19)."""
    return ((predicted - true) ** 2).sum(1).mean()


def compute_twist_scores(
    network: TwistRegressor,
    training_rotations: Float[np.ndarray, "N J 3 3"],
    held_out_rotations: Float[np.ndarray, "M J 3 3"],
    rng: np.random.Generator,
) -> tuple[TwistScores, Float[np.ndarray, " J"]]:
    """Return the scores on held-out poses, and the root mean square error of each joint in radians with displaced joints."""
    skeleton = load_cmu31_body().skeleton
    inputs, true = build_examples(held_out_rotations, skeleton, None)
    no_twist, mean = np.array([1.0, 0.0]), compute_twist_targets(training_rotations, skeleton).mean(axis=0)
    errors = [compute_angle_errors(each, true) for each in (no_twist, mean, network.evaluate(inputs))]
    inputs, true = build_examples(held_out_rotations, skeleton, rng)
    errors.append(compute_angle_errors(network.evaluate(inputs), true))
    rms_error_rad = np.zeros(len(skeleton.names))
    rms_error_rad[HAS_TWIST] = np.sqrt((errors[-1] ** 2).mean(axis=0))
    return TwistScores(*(np.degrees(each.mean(axis=0)) for each in errors)), rms_error_rad


def compute_angle_errors(predicted: Float[np.ndarray, "... 2"], true: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "..."]:
    """Return the absolute differences in radians between angles given by cosine and sine, which are broadcast."""
    cosine = (predicted * true).sum(-1)
    sine = predicted[..., 0] * true[..., 1] - predicted[..., 1] * true[..., 0]
    return np.abs(np.arctan2(sine, cosine))
