"""The 31-joint CMU skeleton: names, tree and the lengths of an average body.

Rest pose and joint axes are those of CMU's own motion (a T-pose facing +Z, Y up, every joint's axes along the
world's), so that CMU motion and mocapfix motion compare. Lengths are anatomical: the thorax and the wrists, which
CMU's BVH release drops, are there.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from mocapfix import shape
from mocapfix.scenes import folder, load_yaml

CMU31 = "skeletons/cmu31.yaml"


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
    def size(self) -> float:
        """Metres, of all offsets together: by its ratio to another skeleton's a person is so many times as large."""
        return float(np.linalg.norm(self.offsets))

    @property
    def resting(self) -> np.ndarray:
        """(J, 3) metres: the joints in the rest pose, the root at its offset."""
        places = self.offsets.copy()
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                places[joint] += places[parent]
        return places

    def index(self, name: str) -> int:
        return self.names.index(name)


@dataclass(frozen=True)
class Body:
    """The skeleton with what calibration and solving know of any body.

    groups  G named groups of joints whose offsets have one scale in common (left and right together)
    shapes  (P, J, 3) metres: how people's offsets differ at one size, one standard deviation of each of P components
    free    (J,) bool: joints that markers can turn; the hip stubs are redundant with the thighs, and toes, fingers and
            thumbs carry no markers, so they stay as they rest
    """

    skeleton: Skeleton
    groups: dict[str, tuple[int, ...]]
    shapes: np.ndarray
    free: np.ndarray


@cache
def cmu31() -> Body:
    """-> the average body over the CMU subjects, left and right alike, from scenes/skeletons/cmu31.yaml."""
    data, skeleton = load_yaml(CMU31), average()
    groups = {name: tuple(skeleton.index(j) for j in joints) for name, joints in data["groups"].items()}
    free = np.array([name not in data["fixed"] for name in skeleton.names])
    return Body(skeleton, groups, shape.load(folder("priors") / "shape.yaml", skeleton.names), free)


def average() -> Skeleton:
    """-> the skeleton of `cmu31` alone, which its shapes are fitted about."""
    joints = load_yaml(CMU31)["joints"]
    names = tuple(joint["name"] for joint in joints)
    parents = np.array([names.index(j["parent"]) if j["parent"] else -1 for j in joints])
    offsets = np.array([joint["offset"] for joint in joints], float)
    ends = np.array([joint.get("end", [np.nan] * 3) for joint in joints], float)
    return Skeleton(names, parents, offsets, ends)
