"""The rest pose of an armature as a character file of mocapfix, and the motion that mocapfix writes for it.

The file has heads and tails in metres in the world, Y up, and the rotation of each bone's axes. The world of the character is
that of the armature object without its place and its heading, so that the motion moves with the object.
"""

import json
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import bpy
import numpy as np
from mathutils import Quaternion

from .axes import BLENDER_FROM_Y_UP, conjugate_quaternions, make_matrices, make_quaternions, multiply_quaternions
from .process import ProcessError

CHARACTER_NPZ_FORMAT = "mocapfix character 1"
MAX_SCALE_DIFFERENCE = 1e-3
"""relative difference of the scales of an object along its axes, up to which they are the same"""


@dataclass(frozen=True)
class BoneMotion:
    """The motion of N bones of an armature over T frames, relative to their rest pose, in their own axes."""

    names: tuple[str, ...]  # names of the bones that are moved
    basis: np.ndarray  # (T, N, 4): quaternions x, y, z, w, without changes of sign
    pelvis: str  # name of the bone that is translated, one of `names`
    location: np.ndarray  # (T, 3) m: its translation
    rate: float  # frames per second
    segments: dict[str, list[str]]  # the bones of each segment of the body, from the pelvis outwards


def get_object_scale(armature: bpy.types.Object) -> float:
    """Return the scale of an armature object. Raises ProcessError if it is not the same along all axes."""
    scales = np.array(armature.matrix_world.to_scale())
    if armature.matrix_world.determinant() < 0 or np.ptp(scales) > MAX_SCALE_DIFFERENCE * scales.max() or scales.min() <= 0:
        raise ProcessError(
            f"{armature.name} is mirrored or scaled differently along its axes; apply its scale (Object > Apply > Scale)."
        )
    return float(scales.mean())


def write_character(path: Path, armature: bpy.types.Object) -> None:
    """Write the rest pose of an armature. Raises ProcessError if its object has a scale that differs along the axes."""
    scale, rotation = get_object_scale(armature), armature.matrix_world.to_quaternion()
    heading = Quaternion((0.0, 0.0, 1.0), 2.0 * math.atan2(rotation.z, rotation.w))
    to_character = BLENDER_FROM_Y_UP.T @ np.array((heading.inverted() @ rotation).to_matrix())
    bones = []
    for bone in _list_bones(armature.data):
        x, y, z, w = make_quaternions(to_character @ np.array(bone.matrix_local.to_3x3()))
        head, tail = (scale * to_character @ np.array(each) for each in (bone.head_local, bone.tail_local))
        name, parent = (json.dumps(each, ensure_ascii=False) for each in (bone.name, bone.parent.name if bone.parent else None))
        numbers = (
            f"{key}: {_format_numbers(each)}" for key, each in (("head", head), ("tail", tail), ("rotation", (w, x, y, z)))
        )
        bones.append(f"  - {{name: {name}, parent: {parent}, {', '.join(numbers)}}}")
    head_lines = ["kind: character", f"name: {json.dumps(path.stem, ensure_ascii=False)}", "up: Z", "bones:"]
    path.write_text("\n".join([*head_lines, *bones, ""]), encoding="utf-8")


def get_character_name(armature: bpy.types.Object) -> str:
    """Return the name of an armature as part of the name of a file."""
    return re.sub(r"[^\w-]+", "-", armature.name).strip("-_") or "character"


def read_bone_motion(path: Path) -> BoneMotion:
    """Read the motion that mocapfix has written for an armature. Raises ProcessError if it is not of the known form."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        if str(arrays["format"]) != CHARACTER_NPZ_FORMAT:
            raise ProcessError(f"mocapfix wrote a file of another version ({arrays['format']}); update the add-on and mocapfix.")
        names, moved = [str(each) for each in arrays["names"]], np.flatnonzero(arrays["is_moved"])
        rest, pelvis = arrays["rest_rotations"], names.index(str(arrays["pelvis"]))
        return BoneMotion(
            tuple(names[j] for j in moved),
            multiply_quaternions(conjugate_quaternions(rest[moved]), arrays["rotations"][:, moved]),
            names[pelvis],
            (arrays["pelvis_position"] - arrays["rest_positions"][pelvis]) @ make_matrices(rest[pelvis]),
            float(arrays["rate"]),
            {
                str(segment): str(bones).split("\n")
                for segment, bones in zip(arrays["segments"], arrays["segment_bones"], strict=True)
            },
        )
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        raise ProcessError("The motion that mocapfix wrote cannot be read; update the add-on and mocapfix.") from error


def _format_numbers(numbers: Iterable[float]) -> str:
    """Return numbers as a sequence of YAML, without exponents, which not every reader takes for numbers."""
    return f"[{', '.join(f'{each:.9f}' for each in numbers)}]"


def _list_bones(data: bpy.types.Armature) -> list[bpy.types.Bone]:
    """Return the bones, parents before children."""
    found: list[bpy.types.Bone] = []
    waiting = [bone for bone in data.bones if bone.parent is None]
    while waiting:
        bone = waiting.pop()
        found.append(bone)
        waiting += reversed(bone.children)
    return found
