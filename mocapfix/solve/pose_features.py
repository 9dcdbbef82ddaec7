"""The features of a pose that networks take and return, as differentiable torch functions.

Continuous features are two columns of each rotation matrix (Zhou et al., CVPR 2019) and the up vector in the axes of the root.
They change continuously with the rotations, unlike Euler angles, which wrap around and have a gimbal lock.
"""

from abc import ABC, abstractmethod

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.linalg import cross


class PoseFeatures(ABC):
    """Features of poses relative to a reference pose of J joints.

    A pose is given as rotation vectors from the reference pose, (..., J, 3) in radians; features are (..., F).
    """

    def __init__(self, reference_rotations: Tensor):
        self.reference_rotations = reference_rotations

    @property
    @abstractmethod
    def feature_count(self) -> int:
        """F, the number of features of a pose."""

    @abstractmethod
    def compute_features(self, vectors: Tensor) -> Tensor:
        """Return the features (..., F) of rotation vectors (..., J, 3)."""

    @abstractmethod
    def compute_vectors(self, features: Tensor) -> Tensor:
        """Return the rotation vectors (..., J, 3) of features (..., F), which need not be those of an exact rotation."""

    @property
    @abstractmethod
    def feature_joints(self) -> Tensor:
        """(F,) the joint of each feature; the rotation vector of a joint depends on the joint's own features only."""

    def linearise_vectors(self, features: Tensor, slopes: Tensor) -> tuple[Tensor, Tensor]:
        """Return rotation vectors and their derivatives along P directions.

        Vectors are (N, J, 3) for features (N, F), derivatives (N, J, 3, P) for derivatives of the features (N, P, F).
        """
        gather = nn.functional.one_hot(self.feature_joints, len(self.reference_rotations)).to(slopes.dtype)
        with torch.enable_grad():
            variable = features.detach().requires_grad_()
            vectors = self.compute_vectors(variable)
            gradients = [torch.autograd.grad(vectors[..., a].sum(), variable, retain_graph=True)[0] for a in range(3)]
        components = [(slopes * gradient[:, None]) @ gather for gradient in gradients]
        return vectors.detach(), torch.stack(components, -1).permute(0, 2, 3, 1).contiguous()


class ContinuousFeatures(PoseFeatures):
    """Two columns of each rotation matrix, and the up vector in the axes of the root: 6 (J - 1) + 3 features."""

    @property
    def feature_count(self) -> int:
        return 6 * (len(self.reference_rotations) - 1) + 3

    @property
    def feature_joints(self) -> Tensor:
        joints = torch.arange(1, len(self.reference_rotations)).repeat_interleave(6)
        return torch.cat([joints, torch.zeros(3, dtype=torch.long)])

    def compute_features(self, vectors: Tensor) -> Tensor:
        local = compute_rotation_tensor(vectors) @ self.reference_rotations
        columns = local[..., 1:, :, :2].transpose(-1, -2).flatten(-3)
        return torch.cat([columns, local[..., 0, 1, :]], -1)

    def compute_vectors(self, features: Tensor) -> Tensor:
        columns = features[..., :-3].unflatten(-1, (-1, 2, 3))
        x, up = normalise_tensor(columns[..., 0, :]), normalise_tensor(features[..., -3:])
        y = normalise_tensor(columns[..., 1, :] - (columns[..., 1, :] * x).sum(-1, keepdim=True) * x)
        local = torch.stack([x, y, cross(x, y)], -1)
        vectors = compute_rotation_vector_tensor(local @ self.reference_rotations[1:].transpose(-1, -2))
        return torch.cat([compute_tilt_tensor(up)[..., None, :], vectors], -2)


class PerJointFeatures(PoseFeatures):
    """Three features of every joint."""

    @property
    def feature_count(self) -> int:
        return 3 * len(self.reference_rotations)

    @property
    def feature_joints(self) -> Tensor:
        return torch.arange(len(self.reference_rotations)).repeat_interleave(3)


class EulerFeatures(PerJointFeatures):
    """The Euler angles z, y, x of every joint, the root included, in radians (MNN-IK, 4.1: 93 numbers)."""

    def compute_features(self, vectors: Tensor) -> Tensor:
        return compute_euler_tensor(compute_rotation_tensor(vectors) @ self.reference_rotations).flatten(-2)

    def compute_vectors(self, features: Tensor) -> Tensor:
        angles = features.unflatten(-1, (-1, 3))
        z, y, x = (compute_rotation_tensor(angles[..., a, None] * axis) for a, axis in enumerate(torch.eye(3).flip(0)))
        return compute_rotation_vector_tensor(z @ y @ x @ self.reference_rotations.transpose(-1, -2))


