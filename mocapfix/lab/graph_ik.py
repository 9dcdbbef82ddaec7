"""The network that Learnable SMPLify publishes: ST-GCN features of two frames, and a residual rotation for each joint.

It serves the comparisons of `mocapfix train ik` only; mocapfix ships the network that corrects the closed form.

The human-centric frame of Learnable SMPLify (Eqs. 7-13): joints about the pelvis, in axes that turn with the body.

The differentiable form of `mocapfix.kernels.pose_transfer.correct_pose_frames`, and the losses of Learnable SMPLify.
"""

from collections import defaultdict
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from mocapfix.kernels.pose_transfer import TransferTree
from mocapfix.lab.frame_pairs import IkBatch
from mocapfix.lab.networks import build_layers
from mocapfix.lab.settings import LearnedIkSettings
from mocapfix.model.skeleton import load_cmu31_skeleton
from mocapfix.solve.kinematics import build_kinematic_tree, compute_tree_poses


class HumanFrame(NamedTuple):
    """Axes of T skeletons.

    origin    (T, 3) m: the pelvis (Eq. 7)
    to_human  (T, 3, 3): world axes to human-centric axes (Eq. 13)
    """

    origin: np.ndarray
    to_human: np.ndarray

    def transform(self, positions: Float[np.ndarray, "T J 3"]) -> Float[np.ndarray, "T J 3"]:
        """Return world positions in the human-centric frame."""
        return np.einsum("tab,tjb->tja", self.to_human, positions - self.origin[:, None])


def build_human_frame(positions: Float[np.ndarray, "T J 3"]) -> HumanFrame:
    """Return the frame of skeletons: y from the pelvis to the thorax, z forward, x to the left (Eqs. 8-12).

    positions  of the 31 joints in metres; hips, pelvis and thorax (the base of the neck) must not coincide or be in line
    """
    pelvis, left, right, thorax = map(load_cmu31_skeleton().find_joint, ("Hips", "LeftUpLeg", "RightUpLeg", "Neck"))
    y = _normalise(positions[:, thorax] - positions[:, pelvis])
    forward = np.cross(positions[:, left] - positions[:, right], y)
    z = _normalise(forward - (forward * y).sum(1, keepdims=True) * y)
    return HumanFrame(positions[:, pelvis], np.stack([np.cross(y, z), y, z], 1))


def _normalise(vectors: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3"]:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


VERTEX_DISTANCE_M = 0.1  # distance from each joint, along its axes, of the points that stand in for the vertices of a mesh
MIN_ANGLE_SQUARED = 1e-12  # keeps the derivative of an angle finite at 0
MIN_SWING_COSINE = -0.999  # swings of nearly half a turn are not exact, so that their derivative stays finite


@dataclass(frozen=True)
class TreeLevels:
    """The joints of a skeleton level by level: each level's joints and their parents."""

    levels: tuple[tuple[list[int], list[int]], ...]

    @classmethod
    def build(cls, parents: np.ndarray) -> "TreeLevels":
        """Return the levels below the root."""
        depth = np.zeros(len(parents), int)
        members: dict[int, list[int]] = defaultdict(list)
        for joint in range(1, len(parents)):
            depth[joint] = depth[parents[joint]] + 1
            members[int(depth[joint])].append(joint)
        return cls(tuple((joints, [int(parents[j]) for j in joints]) for _, joints in sorted(members.items())))


@dataclass(frozen=True)
class TransferTensors:
    """What the closed form gives the differentiable correction, for B poses.

    start_local, rotation  (B, J, 3, 3)
    direction              (B, J, 3), 0 where unknown
    authority              (B, J)
    root, root_unit        (B, 3) and (B,) metres
    """

    start_local: Tensor
    rotation: Tensor
    direction: Tensor
    authority: Tensor
    root: Tensor
    root_unit: Tensor


@dataclass(frozen=True)
class PoseTensors:
    """World positions (B, J, 3) in metres and world rotations (B, J, 3, 3) of B poses."""

    position: Tensor
    rotation: Tensor


def compute_rotation_exponential(vectors: Float[Tensor, "... 3"]) -> Float[Tensor, "... 3 3"]:
    """Return the rotation matrices of rotation vectors in radians."""
    angle = torch.sqrt((vectors**2).sum(-1, keepdim=True) + MIN_ANGLE_SQUARED)
    axis = vectors / angle
    x, y, z = axis.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*vectors.shape, 3)
    sine, versine = torch.sin(angle)[..., None], (1 - torch.cos(angle))[..., None]
    outer = axis[..., :, None] * axis[..., None, :]
    identity = torch.eye(3, dtype=vectors.dtype)
    return identity + sine * cross + versine * (outer - identity)


