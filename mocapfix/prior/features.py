"""Poses as what a network takes in and gives out; in torch, so that they can be differentiated.

Continuous: two columns of each rotation (Zhou et al., CVPR 2019) and the up vector in the root's axes. A turn that changes a
little changes them a little, which of Euler angles is not true: they wrap, and have gimbal lock.
"""

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn
from torch.linalg import cross


class Features(ABC):
    """What stands for a pose, about a middle pose (J, 3, 3)."""

    def __init__(self, middle: Tensor):
        self.middle = middle

    @property
    @abstractmethod
    def size(self) -> int:
        """F, how many numbers a pose is."""

    @abstractmethod
    def of(self, vectors: Tensor) -> Tensor:
        """-> (..., F) of rotation vectors from the middle (..., J, 3)."""

    @abstractmethod
    def vectors(self, features: Tensor) -> Tensor:
        """-> (..., J, 3) radians, of features (..., F) that need not be exactly those of a pose."""

    @property
    @abstractmethod
    def owners(self) -> Tensor:
        """-> (F,) the joint that each feature tells of; a joint's vector depends on its own features alone."""

    def linearised(self, features: Tensor, slopes: Tensor) -> tuple[Tensor, Tensor]:
        """-> vectors (N, J, 3) of features (N, F), and their slopes (N, J, 3, P) where those of the features are (N, P, F)."""
        gather = nn.functional.one_hot(self.owners, len(self.middle)).to(slopes.dtype)
        with torch.enable_grad():
            asked = features.detach().requires_grad_()
            vectors = self.vectors(asked)
            each = [torch.autograd.grad(vectors[..., a].sum(), asked, retain_graph=True)[0] for a in range(3)]
        axes = [(slopes * d[:, None]) @ gather for d in each]
        return vectors.detach(), torch.stack(axes, -1).permute(0, 2, 3, 1).contiguous()


class Continuous(Features):
    @property
    def size(self) -> int:
        return 6 * (len(self.middle) - 1) + 3

    @property
    def owners(self) -> Tensor:
        return torch.cat([torch.arange(1, len(self.middle)).repeat_interleave(6), torch.zeros(3, dtype=torch.long)])

    def of(self, vectors: Tensor) -> Tensor:
        local = rotation(vectors) @ self.middle
        columns = local[..., 1:, :, :2].transpose(-1, -2).flatten(-3)
        return torch.cat([columns, local[..., 0, 1, :]], -1)

    def vectors(self, features: Tensor) -> Tensor:
        columns = features[..., :-3].unflatten(-1, (-1, 2, 3))
        x, up = unit(columns[..., 0, :]), unit(features[..., -3:])
        y = unit(columns[..., 1, :] - (columns[..., 1, :] * x).sum(-1, keepdim=True) * x)
        local = torch.stack([x, y, cross(x, y)], -1)
        return torch.cat([leaning(up)[..., None, :], logarithm(local @ self.middle[1:].transpose(-1, -2))], -2)


class ThreeEach(Features):
    """Three numbers for every joint."""

    @property
    def size(self) -> int:
        return 3 * len(self.middle)

    @property
    def owners(self) -> Tensor:
        return torch.arange(len(self.middle)).repeat_interleave(3)


class Euler(ThreeEach):
    """The angles z, y, x of every joint, the root's too, in radians (MNN-IK, 4.1: 93 numbers)."""

    def of(self, vectors: Tensor) -> Tensor:
        return angles(rotation(vectors) @ self.middle).flatten(-2)

    def vectors(self, features: Tensor) -> Tensor:
        z, y, x = (features.unflatten(-1, (-1, 3))[..., a, None] * axis for a, axis in enumerate(torch.eye(3).flip(0)))
        return logarithm(rotation(z) @ rotation(y) @ rotation(x) @ self.middle.transpose(-1, -2))


class Vectors(ThreeEach):
    """The rotation vectors themselves: as continuous as the rest as long as no joint turns by half a turn from the middle."""

    def of(self, vectors: Tensor) -> Tensor:
        return vectors.flatten(-2)

    def vectors(self, features: Tensor) -> Tensor:
        return features.unflatten(-1, (-1, 3))

    def linearised(self, features: Tensor, slopes: Tensor) -> tuple[Tensor, Tensor]:
        return self.vectors(features), slopes.transpose(1, 2).unflatten(1, (-1, 3)).contiguous()


KINDS = {"continuous": Continuous, "euler": Euler, "vectors": Vectors}


def unit(v: Tensor) -> Tensor:
    return v / v.norm(dim=-1, keepdim=True).clamp_min(1e-9)


def angles(r: Tensor) -> Tensor:
    """-> (..., 3) the angles z, y, x of rotations (..., 3, 3), y within a quarter of a turn."""
    z, x = torch.atan2(r[..., 1, 0], r[..., 0, 0]), torch.atan2(r[..., 2, 1], r[..., 2, 2])
    y = torch.atan2(-r[..., 2, 0], torch.hypot(r[..., 0, 0], r[..., 1, 0]))
    return torch.stack([z, y, x], -1)


def leaning(up: Tensor) -> Tensor:
    """-> (..., 3) the rotation vector of the root's tilt, from where up is in the root's axes (..., 3), of unit length."""
    return axis_angle(torch.stack([-up[..., 2], torch.zeros_like(up[..., 0]), up[..., 0]], -1), up[..., 1])


def rotation(vectors: Tensor) -> Tensor:
    """-> (..., 3, 3) of rotation vectors (..., 3), by Rodrigues' formula."""
    square = (vectors**2).sum(-1)[..., None, None]
    angle = torch.where(square < 1e-12, 1.0, square).sqrt()  # a root that has a derivative at zero too
    x, y, z = vectors.unbind(-1)
    o = torch.zeros_like(x)
    k = torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).unflatten(-1, (3, 3))
    first = torch.where(square < 1e-12, 1.0, torch.sin(angle) / angle)
    second = torch.where(square < 1e-12, 0.5, (1 - torch.cos(angle)) / angle**2)
    return torch.eye(3, dtype=vectors.dtype) + first * k + second * (k @ k)


def logarithm(r: Tensor) -> Tensor:
    """-> (..., 3) rotation vectors of (..., 3, 3); at half a turn exactly there is no telling, and the answer is zero."""
    w = torch.stack([r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], -1) / 2
    return axis_angle(w, (r.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2)


def axis_angle(w: Tensor, cosine: Tensor) -> Tensor:
    """-> (..., 3) the rotation vector along w (..., 3), whose length is the angle's sine, `cosine` (...) its cosine."""
    square = (w**2).sum(-1)
    sine = torch.where(square < 1e-14, 1.0, square).sqrt()
    return w * torch.where(square < 1e-14, 1.0, torch.atan2(sine, cosine) / sine)[..., None]
