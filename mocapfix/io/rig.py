"""Rigs: the skeleton as another program expects it, with its joint names, tree, rest pose and unit, and the motion on it.

A rig may omit joints of the skeleton. The rotation of an omitted joint is composed into those of its children, so that their
rotations in the world do not change. A child's position in its remaining parent is constant only if the omitted joint never
rotates or has no offset to the child; otherwise the joint cannot be omitted. Let C be the rotation of a joint's axes from the
skeleton's rest pose to that of the rig, such as a T-pose. A world rotation R of the skeleton's joint is R C^T on the rig.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from pydantic import Field, PositiveFloat

from mocapfix.errors import SceneError, WriteError
from mocapfix.io.shipped import find_shipped_folder, read_shipped_yaml
from mocapfix.io.yaml_files import StrictModel, read_yaml_model
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton, compute_local_rotations
from mocapfix.options import RIG_NAMES
from mocapfix.solve import kinematics
from mocapfix.stats.rigid_alignment import compute_shortest_rotation

MAX_JOINT_ERROR_M = 1e-4  # distance of a rig's joint from that of the skeleton


class RigJoint(StrictModel):
    """One joint of a rig."""

    name: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")  # as the program expects it
    parent: str | None  # name of the rig's joint above it; None for the root, which comes first
    joint: str = ""  # the skeleton's joint at the same position; by default the one of the same name
    axes: str = ""  # the skeleton's joint with the same rotation; by default `joint`
    # for the last bone of a chain, the skeleton's joint whose end site (or position, if it has none) ends the bone; by default
    # `axes`
    end: str = ""

    def model_post_init(self, _: object) -> None:
        """Fill in the defaults."""
        joint = self.joint or self.name
        axes = self.axes or joint
        for key, value in (("joint", joint), ("axes", axes), ("end", self.end or axes)):
            object.__setattr__(self, key, value)


class _RigFile(StrictModel):
    program: str
    unit_m: PositiveFloat
    rotations: Literal["ZYX", "ZXY", "YXZ", "YZX", "XYZ", "XZY"]
    rest: Literal["t-pose", "arms-down", "skeleton"]
    first_frame: Literal["t-pose", "motion"]
    note: str
    joints: tuple[RigJoint, ...] = Field(min_length=1)


@dataclass(frozen=True)
class Rig:
    """The skeleton that a program expects."""

    name: str  # name of the file, as in --bvh-for
    program: str  # name of the program
    unit_m: float  # length of a unit of the written file in metres
    rotation_order: str  # order of a joint's rotation channels, the outermost first: "ZYX" is R = Rz Ry Rx
    rest_pose: str  # pose in which all rotations are zero: "t-pose", "arms-down", or "skeleton" for the skeleton's own rest pose
    starts_with_t_pose: bool  # a T-pose that faces +Z and stands on the floor precedes the motion
    note: str  # what users of the file need to know, for the report
    joints: tuple[RigJoint, ...]  # parents before children

    @property
    def parents(self) -> list[int]:
        """Index of each joint's parent, -1 for the root."""
        names = [joint.name for joint in self.joints]
        return [names.index(joint.parent) if joint.parent else -1 for joint in self.joints]


def load_rig(name: str | Path) -> Rig:
    """Load a shipped rig by name, or one from a YAML file.

    Raises:
        SceneError: If there is no rig of the name, or if the file is not valid, with the key that is wrong.
    """
    shipped_folder = find_shipped_folder("scenes") / "rigs"
    path = Path(name) if str(name).endswith((".yaml", ".yml")) else shipped_folder / f"{name}.yaml"
    if path.parent == shipped_folder and path.stem not in RIG_NAMES:
        raise SceneError(f"There is no rig {str(name)!r}; choose one of {', '.join(RIG_NAMES)}, or give a .yaml file.")
    model = read_yaml_model(_RigFile, path)
    known: set[str | None] = set()
    for joint in model.joints:
        is_ordered = joint.parent in known if known else joint.parent is None
        if joint.name in known or not is_ordered:
            raise SceneError(
                f"{path}: joints: {joint.name}: must be listed once, after its parent; only the first joint is a root."
            )
        known.add(joint.name)
    return Rig(
        name=path.stem,
        program=model.program,
        unit_m=model.unit_m,
        rotation_order=model.rotations,
        rest_pose=model.rest,
        starts_with_t_pose=model.first_frame == "t-pose",
        note=model.note,
        joints=model.joints,
    )


@dataclass(frozen=True)
class BoneDirection:
    """The joint at the end of a bone, and the direction (3,) of the bone in a pose."""

    end: str
    direction: Float[np.ndarray, " 3"]


def load_bone_directions(pose_name: str) -> dict[str, BoneDirection]:
    """Load a shipped pose, such as "t-pose": the directions of bones by the skeleton's joint at which they start."""
    bones = read_shipped_yaml("rigs/poses.yaml")[pose_name]
    return {joint: BoneDirection(end, np.array(direction, float)) for joint, (end, direction) in bones.items()}