def swing_rotations(
    rotation: Float[Tensor, "... 3 3"], bone: Float[Tensor, "... 3"], direction: Float[Tensor, "... 3"]
) -> Float[Tensor, "... 3 3"]:
    """Return rotations after the shortest rotation from the unit vector `bone` to `direction`; unchanged where that is 0."""
    cosine = torch.clamp((bone * direction).sum(-1), min=MIN_SWING_COSINE)
    axis = torch.linalg.cross(bone, direction)[..., None]
    once = torch.linalg.cross(axis.expand_as(rotation), rotation, dim=-2)
    twice = torch.linalg.cross(axis.expand_as(rotation), once, dim=-2)
    return rotation + once + twice / (1 + cosine)[..., None, None]


def correct_pose_tensors(
    tree: TransferTree, levels: TreeLevels, transferred: TransferTensors, corrections: Float[Tensor, "B C"]
) -> PoseTensors:
    """Return the poses of `correct_pose_frames`, differentiable by the corrections."""
    joints = len(tree.parents)
    offsets = torch.as_tensor(tree.offsets, dtype=torch.float32)
    ends = torch.as_tensor(np.maximum(tree.bone_end, 0))
    bone = torch.nn.functional.normalize(offsets[ends], dim=-1)
    has_direction = (transferred.direction**2).sum(-1, keepdim=True) > 0.5
    vectors, authority = corrections[:, : 3 * joints].reshape(-1, joints, 3), transferred.authority[..., None]
    along = (1 - authority) * (vectors * bone).sum(-1, keepdim=True) * has_direction
    is_free = torch.as_tensor(~tree.is_held)[:, None]
    turn = compute_rotation_exponential((authority * vectors + along * bone) * is_free)
    is_registered = np.diff(tree.cloud_start) > 0
    rotations: list[Tensor] = [transferred.rotation[:, 0] @ turn[:, 0]] * joints
    shift = (transferred.rotation[:, 0] @ corrections[:, 3 * joints :, None])[..., 0]
    positions: list[Tensor] = [transferred.root + transferred.root_unit[:, None] * shift] * joints
    for members, parents in levels.levels:
        parent_rotation = torch.stack([rotations[p] for p in parents], 1)
        parent_position = torch.stack([positions[p] for p in parents], 1)
        position = parent_position + (parent_rotation @ offsets[members][..., None])[..., 0]
        inherited = parent_rotation @ transferred.start_local[:, members]
        current = swing_rotations(inherited, (inherited @ bone[members][..., None])[..., 0], transferred.direction[:, members])
        if is_registered[members].any():
            use = torch.as_tensor(is_registered[members]) & (transferred.authority[:, members] < 1)
            current = torch.where(use[..., None, None], transferred.rotation[:, members], current)
        current = current @ turn[:, members]
        for i, joint in enumerate(members):
            rotations[joint], positions[joint] = current[:, i], position[:, i]
    return PoseTensors(torch.stack(positions, 1), torch.stack(rotations, 1))


def compute_angles(a: Float[Tensor, "... 3 3"], b: Float[Tensor, "... 3 3"]) -> Float[Tensor, "..."]:
    """Return the angles between rotations in radians: the geodesic distance."""
    chord = torch.sqrt(((a - b) ** 2).sum((-1, -2)) + MIN_ANGLE_SQUARED) / 8**0.5
    return 2 * torch.asin(torch.clamp(chord, max=0.9999))


def compute_ik_loss(predicted: PoseTensors, true: PoseTensors, weights: tuple[float, float, float]) -> Tensor:
    """Return the loss (Eqs. 18-21), given the weights of joints, pose and vertices.

    The skeleton has no mesh: points VERTEX_DISTANCE_M from the joints along their axes stand in for the vertices.
    """
    difference = predicted.position - true.position
    joints = torch.sqrt((difference**2).sum(-1) + MIN_ANGLE_SQUARED).mean()
    pose = compute_angles(predicted.rotation, true.rotation).mean()
    points = difference[..., None] + VERTEX_DISTANCE_M * (predicted.rotation - true.rotation)
    vertices = torch.sqrt((points**2).sum(-2) + MIN_ANGLE_SQUARED).mean()
    return weights[0] * joints + weights[1] * pose + weights[2] * vertices


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
