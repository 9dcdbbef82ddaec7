"""Poses as a mixture of Gaussians (Wei and Chai, SIGGRAPH Asia 2011): reduced linearly, then a density of many components.

The components compete: a pose is told by the one in which it costs least, with that one's linear decoder, and belongs to another
as soon as that is cheaper. `near` says to which.
"""

from dataclasses import dataclass, replace

import numpy as np

from mocapfix.prior.contract import PoseModel, checked


@dataclass(frozen=True)
class Mixture(PoseModel):
    """C Gaussians in a space of P numbers, which are a pose's coordinates along `axes`.

    mean     (J, 3) radians
    axes     (P, J, 3) of unit length and across each other
    weights  (C,) of the components; their sum is 1
    centres  (C, P) radians
    spreads  (C, P, P) radians, lower triangular: a code of the component c is at centres[c] + spreads[c] code
    chosen   (N,) or (1,): of which component the codes are
    """

    mean: np.ndarray
    axes: np.ndarray
    weights: np.ndarray
    centres: np.ndarray
    spreads: np.ndarray
    chosen: np.ndarray

    @property
    def size(self) -> int:
        return len(self.axes)

    def reduced(self, vectors: np.ndarray) -> np.ndarray:
        """-> (N, P) radians, poses' coordinates along the axes."""
        return (vectors - self.mean).reshape(len(vectors), -1) @ self.axes.reshape(self.size, -1).T

    @property
    def offsets(self) -> np.ndarray:
        """-> (C,) what a component costs beside half the square of the code: the logarithm of its spread over its weight."""
        return np.log(np.diagonal(self.spreads, axis1=1, axis2=2)).sum(1) - np.log(self.weights)

    def costs(self, vectors: np.ndarray) -> np.ndarray:
        """-> (N, C) what poses cost in each component: but for a constant, the negative logarithm of density times weight."""
        rows, parts = self.reduced(vectors), np.empty((len(self.weights), len(vectors)))
        for part, centre, spread, offset in zip(parts, self.centres, self.spreads, self.offsets, strict=True):
            part[:] = 0.5 * (np.linalg.solve(spread, (rows - centre).T) ** 2).sum(0) + offset
        return parts.T

    def near(self, vectors: np.ndarray) -> "Mixture":
        """-> the same mixture, the codes of which are each of the component in which that pose costs least."""
        return replace(self, chosen=self.costs(vectors).argmin(1))

    def encode(self, vectors: np.ndarray) -> np.ndarray:
        away = self.reduced(vectors) - self.centres[self.chosen]
        return np.linalg.solve(self._own(self.spreads, away), away[..., None])[..., 0]

    def decode(self, codes: np.ndarray) -> np.ndarray:
        rows = self.centres[self.chosen] + np.einsum("npq,nq->np", self._own(self.spreads, codes), codes)
        return self.mean + np.tensordot(rows, self.axes, 1)

    def linearise(self, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.decode(codes), np.einsum("paj,npq->najq", self.axes, self._own(self.spreads, codes))

    def packed(self) -> tuple[dict, dict[str, np.ndarray]]:
        names = ("middle", "sigma", "mean", "axes", "weights", "centres", "spreads")
        return {}, {name: getattr(self, name).astype(np.float32) for name in names}

    @classmethod
    def unpacked(cls, joints: tuple[str, ...], said: dict, tensors: dict[str, np.ndarray]) -> "Mixture":
        count, (parts, size) = len(joints), tensors["centres"].shape
        poses = {"middle": (count, 3, 3), "sigma": (count,), "mean": (count, 3), "axes": (size, count, 3)}
        known = checked(tensors, **poses, weights=(parts,), centres=(parts, size), spreads=(parts, size, size))
        return cls(joints, **known, chosen=np.zeros(1, int))

    def _own(self, of_components: np.ndarray, codes: np.ndarray) -> np.ndarray:
        """-> (N, ...) what the component of each of the codes (N, P) has."""
        return np.broadcast_to(of_components[self.chosen], (len(codes), *of_components.shape[1:]))
