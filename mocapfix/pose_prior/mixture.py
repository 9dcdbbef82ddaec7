"""Poses as a mixture of Gaussians (Wei and Chai, IEEE Computer Graphics and Applications, 2011): reduced linearly, then a density
of many components.

The components compete: a pose is told by the one in which it costs least, with that one's linear decoder, and belongs to another
as soon as that is cheaper. `near` says to which.
"""

from dataclasses import dataclass, replace

import numpy as np

from mocapfix.pose_prior.model import PoseModel, validate_tensors


@dataclass(frozen=True)
class MixtureModel(PoseModel):
    """C Gaussians in a space of P numbers, which are a pose's coordinates along `axes`.

    mean     (J, 3) radians
    axes     (P, J, 3) of unit length and across each other
    weights  (C,) of the components; their sum is 1
    centres  (C, P) radians
    spreads  (C, P, P) radians, lower triangular: a code of the component c is at centres[c] + spreads[c] code
    chosen   (N,) or (1,): of which component the codes are
    """

    mean_vectors: np.ndarray
    principal_axes: np.ndarray
    component_weights: np.ndarray
    component_means: np.ndarray
    component_cholesky: np.ndarray
    component_index: np.ndarray

    @property
    def code_size(self) -> int:
        return len(self.principal_axes)

    def project_poses(self, pose_vectors: np.ndarray) -> np.ndarray:
        """-> (N, P) radians, poses' coordinates along the axes."""
        return (pose_vectors - self.mean_vectors).reshape(len(pose_vectors), -1) @ self.principal_axes.reshape(
            self.code_size, -1
        ).T

    @property
    def component_offsets(self) -> np.ndarray:
        """-> (C,) what a component costs beside half the square of the code: the logarithm of its spread over its weight."""
        return np.log(np.diagonal(self.component_cholesky, axis1=1, axis2=2)).sum(1) - np.log(self.component_weights)

    def compute_component_costs(self, pose_vectors: np.ndarray) -> np.ndarray:
        """-> (N, C) what poses cost in each component: but for a constant, the negative logarithm of density times weight."""
        rows, parts = self.project_poses(pose_vectors), np.empty((len(self.component_weights), len(pose_vectors)))
        for part, centre, spread, offset in zip(
            parts, self.component_means, self.component_cholesky, self.component_offsets, strict=True
        ):
            part[:] = 0.5 * (np.linalg.solve(spread, (rows - centre).T) ** 2).sum(0) + offset
        return parts.T

    def select_components(self, pose_vectors: np.ndarray) -> "MixtureModel":
        """-> the same mixture, the codes of which are each of the component in which that pose costs least."""
        return replace(self, component_index=self.compute_component_costs(pose_vectors).argmin(1))

    def encode(self, pose_vectors: np.ndarray) -> np.ndarray:
        away = self.project_poses(pose_vectors) - self.component_means[self.component_index]
        return np.linalg.solve(self._take_selected(self.component_cholesky, away), away[..., None])[..., 0]

    def decode(self, codes: np.ndarray) -> np.ndarray:
        rows = self.component_means[self.component_index] + np.einsum(
            "npq,nq->np", self._take_selected(self.component_cholesky, codes), codes
        )
        return self.mean_vectors + np.tensordot(rows, self.principal_axes, 1)

    def linearise(self, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.decode(codes), np.einsum(
            "paj,npq->najq", self.principal_axes, self._take_selected(self.component_cholesky, codes)
        )

    def serialise(self) -> tuple[dict, dict[str, np.ndarray]]:
        names = ("middle", "sigma", "mean", "axes", "weights", "centres", "spreads")
        return {}, {name: getattr(self, name).astype(np.float32) for name in names}

    @classmethod
    def deserialise(cls, joint_names: tuple[str, ...], header: dict, tensors: dict[str, np.ndarray]) -> "MixtureModel":
        count, (parts, size) = len(joint_names), tensors["centres"].shape
        poses = {"middle": (count, 3, 3), "sigma": (count,), "mean": (count, 3), "axes": (size, count, 3)}
        known = validate_tensors(tensors, **poses, weights=(parts,), centres=(parts, size), spreads=(parts, size, size))
        return cls(joint_names, **known, component_index=np.zeros(1, int))

    def _take_selected(self, component_values: np.ndarray, codes: np.ndarray) -> np.ndarray:
        """-> (N, ...) what the component of each of the codes (N, P) has."""
        return np.broadcast_to(component_values[self.component_index], (len(codes), *component_values.shape[1:]))