def retarget_to_rig(rig: Rig, skeleton: Skeleton, motion: Motion) -> tuple[Skeleton, Motion]:
    """Return the rig's skeleton with the bone lengths of a skeleton, and the motion on it, after a T-pose if the rig wants one.

    Raises:
        WriteError: If the skeleton lacks a joint, or if a joint rotates that the rig omits.
    """
    parents = np.array(rig.parents)
    joints = _find_joints(rig, skeleton, [joint.joint for joint in rig.joints])
    axes = _find_joints(rig, skeleton, [joint.axes for joint in rig.joints])
    ends = _find_joints(rig, skeleton, [joint.end for joint in rig.joints])
    rest_rotations = _compute_pose_rotations(skeleton, load_bone_directions(rig.rest_pose))
    rig_skeleton = _build_rig_skeleton(rig, skeleton, rest_rotations, joints, ends)
    positions, rotations = kinematics.compute_world_poses(skeleton, motion)
    local_rotations = compute_local_rotations(rotations[:, axes] @ rest_rotations[axes].swapaxes(-1, -2), parents)
    rig_motion = _replace_poses(motion, positions[:, joints[0]], local_rotations)
    rig_positions, _ = kinematics.compute_world_poses(rig_skeleton, rig_motion)
    error_m = np.linalg.norm(rig_positions - positions[:, joints], axis=-1).max(0)
    if error_m.max() > MAX_JOINT_ERROR_M:
        name = rig_skeleton.names[int(error_m.argmax())]
        raise WriteError(
            f"A BVH for {rig.program} cannot be written: {name} would be off by {error_m.max() * 1e3:.1f} mm, because a joint "
            "above it rotates that this rig omits; choose another rig, or the plain BVH."
        )
    if rig.starts_with_t_pose:
        t_pose = _compute_pose_rotations(skeleton, load_bone_directions("t-pose"))
        local_pose = compute_local_rotations((t_pose @ rest_rotations.swapaxes(-1, -2))[axes][None], parents)
        rig_motion = _prepend_pose(rig_skeleton, rig_motion, _round_to_degrees(local_pose, rig.rotation_order))
    return rig_skeleton, rig_motion


def _find_joints(rig: Rig, skeleton: Skeleton, names: list[str]) -> Int[np.ndarray, " R"]:
    if missing := [name for name in names if name not in skeleton.names]:
        raise WriteError(f"A BVH for {rig.program} cannot be written: the skeleton has no joint {missing[0]}.")
    return np.array([skeleton.find_joint(name) for name in names])


def _build_rig_skeleton(
    rig: Rig,
    skeleton: Skeleton,
    rest_rotations: Float[np.ndarray, "J 3 3"],
    joints: Int[np.ndarray, " R"],
    ends: Int[np.ndarray, " R"],
) -> Skeleton:
    """Return the rig's skeleton: the positions of the R joints in its rest pose, and end sites for its leaves."""
    parents = np.array(rig.parents)
    rest_positions, rest_tips = _compute_pose_positions(skeleton, rest_rotations)
    offsets = rest_positions[joints] - rest_positions[joints[parents]] * (parents >= 0)[:, None]
    is_leaf = ~np.isin(np.arange(len(parents)), parents)
    end_sites = np.where(is_leaf[:, None], rest_tips[ends] - rest_positions[joints], np.nan)
    return Skeleton(tuple(joint.name for joint in rig.joints), parents, offsets, end_sites)


def _compute_pose_rotations(skeleton: Skeleton, bone_directions: Mapping[str, BoneDirection]) -> Float[np.ndarray, "J 3 3"]:
    """Compute the world rotations of the joints in a pose with the given directions of bones."""
    rotations = np.tile(np.eye(3), (len(skeleton.names), 1, 1))
    for joint, (name, parent) in enumerate(zip(skeleton.names, skeleton.parents, strict=True)):
        if parent >= 0:
            rotations[joint] = rotations[parent]
        bone = bone_directions.get(name)
        if bone and bone.end in skeleton.names:
            current = rotations[joint] @ skeleton.offsets[skeleton.find_joint(bone.end)]
            rotations[joint] = compute_shortest_rotation(current, bone.direction) @ rotations[joint]
    return rotations


def _compute_pose_positions(
    skeleton: Skeleton, rotations: Float[np.ndarray, "J 3 3"]
) -> tuple[Float[np.ndarray, "J 3"], Float[np.ndarray, "J 3"]]:
    """Compute the positions of joints and of their end sites in metres for world rotations, with the root at the origin."""
    positions = np.zeros((len(rotations), 3))
    for joint, parent in enumerate(skeleton.parents):
        if parent >= 0:
            positions[joint] = positions[parent] + rotations[parent] @ skeleton.offsets[joint]
    return positions, positions + (rotations @ np.nan_to_num(skeleton.ends)[..., None])[..., 0]


def _round_to_degrees(rotations: Float[np.ndarray, "1 J 3 3"], order: str) -> Float[np.ndarray, "1 J 3 3"]:
    """Round the angles of a pose to whole degrees, by which readers of CMU's files distinguish the T-pose from the motion."""
    from scipy.spatial.transform import Rotation  # slow to import

    angles = Rotation.from_matrix(rotations[0]).as_euler(order, degrees=True)
    return Rotation.from_euler(order, np.round(angles), degrees=True).as_matrix()[None]


def _replace_poses(
    motion: Motion, root_position: Float[np.ndarray, "T 3"], local_rotations: Float[np.ndarray, "T J 3 3"]
) -> Motion:
    return replace(motion, root_position=np.ascontiguousarray(root_position), local_rotations=local_rotations)


def _prepend_pose(skeleton: Skeleton, motion: Motion, local_rotations: Float[np.ndarray, "1 J 3 3"]) -> Motion:
    """Return the motion after one frame of a pose that stands on the floor below the motion's first position."""
    first = motion.select_frames(np.zeros(1, int))
    tree = kinematics.build_kinematic_tree(skeleton)
    rotations = kinematics.compute_tree_poses(tree, np.zeros((1, 3)), local_rotations)[1][0]
    positions, tips = _compute_pose_positions(skeleton, rotations)
    lowest = min(positions[:, 1].min(), tips[:, 1].min())
    root_position = np.array([[first.root_position[0, 0], -lowest, first.root_position[0, 2]]])
    pose = _replace_poses(first, root_position, local_rotations)
    return Motion(*(np.concatenate([getattr(pose, name), values]) for name, values in vars(motion).items()))
