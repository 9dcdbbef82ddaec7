"""Poses as a Gaussian: a mean and components, each one standard deviation of the code.

With few components this is probabilistic principal components (Tipping and Bishop, 1999, Eqs. 5-8), with as many as stand out
of the noise the full Gaussian.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from mocapfix.pose_prior.model import PoseModel, validate_tensors


@dataclass(frozen=True)
class GaussianModel(PoseModel):
    """mean (J, 3) and components (P, J, 3) in radians; noise, radians: the deviation of each axis about them."""

    mean_vectors: np.ndarray
    components: np.ndarray
    noise_sd_rad: float
    is_linear: ClassVar[bool] = True

    @property
    def code_size(self) -> int:
        return len(self.components)

    def encode(self, pose_vectors: np.ndarray) -> np.ndarray:
        """-> (N, P) the mean of the codes that a pose may have (Tipping and Bishop, Eq. 8)."""
        w = self.components.reshape(self.code_size, -1)
        away = (pose_vectors - self.mean_vectors).reshape(len(pose_vectors), -1)
        return np.linalg.solve(w @ w.T + self.noise_sd_rad**2 * np.eye(self.code_size), w @ away.T).T

    def decode(self, codes: np.ndarray) -> np.ndarray:
        return self.mean_vectors + np.tensordot(codes, self.components, 1)

    def linearise(self, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        slope = np.moveaxis(self.components, 0, -1)
        return self.decode(codes), np.broadcast_to(slope, (len(codes), *slope.shape))

    def serialise(self) -> tuple[dict, dict[str, np.ndarray]]:
        tensors = {name: getattr(self, name).astype(np.float32) for name in ("middle", "sigma", "mean", "components")}
        return {"noise": self.noise_sd_rad}, tensors

    @classmethod
    def deserialise(cls, joint_names: tuple[str, ...], header: dict, tensors: dict[str, np.ndarray]) -> "GaussianModel":
        count, size = len(joint_names), len(tensors["components"])
        shapes = {"middle": (count, 3, 3), "sigma": (count,), "mean": (count, 3), "components": (size, count, 3)}
        return cls(joint_names, **validate_tensors(tensors, **shapes), noise_sd_rad=float(header["noise"]))
