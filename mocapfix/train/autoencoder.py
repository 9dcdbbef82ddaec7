"""Spoiling poses, for a network to mend: what it learns is the way back to people's poses from beside them."""

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
from mocapfix.files.output_files import replace_atomically
from mocapfix.pose_prior.network import AutoencoderNetwork, NetworkArchitecture, build_network
from mocapfix.pose_prior.pose_features import FEATURE_TYPES, PoseFeatures
from mocapfix.skeleton import load_cmu31_body
from mocapfix.train.settings import AutoencoderSettings

# MERGED: mocapfix.train.corruption
MAX_JOINT_NOISE_SD_RAD = 0.35  # radians: the most that all joints' noise deviates, drawn per pose
LIMB_NOISE_SD_RAD = 1.0  # radians: the deviation of a limb that is all noise
CORRUPTED_POSE_SHARE = 0.6  # of the poses lose limbs
CORRUPTED_LIMB_SHARE = 0.22  # of the limbs of these
LIMB_ROOT_JOINTS = ("LeftShoulder", "RightShoulder", "LHipJoint", "RHipJoint", "Neck")  # each with all that hangs on it


def build_limb_masks() -> Tensor:
    """-> (L, J) bool: which joints belong to which limb."""
    skeleton = load_cmu31_body().skeleton
    rows = torch.zeros(len(LIMB_ROOT_JOINTS), len(skeleton.names), dtype=torch.bool)
    for row, first in zip(rows, LIMB_ROOT_JOINTS, strict=True):
        for j, name in enumerate(skeleton.names):
            row[j] = name == first or bool(row[skeleton.parents[j]])  # parents come before children; the root is no limb's
    return rows


def corrupt_poses(pose_vectors: Tensor, limb_masks: Tensor, generator: Generator) -> Tensor:
    """-> (N, J, 3) poses (N, J, 3) with noise on all joints, and some limbs lost.

    A lost limb is that of the middle pose, of another pose, all noise, or drawn some way to the middle; each as often.
    """

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator)

    count, joints = len(pose_vectors), pose_vectors.shape[1]
    noise = torch.randn(pose_vectors.shape, generator=generator)
    shaken = pose_vectors + MAX_JOINT_NOISE_SD_RAD * uniform(count, 1, 1) * noise
    lost = (uniform(count, len(limb_masks)) < CORRUPTED_LIMB_SHARE) & (uniform(count, 1) < CORRUPTED_POSE_SHARE)
    instead = torch.stack(
        [
            torch.zeros_like(pose_vectors),
            pose_vectors[torch.randperm(count, generator=generator)],
            pose_vectors + LIMB_NOISE_SD_RAD * noise,
            pose_vectors * uniform(count, 1, 1),
        ]
    )
    way = torch.randint(len(instead), lost.shape, generator=generator)
    for limb, its in enumerate(limb_masks):
        other = instead[way[:, limb], torch.arange(count)]
        shaken = torch.where((lost[:, limb, None] & its)[..., None].expand(count, joints, 1), other, shaken)
    return shaken


# MERGED: mocapfix.train.evidence
# How likely a network makes poses: the lower bound on the evidence that variational autoencoders learn by (Kingma and Welling,
# 2014, Eq. 10).
#
# The code of a pose is not one point but known only so far, and drawn about the encoder's: so neighbouring codes must mean
# neighbouring poses, and all codes together are normal, which is what the solve takes them for. How far, and how poses stray
# from what their codes mean, each axis by itself and many together, is learned with the network; joints that nobody can
# tell weigh little by themselves.
MIN_FEATURE_SD = math.radians(1.0)  # what a pose strays by at least: the solve that it comes from is not better
INITIAL_SDS = 0.1, 0.3  # radians of the pose, deviations of the code: how far they are known before any training


