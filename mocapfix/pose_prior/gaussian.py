"""Linear Gaussian pose models: a mean pose and components, each scaled to one standard deviation of the code.

With few components this is probabilistic principal component analysis (Tipping and Bishop, 1999, Eqs. 5-8); with all components
above the noise it is the full Gaussian.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from mocapfix.pose_prior.model import Header, PoseModel, Tensors, validate_tensors

FIELD_OF_GAUSSIAN_TENSOR = {
    "middle": "reference_rotations",
    "sigma": "residual_sd_rad",
    "mean": "mean_vectors",
    "components": "components",
}


@dataclass(frozen=True)
class GaussianModel(PoseModel):
    """A Gaussian with P components.

    mean_vectors  (J, 3) radians: rotation vectors from the reference pose to the mean pose
    components    (P, J, 3) radians: each is one standard deviation
    noise_sd_rad  radians: standard deviation of each axis around mean and components
    """

    mean_vectors: np.ndarray
    components: np.ndarray
    noise_sd_rad: float
    kind: ClassVar[str] = "linear"
    is_linear: ClassVar[bool] = True

    @property
    def code_size(self) -> int:
        return len(self.components)

    def encode(self, pose_vectors: Float[np.ndarray, "N J 3"]) -> Float[np.ndarray, "N P"]:
        """Return the posterior mean of the codes of poses (Tipping and Bishop, Eq. 8)."""
        w = self.components.reshape(self.code_size, -1)
        deviation = (pose_vectors - self.mean_vectors).reshape(len(pose_vectors), -1)
        return np.linalg.solve(w @ w.T + self.noise_sd_rad**2 * np.eye(self.code_size), w @ deviation.T).T

    def decode(self, codes: Float[np.ndarray, "N P"]) -> Float[np.ndarray, "N J 3"]:
        return self.mean_vectors + np.tensordot(codes, self.components, 1)

    def linearise(self, codes: Float[np.ndarray, "N P"]) -> tuple[Float[np.ndarray, "N J 3"], Float[np.ndarray, "N J 3 P"]]:
        jacobian = np.moveaxis(self.components, 0, -1)
        return self.decode(codes), np.broadcast_to(jacobian, (len(codes), *jacobian.shape))

    def serialise(self) -> tuple[Header, Tensors]:
        tensors = {name: getattr(self, field).astype(np.float32) for name, field in FIELD_OF_GAUSSIAN_TENSOR.items()}
        return {"noise": self.noise_sd_rad}, tensors

    @classmethod
    def deserialise(cls, joint_names: tuple[str, ...], header: Header, tensors: Tensors) -> "GaussianModel":
        count, size = len(joint_names), len(tensors["components"])
        shapes = {"middle": (count, 3, 3), "sigma": (count,), "mean": (count, 3), "components": (size, count, 3)}
        fields = {FIELD_OF_GAUSSIAN_TENSOR[name]: values for name, values in validate_tensors(tensors, **shapes).items()}
        return cls(joint_names, **fields, noise_sd_rad=float(header["noise"]))
