"""The mean-pose prior: the mean rotation of every joint, the covariance of poses around it, and the limits of each joint."""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mocapfix.errors import SceneError
from mocapfix.io.shipped import find_shipped_folder, read_yaml
from mocapfix.kernels import lie
from mocapfix.model.skeleton import Skeleton

NO_PRIOR_SD_RAD = 3.0  # radians per axis: the prior "none" only breaks ties between poses that the markers do not distinguish
# YAML files in priors/ that are not mean-pose priors. Nor are those beside weights, which are settings of training.
OTHER_PRIOR_FILES = ("hand", "joint-limits", "shape")


@dataclass(frozen=True)
class MeanPosePrior:
    """A mean pose and the inverse covariance of the poses around it."""

    name: str
    mean_rotations: np.ndarray  # (J, 3, 3) local joint rotations; the root's is the identity and is not used
    # (J, 3, 3) 1/rad^2: inverse covariance of the rotation vector from the mean pose to a pose, in the axes of the joint's
    # parent; zero for the root, whose rotation the prior does not constrain
    information: np.ndarray
    # (J, 3, 3) 1/rad^2: the part of `information` about locked axes, in which the skeleton does not rotate (fixed joints, and
    # hinges across their axis)
    locked_information: np.ndarray
    between_take_covariance: np.ndarray  # (J, 3, 3) rad^2: covariance of the mean poses of takes; zero about locked axes

    def scale_information(self, scale: float) -> "MeanPosePrior":
        """Return the prior with its information multiplied by `scale`, except about locked axes.

        Locked axes are a property of the skeleton and apply to every frame. The rest are habits of people, which vary between
        takes.
        """
        return replace(self, information=scale * (self.information - self.locked_information) + self.locked_information)

    def build_within_take_prior(self) -> "MeanPosePrior":
        """Return the prior about a take's own mean: total covariance is that within plus that between takes."""
        information = self.information.copy()
        information[1:] = np.linalg.inv(np.linalg.inv(self.information[1:]) - self.between_take_covariance[1:])
        return replace(self, information=information)


def load_mean_pose_prior(name: str, skeleton: Skeleton) -> MeanPosePrior:
    """Return the prior shipped as priors/NAME.yaml, or for "none" the rest pose with a standard deviation of NO_PRIOR_SD_RAD.

    Raises SceneError that lists the available priors if there is none of this name.
    """
    joint_count = len(skeleton.names)
    if name == "none":
        information = np.tile(np.eye(3) / NO_PRIOR_SD_RAD**2, (joint_count, 1, 1))
        information[0] = 0
        identity = np.tile(np.eye(3), (joint_count, 1, 1))
        return MeanPosePrior(name, identity, information, np.zeros_like(information), identity * NO_PRIOR_SD_RAD**2 / 2)
    folder = find_shipped_folder("priors")
    names = sorted(path.stem for path in folder.glob("*.yaml") if not path.with_suffix(".safetensors").is_file())
    if name not in names or name in OTHER_PRIOR_FILES:
        available = ", ".join(each for each in names if each not in OTHER_PRIOR_FILES)
        raise SceneError(f"There is no prior named {name!r}; choose one of: {available}, none.")
    return read_mean_pose_prior(folder / f"{name}.yaml", skeleton.names)


@cache
def read_mean_pose_prior(path: Path, joint_names: tuple[str, ...]) -> MeanPosePrior:
    """Return the prior in a file, for joints of these names. The file is read once."""
    data, joint_count = read_yaml(path), len(joint_names)
    mean_rotations = np.tile(np.eye(3), (joint_count, 1, 1))
    information, locked_information, between_take_covariance = np.zeros((3, joint_count, 3, 3))
    for j, joint in enumerate(joint_names[1:], start=1):
        try:
            entry = data["joints"][joint]
            quaternion = np.reshape(entry["quaternion_xyzw"], (1, 4)).astype(float)
            lie.store_joint_quaternions(quaternion, j, mean_rotations[None])
            if not np.isfinite(mean_rotations[j]).all():
                raise ValueError("it is no rotation")
            covariance = build_symmetric_matrix(entry["covariance"])
            between_take_covariance[j] = build_symmetric_matrix(entry["between_takes"])
            np.linalg.cholesky(covariance - between_take_covariance[j])  # the covariance within takes is positive definite
            information[j] = np.linalg.inv(covariance)
            for axis in np.array(entry["locked_axes"], float).reshape(-1, 3):  # locked axes are principal axes of the covariance
                locked_information[j] += (axis @ information[j] @ axis) * np.outer(axis, axis)
        except (KeyError, TypeError, ValueError, np.linalg.LinAlgError) as error:
            keys = "quaternion_xyzw, covariance and between_takes (xx, yy, zz, xy, xz, yz) and locked_axes"
            raise SceneError(f"{path}: joints.{joint} must hold {keys}.") from error
    return MeanPosePrior(path.stem, mean_rotations, information, locked_information, between_take_covariance)


def build_symmetric_matrix(entries: list[float]) -> Float[np.ndarray, "3 3"]:
    """Return the symmetric matrix of its entries xx, yy, zz, xy, xz, yz.

    Raises:
        TypeError, ValueError: Unless these are six numbers.
    """
    xx, yy, zz, xy, xz, yz = (float(v) for v in entries)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


@dataclass(frozen=True)
class JointLimits:
    """The range of the rotation vector from the mean pose to a person's pose, in the axes of each joint's parent."""

    mean_rotations: np.ndarray  # (J, 3, 3) local joint rotations of the mean pose, as in MeanPosePrior
    lower_rad: np.ndarray  # lower_rad, upper_rad: (J, 3) radians; infinite for the root
    upper_rad: np.ndarray


def load_joint_limits(skeleton: Skeleton) -> JointLimits:
    """Return the limits in priors/joint-limits.yaml. Raises SceneError that names a joint with missing or invalid limits."""
    path = find_shipped_folder("priors") / "joint-limits.yaml"
    mean_rotations = load_mean_pose_prior("mean-pose", skeleton).mean_rotations
    data, bounds = read_yaml(path), np.full((2, len(skeleton.names), 3), np.inf)
    bounds[0, 0] = -np.inf
    for j, joint in enumerate(skeleton.names[1:], start=1):
        try:
            bounds[:, j] = [[float(v) for v in data["joints"][joint][side]] for side in ("low", "high")]
        except (KeyError, TypeError, ValueError) as error:
            raise SceneError(f"{path}: joints.{joint} must hold low and high (x, y, z).") from error
        if not (bounds[0, j] < bounds[1, j]).all():
            raise SceneError(f"{path}: the low limits of joints.{joint} must be below its high limits.")
    return JointLimits(mean_rotations, *bounds)
