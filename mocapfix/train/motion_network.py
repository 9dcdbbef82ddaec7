"""The motion prior's network for training: layers that mix the moments of a gap and its features in turn, and its loss."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from mocapfix.motion_prior.model import INITIAL_LOG_SD, MAX_LOG_SD, MIN_LOG_SD
from mocapfix.motion_prior.motion_features import (
    INNER_COUNT,
    INNER_TOKENS,
    TOKEN_COUNT,
    build_motion_tree,
    compute_carried_points,
    compute_output_scale,
    compute_quaternion_matrices,
    compute_window_features,
    count_features,
    count_outputs,
    interpolate_missing_values,
    remove_window_heading,
)
from mocapfix.pose_prior.pose_features import compute_rotation_tensor
from mocapfix.train.motion_windows import TrainingWindows

ROTATION_LOSS_M_RAD = 0.03
"""Weight of rotation errors compared with position errors."""
DEVIATION_LOSS_WEIGHT = 0.02
"""Weight of the likelihood from which the standard deviations are learned."""
SHORT_GAP_WEIGHT_S = 0.1
"""Gaps have a weight that is inverse to their duration plus this."""
MIN_MOTION_FEATURE_SD = 0.05
"""Least standard deviation of a feature."""
MIN_ERROR_M = 0.005
"""Position errors below this count by their square."""


class MixingBlock(nn.Module):
    """A residual block: normalisation, a linear layer over the moments and one over the channels."""

    def __init__(self, width: int):
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.time = nn.Linear(TOKEN_COUNT, TOKEN_COUNT)
        self.channel = nn.Linear(width, width)
        self.out = nn.Linear(width, width)

    def forward(self, hidden: Tensor) -> Tensor:
        mixed = self.time.weight @ self.norm(hidden) + self.time.bias[:, None]
        return hidden + self.out(nn.functional.silu(self.channel(mixed)))


class MotionNetwork(nn.Module):
    """From features (B, T, F) of all moments to outputs (B, I, O) of those inside the gap."""

    feature_mean: Tensor
    feature_sd: Tensor

    def __init__(self, width: int, block_count: int, feature_mean: Tensor, feature_sd: Tensor):
        super().__init__()
        self.register_buffer("feature_mean", feature_mean)
        self.register_buffer("feature_sd", feature_sd)
        self.input = nn.Linear(count_features(), width)
        self.position = nn.Parameter(0.1 * torch.randn(TOKEN_COUNT, width))
        self.blocks = nn.ModuleList(MixingBlock(width) for _ in range(block_count))
        self.norm = nn.LayerNorm(width)
        self.output = nn.Linear(width, count_outputs())
        with torch.no_grad():
            self.output.weight *= 0.1
            self.output.bias.zero_()

    def forward(self, features: Tensor) -> Tensor:
        hidden = self.input((features - self.feature_mean) / self.feature_sd) + self.position
        for block in self.blocks:
            hidden = block(hidden)
        return self.output(self.norm(hidden[:, INNER_TOKENS]))


class MotionExamples:
    """Gaps as tensors: features (B, T, F); and of the R = B I moments inside them the interpolated and true poses."""

    def __init__(self, windows: TrainingWindows):
        interpolated = interpolate_missing_values(windows.quaternions, windows.position, windows.is_known, windows.times_s)
        relative, heading, origin = remove_window_heading(interpolated)
        features = compute_window_features(relative, windows.is_known, windows.is_inside, windows.times_s)
        self.features = torch.from_numpy(features)
        turn = np.repeat(compute_quaternion_matrices(heading), INNER_COUNT, axis=0)
        true = compute_quaternion_matrices(select_inner_moments(windows.quaternions))
        true[:, 0] = np.swapaxes(turn, 1, 2) @ true[:, 0]
        shifted = select_inner_moments(windows.position - origin[:, None])
        position = (shifted[:, None] @ turn)[:, 0]
        self.true_points = torch.from_numpy(compute_carried_points(true, position, np.arange(31)))
        self.true_matrices, self.true_position = torch.from_numpy(true), torch.from_numpy(position)
        self.matrices = torch.from_numpy(compute_quaternion_matrices(select_inner_moments(relative.quaternions)))
        self.position = torch.from_numpy(select_inner_moments(relative.position))
        self.scale = torch.from_numpy(compute_output_scale(select_inner_moments(interpolated.edge_s)))
        self.is_missing = torch.from_numpy(~select_inner_moments(windows.is_known))
        weight = 1 / (SHORT_GAP_WEIGHT_S + windows.gap_s)
        self.row_weight = torch.from_numpy(np.repeat(weight / weight.sum() / INNER_COUNT, INNER_COUNT).astype(np.float32))


def select_inner_moments(values: np.ndarray) -> np.ndarray:
    """Return the values (B I, ...) of the moments inside each gap, given (B, T, ...)."""
    inner = values[:, INNER_TOKENS]
    return np.ascontiguousarray(inner.reshape(-1, *inner.shape[2:]))


def compute_points(matrices: Tensor, position: Tensor) -> Tensor:
    """Return the 31 joints (R, 31, 3) of poses: local rotations (R, J, 3, 3) and root positions (R, 3)."""
    tree = build_motion_tree()
    world, origins = [matrices[:, 0]], [position]
    for j in range(1, len(tree.parents)):
        parent = int(tree.parents[j])
        origins.append(origins[parent] + world[parent] @ torch.from_numpy(tree.offsets[j]))
        world.append(world[parent] @ matrices[:, j])
    rotations, carried = torch.stack(world, 1)[:, tree.carriers], torch.stack(origins, 1)[:, tree.carriers]
    return carried + (rotations @ torch.from_numpy(tree.points)[..., None])[..., 0]


def predict_rows(outputs: Tensor, examples: MotionExamples) -> tuple[Tensor, Tensor, Tensor]:
    """Return the predicted local rotations (R, J, 3, 3), root positions (R, 3) and standard deviations (R, J + 1)."""
    count = examples.matrices.shape[1]
    rows = outputs.flatten(0, 1)
    vectors = rows[:, : 3 * count].unflatten(1, (count, 3)) * examples.scale[..., None]
    matrices = examples.matrices @ compute_rotation_tensor(vectors)
    position = examples.position + rows[:, 3 * count : 3 * count + 3] * examples.scale[:, :1]
    scale = torch.cat([examples.scale, examples.scale[:, :1]], 1)
    deviation = scale * (rows[:, 3 * count + 3 :] + INITIAL_LOG_SD).clamp(MIN_LOG_SD, MAX_LOG_SD).exp()
    return matrices, position, deviation


def compute_motion_loss(outputs: Tensor, examples: MotionExamples) -> tuple[Tensor, Tensor]:
    """Return the loss, and the mean position error (R,) in metres over the 31 joints of each frame."""
    matrices, position, deviation = predict_rows(outputs, examples)
    distance = ((compute_points(matrices, position) - examples.true_points) ** 2).sum(-1)
    distance = (distance + MIN_ERROR_M**2).sqrt() - MIN_ERROR_M
    relative = (matrices - examples.true_matrices).flatten(2)
    chordal = ((relative**2).sum(-1) / 2 + 1e-6).sqrt() - 1e-3  # close to the angle
    row_loss = distance.mean(1) + ROTATION_LOSS_M_RAD * chordal.mean(1)
    with torch.no_grad():
        square = (relative**2).sum(-1) / 6  # a small rotation's mean square per axis
        root_square = ((position - examples.true_position) ** 2).mean(1, keepdim=True)
        squares = torch.cat([square, root_square], 1)
        is_missing = torch.cat([examples.is_missing, examples.is_missing[:, :1]], 1)
    sd = torch.where(is_missing, deviation, 1.0)
    likelihood = torch.where(is_missing, sd.log() + squares / (2 * sd**2), 0.0).mean(1)
    weight = examples.row_weight
    loss = (weight * row_loss).sum() + DEVIATION_LOSS_WEIGHT * (weight * likelihood).sum()
    return loss, distance.mean(1).detach()


def draw_initial_network(width: int, block_count: int, seed: int, features: Tensor) -> MotionNetwork:
    """Return the untrained network, drawn with a seed; it normalises features as some examples (B, T, F) show them."""
    mean, sd = features.mean((0, 1)), features.std((0, 1)).clamp_min(MIN_MOTION_FEATURE_SD)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return MotionNetwork(width, block_count, mean, sd)


def average_moments(errors: Float[np.ndarray, " R"]) -> Float[np.ndarray, " B"]:
    """Return the mean of each gap's moments."""
    return errors.reshape(-1, INNER_COUNT).mean(axis=1)
