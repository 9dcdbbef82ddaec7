"""Skeletons: the one type for trees of joints, their poses, and the 31-joint CMU skeleton that the solver uses.

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
UNLIMITED_RAD = np.tile([-np.inf, np.inf], (3, 1))
MIN_WHOLE_BODY_LIMBS = 3  # the number of limbs with markers, besides pelvis and trunk, of a whole body


def is_below(joint: int, above: int, parents: Int[np.ndarray, " J"]) -> bool:
    """Return whether a joint is a descendant of another."""
    joint = int(parents[joint])
    while joint >= 0 and joint != above:
        joint = int(parents[joint])
    return joint >= 0


def list_path(joint: int, above: int, parents: Int[np.ndarray, " J"]) -> list[int]:
    """Return the joints from the child of `above` (-1: from a root) down to a joint."""
    path: list[int] = []
    while joint not in (above, -1):
        path.append(int(joint))
        joint = int(parents[joint])
    return path[::-1]


def find_ancestor(joint: int, parents: Int[np.ndarray, " J"], is_candidate: Bool[np.ndarray, " J"]) -> int:
    """Return the nearest candidate above a joint, -1 if there is none."""
    joint = int(parents[joint])
    while joint >= 0 and not is_candidate[joint]:
        joint = int(parents[joint])
    return joint


def find_common_joint(parents: Int[np.ndarray, " J"], joints: Collection[int]) -> int:
    """Return the lowest joint that is one of `joints`, or an ancestor, of each of them; -1 if they are below different roots."""
    paths = [list_path(int(joint), -1, parents) for joint in joints]
    return next((joint for joint in paths[0][::-1] if all(joint in path for path in paths)), -1)


def compose_transforms(
    parents: Int[np.ndarray, " J"], positions: Float[np.ndarray, "T J 3"], rotations: Float[np.ndarray, "T J 3 3"]
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T J 3 3"]]:
    """Compose local positions and rotations along a tree of joints, parents before children, into those in the world."""
    position_world, rotation_world = positions.copy(), rotations.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            offset_world = (rotation_world[:, parent] @ positions[:, joint, :, None])[..., 0]
            position_world[:, joint] = position_world[:, parent] + offset_world
            rotation_world[:, joint] = rotation_world[:, parent] @ rotations[:, joint]
    return position_world, rotation_world


def compute_local_rotations(
    world_rotations: Float[np.ndarray, "*batch J 3 3"], parents: Int[np.ndarray, " J"]
) -> Float[np.ndarray, "*batch J 3 3"]:
    """Return the rotations of joints relative to their parents; those without one keep their world rotations."""
    local, below = world_rotations.copy(), np.flatnonzero(parents >= 0)
    local[..., below, :, :] = world_rotations[..., parents[below], :, :].swapaxes(-1, -2) @ world_rotations[..., below, :, :]
    return local


def decompose_transforms(
    positions: Float[np.ndarray, "*batch J 3"], rotations: Float[np.ndarray, "*batch J 3 3"], parents: Int[np.ndarray, " J"]
) -> tuple[Float[np.ndarray, "*batch J 3"], Float[np.ndarray, "*batch J 3 3"]]:
    """Return the positions and rotations of joints relative to their parents, from those in the world; roots keep theirs."""
    local, below = positions.copy(), np.flatnonzero(parents >= 0)
    vectors, axes = positions[..., below, :] - positions[..., parents[below], :], rotations[..., parents[below], :, :]
    local[..., below, :] = np.einsum("...ba,...b->...a", axes, vectors)
    return local, compute_local_rotations(rotations, parents)


@dataclass(frozen=True)
class Skeleton:
    """A tree of J joints in its rest pose: that of a person, a rig, a character or a file.

    A local rotation maps a joint's axes to those of its parent, a root's to the world's. It includes the rest rotation.
    """

    names: tuple[str, ...]  # of the joints
    parents: Int[np.ndarray, " J"]  # index of each joint's parent, -1 for a root; parents come before children
    offsets: Float[np.ndarray, "J 3"]  # m: each joint in its parent's axes, a root in the world
    # m: the end of each joint's bone in the joint's axes; NaN where no end is known but that of its children
    ends: Float[np.ndarray, "J 3"]
    # local rotations in the rest pose; by default the axes are parallel to the world's
    rest_rotations: Float[np.ndarray, "J 3 3"] = field(default_factory=lambda: np.zeros((0, 3, 3)))
    # unit vectors in the joints' axes about which joints of one degree of freedom turn; NaN, the default, if about any axis
    hinge_axes: Float[np.ndarray, "J 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    # least and greatest components of each joint's rotation vector from the rest pose, in its parent's axes; of a hinge the
    # first is its angle. Infinite by default
    limits_rad: Float[np.ndarray, "J 3 2"] = field(default_factory=lambda: np.zeros((0, 3, 2)))

    def __post_init__(self) -> None:
        for name, default in (("rest_rotations", np.eye(3)), ("hinge_axes", np.full(3, np.nan)), ("limits_rad", UNLIMITED_RAD)):
            if not len(getattr(self, name)):
                object.__setattr__(self, name, np.tile(default, (len(self.names), *([1] * default.ndim))))

    @property
    def total_length_m(self) -> float:
        """The norm of all offsets together; the ratio of two of them is the ratio of two people's sizes."""
        return float(np.linalg.norm(self.offsets))

    @property
    def size_ratio(self) -> float:
        """The size of a person relative to the average body."""
        return self.total_length_m / load_cmu31_body().skeleton.total_length_m

    @property
    def rest_positions(self) -> Float[np.ndarray, "J 3"]:
        """The joints in the rest pose, in metres, with the roots at their offsets."""
        return self.compute_rest_pose()[0]

    @property
    def is_leaf(self) -> Bool[np.ndarray, " J"]:
        """The joints without children."""
        return ~np.isin(np.arange(len(self.parents)), self.parents)

    def compute_rest_pose(self) -> tuple[Float[np.ndarray, "J 3"], Float[np.ndarray, "J 3 3"]]:
        """Compute the positions in metres and the rotations of the joints in the world, in the rest pose."""
        position, rotation = compose_transforms(self.parents, self.offsets[None], self.rest_rotations[None])
        return position[0], rotation[0]

    def compute_rest_ends(self) -> Float[np.ndarray, "J 3"]:
        """Compute the ends of the bones in the world, in metres, in the rest pose; NaN where none is known."""
        positions, rotations = self.compute_rest_pose()
        return positions + (rotations @ self.ends[..., None])[..., 0]

    def find_joint(self, name: str) -> int:
        """Return the index of a joint. Raises ValueError for an unknown name."""
        return self.names.index(name)


@dataclass(frozen=True)
class BodyModel:
    """An average skeleton with what calibration and the solver assume of every body.

    Of a part of a body (see `restrict_body`), only the joints within the part are free. The others keep the mean pose.

    Attributes:
        shape_components: Metres: the variation of people's offsets at one size, one standard deviation per component.
        free_joints: Joints that markers can turn. The hip stubs are redundant with the thighs, and toes, fingers and thumbs carry
            no markers, so they keep their rest pose.
        shown_segments: Joints whose own segment is determined by markers; all joints for a whole body.
    """

    skeleton: Skeleton
    bone_groups: dict[str, tuple[int, ...]]  # g named groups of joints whose offsets share one scale (left and right together)
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


def make_names_unique(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names with a number behind each that was used before."""
    used: dict[str, None] = {}
    for index, name in enumerate(names):
        unique = name
        while unique in used:
            unique = f"{unique}#{index}"
        used[unique] = None
    return tuple(used)
