"""What people's poses are like, where nothing else tells: the mean pose and the joint limits; trained models in `models`."""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.errors import SceneError
from mocapfix.files.shipped import find_shipped_folder, read_yaml
from mocapfix.skeleton import Skeleton

# on the shelf of priors, but not of this kind: the last six say how a model was trained
OTHER_PRIOR_FILES = ("joint-limits", "shape", "autoencoder", "gaussian", "mixture", "mnn-ik", "pca", "twist")


@dataclass(frozen=True)
class MeanPosePrior:
    """A mean pose and how far each joint strays from it.

    rotations    (J, 3, 3) local joint rotations; the root's is the identity and never used
    information  (J, 3, 3) inverse covariance, in 1/rad^2, of the rotation vector from the mean pose to a pose, in the
                 axes of the joint's parent; zero for the root, of which the prior knows nothing
    held         (J, 3, 3) the part of it about axes that the skeleton itself holds: hinges and fixed joints
    between      (J, 3, 3) rad^2: the covariance of a take's mean pose about people's, nothing about the held axes
    """

    name: str
    mean_rotations: np.ndarray
    information: np.ndarray
    locked_information: np.ndarray
    between_take_covariance: np.ndarray

    def scale_information(self, scale: float) -> "MeanPosePrior":
        """-> the same mean pose, its information times `weight` but for the held axes.

        What the skeleton holds is true in every frame; the rest is people's habit, which a take need not share.
        """
        return replace(self, information=scale * (self.information - self.locked_information) + self.locked_information)

    def build_within_take_prior(self) -> "MeanPosePrior":
        """-> what a take's poses are like about their own mean, which strays from people's by `between`: variances add up."""
        information = self.information.copy()
        information[1:] = np.linalg.inv(np.linalg.inv(self.information[1:]) - self.between_take_covariance[1:])
        return replace(self, information=information)


@dataclass(frozen=True)
class JointLimits:
    """How far each joint turns from the mean pose, along the axes of its parent.

    rotations    (J, 3, 3) local joint rotations of the mean pose, as in Prior
    low, high    (J, 3) radians: between them lies the rotation vector from the mean pose to a person's pose; infinite for
                 the root
    """

    mean_rotations: np.ndarray
    lower_rad: np.ndarray
    upper_rad: np.ndarray


def load_mean_pose_prior(name: str, skeleton: Skeleton) -> MeanPosePrior:
    """-> the prior shipped as priors/NAME.yaml; "none" is the rest pose, held so weakly that it only breaks ties.

    Raises SceneError naming the priors there are.
    """
    joints = len(skeleton.names)
    if name == "none":
        weak = np.tile(np.eye(3) / 3.0**2, (joints, 1, 1))
        weak[0] = 0
        eye = np.tile(np.eye(3), (joints, 1, 1))
        return MeanPosePrior(name, eye, weak, np.zeros_like(weak), eye * 3.0**2 / 2)
    path = find_shipped_folder("priors") / f"{Path(name).name}.yaml"
    if not path.is_file() or path.stem in OTHER_PRIOR_FILES:
        there = ", ".join(sorted(p.stem for p in find_shipped_folder("priors").glob("*.yaml") if p.stem not in OTHER_PRIOR_FILES))
        raise SceneError(f"There is no prior named {name!r}; choose one of: {there}, none.")
    return read_mean_pose_prior(path, skeleton.names)


@cache
def read_mean_pose_prior(path: Path, joint_names: tuple[str, ...]) -> MeanPosePrior:
    """-> the prior in a file, for joints of these names; read once. Raises SceneError where it does not say what it must."""
    data, joints = read_yaml(path), len(joint_names)
    rotations, (information, held, between) = np.tile(np.eye(3), (joints, 1, 1)), np.zeros((3, joints, 3, 3))
    for j, joint in enumerate(joint_names[1:], start=1):
        try:
            said = data["joints"][joint]
            rotations[j] = Rotation.from_quat(said["quaternion_xyzw"]).as_matrix()
            covariance, between[j] = build_symmetric_matrix(said["covariance"]), build_symmetric_matrix(said["between"])
            np.linalg.cholesky(covariance - between[j])  # there is no more between takes than there is altogether
            information[j] = np.linalg.inv(covariance)
            for axis in np.array(said["held"], float).reshape(-1, 3):  # held axes are axes of the covariance
                held[j] += (axis @ information[j] @ axis) * np.outer(axis, axis)
        except (KeyError, TypeError, ValueError, np.linalg.LinAlgError) as error:
            keys = "quaternion_xyzw, covariance and between (xx, yy, zz, xy, xz, yz) and held"
            raise SceneError(f"{path}: joints.{joint} must hold {keys}.") from error
    return MeanPosePrior(path.stem, rotations, information, held, between)


def build_symmetric_matrix(entries: list) -> np.ndarray:
    """-> (3, 3) of its six numbers. Raises TypeError or ValueError where they are none."""
    xx, yy, zz, xy, xz, yz = (float(v) for v in entries)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def load_joint_limits(skeleton: Skeleton) -> JointLimits:
    """-> the joint limits shipped as priors/joint-limits.yaml.

    Raises SceneError naming the file and the joint that does not say what it must.
    """
    path, rotations = (
        find_shipped_folder("priors") / "joint-limits.yaml",
        load_mean_pose_prior("mean-pose", skeleton).mean_rotations,
    )
    data, bounds = read_yaml(path), np.full((2, len(skeleton.names), 3), np.inf)
    bounds[0, 0] = -np.inf
    for j, joint in enumerate(skeleton.names[1:], start=1):
        try:
            bounds[:, j] = [[float(v) for v in data["joints"][joint][side]] for side in ("low", "high")]
        except (KeyError, TypeError, ValueError) as error:
            raise SceneError(f"{path}: joints.{joint} must hold low and high (x, y, z).") from error
        if not (bounds[0, j] < bounds[1, j]).all():
            raise SceneError(f"{path}: joints.{joint} has a low that is not below its high.")
    return JointLimits(rotations, *bounds)
