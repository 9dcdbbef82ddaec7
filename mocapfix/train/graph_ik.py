"""The network that Learnable SMPLify publishes: ST-GCN features of two frames, and a residual rotation for each joint.

It serves the comparisons of `mocapfix train ik` only; mocapfix ships the network that corrects the closed form.
"""

from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from mocapfix.learned_ik.human_frame import HumanFrame, build_human_frame
from mocapfix.pose_prior.network import build_layers
from mocapfix.skeleton import load_cmu31_skeleton
from mocapfix.solve.kinematics import build_kinematic_tree, compute_tree_poses
from mocapfix.train.frame_pairs import IkBatch
from mocapfix.train.ik_losses import PoseTensors, TreeLevels
from mocapfix.train.settings import LearnedIkSettings

TEMPORAL_KERNEL_FRAMES = 3  # of the convolutions over time; the sequence has two frames, start and target
ROTATION_NUMBERS = 6  # the first two columns of a rotation matrix (appendix A)


class GraphBlock(nn.Module):
    """A block of ST-GCN: a convolution over neighbours in the tree, one over time, and a residual connection."""

    adjacency: Tensor

    def __init__(self, inputs: int, outputs: int, adjacency: Tensor) -> None:
        super().__init__()
        self.register_buffer("adjacency", adjacency)
        self.importance = nn.Parameter(torch.ones_like(adjacency))
        self.spatial = nn.Conv2d(inputs, outputs * len(adjacency), 1)
        self.temporal = nn.Sequential(
            nn.BatchNorm2d(outputs),
            nn.ReLU(),
            nn.Conv2d(outputs, outputs, (TEMPORAL_KERNEL_FRAMES, 1), padding=(TEMPORAL_KERNEL_FRAMES // 2, 0)),
            nn.BatchNorm2d(outputs),
        )
        self.residual = nn.Identity() if inputs == outputs else nn.Conv2d(inputs, outputs, 1)

    def forward(self, values: Float[Tensor, "B C T J"]) -> Float[Tensor, "B D T J"]:
        """Return the features of the next block."""
        partitions = self.spatial(values)
        batch, _, frames, joints = partitions.shape
        partitions = partitions.view(batch, len(self.adjacency), -1, frames, joints)
        mixed = torch.einsum("bkctv,kvw->bctw", partitions, self.adjacency * self.importance)
        return torch.relu(self.temporal(mixed) + self.residual(values))


class GraphModel(nn.Module):
    """The network of Learnable SMPLify (appendix A) on the 31 joints."""

    def __init__(self, settings: LearnedIkSettings) -> None:
        super().__init__()
        skeleton = load_cmu31_skeleton()
        joints, adjacency = len(skeleton.names), build_adjacency(skeleton.parents)
        widths = (3, *settings.graph_widths)
        self.is_normalised, self.is_residual = settings.is_normalised, settings.is_residual
        self.blocks = nn.Sequential(*(GraphBlock(a, b, adjacency) for a, b in pairwise(widths)))
        self.trunk = build_layers((widths[-1] + ROTATION_NUMBERS * joints, *settings.hidden_widths), "relu")
        self.heads = nn.Linear(settings.hidden_widths[-1], ROTATION_NUMBERS * joints)  # one linear layer for each joint
        self.levels = TreeLevels.build(skeleton.parents)
        with torch.no_grad():
            self.heads.weight *= 0.01
            self.heads.bias.copy_(torch.tensor([1.0, 0, 0, 0, 1, 0]).repeat(joints))

    def predict(self, batch: IkBatch) -> PoseTensors:
        """Return the poses of a batch, whose joints must all be given."""
        start_positions, _ = compute_tree_poses(build_kinematic_tree(batch.body), *batch.start)
        frame = build_human_frame(start_positions)
        if not self.is_normalised:
            frame = HumanFrame(frame.origin, np.broadcast_to(np.eye(3), frame.to_human.shape))
        target = batch.positions - batch.positions[:, :1] + batch.start[0][:, None]  # the root's place is known
        sequence = np.stack([frame.transform(each) for each in (start_positions, target)], 1)
        start = batch.start[1].copy()
        start[:, 0] = frame.to_human @ start[:, 0]
        start_tensor = torch.as_tensor(start, dtype=torch.float32)
        pooled = self.blocks(torch.as_tensor(sequence, dtype=torch.float32).permute(0, 3, 1, 2)).mean((2, 3))
        hidden = torch.relu(self.trunk(torch.cat([pooled, start_tensor[..., :2].flatten(1)], 1)))
        local = convert_columns_to_rotations(self.heads(hidden).view(len(start), -1, ROTATION_NUMBERS))
        if self.is_residual:
            local = start_tensor @ local
        to_world = torch.as_tensor(np.swapaxes(frame.to_human, 1, 2).copy(), dtype=torch.float32)
        root = torch.as_tensor(batch.positions[:, 0], dtype=torch.float32)
        return compute_world_tensors(self.levels, torch.as_tensor(batch.body.offsets, dtype=torch.float32), root, local, to_world)


def build_adjacency(parents: np.ndarray) -> Float[Tensor, "3 J J"]:
    """Return the adjacency matrices of ST-GCN's spatial partition: the joint, those nearer to the root, those further away."""
    joints = len(parents)
    own, inward = np.eye(joints), np.zeros((joints, joints))
    inward[parents[1:], np.arange(1, joints)] = 1.0
    outward = inward.T / np.maximum(inward.T.sum(0), 1)
    return torch.as_tensor(np.stack([own, inward, outward]), dtype=torch.float32)


def convert_columns_to_rotations(numbers: Float[Tensor, "... 6"]) -> Float[Tensor, "... 3 3"]:
    """Return rotations from their first two columns, not yet orthonormal (Zhou et al. 2019).

    The numbers are those of the first column, then those of the second.
    """
    columns = numbers.unflatten(-1, (2, 3))
    first = nn.functional.normalize(columns[..., 0, :], dim=-1)
    second = columns[..., 1, :] - (first * columns[..., 1, :]).sum(-1, keepdim=True) * first
    second = nn.functional.normalize(second, dim=-1)
    return torch.stack([first, second, torch.linalg.cross(first, second)], -1)


def compute_world_tensors(levels: TreeLevels, offsets: Tensor, root: Tensor, local: Tensor, to_world: Tensor) -> PoseTensors:
    """Return forward kinematics, differentiable, of local rotations (B, J, 3, 3); the root's axes are those of `to_world`."""
    rotations: list[Tensor] = [to_world @ local[:, 0]] * local.shape[1]
    positions: list[Tensor] = [root] * local.shape[1]
    for members, parents in levels.levels:
        parent_rotation = torch.stack([rotations[p] for p in parents], 1)
        position = torch.stack([positions[p] for p in parents], 1) + (parent_rotation @ offsets[members][..., None])[..., 0]
        current = parent_rotation @ local[:, members]
        for i, joint in enumerate(members):
            rotations[joint], positions[joint] = current[:, i], position[:, i]
    return PoseTensors(torch.stack(positions, 1), torch.stack(rotations, 1))
