"""Training of autoencoder pose models: MNN-IK's network (section 3, appendix A), and a denoising variational autoencoder.

The random numbers of an epoch depend only on the seed and the number of the epoch. Training that was interrupted therefore
continues from the checkpoint of its last epoch to the same weights.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn
from torch.optim.lr_scheduler import LambdaLR

from mocapfix.lab.networks import AutoencoderNetwork
from mocapfix.lab.settings import AutoencoderSettings, Stateful, compute_training_fingerprint, resume_training, write_checkpoint
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve.trained_priors import FEATURE_COUNTS, NetworkArchitecture, compute_pose_features

RATE_DECAY_INTERVAL_STEPS = 2000  # after so many steps a rate schedule's factor is applied (MNN-IK, appendix A)
MAX_JOINT_NOISE_SD_RAD = 0.35  # standard deviation of the noise of all joints: at most this, drawn for each corrupted pose
LIMB_NOISE_SD_RAD = 1.0  # standard deviation of the noise of a limb that is replaced by noise
CORRUPTED_POSE_SHARE = 0.6  # fraction of the corrupted poses that have corrupted limbs
CORRUPTED_LIMB_SHARE = 0.22  # fraction of the limbs of these poses that are corrupted
LIMB_ROOT_JOINTS = ("LeftShoulder", "RightShoulder", "LHipJoint", "RHipJoint", "Neck")  # a limb is all joints below one of them
MIN_FEATURE_SD = math.radians(1.0)  # lower bound of a feature's standard deviation: the solved motion is not more accurate
INITIAL_FEATURE_SD = 0.1  # radians: standard deviation of the decoded pose before training
INITIAL_CODE_SD = 0.3  # standard deviation of the code before training


@dataclass(frozen=True)
class TrainedNetwork:
    """A trained network, its weights rounded to half precision, and the distribution of its residuals."""

    architecture: NetworkArchitecture
    network: AutoencoderNetwork
    residual_model: "ResidualModel"


class ResidualModel(nn.Module):
    """The distribution of poses around the decoded pose of their code, and of codes around the encoder's.

    Attributes:
        log_feature_sd: (F,) logarithms of each feature's independent standard deviation.
        residual_directions: (R, F) directions of correlated residuals, each as long as its standard deviation.
        log_code_sd: (P,) logarithms of the code's standard deviations.
    """

    def __init__(self, output_count: int, direction_count: int, code_size: int):
        super().__init__()
        self.log_feature_sd = nn.Parameter(torch.full((output_count,), math.log(INITIAL_FEATURE_SD)))
        directions = INITIAL_FEATURE_SD * torch.randn(direction_count, output_count) / math.sqrt(output_count)
        self.residual_directions = nn.Parameter(directions)
        self.log_code_sd = nn.Parameter(torch.full((code_size,), math.log(INITIAL_CODE_SD)))

    @property
    def feature_sd(self) -> Tensor:
        """(F,) each feature's independent standard deviation."""
        return self.log_feature_sd.clamp_min(math.log(MIN_FEATURE_SD)).exp()

    def compute_negative_log_likelihood(self, residuals: Tensor) -> Tensor:
        """Return (N,) the negative log-likelihood of residuals (N, F), up to a constant."""
        covariance = torch.diag(self.feature_sd**2) + self.residual_directions.T @ self.residual_directions
        root = torch.linalg.cholesky(covariance)
        whitened = torch.linalg.solve_triangular(root, residuals.T, upper=False)
        return 0.5 * (whitened**2).sum(0) + root.diagonal().log().sum()


