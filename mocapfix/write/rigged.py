"""A motion carried over to a rig: fewer joints, other names, another rest pose, every joint where the solve has it.

Leaving a joint out composes its rotation into its children's, so that they turn in the world as they did. Their places in
the parent that is left are only constant where the joint never turned (or nothing hung on it): else it cannot be left out.
With C the turn of a joint's axes from the skeleton's rest pose to the rig's (a T-pose, say), a joint that is turned R in the
world is turned R C^T in the rig.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.errors import WriteError
from mocapfix.kernels import kinematics
from mocapfix.kernels.aligned import shortest_turn
from mocapfix.motion import Motion
from mocapfix.rig import Rig, pose
from mocapfix.skeleton import Skeleton

OFF = 1e-4  # metres that a joint may be away from where the solve has it


def rigged(rig: Rig, skeleton: Skeleton, motion: Motion) -> tuple[Skeleton, Motion]:
    """-> the rig with this skeleton's lengths, and the motion on it, a T-pose before it where the rig wants one.

    Raises WriteError where the skeleton lacks a joint, or one that the rig leaves out turns.
    """
    parents = np.array(rig.parents)
    places, axes, ends = (_found(rig, skeleton, [getattr(j, key) for j in rig.joints]) for key in ("joint", "axes", "end"))
    rest, t_pose = (_turns(skeleton, pose(name)) for name in (rig.rest, "t-pose"))
    resting, _ = _standing(skeleton, rest)
    offsets = resting[places] - resting[places[parents]] * (parents >= 0)[:, None]
    leaf = ~np.isin(np.arange(len(parents)), parents)
    tips = resting + (rest @ np.nan_to_num(skeleton.ends)[..., None])[..., 0]
    told = Skeleton(
        tuple(j.name for j in rig.joints), parents, offsets, np.where(leaf[:, None], tips[ends] - resting[places], np.nan)
    )
    position, world = kinematics.world(skeleton, motion)
    moved = _on(motion, position[:, places[0]], _local(world[:, axes] @ rest[axes].swapaxes(-1, -2), parents))
    off = np.linalg.norm(kinematics.world(told, moved)[0] - position[:, places], axis=-1).max(0)
    if off.max() > OFF:
        name = told.names[int(off.argmax())]
        raise WriteError(
            f"A BVH for {rig.program} cannot be written: {name} would be {off.max() * 1e3:.1f} mm off, for a joint above it that "
            "this rig leaves out turns; choose another rig, or the plain BVH."
        )
    if rig.t_pose:
        local = _local((t_pose @ rest.swapaxes(-1, -2))[axes][None], parents)
        moved = _after(told, moved, _whole_degrees(local, rig.rotations))
    return told, moved


def _found(rig: Rig, skeleton: Skeleton, names: list[str]) -> np.ndarray:
    if lacking := [name for name in names if name not in skeleton.names]:
        raise WriteError(f"A BVH for {rig.program} cannot be written: the skeleton has no joint {lacking[0]}.")
    return np.array([skeleton.index(name) for name in names])


def _turns(skeleton: Skeleton, ways: dict[str, tuple[str, list[float]]]) -> np.ndarray:
    """-> (J, 3, 3) each joint's axes in the world, in a pose in which bones point those ways."""
    turns = np.tile(np.eye(3), (len(skeleton.names), 1, 1))
    for j, (name, parent) in enumerate(zip(skeleton.names, skeleton.parents, strict=True)):
        if parent >= 0:
            turns[j] = turns[parent]
        end, way = ways.get(name, ("", []))
        if end in skeleton.names:
            points = turns[j] @ skeleton.offsets[skeleton.index(end)]
            turns[j] = shortest_turn(points, np.array(way, float)) @ turns[j]
    return turns


def _standing(skeleton: Skeleton, turns: np.ndarray) -> tuple[np.ndarray, float]:
    """-> (J, 3) metres: the joints where their axes are turned so in the world, the root at the origin; the lowest's height."""
    places = np.zeros((len(turns), 3))
    for j, parent in enumerate(skeleton.parents):
        if parent >= 0:
            places[j] = places[parent] + turns[parent] @ skeleton.offsets[j]
    tips = places + (turns @ np.nan_to_num(skeleton.ends)[..., None])[..., 0]
    return places, float(min(places[:, 1].min(), tips[:, 1].min()))


def _local(world: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """-> (T, J, 3, 3) each joint's axes in its parent's, of their axes in the world."""
    carrying = np.where((parents >= 0)[:, None, None], world[:, parents], np.eye(3))
    return np.ascontiguousarray(carrying.swapaxes(-1, -2) @ world)


def _whole_degrees(rotations: np.ndarray, order: str) -> np.ndarray:
    """-> the rotations (1, J, 3, 3) with angles of whole degrees: by them CMU's readers tell the T-pose from the motion."""
    angles = Rotation.from_matrix(rotations[0]).as_euler(order, degrees=True)
    return Rotation.from_euler(order, np.round(angles), degrees=True).as_matrix()[None]


def _on(motion: Motion, root: np.ndarray, rotations: np.ndarray) -> Motion:
    return replace(motion, root=np.ascontiguousarray(root), rotations=rotations)


def _after(skeleton: Skeleton, motion: Motion, local: np.ndarray) -> Motion:
    """-> the motion after one frame of a pose (1, J, 3, 3), standing on the floor where it begins."""
    first = motion.at(np.zeros(1, int))
    turns = kinematics.carried(kinematics.tree_of(skeleton), np.zeros((1, 3)), local)[1][0]
    place = np.array([[first.root[0, 0], -_standing(skeleton, turns)[1], first.root[0, 2]]])
    before = _on(first, place, local)
    return Motion(*(np.concatenate([getattr(before, key), field]) for key, field in vars(motion).items()))
