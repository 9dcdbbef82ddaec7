"""The interface of trained pose models, both linear models and neural networks.

A pose is given as rotation vectors that lead from a reference pose to the pose, in the axes of each joint's parent. The root's
vector is its tilt: position and heading are not part of the pose. A code has P numbers that are independent and standard normal
under the prior, so the cost of a code is half its sum of squares. A pose is normally distributed around the decoded pose of its
code with the standard deviation `residual_sd_rad`. `kernels.terms.latent` uses this interface in the solver.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

Header = dict[str, Any]  # the JSON header of a weights file
Tensors = dict[str, np.ndarray]  # the tensors of a weights file, by name


@dataclass(frozen=True)
class PoseModel(ABC):
    """A model of human poses with a latent code.

    joint_names          J names
    reference_rotations  (J, 3, 3) local joint rotations of the reference pose; the root's is the identity
    residual_sd_rad      (J,) radians per axis: standard deviation of held-out subjects' poses around the decoded pose of their
                         code
    """

    joint_names: tuple[str, ...]
    reference_rotations: np.ndarray
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

        Raises KeyError, TypeError, ValueError or RuntimeError if header or tensors are incomplete, unknown or have wrong shapes.
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

    Raises ValueError unless the tensors have exactly these names and shapes and are finite.
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
    return Rotation.from_matrix(difference.reshape(-1, 3, 3)).as_rotvec().reshape(*rotations.shape[:2], 3)


def remove_heading(rotations: Float[np.ndarray, "N 3 3"]) -> Float[np.ndarray, "N 3 3"]:
    """Return rotations without their heading, by swing-twist decomposition.

    R = heading @ tilt, where heading is a rotation about the vertical axis y, and the axis of tilt is perpendicular to y.
    """
    quaternions = Rotation.from_matrix(rotations).as_quat()
    heading = 2 * np.arctan2(quaternions[:, 1], quaternions[:, 3])
    return Rotation.from_euler("y", -heading[:, None]).as_matrix() @ rotations
