"""What a trained model of poses can be asked: one contract for linear models and networks.

A pose is given as rotation vectors from a middle pose, in the parents' axes; the root's is its tilt, for where somebody
stands and which way he faces says nothing about his pose. A code is P numbers that are independent and normal, each in its
own standard deviation: half their sum of squares is what a code costs. Decoding says what pose a code means, and a person's
pose lies about that by `sigma`. This is what kernels.terms.latent takes.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class PoseModel(ABC):
    """A model of poses with a latent code.

    joints  J names
    middle  (J, 3, 3) local joint rotations of the middle pose; the identity for the root
    sigma   (J,) radians: deviation per axis of unseen people's poses from the decoded pose of their code
    """

    joint_names: tuple[str, ...]
    reference_rotations: np.ndarray
    residual_sd_rad: np.ndarray
    is_linear: ClassVar[bool] = False  # whether decoding is, so that the model is linearised once and for all

    @property
    @abstractmethod
    def code_size(self) -> int:
        """P, of how many numbers a code is."""

    @property
    def nonlinear_code_size(self) -> int:
        """B, how many of a code's first numbers decoding bends; it is linear in the others, which say the same at all codes."""
        return 0 if self.is_linear else self.code_size

    @abstractmethod
    def encode(self, pose_vectors: np.ndarray) -> np.ndarray:
        """-> (N, P) codes of poses (N, J, 3)."""

    @abstractmethod
    def decode(self, codes: np.ndarray) -> np.ndarray:
        """-> (N, J, 3) radians, the poses that codes (N, P) mean."""

    @abstractmethod
    def linearise(self, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """-> (N, J, 3) radians, as `decode`, and how they change with the code, (N, J, 3, P) radians."""

    @abstractmethod
    def serialise(self) -> tuple[dict, dict[str, np.ndarray]]:
        """-> what a file's header must say of the model beside its joints, and the file's tensors."""

    @classmethod
    @abstractmethod
    def deserialise(cls, joint_names: tuple[str, ...], header: dict, tensors: dict[str, np.ndarray]) -> "PoseModel":
        """-> the model again. Raises KeyError, TypeError, ValueError or RuntimeError where anything lacks or is too much."""

    def select_components(self, pose_vectors: np.ndarray) -> "PoseModel":
        """-> the model to encode and decode these poses (N, J, 3) by: another only where several compete for each of them."""
        return self

    @property
    def residual_information(self) -> np.ndarray:
        """-> (J, 3, 3) in 1/rad^2, of a pose about the decoded one; the root's is that of its tilt."""
        return self.residual_sd_rad[:, None, None] ** -2 * np.eye(3)


def validate_tensors(tensors: dict[str, np.ndarray], **shapes: tuple[int, ...]) -> dict[str, np.ndarray]:
    """-> the tensors as float64. Raises ValueError unless they are the named ones, of these shapes, and finite."""
    found = {name: values.shape for name, values in tensors.items()}
    if found != shapes or not all(np.isfinite(values).all() for values in tensors.values()):
        raise ValueError(f"it should hold {shapes} and finite numbers; it holds {found}")
    return {name: values.astype(float) for name, values in tensors.items()}


def compute_pose_vectors(rotations: np.ndarray, reference_rotations: np.ndarray) -> np.ndarray:
    """-> (N, J, 3) radians: local joint rotations (N, J, 3, 3) as vectors from `middle` (J, 3, 3), the heading taken out."""
    local = np.concatenate([remove_heading(rotations[:, 0])[:, None], rotations[:, 1:]], axis=1)
    away = local @ np.swapaxes(reference_rotations, 1, 2)
    return Rotation.from_matrix(away.reshape(-1, 3, 3)).as_rotvec().reshape(*rotations.shape[:2], 3)


def remove_heading(rotations: np.ndarray) -> np.ndarray:
    """-> (N, 3, 3) rotations (N, 3, 3) without their turn about the vertical, by swing and twist.

    R = heading tilt, the heading a turn about y, the tilt one about an axis across it.
    """
    quaternions = Rotation.from_matrix(rotations).as_quat()
    heading = 2 * np.arctan2(quaternions[:, 1], quaternions[:, 3])
    return Rotation.from_euler("y", -heading[:, None]).as_matrix() @ rotations
