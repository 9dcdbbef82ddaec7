"""How people's bones differ: the shape parameters of a body (SCOPE, Eqs. 1 and 60-64)."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from mocapfix.errors import SceneError
from mocapfix.files.shipped import find_shipped_folder, read_shipped_yaml, read_yaml


# MERGED: mocapfix.shape
def load_shape_components(path: Path, joint_names: tuple[str, ...]) -> np.ndarray:
    """-> (P, J, 3) metres: one standard deviation of each component of people's bone offsets, in the parents' axes.

    joints  J names; a component leaves those alone that it does not name

    Raises SceneError with the file and the component that does not say what it must.
    """
    said = read_yaml(path).get("components")
    if not isinstance(said, list):
        raise SceneError(f"{path}: components must be a list.")
    components = np.zeros((len(said), len(joint_names), 3))
    for p, component in enumerate(said):
        try:
            for name, offset in component.items():
                components[p, joint_names.index(name)] = [float(length) for length in offset]
        except (AttributeError, TypeError, ValueError) as error:
            raise SceneError(f"{path}: components.{p} must give joints of the skeleton three lengths each ({error}).") from error
    return components


# MERGED: mocapfix.skeleton
# The 31-joint CMU skeleton: names, tree and the lengths of an average body.
#
# Rest pose and joint axes are those of CMU's own motion (a T-pose facing +Z, Y up, every joint's axes along the
# world's), so that CMU motion and mocapfix motion compare. Lengths are anatomical: the thorax and the wrists, which
# CMU's BVH release drops, are there.
CMU31_FILE = "skeletons/cmu31.yaml"


@dataclass(frozen=True)
class Skeleton:
    """A tree of joints, parents before children.

    names    J joint names; the first is the root
    parents  (J,) index of each joint's parent, -1 for the root
    offsets  (J, 3) metres: the joint in its parent's axes
    ends     (J, 3) metres: the end site of a leaf joint in the joint's axes, NaN for the others
    """

    names: tuple[str, ...]
    parents: np.ndarray
    offsets: np.ndarray
    ends: np.ndarray

    @property
    def total_length_m(self) -> float:
        """Metres, of all offsets together: by its ratio to another skeleton's a person is so many times as large."""
        return float(np.linalg.norm(self.offsets))

    @property
    def rest_positions(self) -> np.ndarray:
        """(J, 3) metres: the joints in the rest pose, the root at its offset."""
        places = self.offsets.copy()
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                places[joint] += places[parent]
        return places

    def find_joint(self, name: str) -> int:
        return self.names.index(name)


@dataclass(frozen=True)
class BodyModel:
    """The skeleton with what calibration and solving know of any body.

    groups  G named groups of joints whose offsets have one scale in common (left and right together)
    shapes  (P, J, 3) metres: how people's offsets differ at one size, one standard deviation of each of P components
    free    (J,) bool: joints that markers can turn; the hip stubs are redundant with the thighs, and toes, fingers and
            thumbs carry no markers, so they stay as they rest
    """

    skeleton: Skeleton
    bone_groups: dict[str, tuple[int, ...]]
    shape_components: np.ndarray
    free_joints: np.ndarray


@cache
def load_cmu31_body() -> BodyModel:
    """-> the average body over the CMU subjects, left and right alike, from scenes/skeletons/cmu31.yaml."""
    data, skeleton = read_shipped_yaml(CMU31_FILE), load_cmu31_skeleton()
    groups = {name: tuple(skeleton.find_joint(j) for j in joints) for name, joints in data["groups"].items()}
    free = np.array([name not in data["fixed"] for name in skeleton.names])
    return BodyModel(skeleton, groups, load_shape_components(find_shipped_folder("priors") / "shape.yaml", skeleton.names), free)


def load_cmu31_skeleton() -> Skeleton:
    """-> the skeleton of `cmu31` alone, which its shapes are fitted about."""
    joints = read_shipped_yaml(CMU31_FILE)["joints"]
    names = tuple(joint["name"] for joint in joints)
    parents = np.array([names.index(j["parent"]) if j["parent"] else -1 for j in joints])
    offsets = np.array([joint["offset"] for joint in joints], float)
    ends = np.array([joint.get("end", [np.nan] * 3) for joint in joints], float)
    return Skeleton(names, parents, offsets, ends)
