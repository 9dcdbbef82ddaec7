"""Skeletons: a tree of joints with its lengths, and the 31-joint CMU skeleton that the solver uses.

The rest pose and the joint axes of the CMU skeleton are those of CMU's own motion (a T-pose facing +Z, Y up, every joint's axes
parallel to the world's), so that CMU motion and mocapfix motion can be compared. Lengths are anatomical and include the thorax
and the wrists, which the BVH release of the CMU data omits.
"""

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.errors import SceneError
from mocapfix.io.shipped import find_shipped_folder, read_shipped_yaml, read_yaml

CMU31_FILE = "skeletons/cmu31.yaml"
BODY_SECTIONS: dict[str, tuple[str, ...]] = {
    "pelvis": ("Hips", "LHipJoint", "RHipJoint"),
    "trunk": ("LowerBack", "Spine", "Spine1", "LeftShoulder", "RightShoulder"),
    "head": ("Neck", "Neck1", "Head"),
    "left arm": ("LeftArm", "LeftForeArm", "LeftHand", "LeftFingerBase", "LeftHandIndex1", "LThumb"),
    "right arm": ("RightArm", "RightForeArm", "RightHand", "RightFingerBase", "RightHandIndex1", "RThumb"),
    "left leg": ("LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase"),
    "right leg": ("RightUpLeg", "RightLeg", "RightFoot", "RightToeBase"),
}
"""the joints of each section of the body"""
MIN_WHOLE_BODY_LIMBS = 3  # the number of limbs with markers, besides pelvis and trunk, of a whole body


@dataclass(frozen=True)
class Skeleton:
    """A tree of joints, parents before children."""

    names: tuple[str, ...]  # J joint names; the first is the root
    parents: Int[np.ndarray, " J"]  # index of each joint's parent, -1 for the root
    offsets: Float[np.ndarray, "J 3"]  # m: the joint in its parent's axes
    ends: Float[np.ndarray, "J 3"]  # m: the end site of a leaf joint in the joint's axes, NaN for the others

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

    Of a part of a body (see `restrict_body`), only the joints within the part are free. The others keep the mean pose.

    Attributes:
        bone_groups: G named groups of joints whose offsets share one scale (left and right together).
        shape_components: Metres: the variation of people's offsets at one size, one standard deviation per component.
        free_joints: Joints that markers can turn. The hip stubs are redundant with the thighs, and toes, fingers and thumbs carry
            no markers, so they keep their rest pose.
        shown_segments: Joints whose own segment is determined by markers; all joints for a whole body.
    """

    skeleton: Skeleton
    bone_groups: dict[str, tuple[int, ...]]
    shape_components: Float[np.ndarray, "P J 3"]
    free_joints: Bool[np.ndarray, " J"]
    shown_segments: Bool[np.ndarray, " J"] = field(default_factory=lambda: np.zeros(0, bool))

    def __post_init__(self) -> None:
        if not len(self.shown_segments):
            object.__setattr__(self, "shown_segments", np.ones(len(self.free_joints), bool))

    @property
    def solved_joints(self) -> Bool[np.ndarray, " J"]:
        """The joints (J,) whose positions markers determine: those on the segments that the markers show."""
        parents = self.skeleton.parents
        return self.shown_segments | (self.shown_segments[parents] & (parents >= 0))


@cache
def load_cmu31_body() -> BodyModel:
    """Return the average body of the CMU subjects, symmetric, from scenes/skeletons/cmu31.yaml."""
    data, skeleton = read_shipped_yaml(CMU31_FILE), load_cmu31_skeleton()
    bone_groups = {name: tuple(skeleton.find_joint(joint) for joint in joints) for name, joints in data["groups"].items()}
    free_joints = np.array([name not in data["fixed"] for name in skeleton.names])
    shape_components = load_shape_components(find_shipped_folder("priors") / "shape.yaml", skeleton.names)
    return BodyModel(skeleton, bone_groups, shape_components, free_joints)


def restrict_body(body: BodyModel, marked_joints: Collection[int]) -> BodyModel:
    """Return the part of a body that markers on some joints show: the segments with markers and those between them.

    Markers show how a joint turns if some are on its segment or beyond, and others on the other side of it. The segment nearest
    to the root keeps the mean pose relative to the root, whose position and rotation then follow from that of this segment.

    In a whole body all joints stay free: the prior alone keeps the few that markers do not show, such as the hands.
    """
    parents, free_joints = body.skeleton.parents, body.free_joints
    carriers = find_carriers(parents, free_joints)
    marked = {int(carriers[joint]) for joint in marked_joints}
    if not marked:
        return body
    top = find_common_joint(parents, marked)
    shown = np.zeros(len(parents), bool)
    for joint in marked:
        while joint >= 0 and not shown[joint]:
            shown[joint] = True
            joint = int(parents[joint]) if joint != top else -1
    is_free = free_joints & shown
    is_free[top], is_free[0] = False, True
    if _is_whole_body({body.skeleton.names[joint] for joint in marked}):
        is_free = free_joints
    return replace(body, free_joints=is_free, shown_segments=shown[carriers])


def _is_whole_body(joint_names: Collection[str]) -> bool:
    """Return whether joints with markers are those of a whole body: on pelvis and trunk, and on all limbs but one."""
    sections = {section for section, joints in BODY_SECTIONS.items() if not set(joints).isdisjoint(joint_names)}
    return {"pelvis", "trunk"} <= sections and len(sections - {"pelvis", "trunk", "head"}) >= MIN_WHOLE_BODY_LIMBS


def find_carriers(parents: Int[np.ndarray, " J"], free_joints: Bool[np.ndarray, " J"]) -> Int[np.ndarray, " J"]:
    """Return for each joint the free joint with which it turns: itself, or the nearest one above a fixed joint."""
    carriers = np.arange(len(parents))
    for joint in range(1, len(parents)):
        if not free_joints[joint]:
            carriers[joint] = carriers[parents[joint]]
    return carriers


def find_common_joint(parents: Int[np.ndarray, " J"], joints: Collection[int]) -> int:
    """Return the lowest joint that is one of `joints`, or an ancestor, of each of them."""
    paths: list[list[int]] = []
    for joint in joints:
        path = [int(joint)]
        while parents[path[-1]] >= 0:
            path.append(int(parents[path[-1]]))
        paths.append(path)
    return next(joint for joint in paths[0] if all(joint in path for path in paths))


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