class ResidualModel(nn.Module):
    """How poses stray from what their codes mean, and codes from the encoder's.

    pose    (F,) logarithms of each feature's deviation by itself
    astray  (R, F) directions in which they stray together, each as long as its deviation
    code    (P,) logarithms of the code's deviations
    """

    def __init__(self, output_count: int, direction_count: int, code_size: int):
        super().__init__()
        self.log_feature_sd = nn.Parameter(torch.full((output_count,), math.log(INITIAL_SDS[0])))
        self.residual_directions = nn.Parameter(
            INITIAL_SDS[0] * torch.randn(direction_count, output_count) / math.sqrt(output_count)
        )
        self.log_code_sd = nn.Parameter(torch.full((code_size,), math.log(INITIAL_SDS[1])))

    @property
    def feature_sd(self) -> Tensor:
        """-> (F,) each feature's deviation by itself."""
        return self.log_feature_sd.clamp_min(math.log(MIN_FEATURE_SD)).exp()

    def compute_negative_log_likelihood(self, residuals: Tensor) -> Tensor:
        """-> (N,) minus the logarithm of how likely poses stray so (N, F), but for a constant."""
        covariance = torch.diag(self.feature_sd**2) + self.residual_directions.T @ self.residual_directions
        root = torch.linalg.cholesky(covariance)
        alike = torch.linalg.solve_triangular(root, residuals.T, upper=False)
        return 0.5 * (alike**2).sum(0) + root.diagonal().log().sum()


def compute_evidence_loss(
    network: AutoencoderNetwork,
    residual_model: ResidualModel,
    input_features: Tensor,
    pose_vectors: Tensor,
    output_features: PoseFeatures,
    generator: Generator,
) -> Tensor:
    """-> minus the bound, per pose, but for a constant.

    shown  (N, F) features of poses, perhaps corrupted, as the encoder is told them; poses (N, J, 3): which those were
    """
    code = network.encoder(input_features)
    drawn = code + residual_model.log_code_sd.exp() * torch.randn(code.shape, generator=generator)
    spent = 0.5 * (code**2 + (2 * residual_model.log_code_sd).exp()) - residual_model.log_code_sd
    return (
        residual_model.compute_negative_log_likelihood(
            network.decoder(drawn) - output_features.compute_features(pose_vectors)
        ).mean()
        + spent.sum(1).mean()
    )


# MERGED: mocapfix.train.autoencoder
# Training an autoencoder of poses: MNN-IK's (section 3, appendix A), and the denoising one that makes the better prior.
#
# An epoch's randomness depends on the seed and its number alone. So training that was interrupted goes on from the checkpoint
# of its last epoch to the same weights.
RATE_DECAY_INTERVAL_STEPS = 2000  # steps, after which a falling factor is applied (MNN-IK, appendix A)


