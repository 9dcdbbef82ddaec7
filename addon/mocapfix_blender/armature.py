"""The armature of a take: made, or updated in place, with its motion as an action."""

from collections.abc import Generator
from contextlib import contextmanager

import bpy
import numpy as np

from .axes import rotate_quaternions
from .keyframes import TAKE_PROPERTY, ActionWriter, KeyWriter
from .process import ProcessError
from .rest_bones import compute_rest_heads, compute_tail_offsets, find_roll_directions
from .solved_take import SkeletonMotion

BONE_PROPERTY = "mocapfix_bone"
"""custom property of the bones that the import has made; others are the user's"""
UNSOLVED_COLLECTION = "Not shown by the markers"
CONNECTED_DISTANCE_M = 1e-6


def find_armature(take_key: str) -> bpy.types.Object | None:
    """Return the armature that an earlier import of the take has made."""
    for each in bpy.data.objects:
        if each.type == "ARMATURE" and each.get(TAKE_PROPERTY) == take_key and each.library is None:
            return each
    return None


def build_armature(context, body: SkeletonMotion, name: str, take_key: str) -> bpy.types.Object:
    """Make the armature of a take, or update the bones of the one that an earlier import has made.

    The object with its transform, constraints and custom properties stays, so do constraints and properties of bones that still
    exist, and bones that the user has added. Raises ProcessError if its data cannot be edited.
    """
    armature = find_armature(take_key)
    if armature is None:
        armature = bpy.data.objects.new(name, bpy.data.armatures.new(name))
        armature[TAKE_PROPERTY] = take_key
        context.collection.objects.link(armature)
    elif armature.data.library is not None or armature.data.override_library is not None:
        raise ProcessError(f"The armature {armature.name} is linked from another file; make it local to update it.")
    with edit_bones(context, armature.data) as bones:
        _update_edit_bones(bones, body)
    _mark_bones(armature.data, body)
    return armature


@contextmanager
def edit_bones(context, data: bpy.types.Armature) -> Generator[bpy.types.ArmatureEditBones]:
    """Yield the edit bones of an armature, also if its object is hidden; active object and selection are as before afterwards."""
    layer = context.view_layer
    active, selected = layer.objects.active, [each for each in layer.objects if each.select_get()]
    if active is not None and active.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    helper = bpy.data.objects.new("mocapfix", data)
    context.scene.collection.objects.link(helper)
    try:
        layer.objects.active = helper
        bpy.ops.object.mode_set(mode="EDIT")
        yield data.edit_bones
    finally:
        bpy.ops.object.mode_set(mode="OBJECT")
        bpy.data.objects.remove(helper)
        layer.objects.active = active
        for each in selected:
            each.select_set(True)


def key_body(armature: bpy.types.Object, body: SkeletonMotion, frames: np.ndarray, actions: ActionWriter) -> None:
    """Write the motion of a body as keys of the bones of its armature."""
    keys = actions.assign(armature)
    for j, name in enumerate(body.names):
        bone = armature.data.bones[name]
        rest = np.array(bone.matrix_local.to_3x3())  # the axes of the joint in the rest pose are those of the armature
        basis = rotate_quaternions(body.rotations[:, j], rest.T)
        if body.parents[j] < 0:
            location = (body.root - np.array(bone.head_local)) @ rest
        elif j in body.translations:
            location = (body.translations[j] - body.offsets[j]) @ rest
        else:
            location = None
        key_pose_bone(keys, armature.pose.bones[name], frames, basis, location)


def key_pose_bone(
    keys: KeyWriter, bone: bpy.types.PoseBone, frames: np.ndarray, basis: np.ndarray, location: np.ndarray | None
) -> None:
    """Write rotations, and locations if there are any, of a pose bone in its rotation mode.

    Args:
        basis: (T, 4): quaternions x, y, z, w in the bone's axes in the rest pose, without changes of sign.
        location: (T, 3) in the bone's axes in the rest pose, in units of the armature.
    """
    path = bone.path_from_id()
    if bone.rotation_mode == "QUATERNION":
        keys.write(f"{path}.rotation_quaternion", frames, basis[:, [3, 0, 1, 2]], group=bone.name)
    elif bone.rotation_mode == "AXIS_ANGLE":
        keys.write(f"{path}.rotation_axis_angle", frames, _convert_to_axis_angles(basis), group=bone.name)
    else:
        keys.write(f"{path}.rotation_euler", frames, _convert_to_euler(basis, bone.rotation_mode), group=bone.name)
    if location is not None:
        keys.write(f"{path}.location", frames, location, group=bone.name)


def _convert_to_euler(basis: np.ndarray, order: str) -> np.ndarray:
    """Return Euler angles (T, 3) that are close to those of the frame before."""
    from mathutils import Euler, Quaternion

    angles, previous = np.full((len(basis), 3), np.nan), Euler((0.0, 0.0, 0.0), order)
    for t in np.flatnonzero(np.isfinite(basis).all(1)):
        x, y, z, w = basis[t]
        previous = Quaternion((w, x, y, z)).to_euler(order, previous)
        angles[t] = previous
    return angles


def _convert_to_axis_angles(basis: np.ndarray) -> np.ndarray:
    """Return angles and axes (T, 4)."""
    length = np.linalg.norm(basis[:, :3], axis=1)
    angle = 2.0 * np.arctan2(length, basis[:, 3])
    axis = np.where(length[:, None] > 1e-9, basis[:, :3] / np.maximum(length, 1e-9)[:, None], [0.0, 1.0, 0.0])
    return np.concatenate([angle[:, None], axis], axis=1)


def _update_edit_bones(bones: bpy.types.ArmatureEditBones, body: SkeletonMotion) -> None:
    for bone in [each for each in bones if each.get(BONE_PROPERTY) and each.name not in body.names]:
        bones.remove(bone)
    heads, tails = compute_rest_heads(body), compute_tail_offsets(body)
    rolls = find_roll_directions(tails)
    for name in body.names:
        bone = bones.get(name) or bones.new(name)
        bone[BONE_PROPERTY] = True
        bone.use_connect = False
    for j, (name, parent) in enumerate(zip(body.names, body.parents, strict=True)):
        bone = bones[name]
        bone.parent = bones[body.names[parent]] if parent >= 0 else None
        bone.head, bone.tail = heads[j], heads[j] + tails[j]
        bone.align_roll(rolls[j])
    for j, (name, parent) in enumerate(zip(body.names, body.parents, strict=True)):
        if parent >= 0 and j not in body.translations:
            gap = np.linalg.norm(heads[j] - heads[parent] - tails[parent])
            bones[name].use_connect = bool(gap < CONNECTED_DISTANCE_M)


def _mark_bones(data: bpy.types.Armature, body: SkeletonMotion) -> None:
    """Put bones of joints that no marker shows in a bone collection of their own."""
    unsolved = [name for name, is_solved in zip(body.names, body.is_solved, strict=True) if not is_solved]
    collection = data.collections.get(UNSOLVED_COLLECTION)
    if collection is None:
        if not unsolved:
            return
        collection = data.collections.new(UNSOLVED_COLLECTION)
    for name in body.names:
        change = collection.assign if name in unsolved else collection.unassign
        change(data.bones[name])
