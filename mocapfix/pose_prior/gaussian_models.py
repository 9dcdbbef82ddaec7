"""Gaussian pose models: linear ones, and mixtures.

A linear model is a mean pose and components, each scaled to one standard deviation of the code. With few components this is
probabilistic principal component analysis (Tipping and Bishop, 1999, Eqs. 5-8); with all components above the noise it is the
full Gaussian.

In a mixture (Wei and Chai, IEEE Computer Graphics and Applications, 2011) poses are projected onto principal axes, and their
density there is a mixture of Gaussians. A pose is described by the component of least cost, with the linear decoder of that
component. `select_components` selects that component for each pose.
"""

from dataclasses import dataclass, replace
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


FIELD_OF_MIXTURE_TENSOR = {
    "middle": "reference_rotations",
    "sigma": "residual_sd_rad",
    "mean": "mean_vectors",
    "axes": "principal_axes",
    "weights": "component_weights",
    "centres": "component_means",
    "spreads": "component_cholesky",
}


@dataclass(frozen=True)
class MixtureModel(PoseModel):
    """C Gaussians in the P coordinates of a pose along the principal axes.

    mean_vectors        (J, 3) radians
    principal_axes      (P, J, 3) orthonormal
    component_weights   (C,), their sum is 1
    component_means     (C, P) radians
    component_cholesky  (C, P, P) radians, lower triangular: Cholesky factor of the covariance of each component. A code of the
                        component c is at component_means[c] + component_cholesky[c] @ code
    component_index     (N,) or (1,): the component of each code
    """

    mean_vectors: np.ndarray
    principal_axes: np.ndarray
    component_weights: np.ndarray
    component_means: np.ndarray
    component_cholesky: np.ndarray
    component_index: np.ndarray
    kind: ClassVar[str] = "mixture"

    @property
    def code_size(self) -> int:
        return len(self.principal_axes)

    def project_poses(self, pose_vectors: Float[np.ndarray, "N J 3"]) -> Float[np.ndarray, "N P"]:
        """Return the coordinates of poses along the principal axes, in radians."""
        deviation = (pose_vectors - self.mean_vectors).reshape(len(pose_vectors), -1)
        return deviation @ self.principal_axes.reshape(self.code_size, -1).T

    @property
    def component_offsets(self) -> Float[np.ndarray, " C"]:
        """The cost of a component besides half the squared code: log of the determinant of its Cholesky factor minus log
        weight."""
        log_determinant = np.log(np.diagonal(self.component_cholesky, axis1=1, axis2=2)).sum(1)
        return log_determinant - np.log(self.component_weights)

    def compute_component_costs(self, pose_vectors: Float[np.ndarray, "N J 3"]) -> Float[np.ndarray, "N C"]:
        """Return the negative logarithm of weight times density of poses in each component, up to a constant."""
        rows, costs = self.project_poses(pose_vectors), np.empty((len(self.component_weights), len(pose_vectors)))
        components = zip(costs, self.component_means, self.component_cholesky, self.component_offsets, strict=True)
        for cost, mean, cholesky, offset in components:
            cost[:] = 0.5 * (np.linalg.solve(cholesky, (rows - mean).T) ** 2).sum(0) + offset
        return costs.T

    def select_components(self, pose_vectors: Float[np.ndarray, "N J 3"]) -> "MixtureModel":
        """Return the mixture whose n-th code belongs to the component of least cost for the n-th pose."""
        return replace(self, component_index=self.compute_component_costs(pose_vectors).argmin(1))

    def encode(self, pose_vectors: Float[np.ndarray, "N J 3"]) -> Float[np.ndarray, "N P"]:
        deviation = self.project_poses(pose_vectors) - self.component_means[self.component_index]
        return np.linalg.solve(self._take_selected(self.component_cholesky, deviation), deviation[..., None])[..., 0]

    def decode(self, codes: Float[np.ndarray, "N P"]) -> Float[np.ndarray, "N J 3"]:
        cholesky = self._take_selected(self.component_cholesky, codes)
        rows = self.component_means[self.component_index] + np.einsum("npq,nq->np", cholesky, codes)
        return self.mean_vectors + np.tensordot(rows, self.principal_axes, 1)

    def linearise(self, codes: Float[np.ndarray, "N P"]) -> tuple[Float[np.ndarray, "N J 3"], Float[np.ndarray, "N J 3 P"]]:
        cholesky = self._take_selected(self.component_cholesky, codes)
        return self.decode(codes), np.einsum("paj,npq->najq", self.principal_axes, cholesky)

    def serialise(self) -> tuple[Header, Tensors]:
        return {}, {name: getattr(self, field).astype(np.float32) for name, field in FIELD_OF_MIXTURE_TENSOR.items()}

    @classmethod
    def deserialise(cls, joint_names: tuple[str, ...], header: Header, tensors: Tensors) -> "MixtureModel":
        joint_count, (component_count, size) = len(joint_names), tensors["centres"].shape
        shapes = {
            "middle": (joint_count, 3, 3),
            "sigma": (joint_count,),
            "mean": (joint_count, 3),
            "axes": (size, joint_count, 3),
            "weights": (component_count,),
            "centres": (component_count, size),
            "spreads": (component_count, size, size),
        }
        fields = {FIELD_OF_MIXTURE_TENSOR[name]: values for name, values in validate_tensors(tensors, **shapes).items()}
        return cls(joint_names, **fields, component_index=np.zeros(1, int))

    def _take_selected(self, component_values: np.ndarray, codes: np.ndarray) -> np.ndarray:
        """Return (N, ...) the values (C, ...) of the component that each code (N, P) belongs to."""
        return np.broadcast_to(component_values[self.component_index], (len(codes), *component_values.shape[1:]))
