"""A rig: the skeleton as another program wants it. Its names, its tree, its rest pose, its unit."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, PositiveFloat
from scipy.spatial.transform import Rotation

from mocapfix.errors import SceneError, WriteError
from mocapfix.files.shipped import find_shipped_folder, read_shipped_yaml
from mocapfix.files.yaml_models import StrictModel, read_yaml_model
from mocapfix.motion import Motion
from mocapfix.options import RIG_NAMES
from mocapfix.skeleton import Skeleton
from mocapfix.solve import kinematics
from mocapfix.stats.rigid_alignment import compute_shortest_rotation


# MERGED: mocapfix.rig
class RigJoint(StrictModel):
    """One joint of a rig.

    name    as the program knows it;  parent  the rig's joint it hangs on, null for the root, which comes first
    joint   the skeleton's joint that is there; by default the one of the same name
    axes    the skeleton's joint with which it turns; by default `joint`
    end     of a last bone: the skeleton's joint whose end (its place, where it has none) is the bone's; by default `axes`
    """

    name: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")
    parent: str | None
    joint: str = ""
    axes: str = ""
    end: str = ""

    def model_post_init(self, _: object) -> None:
        for key, given in (("joint", self.joint or self.name), ("axes", self.axes or self.joint or self.name)):
            object.__setattr__(self, key, given)
        object.__setattr__(self, "end", self.end or self.axes)


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
    """How a program wants a skeleton.

    name         the file's, as in --bvh-for;  program  who wants it so
    unit         metres in one unit of the file
    rotations    the order of a joint's channels, first the one that turns last: "ZYX" is R = Rz Ry Rx
    rest         the pose that no rotation at all means: "t-pose", "arms-down" or the "skeleton"'s own
    t_pose       does a T-pose facing +Z, standing on the floor where the motion begins, come before the motion?
    note         what whoever opens it must know, for the report
    joints       parents before children
    """

    name: str
    program: str
    unit_m: float
    rotation_order: str
    rest_pose: str
    starts_with_t_pose: bool
    note: str
    joints: tuple[RigJoint, ...]

    @property
    def parents(self) -> list[int]:
        names = [joint.name for joint in self.joints]
        return [names.index(joint.parent) if joint.parent else -1 for joint in self.joints]


def load_rig(name: str | Path) -> Rig:
    """-> a shipped rig, by its name, or one from a YAML file.

    Raises SceneError where there is none of the name, or naming the key that is not as it must be.
    """
    path = Path(name) if str(name).endswith((".yaml", ".yml")) else find_shipped_folder("scenes") / "rigs" / f"{name}.yaml"
    if path.parent == find_shipped_folder("scenes") / "rigs" and path.stem not in RIG_NAMES:
        raise SceneError(f"There is no rig {str(name)!r}; choose of: {', '.join(RIG_NAMES)}; or give a .yaml file.")
    form = read_yaml_model(_RigFile, path)
    seen: set[str | None] = set()
    for joint in form.joints:
        if joint.name in seen or (joint.parent not in seen if seen else joint.parent is not None):
            raise SceneError(f"{path}: joints: {joint.name}: must come once, after its parent; the first alone is the root.")
        seen.add(joint.name)
    t_pose = form.first_frame == "t-pose"
    return Rig(path.stem, form.program, form.unit_m, form.rotations, form.rest, t_pose, form.note, form.joints)


def load_bone_directions(name: str) -> dict[str, tuple[str, list[float]]]:
    """-> by joint of the skeleton, the joint at its bone's other end and which way the bone points in a pose."""
    return {joint: (end, way) for joint, (end, way) in read_shipped_yaml("rigs/poses.yaml")[name].items()}


# MERGED: mocapfix.write.rigged
# A motion carried over to a rig: fewer joints, other names, another rest pose, every joint where the solve has it.
#
# Leaving a joint out composes its rotation into its children's, so that they turn in the world as they did. Their places in
# the parent that is left are only constant where the joint never turned (or nothing hung on it): else it cannot be left out.
# With C the turn of a joint's axes from the skeleton's rest pose to the rig's (a T-pose, say), a joint that is turned R in the
# world is turned R C^T in the rig.
MAX_JOINT_ERROR_M = 1e-4  # metres that a joint may be away from where the solve has it