class RotationVectorFeatures(PerJointFeatures):
    """The rotation vectors themselves, which are continuous while every joint is within half a turn of the reference pose."""

    def compute_features(self, vectors: Tensor) -> Tensor:
        return vectors.flatten(-2)

    def compute_vectors(self, features: Tensor) -> Tensor:
        return features.unflatten(-1, (-1, 3))

    def linearise_vectors(self, features: Tensor, slopes: Tensor) -> tuple[Tensor, Tensor]:
        return self.compute_vectors(features), slopes.transpose(1, 2).unflatten(1, (-1, 3)).contiguous()


FEATURE_TYPES: dict[str, type[PoseFeatures]] = {
    "continuous": ContinuousFeatures,
    "euler": EulerFeatures,
    "vectors": RotationVectorFeatures,
}


def build_features(kind: str, reference_rotations: Float[np.ndarray, "J 3 3"]) -> PoseFeatures:
    """Return the features of a kind relative to a reference pose."""
    return FEATURE_TYPES[kind](torch.as_tensor(reference_rotations, dtype=torch.float32))


def normalise_tensor(vectors: Tensor) -> Tensor:
    """Return vectors (..., 3) scaled to unit length."""
    return vectors / vectors.norm(dim=-1, keepdim=True).clamp_min(1e-9)


def compute_euler_tensor(rotations: Tensor) -> Tensor:
    """Return the Euler angles z, y, x (..., 3) in radians of rotations (..., 3, 3), with y within a quarter turn."""
    z = torch.atan2(rotations[..., 1, 0], rotations[..., 0, 0])
    x = torch.atan2(rotations[..., 2, 1], rotations[..., 2, 2])
    y = torch.atan2(-rotations[..., 2, 0], torch.hypot(rotations[..., 0, 0], rotations[..., 1, 0]))
    return torch.stack([z, y, x], -1)


def compute_tilt_tensor(up: Tensor) -> Tensor:
    """Return the rotation vectors (..., 3) of the root's tilt, given the unit up vectors (..., 3) in the axes of the root."""
    return scale_axis_to_angle(torch.stack([-up[..., 2], torch.zeros_like(up[..., 0]), up[..., 0]], -1), up[..., 1])


def compute_rotation_tensor(vectors: Tensor) -> Tensor:
    """Return the rotations (..., 3, 3) of rotation vectors (..., 3), by Rodrigues' formula."""
    square = (vectors**2).sum(-1)[..., None, None]
    angle = torch.where(square < 1e-12, 1.0, square).sqrt()  # the square root has no derivative at zero
    x, y, z = vectors.unbind(-1)
    o = torch.zeros_like(x)
    k = torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).unflatten(-1, (3, 3))
    first = torch.where(square < 1e-12, 1.0, torch.sin(angle) / angle)
    second = torch.where(square < 1e-12, 0.5, (1 - torch.cos(angle)) / angle**2)
    return torch.eye(3, dtype=vectors.dtype) + first * k + second * (k @ k)


def compute_rotation_vector_tensor(rotations: Tensor) -> Tensor:
    """Return the rotation vectors (..., 3) of rotations (..., 3, 3); zero for an exact half turn, whose axis this does not
    find."""
    x = rotations[..., 2, 1] - rotations[..., 1, 2]
    y = rotations[..., 0, 2] - rotations[..., 2, 0]
    z = rotations[..., 1, 0] - rotations[..., 0, 1]
    return scale_axis_to_angle(torch.stack([x, y, z], -1) / 2, (rotations.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2)


def scale_axis_to_angle(axis: Tensor, cosine: Tensor) -> Tensor:
    """Return the rotation vectors (..., 3) along axes (..., 3) whose length is the sine of the angle, given its cosine (...)."""
    square = (axis**2).sum(-1)
    sine = torch.where(square < 1e-14, 1.0, square).sqrt()
    return axis * torch.where(square < 1e-14, 1.0, torch.atan2(sine, cosine) / sine)[..., None]
