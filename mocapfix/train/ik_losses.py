"""The differentiable form of `mocapfix.kernels.pose_transfer.correct_pose_frames`, and the losses of Learnable SMPLify."""

from collections import defaultdict
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mocapfix.kernels.pose_transfer import TransferTree

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