def train_network(
    joint_names: tuple[str, ...],
    reference_rotations: np.ndarray,
    pose_vectors: np.ndarray,
    subject_index: np.ndarray,
    settings: AutoencoderSettings,
    checkpoint: Path,
    progress: Callable[[str], None],
) -> tuple[NetworkArchitecture, AutoencoderNetwork, ResidualModel]:
    """-> a network trained on poses (N, J, 3), its weights rounded to half precision, and how poses stray from it.

    whose       (N,) the number of the subject of each pose
    checkpoint  a file that is written after each epoch; training goes on from it where it is of these settings and poses
    """
    shape = NetworkArchitecture(**{field.name: getattr(settings, field.name) for field in fields(NetworkArchitecture)})
    features, given = (
        FEATURE_TYPES[kind](torch.as_tensor(reference_rotations, dtype=torch.float32))
        for kind in (shape.input_features, shape.output_features)
    )
    network, doubt = initialise_network(given.size, reference_rotations, shape, settings)
    poses, weights = (
        torch.as_tensor(pose_vectors, dtype=torch.float32),
        torch.as_tensor(compute_sampling_weights(subject_index, settings.subject_balance)),
    )
    steps = -(-len(poses) // settings.batch_poses)
    learned = [*network.parameters(), *doubt.parameters()]
    optimizer = torch.optim.AdamW(learned, settings.learning_rate, weight_decay=settings.weight_decay)
    schedule = LambdaLR(optimizer, build_rate_schedule(settings, steps * settings.epochs))
    parts = {"network": network, "doubt": doubt, "optimizer": optimizer, "schedule": schedule}
    mark, of_limbs = compute_training_fingerprint(settings, poses), build_limb_masks()
    for epoch in range(resume_training(checkpoint, mark, parts), settings.epochs):
        generator, total = Generator().manual_seed(settings.seed * 1_000_003 + epoch), 0.0
        for batch in sample_epoch(weights, generator).split(settings.batch_poses):
            shown = features.compute_features(corrupt_some_poses(poses[batch], settings.corrupted_share, of_limbs, generator))
            if settings.loss == "evidence":
                loss = compute_evidence_loss(network, doubt, shown, poses[batch], given, generator)
            else:
                away = network(shown) - given.compute_features(poses[batch])
                loss = (away**2).sum(1).mean() + settings.norm_weight * compute_weight_norm(network)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            total += float(loss.detach())
        progress(f"epoch {epoch + 1} of {settings.epochs}, loss {total / steps:.4f}")
        with replace_atomically(checkpoint) as part:
            torch.save({"mark": mark, "epoch": epoch + 1} | {name: each.state_dict() for name, each in parts.items()}, part)
    return shape, network.half().float().eval(), doubt


def compute_sampling_weights(subject_index: np.ndarray, balance: float) -> np.ndarray:
    """-> (N,) how often each pose is to be shown: subjects with few poses the oftener, as `balance` says."""
    return np.bincount(subject_index)[subject_index] ** -float(balance)


def sample_epoch(weights: Tensor, generator: Generator) -> Tensor:
    """-> (N,) an epoch's poses: all, in random order, where they weigh alike; else as many, drawn by their weights (N,)."""
    if weights.min() == weights.max():
        return torch.randperm(len(weights), generator=generator)
    reach = weights.cumsum(0)
    return torch.searchsorted(reach, reach[-1] * torch.rand(len(weights), generator=generator, dtype=reach.dtype))


def corrupt_some_poses(pose_vectors: Tensor, share: float, limb_masks: Tensor, generator: Generator) -> Tensor:
    """-> the poses (N, J, 3), that part of them corrupted."""
    if share == 0:
        return pose_vectors
    which = torch.rand((len(pose_vectors), 1, 1), generator=generator) < share
    return torch.where(which, corrupt_poses(pose_vectors, limb_masks, generator), pose_vectors)


def initialise_network(
    output_count: int, reference_rotations: np.ndarray, architecture: NetworkArchitecture, settings: AutoencoderSettings
) -> tuple[AutoencoderNetwork, ResidualModel]:
    """-> the network before training and what is learned with it, drawn by the seed; given: features of a decoded pose."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        network, doubt = (
            build_network(architecture, reference_rotations),
            ResidualModel(output_count, architecture.residual_directions, architecture.code_size),
        )
        if settings.initial_weight_sd is not None:
            for weight in network.parameters():
                nn.init.normal_(weight, 0.0, settings.initial_weight_sd)
    return network, doubt


def build_rate_schedule(settings: AutoencoderSettings, steps: int) -> Callable[[int], float]:
    """-> the learning rate over its first, by step."""
    if settings.rate_schedule == "cosine":
        return lambda step: 0.5 * (1 + math.cos(math.pi * min(step / steps, 1.0)))
    factor = float(settings.rate_schedule)
    return lambda step: factor ** (step // RATE_DECAY_INTERVAL_STEPS)


def compute_weight_norm(network: AutoencoderNetwork) -> Tensor:
    """-> the root of the sum of squares of all weights, but for the offsets (MNN-IK, Eq. 3.2)."""
    return torch.cat([w.flatten() for w in network.parameters() if w.ndim > 1]).norm()


def compute_training_fingerprint(settings: AutoencoderSettings, pose_vectors: Tensor) -> str:
    """-> what a checkpoint must be of, to be gone on from."""
    said = settings.model_dump(exclude={"test", "unseen"})  # sets, which come in any order; the poses tell of them
    return f"{said} {tuple(pose_vectors.shape)} {pose_vectors.double().sum():.9g} {pose_vectors.double().square().sum():.9g}"


def resume_training(checkpoint: Path, fingerprint: str, states: dict) -> int:
    """-> the epoch to begin with; the parts put back to where they were, if the checkpoint is of the same training.

    Raises ReadError where a file of this name is no checkpoint.
    """
    if not checkpoint.is_file():
        return 0
    try:
        found = torch.load(checkpoint, weights_only=True)
    except (OSError, EOFError, RuntimeError, UnpicklingError) as error:
        raise ReadError(f"{checkpoint}: is no checkpoint of training; move it away.") from error
    if found["mark"] != fingerprint:
        return 0
    for name, part in states.items():
        part.load_state_dict(found[name])
    return found["epoch"]
