"""Rigs: the skeleton as another program expects it, with its joint names, tree, rest pose and unit, and the motion on it.

A rig may omit joints of the skeleton. The rotation of an omitted joint is composed into those of its children, so that their
rotations in the world do not change. A child's position in its remaining parent is constant only if the omitted joint never
rotates or has no offset to the child; otherwise the joint cannot be omitted. Let C be the rotation of a joint's axes from the
skeleton's rest pose to that of the rig, such as a T-pose. A world rotation R of the skeleton's joint is R C^T on the rig.
"""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from pydantic import Field, PositiveFloat

from mocapfix.characters.alignment import SkeletonAlignment
from mocapfix.errors import SceneError, WriteError
from mocapfix.io.bvh import write_bvh
from mocapfix.io.shipped import find_shipped_folder, read_shipped_yaml
from mocapfix.io.yaml_files import StrictModel, read_yaml_model
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton, compute_local_rotations
from mocapfix.options import RIG_NAMES
from mocapfix.solve.kinematics import compute_world_poses
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


class Rig(StrictModel):
    """The skeleton that a program expects."""

    name: str = ""  # name of the file, as in --bvh-for
    program: str  # name of the program
    unit_m: PositiveFloat  # length of a unit of the written file in metres
    # order of a joint's rotation channels, the outermost first: "ZYX" is R = Rz Ry Rx
    rotations: Literal["ZYX", "ZXY", "YXZ", "YZX", "XYZ", "XZY"]
    rest: Literal["t-pose", "arms-down", "skeleton"]  # pose in which all rotations are zero; "skeleton" for its own rest pose
    first_frame: Literal["t-pose", "motion"]  # whether a T-pose that faces +Z and stands on the floor precedes the motion
    note: str  # what users of the file need to know, for the report
    joints: tuple[RigJoint, ...] = Field(min_length=1)  # parents before children

    @property
    def parents(self) -> list[int]:
        """Index of each joint's parent, -1 for the root."""
        names = [joint.name for joint in self.joints]
        return [names.index(joint.parent) if joint.parent else -1 for joint in self.joints]

    def find_joints(self, skeleton: Skeleton, names: list[str]) -> Int[np.ndarray, " R"]:
        """Return the indices of joints of the skeleton. Raises WriteError if it lacks one."""
        if missing := [name for name in names if name not in skeleton.names]:
            raise WriteError(f"A BVH for {self.program} cannot be written: the skeleton has no joint {missing[0]}.")
        return np.array([skeleton.find_joint(name) for name in names])


def load_rig(name: str | Path) -> Rig:
    """Load a shipped rig by name, or one from a YAML file.

    Raises:
        SceneError: If there is no rig of the name, or if the file is not valid, with the key that is wrong.
    """
    shipped_folder = find_shipped_folder("scenes") / "rigs"
    path = Path(name) if str(name).endswith((".yaml", ".yml")) else shipped_folder / f"{name}.yaml"
    if path.parent == shipped_folder and path.stem not in RIG_NAMES:
        raise SceneError(f"There is no rig {str(name)!r}; choose one of {', '.join(RIG_NAMES)}, or give a .yaml file.")
    rig = read_yaml_model(Rig, path)
    known: set[str | None] = set()
    for joint in rig.joints:
        is_ordered = joint.parent in known if known else joint.parent is None
        if joint.name in known or not is_ordered:
            raise SceneError(
                f"{path}: joints: {joint.name}: must be listed once, after its parent; only the first joint is a root."
            )
        known.add(joint.name)
    return rig.model_copy(update={"name": path.stem})


