"""Skeletons: a tree of joints with its lengths, and the 31-joint CMU skeleton that the solver uses.

The rest pose and the joint axes of the CMU skeleton are those of CMU's own motion (a T-pose facing +Z, Y up, every joint's axes
parallel to the world's), so that CMU motion and mocapfix motion can be compared. Lengths are anatomical and include the thorax
and the wrists, which the BVH release of the CMU data omits.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.errors import SceneError
from mocapfix.files.shipped import find_shipped_folder, read_shipped_yaml, read_yaml

CMU31_FILE = "skeletons/cmu31.yaml"


@dataclass(frozen=True)
class Skeleton:
    """A tree of joints, parents before children.

    names    J joint names; the first is the root
    parents  (J,) index of each joint's parent, -1 for the root
    offsets  (J, 3) m: the joint in its parent's axes
    ends     (J, 3) m: the end site of a leaf joint in the joint's axes, NaN for the others
    """

    names: tuple[str, ...]
    parents: Int[np.ndarray, " J"]
    offsets: Float[np.ndarray, "J 3"]
    ends: Float[np.ndarray, "J 3"]

    @property
    def total_length_m(self) -> float:
        """The norm of all offsets together; the ratio of two of them is the ratio of two people's sizes."""
        return float(np.linalg.norm(self.offsets))

    @property
    def rest_positions(self) -> Float[np.ndarray, "J 3"]:
        """The joints in the rest pose, in metres, with the root at its offset."""
        positions = self.offsets.copy()
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                positions[joint] += positions[parent]
        return positions

    def find_joint(self, name: str) -> int:
        """Return the index of a joint. Raises ValueError for an unknown name."""
        return self.names.index(name)


@dataclass(frozen=True)
class BodyModel:
    """An average skeleton with what calibration and the solver assume of every body.

    bone_groups       G named groups of joints whose offsets share one scale (left and right together)
    shape_components  (P, J, 3) m: the variation of people's offsets at one size, one standard deviation per component
    free_joints       (J,) joints that markers can turn. The hip stubs are redundant with the thighs, and toes, fingers and
                      thumbs carry no markers, so they keep their rest pose.
    """

    skeleton: Skeleton
    bone_groups: dict[str, tuple[int, ...]]
    shape_components: Float[np.ndarray, "P J 3"]
    free_joints: Bool[np.ndarray, " J"]


@cache
def load_cmu31_body() -> BodyModel:
    """Return the average body of the CMU subjects, symmetric, from scenes/skeletons/cmu31.yaml."""
    data, skeleton = read_shipped_yaml(CMU31_FILE), load_cmu31_skeleton()
    bone_groups = {name: tuple(skeleton.find_joint(joint) for joint in joints) for name, joints in data["groups"].items()}
    free_joints = np.array([name not in data["fixed"] for name in skeleton.names])
    shape_components = load_shape_components(find_shipped_folder("priors") / "shape.yaml", skeleton.names)
    return BodyModel(skeleton, bone_groups, shape_components, free_joints)


def load_cmu31_skeleton() -> Skeleton:
    """Return the skeleton of `load_cmu31_body`, about which the shape components are fitted."""
    joints = read_shipped_yaml(CMU31_FILE)["joints"]
    names = tuple(joint["name"] for joint in joints)
    parents = np.array([names.index(joint["parent"]) if joint["parent"] else -1 for joint in joints])
    offsets = np.array([joint["offset"] for joint in joints], float)
    ends = np.array([joint.get("end", [np.nan] * 3) for joint in joints], float)
    return Skeleton(names, parents, offsets, ends)


def load_shape_components(path: Path, joint_names: tuple[str, ...]) -> Float[np.ndarray, "P J 3"]:
    """Return the shape parameters of a body (SCOPE, Eqs. 1 and 60-64): one standard deviation of each component, in metres.

    Joints that a component does not name have zero offset in it. Raises SceneError with the file and the invalid component.
    """
    entries = read_yaml(path).get("components")
    if not isinstance(entries, list):
        raise SceneError(f"{path}: components must be a list.")
    components = np.zeros((len(entries), len(joint_names), 3))
    for p, entry in enumerate(entries):
        try:
            for name, offset in entry.items():
                components[p, joint_names.index(name)] = [float(length) for length in offset]
        except (AttributeError, TypeError, ValueError) as error:
            raise SceneError(f"{path}: components.{p} must give joints of the skeleton three lengths each ({error}).") from error
    return components
