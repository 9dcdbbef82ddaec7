"""Poses as a Gaussian: a mean and components, each one standard deviation of the code.

With few components this is probabilistic principal components (Tipping and Bishop, 1999, Eqs. 5-8), with as many as stand out
of the noise the full Gaussian.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from mocapfix.prior.contract import PoseModel, checked


@dataclass(frozen=True)
class Linear(PoseModel):
    """mean (J, 3) and components (P, J, 3) in radians; noise, radians: the deviation of each axis about them."""

    mean: np.ndarray
    components: np.ndarray
    noise: float
    linear: ClassVar[bool] = True

    @property
    def size(self) -> int:
        return len(self.components)

    def encode(self, vectors: np.ndarray) -> np.ndarray:
        """-> (N, P) the mean of the codes that a pose may have (Tipping and Bishop, Eq. 8)."""
        w = self.components.reshape(self.size, -1)
        away = (vectors - self.mean).reshape(len(vectors), -1)
        return np.linalg.solve(w @ w.T + self.noise**2 * np.eye(self.size), w @ away.T).T

    def decode(self, codes: np.ndarray) -> np.ndarray:
        return self.mean + np.tensordot(codes, self.components, 1)

    def linearise(self, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        slope = np.moveaxis(self.components, 0, -1)
        return self.decode(codes), np.broadcast_to(slope, (len(codes), *slope.shape))

    def packed(self) -> tuple[dict, dict[str, np.ndarray]]:
        tensors = {name: getattr(self, name).astype(np.float32) for name in ("middle", "sigma", "mean", "components")}
        return {"noise": self.noise}, tensors

    @classmethod
    def unpacked(cls, joints: tuple[str, ...], said: dict, tensors: dict[str, np.ndarray]) -> "Linear":
        count, size = len(joints), len(tensors["components"])
        shapes = {"middle": (count, 3, 3), "sigma": (count,), "mean": (count, 3), "components": (size, count, 3)}
        return cls(joints, **checked(tensors, **shapes), noise=float(said["noise"]))