def retarget_to_rig(rig: Rig, skeleton: Skeleton, motion: Motion) -> tuple[Skeleton, Motion]:
    """Return the rig's skeleton with the bone lengths of a skeleton, and the motion on it, after a T-pose if the rig wants one.

    Raises:
        WriteError: If the skeleton lacks a joint, or if a joint rotates that the rig omits.
    """
    joints = rig.find_joints(skeleton, [joint.joint for joint in rig.joints])
    alignment = _align_rig(rig, skeleton, joints)
    positions, rotations = compute_world_poses(skeleton, motion)
    local_rotations = alignment.convert_rotations(rotations)
    rig_motion = replace(motion, root_position=np.ascontiguousarray(positions[:, joints[0]]), local_rotations=local_rotations)
    rig_positions, _ = compute_world_poses(alignment.skeleton, rig_motion)
    error_m = np.linalg.norm(rig_positions - positions[:, joints], axis=-1).max(0)
    if error_m.max() > MAX_JOINT_ERROR_M:
        name = rig.joints[int(error_m.argmax())].name
        raise WriteError(
            f"A BVH for {rig.program} cannot be written: {name} would be off by {error_m.max() * 1e3:.1f} mm, because a joint "
            "above it rotates that this rig omits; choose another rig, or the plain BVH."
        )
    if rig.first_frame == "t-pose":
        t_pose = _pose_skeleton(skeleton, "t-pose").compute_rest_pose()[1]
        rig_motion = _prepend_pose(alignment.skeleton, rig_motion, alignment.convert_rotations(t_pose[None])[0], rig.rotations)
    return alignment.skeleton, rig_motion


def _align_rig(rig: Rig, skeleton: Skeleton, joints: Int[np.ndarray, " R"]) -> SkeletonAlignment:
    """Return the rig's skeleton: the places of the skeleton's R joints in its rest pose, and end sites for its leaves."""
    axes = rig.find_joints(skeleton, [joint.axes for joint in rig.joints])
    ends = rig.find_joints(skeleton, [joint.end for joint in rig.joints])
    parents, names = np.array(rig.parents), tuple(joint.name for joint in rig.joints)
    posed = _pose_skeleton(skeleton, rig.rest)
    positions, rotations = posed.compute_rest_pose()
    tips = np.where(np.isnan(skeleton.ends), positions, posed.compute_rest_ends())
    offsets = positions[joints] - positions[joints[parents]]
    offsets[0] = 0.0
    rig_skeleton = Skeleton(names, parents, offsets, tips[ends] - positions[joints])
    rig_skeleton.ends[~rig_skeleton.is_leaf] = np.nan
    return SkeletonAlignment(rig_skeleton, axes, rotations[axes].swapaxes(-1, -2))


def _pose_skeleton(skeleton: Skeleton, pose_name: str) -> Skeleton:
    """Return a skeleton in another rest pose, in which its bones have the directions of a shipped pose, such as "t-pose"."""
    bones = read_shipped_yaml("rigs/poses.yaml")[pose_name]
    rotations = np.tile(np.eye(3), (len(skeleton.names), 1, 1))
    for joint, (name, parent) in enumerate(zip(skeleton.names, skeleton.parents, strict=True)):
        if parent >= 0:
            rotations[joint] = rotations[parent]
        end, direction = bones.get(name, (None, None))
        if end in skeleton.names:
            current = rotations[joint] @ skeleton.offsets[skeleton.find_joint(end)]
            rotations[joint] = compute_shortest_rotation(current, np.array(direction, float)) @ rotations[joint]
    return replace(skeleton, rest_rotations=compute_local_rotations(rotations, skeleton.parents))


def _prepend_pose(skeleton: Skeleton, motion: Motion, local_rotations: Float[np.ndarray, "J 3 3"], order: str) -> Motion:
    """Return the motion after one frame of a pose that stands on the floor below the motion's first position.

    Its angles are whole degrees, by which readers of CMU's files distinguish the pose from the motion.
    """
    from scipy.spatial.transform import Rotation  # slow to import

    angles = np.round(Rotation.from_matrix(local_rotations).as_euler(order, degrees=True))
    local_rotations = Rotation.from_euler(order, angles, degrees=True).as_matrix()
    posed = replace(skeleton, rest_rotations=local_rotations)
    lowest = min(posed.rest_positions[:, 1].min(), np.nanmin(posed.compute_rest_ends()[:, 1]))
    first = motion.select_frames(np.zeros(1, int))
    root_position = np.array([[first.root_position[0, 0], -lowest, first.root_position[0, 2]]])
    pose = replace(first, root_position=root_position, local_rotations=local_rotations[None])
    return Motion(*(np.concatenate([getattr(pose, name), values]) for name, values in vars(motion).items()))


def write_rig_bvh(target: Path, rig: Rig, skeleton: Skeleton, motion: Motion, rate: float) -> None:
    """Write a motion on the rig of another program. Raises WriteError as `write_bvh` and `retarget_to_rig` do."""
    write_bvh(target, *retarget_to_rig(rig, skeleton, motion), rate, rig.unit_m, rig.rotations)
