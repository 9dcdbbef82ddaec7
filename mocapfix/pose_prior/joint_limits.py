"""Joint limits: the range of each joint's rotation around the mean pose."""

from dataclasses import dataclass

import numpy as np

from mocapfix.errors import SceneError
from mocapfix.files.shipped import find_shipped_folder, read_yaml
from mocapfix.pose_prior.mean_pose import load_mean_pose_prior
from mocapfix.skeleton import Skeleton


@dataclass(frozen=True)
class JointLimits:
    """The range of the rotation vector from the mean pose to a person's pose, in the axes of each joint's parent.

    mean_rotations        (J, 3, 3) local joint rotations of the mean pose, as in MeanPosePrior
    lower_rad, upper_rad  (J, 3) radians; infinite for the root
    """

    mean_rotations: np.ndarray
    lower_rad: np.ndarray
    upper_rad: np.ndarray


def load_joint_limits(skeleton: Skeleton) -> JointLimits:
    """Return the joint limits shipped as priors/joint-limits.yaml.

    Raises SceneError that names the file and the joint if a joint is missing or its limits are invalid.
    """
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
