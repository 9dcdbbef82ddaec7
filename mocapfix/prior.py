"""What people's poses are like, where nothing else tells."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.errors import SceneError
from mocapfix.scenes import folder, read_yaml
from mocapfix.skeleton import Skeleton

CONVENTION = 0.21  # radians


@dataclass(frozen=True)
class Prior:
    """A mean pose and how far each joint strays from it.

    rotations    (J, 3, 3) local joint rotations; the root's is the identity and never used
    information  (J, 3, 3) inverse covariance, in 1/rad^2, of the rotation vector from the mean pose to a pose, in the
                 axes of the joint's parent; zero for the root, of which the prior knows nothing
    """

    name: str
    rotations: np.ndarray
    information: np.ndarray

    def weakened(self, weight: float) -> "Prior":
        """-> the same mean pose, its information times `weight` but for the axes that the skeleton itself holds.

        Axes that every body holds tighter than CONVENTION are hinges and fixed joints: true in every frame, in full. The
        rest is people's habit, which a take need not share.
        """
        information = np.zeros_like(self.information)
        for j, matrix in enumerate(self.information):
            value, axes = np.linalg.eigh(matrix)
            information[j] = (axes * np.where(value > 1 / CONVENTION**2, value, weight * value)) @ axes.T
        return Prior(self.name, self.rotations, information)


def load(name: str, skeleton: Skeleton) -> Prior:
    """-> the prior shipped as priors/NAME.yaml; "none" is the rest pose, held so weakly that it only breaks ties.

    Raises SceneError naming the priors there are.
    """
    joints = len(skeleton.names)
    if name == "none":
        weak = np.tile(np.eye(3) / 3.0**2, (joints, 1, 1))
        weak[0] = 0
        return Prior(name, np.tile(np.eye(3), (joints, 1, 1)), weak)
    path = folder("priors") / f"{Path(name).name}.yaml"
    if not path.is_file():
        there = ", ".join(sorted(p.stem for p in folder("priors").glob("*.yaml")))
        raise SceneError(f"There is no prior named {name!r}; choose one of: {there}, none.")
    data = read_yaml(path)
    rotations, information = np.tile(np.eye(3), (joints, 1, 1)), np.zeros((joints, 3, 3))
    for j, joint in enumerate(skeleton.names[1:], start=1):
        try:
            said = data["joints"][joint]
            rotations[j] = Rotation.from_quat(said["quaternion_xyzw"]).as_matrix()
            xx, yy, zz, xy, xz, yz = (float(v) for v in said["covariance"])
            information[j] = np.linalg.inv([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        except (KeyError, TypeError, ValueError, np.linalg.LinAlgError) as error:
            raise SceneError(f"{path}: joints.{joint} must hold quaternion_xyzw and covariance (xx, yy, zz, xy, xz, yz).") from error
    return Prior(name, rotations, information)