def retarget_to_rig(rig: Rig, skeleton: Skeleton, motion: Motion) -> tuple[Skeleton, Motion]:
    """-> the rig with this skeleton's lengths, and the motion on it, a T-pose before it where the rig wants one.

    Raises WriteError where the skeleton lacks a joint, or one that the rig leaves out turns.
    """
    parents = np.array(rig.parents)
    places, axes, ends = (_find_joints(rig, skeleton, [getattr(j, key) for j in rig.joints]) for key in ("joint", "axes", "end"))
    rest, t_pose = (_compute_pose_rotations(skeleton, load_bone_directions(name)) for name in (rig.rest_pose, "t-pose"))
    resting, _ = _compute_pose_positions(skeleton, rest)
    offsets = resting[places] - resting[places[parents]] * (parents >= 0)[:, None]
    leaf = ~np.isin(np.arange(len(parents)), parents)
    tips = resting + (rest @ np.nan_to_num(skeleton.ends)[..., None])[..., 0]
    told = Skeleton(
        tuple(j.name for j in rig.joints), parents, offsets, np.where(leaf[:, None], tips[ends] - resting[places], np.nan)
    )
    position, world = kinematics.compute_world_poses(skeleton, motion)
    moved = _replace_poses(
        motion, position[:, places[0]], _compute_local_rotations(world[:, axes] @ rest[axes].swapaxes(-1, -2), parents)
    )
    off = np.linalg.norm(kinematics.compute_world_poses(told, moved)[0] - position[:, places], axis=-1).max(0)
    if off.max() > MAX_JOINT_ERROR_M:
        name = told.names[int(off.argmax())]
        raise WriteError(
            f"A BVH for {rig.program} cannot be written: {name} would be {off.max() * 1e3:.1f} mm off, for a joint above it that "
            "this rig leaves out turns; choose another rig, or the plain BVH."
        )
    if rig.starts_with_t_pose:
        local = _compute_local_rotations((t_pose @ rest.swapaxes(-1, -2))[axes][None], parents)
        moved = _prepend_pose(told, moved, _round_to_degrees(local, rig.rotation_order))
    return told, moved


def _find_joints(rig: Rig, skeleton: Skeleton, names: list[str]) -> np.ndarray:
    if lacking := [name for name in names if name not in skeleton.names]:
        raise WriteError(f"A BVH for {rig.program} cannot be written: the skeleton has no joint {lacking[0]}.")
    return np.array([skeleton.find_joint(name) for name in names])


def _compute_pose_rotations(skeleton: Skeleton, bone_directions: dict[str, tuple[str, list[float]]]) -> np.ndarray:
    """-> (J, 3, 3) each joint's axes in the world, in a pose in which bones point those ways."""
    turns = np.tile(np.eye(3), (len(skeleton.names), 1, 1))
    for j, (name, parent) in enumerate(zip(skeleton.names, skeleton.parents, strict=True)):
        if parent >= 0:
            turns[j] = turns[parent]
        end, way = bone_directions.get(name, ("", []))
        if end in skeleton.names:
            points = turns[j] @ skeleton.offsets[skeleton.find_joint(end)]
            turns[j] = compute_shortest_rotation(points, np.array(way, float)) @ turns[j]
    return turns


def _compute_pose_positions(skeleton: Skeleton, rotations: np.ndarray) -> tuple[np.ndarray, float]:
    """-> (J, 3) metres: the joints where their axes are turned so in the world, the root at the origin; the lowest's height."""
    places = np.zeros((len(rotations), 3))
    for j, parent in enumerate(skeleton.parents):
        if parent >= 0:
            places[j] = places[parent] + rotations[parent] @ skeleton.offsets[j]
    tips = places + (rotations @ np.nan_to_num(skeleton.ends)[..., None])[..., 0]
    return places, float(min(places[:, 1].min(), tips[:, 1].min()))


def _compute_local_rotations(world_rotations: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """-> (T, J, 3, 3) each joint's axes in its parent's, of their axes in the world."""
    carrying = np.where((parents >= 0)[:, None, None], world_rotations[:, parents], np.eye(3))
    return np.ascontiguousarray(carrying.swapaxes(-1, -2) @ world_rotations)


def _round_to_degrees(rotations: np.ndarray, order: str) -> np.ndarray:
    """-> the rotations (1, J, 3, 3) with angles of whole degrees: by them CMU's readers tell the T-pose from the motion."""
    angles = Rotation.from_matrix(rotations[0]).as_euler(order, degrees=True)
    return Rotation.from_euler(order, np.round(angles), degrees=True).as_matrix()[None]


def _replace_poses(motion: Motion, root: np.ndarray, rotations: np.ndarray) -> Motion:
    return replace(motion, root_position=np.ascontiguousarray(root), local_rotations=rotations)


def _prepend_pose(skeleton: Skeleton, motion: Motion, local: np.ndarray) -> Motion:
    """-> the motion after one frame of a pose (1, J, 3, 3), standing on the floor where it begins."""
    first = motion.select_frames(np.zeros(1, int))
    turns = kinematics.compute_tree_poses(kinematics.build_kinematic_tree(skeleton), np.zeros((1, 3)), local)[1][0]
    place = np.array([[first.root_position[0, 0], -_compute_pose_positions(skeleton, turns)[1], first.root_position[0, 2]]])
    before = _replace_poses(first, place, local)
    return Motion(*(np.concatenate([getattr(before, key), field]) for key, field in vars(motion).items()))
