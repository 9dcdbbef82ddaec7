"""The interface of trained pose models, `PoseModel`, and the Gaussian ones.

A pose is given as rotation vectors that lead from a reference pose to the pose, in the axes of each joint's parent. The root's
vector is its tilt: position and heading are not part of the pose. A code has P numbers that are independent and standard normal
under the prior, so the cost of a code is half its sum of squares. A pose is normally distributed around the decoded pose of its
code with the standard deviation `residual_sd_rad`. `solve.model_terms` uses this interface in the solver.

`GaussianModel`: a mean pose and components, each scaled to one standard deviation of the code. With few components this is
probabilistic principal component analysis (Tipping and Bishop, 1999, Eqs. 5-8), with all above the noise the full Gaussian.
`MixtureModel` (Wei and Chai, IEEE Computer Graphics and Applications, 2011): a mixture of Gaussians on the principal axes. Each
pose is described by the component of least cost (`select_components`).
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float

from mocapfix.kernels import lie
from mocapfix.stats.rigid_alignment import compute_rotation_vectors, compute_rotations

Header = dict[str, Any]  # the JSON header of a weights file
Tensors = dict[str, np.ndarray]  # the tensors of a weights file, by name


@dataclass(frozen=True)
class PoseModel(ABC):
    """A model of human poses with a latent code."""

    joint_names: tuple[str, ...]  # J names
    reference_rotations: np.ndarray  # (J, 3, 3) local joint rotations of the reference pose; the root's is the identity
    # (J,) radians per axis: standard deviation of held-out subjects' poses around the decoded pose of their code
    residual_sd_rad: np.ndarray
    kind: ClassVar[str]  # of the model in a weights file
    is_linear: ClassVar[bool] = False  # a linear decoder is linearised only once

    @property
    @abstractmethod
    def code_size(self) -> int:
        """P, the number of dimensions of a code."""

    @property
    def nonlinear_code_size(self) -> int:
        """The number of leading code dimensions in which decoding is nonlinear; the Jacobian of the others is constant."""
        return 0 if self.is_linear else self.code_size

    @abstractmethod
    def encode(self, pose_vectors: Float[np.ndarray, "N J 3"]) -> Float[np.ndarray, "N P"]:
        """Return the codes of poses, given as rotation vectors in radians."""

    @abstractmethod
    def decode(self, codes: Float[np.ndarray, "N P"]) -> Float[np.ndarray, "N J 3"]:
        """Return the poses of codes, as rotation vectors in radians."""

    @abstractmethod
    def linearise(self, codes: Float[np.ndarray, "N P"]) -> tuple[Float[np.ndarray, "N J 3"], Float[np.ndarray, "N J 3 P"]]:
        """Return the decoded poses and their Jacobian with respect to the codes, both in radians."""

    @abstractmethod
    def serialise(self) -> tuple[Header, Tensors]:
        """Return the file's header, without kind and joints, and the file's tensors."""

    @classmethod
    @abstractmethod
    def deserialise(cls, joint_names: tuple[str, ...], header: Header, tensors: Tensors) -> "PoseModel":
        """Return the model of a file.

        Raises:
            KeyError, TypeError, ValueError, RuntimeError: If header or tensors are incomplete, unknown or have wrong shapes.
        """

    def select_components(self, pose_vectors: Float[np.ndarray, "N J 3"]) -> "PoseModel":
        """Return the model to encode and decode these poses with. Only a mixture selects a component for each pose."""
        return self

    @property
    def residual_information(self) -> Float[np.ndarray, "J 3 3"]:
        """The inverse covariance in 1/rad^2 of a pose around its decoded pose; the root's is that of its tilt."""
        return self.residual_sd_rad[:, None, None] ** -2 * np.eye(3)


def validate_tensors(tensors: Tensors, **shapes: tuple[int, ...]) -> Tensors:
    """Return the tensors as float64.

    Raises:
        ValueError: Unless the tensors have exactly these names and shapes and are finite.
    """
    actual_shapes = {name: values.shape for name, values in tensors.items()}
    if actual_shapes != shapes or not all(np.isfinite(values).all() for values in tensors.values()):
        raise ValueError(f"expected finite tensors of the shapes {shapes}, found the shapes {actual_shapes}")
    return {name: values.astype(float) for name, values in tensors.items()}


def compute_pose_vectors(
    rotations: Float[np.ndarray, "N J 3 3"], reference_rotations: Float[np.ndarray, "J 3 3"]
) -> Float[np.ndarray, "N J 3"]:
    """Return the rotation vectors in radians from the reference pose to local joint rotations, without the root's heading."""
    local = np.concatenate([remove_heading(rotations[:, 0])[:, None], rotations[:, 1:]], axis=1)
    difference = local @ np.swapaxes(reference_rotations, 1, 2)
    return compute_rotation_vectors(difference)


def remove_heading(rotations: Float[np.ndarray, "N 3 3"]) -> Float[np.ndarray, "N 3 3"]:
    """Return rotations without their heading, by swing-twist decomposition.

    R = heading @ tilt, where heading is a rotation about the vertical axis y, and the axis of tilt is perpendicular to y.
    """
    quaternions = lie.extract_joint_quaternions(np.array(rotations[:, None], float, order="C"), 0, np.ones(len(rotations), bool))
    heading = 2 * np.arctan2(quaternions[:, 1], quaternions[:, 3])
    return compute_rotations(-heading[:, None] * [0.0, 1.0, 0.0]) @ rotations


FIELD_OF_GAUSSIAN_TENSOR = {
    "middle": "reference_rotations",
    "sigma": "residual_sd_rad",
    "mean": "mean_vectors",
    "components": "components",
}


@dataclass(frozen=True)
class GaussianModel(PoseModel):
    """A Gaussian with P components."""

    mean_vectors: np.ndarray  # (J, 3) radians: rotation vectors from the reference pose to the mean pose
    components: np.ndarray  # (P, J, 3) radians: each is one standard deviation
    noise_sd_rad: float  # radians: standard deviation of each axis around mean and components
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
    """C Gaussians in the P coordinates of a pose along the principal axes."""

    mean_vectors: np.ndarray  # (J, 3) radians
    principal_axes: np.ndarray  # (P, J, 3) orthonormal
    component_weights: np.ndarray  # (C,), their sum is 1
    component_means: np.ndarray  # (C, P) radians
    # (C, P, P) radians, lower triangular: Cholesky factor of the covariance of each component. A code of the component c is at
    # component_means[c] + component_cholesky[c] @ code
    component_cholesky: np.ndarray
    component_index: np.ndarray  # (N,) or (1,): the component of each code
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
        """The cost of a component besides half the squared code: log determinant of its Cholesky factor less log weight."""
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
