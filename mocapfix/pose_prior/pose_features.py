"""Poses as what a network takes in and gives out; in torch, so that they can be differentiated.

Continuous: two columns of each rotation (Zhou et al., CVPR 2019) and the up vector in the root's axes. A turn that changes a
little changes them a little, which of Euler angles is not true: they wrap, and have gimbal lock.
"""

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn
from torch.linalg import cross


class PoseFeatures(ABC):
    """What stands for a pose, about a middle pose (J, 3, 3)."""

    def __init__(self, middle: Tensor):
        self.reference_rotations = middle

    @property
    @abstractmethod
    def feature_count(self) -> int:
        """F, how many numbers a pose is."""

    @abstractmethod
    def compute_features(self, vectors: Tensor) -> Tensor:
        """-> (..., F) of rotation vectors from the middle (..., J, 3)."""

    @abstractmethod
    def compute_vectors(self, features: Tensor) -> Tensor:
        """-> (..., J, 3) radians, of features (..., F) that need not be exactly those of a pose."""

    @property
    @abstractmethod
    def feature_joints(self) -> Tensor:
        """-> (F,) the joint that each feature tells of; a joint's vector depends on its own features alone."""

    def linearise_vectors(self, features: Tensor, slopes: Tensor) -> tuple[Tensor, Tensor]:
        """-> vectors (N, J, 3) of features (N, F), and their slopes (N, J, 3, P) where those of the features are (N, P, F)."""
        gather = nn.functional.one_hot(self.feature_joints, len(self.reference_rotations)).to(slopes.dtype)
        with torch.enable_grad():
            asked = features.detach().requires_grad_()
            vectors = self.compute_vectors(asked)
            each = [torch.autograd.grad(vectors[..., a].sum(), asked, retain_graph=True)[0] for a in range(3)]
        axes = [(slopes * d[:, None]) @ gather for d in each]
        return vectors.detach(), torch.stack(axes, -1).permute(0, 2, 3, 1).contiguous()


class ContinuousFeatures(PoseFeatures):
    @property
    def feature_count(self) -> int:
        return 6 * (len(self.reference_rotations) - 1) + 3

    @property
    def feature_joints(self) -> Tensor:
        return torch.cat([torch.arange(1, len(self.reference_rotations)).repeat_interleave(6), torch.zeros(3, dtype=torch.long)])

    def compute_features(self, vectors: Tensor) -> Tensor:
        local = compute_rotation_tensor(vectors) @ self.reference_rotations
        columns = local[..., 1:, :, :2].transpose(-1, -2).flatten(-3)
        return torch.cat([columns, local[..., 0, 1, :]], -1)

    def compute_vectors(self, features: Tensor) -> Tensor:
        columns = features[..., :-3].unflatten(-1, (-1, 2, 3))
        x, up = normalise_tensor(columns[..., 0, :]), normalise_tensor(features[..., -3:])
        y = normalise_tensor(columns[..., 1, :] - (columns[..., 1, :] * x).sum(-1, keepdim=True) * x)
        local = torch.stack([x, y, cross(x, y)], -1)
        return torch.cat(
            [
                compute_tilt_tensor(up)[..., None, :],
                compute_rotation_vector_tensor(local @ self.reference_rotations[1:].transpose(-1, -2)),
            ],
            -2,
        )


class PerJointFeatures(PoseFeatures):
    """Three numbers for every joint."""

    @property
    def feature_count(self) -> int:
        return 3 * len(self.reference_rotations)

    @property
    def feature_joints(self) -> Tensor:
        return torch.arange(len(self.reference_rotations)).repeat_interleave(3)


class EulerFeatures(PerJointFeatures):
    """The angles z, y, x of every joint, the root's too, in radians (MNN-IK, 4.1: 93 numbers)."""

    def compute_features(self, vectors: Tensor) -> Tensor:
        return compute_euler_tensor(compute_rotation_tensor(vectors) @ self.reference_rotations).flatten(-2)

    def compute_vectors(self, features: Tensor) -> Tensor:
        z, y, x = (features.unflatten(-1, (-1, 3))[..., a, None] * axis for a, axis in enumerate(torch.eye(3).flip(0)))
        return compute_rotation_vector_tensor(
            compute_rotation_tensor(z)
            @ compute_rotation_tensor(y)
            @ compute_rotation_tensor(x)
            @ self.reference_rotations.transpose(-1, -2)
        )


class RotationVectorFeatures(PerJointFeatures):
    """The rotation vectors themselves: as continuous as the rest as long as no joint turns by half a turn from the middle."""

    def compute_features(self, vectors: Tensor) -> Tensor:
        return vectors.flatten(-2)

    def compute_vectors(self, features: Tensor) -> Tensor:
        return features.unflatten(-1, (-1, 3))

    def linearise_vectors(self, features: Tensor, slopes: Tensor) -> tuple[Tensor, Tensor]:
        return self.compute_vectors(features), slopes.transpose(1, 2).unflatten(1, (-1, 3)).contiguous()


FEATURE_TYPES = {"continuous": ContinuousFeatures, "euler": EulerFeatures, "vectors": RotationVectorFeatures}


def normalise_tensor(v: Tensor) -> Tensor:
    return v / v.norm(dim=-1, keepdim=True).clamp_min(1e-9)


def compute_euler_tensor(r: Tensor) -> Tensor:
    """-> (..., 3) the angles z, y, x of rotations (..., 3, 3), y within a quarter of a turn."""
    z, x = torch.atan2(r[..., 1, 0], r[..., 0, 0]), torch.atan2(r[..., 2, 1], r[..., 2, 2])
    y = torch.atan2(-r[..., 2, 0], torch.hypot(r[..., 0, 0], r[..., 1, 0]))
    return torch.stack([z, y, x], -1)


def compute_tilt_tensor(up: Tensor) -> Tensor:
    """-> (..., 3) the rotation vector of the root's tilt, from where up is in the root's axes (..., 3), of unit length."""
    return scale_axis_to_angle(torch.stack([-up[..., 2], torch.zeros_like(up[..., 0]), up[..., 0]], -1), up[..., 1])


def compute_rotation_tensor(vectors: Tensor) -> Tensor:
    """-> (..., 3, 3) of rotation vectors (..., 3), by Rodrigues' formula."""
    square = (vectors**2).sum(-1)[..., None, None]
    angle = torch.where(square < 1e-12, 1.0, square).sqrt()  # a root that has a derivative at zero too
    x, y, z = vectors.unbind(-1)
    o = torch.zeros_like(x)
    k = torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).unflatten(-1, (3, 3))
    first = torch.where(square < 1e-12, 1.0, torch.sin(angle) / angle)
    second = torch.where(square < 1e-12, 0.5, (1 - torch.cos(angle)) / angle**2)
    return torch.eye(3, dtype=vectors.dtype) + first * k + second * (k @ k)


def compute_rotation_vector_tensor(r: Tensor) -> Tensor:
    """-> (..., 3) rotation vectors of (..., 3, 3); at half a turn exactly there is no telling, and the answer is zero."""
    w = torch.stack([r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], -1) / 2
    return scale_axis_to_angle(w, (r.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2)


def scale_axis_to_angle(w: Tensor, cosine: Tensor) -> Tensor:
    """-> (..., 3) the rotation vector along w (..., 3), whose length is the angle's sine, `cosine` (...) its cosine."""
    square = (w**2).sum(-1)
    sine = torch.where(square < 1e-14, 1.0, square).sqrt()
    return w * torch.where(square < 1e-14, 1.0, torch.atan2(sine, cosine) / sine)[..., None]