def train_network(
    reference_rotations: Float[np.ndarray, "J 3 3"],
    pose_vectors: Float[np.ndarray, "N J 3"],
    sampling_weights: Float[np.ndarray, " N"],
    settings: AutoencoderSettings,
    checkpoint: Path,
    progress: Callable[[str], object],
) -> TrainedNetwork:
    """Return a network trained on poses.

    Args:
        sampling_weights: The relative frequency at which each pose is drawn.
        checkpoint: A file that is written after each epoch; training continues from it if it has the same settings and poses.

    Raises:
        ReadError: If the checkpoint is not one.
    """
    architecture = NetworkArchitecture(**{field.name: getattr(settings, field.name) for field in fields(NetworkArchitecture)})

    def compute_features(kind: str, vectors: Tensor) -> Tensor:
        return torch.as_tensor(compute_pose_features(kind, vectors.numpy(), reference_rotations), dtype=torch.float32)

    network, residual_model = initialise_network(len(reference_rotations), architecture, settings)
    poses = torch.as_tensor(pose_vectors, dtype=torch.float32)
    weights = torch.as_tensor(sampling_weights)
    step_count = -(-len(poses) // settings.batch_poses)
    parameters = [*network.parameters(), *residual_model.parameters()]
    optimizer = torch.optim.AdamW(parameters, settings.learning_rate, weight_decay=settings.weight_decay)
    schedule = LambdaLR(optimizer, build_rate_schedule(settings, step_count * settings.epochs))
    states: dict[str, Stateful] = {
        "network": network,
        "residual_model": residual_model,
        "optimizer": optimizer,
        "schedule": schedule,
    }
    fingerprint, limb_masks = compute_training_fingerprint(settings, pose_vectors), build_limb_masks()
    for epoch in range(resume_training(checkpoint, fingerprint, states), settings.epochs):
        generator, total_loss = Generator().manual_seed(settings.seed * 1_000_003 + epoch), 0.0
        for batch in sample_epoch(weights, generator).split(settings.batch_poses):
            corrupted = corrupt_some_poses(poses[batch], settings.corrupted_share, limb_masks, generator)
            inputs = compute_features(architecture.input_features, corrupted)
            outputs = compute_features(architecture.output_features, poses[batch])
            if settings.loss == "evidence":
                loss = compute_evidence_loss(network, residual_model, inputs, outputs, generator)
            else:
                residuals = network(inputs) - outputs
                loss = (residuals**2).sum(1).mean() + settings.norm_weight * compute_weight_norm(network)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            total_loss += float(loss.detach())
        progress(f"epoch {epoch + 1} of {settings.epochs}, loss {total_loss / step_count:.4f}")
        write_checkpoint(checkpoint, fingerprint, epoch + 1, states)
    return TrainedNetwork(architecture, network.half().float().eval(), residual_model)


def compute_evidence_loss(
    network: AutoencoderNetwork, residual_model: ResidualModel, inputs: Tensor, outputs: Tensor, generator: Generator
) -> Tensor:
    """Return the negative evidence lower bound per pose, up to a constant (Kingma and Welling, 2014, Eq. 10).

    The code of a pose is drawn around the encoder's. Neighbouring codes must therefore decode to neighbouring poses, and all
    codes together are normally distributed, as the solver assumes. The standard deviations of code and residuals are learned with
    the network, so that joints that cannot be predicted have little weight.

    Args:
        inputs: (N, F) features of the poses, which may be corrupted.
        outputs: (N, G) features of the true poses.
    """
    code = network.encoder(inputs)
    sampled = code + residual_model.log_code_sd.exp() * torch.randn(code.shape, generator=generator)
    divergence = 0.5 * (code**2 + (2 * residual_model.log_code_sd).exp()) - residual_model.log_code_sd
    residuals = network.decoder(sampled) - outputs
    return residual_model.compute_negative_log_likelihood(residuals).mean() + divergence.sum(1).mean()


def compute_weight_norm(network: AutoencoderNetwork) -> Tensor:
    """Return the Euclidean norm of all weights, biases excluded (MNN-IK, Eq. 3.2)."""
    return torch.cat([w.flatten() for w in network.parameters() if w.ndim > 1]).norm()


def initialise_network(
    joint_count: int, architecture: NetworkArchitecture, settings: AutoencoderSettings
) -> tuple[AutoencoderNetwork, ResidualModel]:
    """Return the untrained network and residual model, drawn with the seed of the settings."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        network = AutoencoderNetwork(architecture, joint_count)
        output_count = FEATURE_COUNTS[architecture.output_features](joint_count)
        residual_model = ResidualModel(output_count, architecture.residual_directions, architecture.code_size)
        if settings.initial_weight_sd is not None:
            for weight in network.parameters():
                nn.init.normal_(weight, 0.0, settings.initial_weight_sd)
    return network, residual_model


def build_rate_schedule(settings: AutoencoderSettings, step_count: int) -> Callable[[int], float]:
    """Return a function from the step to the learning rate, relative to the first one."""
    if settings.rate_schedule == "cosine":
        return lambda step: 0.5 * (1 + math.cos(math.pi * min(step / step_count, 1.0)))
    factor = float(settings.rate_schedule)
    return lambda step: factor ** (step // RATE_DECAY_INTERVAL_STEPS)


def sample_epoch(weights: Tensor, generator: Generator) -> Tensor:
    """Return the indices (N,) of an epoch's poses: a permutation if all weights (N,) are equal, else drawn by the weights."""
    if weights.min() == weights.max():
        return torch.randperm(len(weights), generator=generator)
    cumulative = weights.cumsum(0)
    uniform = torch.rand(len(weights), generator=generator, dtype=cumulative.dtype)
    return torch.searchsorted(cumulative, cumulative[-1] * uniform)


def corrupt_some_poses(pose_vectors: Tensor, share: float, limb_masks: Tensor, generator: Generator) -> Tensor:
    """Return poses (N, J, 3), a fraction of them corrupted."""
    if share == 0:
        return pose_vectors
    is_corrupted = torch.rand((len(pose_vectors), 1, 1), generator=generator) < share
    return torch.where(is_corrupted, corrupt_poses(pose_vectors, limb_masks, generator), pose_vectors)


def corrupt_poses(pose_vectors: Tensor, limb_masks: Tensor, generator: Generator) -> Tensor:
    """Return poses (N, J, 3) with noise on all joints, some of them with corrupted limbs.

    A corrupted limb is, with equal probability, that of the reference pose, that of another pose, the limb with strong noise, or
    the limb moved towards the reference pose.
    """

    def draw_uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator)

    pose_count, joint_count = len(pose_vectors), pose_vectors.shape[1]
    noise = torch.randn(pose_vectors.shape, generator=generator)
    corrupted = pose_vectors + MAX_JOINT_NOISE_SD_RAD * draw_uniform(pose_count, 1, 1) * noise
    limb_draw, pose_draw = draw_uniform(pose_count, len(limb_masks)), draw_uniform(pose_count, 1)
    is_corrupted = (limb_draw < CORRUPTED_LIMB_SHARE) & (pose_draw < CORRUPTED_POSE_SHARE)
    replacements = torch.stack(
        [
            torch.zeros_like(pose_vectors),
            pose_vectors[torch.randperm(pose_count, generator=generator)],
            pose_vectors + LIMB_NOISE_SD_RAD * noise,
            pose_vectors * draw_uniform(pose_count, 1, 1),
        ]
    )
    choice = torch.randint(len(replacements), is_corrupted.shape, generator=generator)
    for limb, limb_joints in enumerate(limb_masks):
        replacement = replacements[choice[:, limb], torch.arange(pose_count)]
        is_replaced = (is_corrupted[:, limb, None] & limb_joints)[..., None].expand(pose_count, joint_count, 1)
        corrupted = torch.where(is_replaced, replacement, corrupted)
    return corrupted


def build_limb_masks() -> Tensor:
    """Return (L, J) bool: the joints of each limb."""
    skeleton = load_cmu31_body().skeleton
    masks = torch.zeros(len(LIMB_ROOT_JOINTS), len(skeleton.names), dtype=torch.bool)
    for mask, first in zip(masks, LIMB_ROOT_JOINTS, strict=True):
        for j, name in enumerate(skeleton.names):  # parents come before children, and the root belongs to no limb
            mask[j] = name == first or bool(mask[skeleton.parents[j]])
    return masks
