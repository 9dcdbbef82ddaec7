"""Write a motion as ASF/AMC in the form of CMU's files: names, order and axes of its bones, lengths in inches times 0.45.

A bone of the ASF has its own axes, rotated by C from the world's in the rest pose. The AMC has the angles of C^-1 R C, with x as
the innermost rotation. Knees and elbows are hinges in CMU's files; here every bone that rotates has three degrees of freedom, so
that the motion is unchanged.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mocapfix.animations import joint_mapping
from mocapfix.errors import WriteError
from mocapfix.files.output_files import replace_atomically
from mocapfix.kernels import euler_angles
from mocapfix.motion import Motion
from mocapfix.skeleton import Skeleton
from mocapfix.write.text_tables import format_rows

CMU_LENGTH_FACTOR = 0.45  # of lengths in inches
CMU_LENGTH_UNIT_M = 0.0254 / CMU_LENGTH_FACTOR
# Degrees about x, y, z by which the axes of CMU's left bones are rotated; those of the right bones are the mirror image.
CMU_BONE_AXES_DEG = {
    "femur": (0, 0, 20),
    "tibia": (0, 0, 20),
    "foot": (-90, 0, 20),
    "toes": (-90, 0, 20),
    "humerus": (180, -30, -90),
    "radius": (180, -30, -90),
    "thumb": (-90, 45, 0),
    "wrist": (0, 90, 90),
    "hand": (0, 90, 90),
    "fingers": (0, 90, 90),
}
FIXED_BONES = ("lhipjoint", "rhipjoint")  # without degrees of freedom, unless the motion rotates them
ZYX_AXES = np.array([2, 1, 0])  # the outermost first
MAX_JOINT_DISTANCE_M = 1e-7  # between joints that begin at the same position
AMC_DECIMALS = 6  # of every number
ASF_HEADER = f"""\
:version 1.10
:name VICON
:units
  mass 1.0
  length {CMU_LENGTH_FACTOR}
  angle deg
:documentation
   Written by mocapfix.
:root
   order TX TY TZ RX RY RZ
   axis XYZ
   position 0 0 0
   orientation 0 0 0
:bonedata
"""


def write_asf_amc(
    asf_target: Path, amc_target: Path, skeleton: Skeleton, motion: Motion, rate: float, first_frame: int = 1
) -> None:
    """Write a skeleton as ASF and its motion as AMC. Both files are replaced, or neither.

    The AMC has the rate in a comment, because the format has no keyword for it.

    Args:
        asf_target: The file of the skeleton.
        amc_target: The file of the motion.
        skeleton: The skeleton with 31 joints.
        motion: Its motion.
        rate: Frames per second.
        first_frame: Number of the first frame.

    Raises:
        WriteError: If joints on one bone do not begin at the same position, the motion is incomplete, or a file is not writable.
    """
    names = get_cmu_bone_names(skeleton)
    if not (np.isfinite(motion.root_position).all() and np.isfinite(motion.local_rotations).all()):
        raise WriteError(f"{amc_target}: the motion has missing frames, which an AMC cannot represent.")
    is_rotating = [
        name not in FIXED_BONES or not np.allclose(motion.local_rotations[:, joint], np.eye(3))
        for joint, name in enumerate(names)
    ]
    bone_data = "".join(_build_bone_data(asf_target, skeleton, names, is_rotating))
    asf = ASF_HEADER + bone_data + "".join(_build_hierarchy(skeleton, names))
    with replace_atomically(Path(asf_target)) as asf_part, replace_atomically(Path(amc_target)) as amc_part:
        asf_part.write_bytes(asf.encode("ascii"))
        amc_part.write_bytes(_build_frames(names, is_rotating, motion, rate, first_frame))


def get_cmu_bone_names(skeleton: Skeleton) -> list[str]:
    """Return CMU's name of the bone that begins at each joint."""
    acclaim = joint_mapping.load_naming_convention("acclaim").candidate_names
    return [acclaim[name][0] for name in skeleton.names]


def get_bone_axes_deg(bone: str) -> tuple[float, float, float]:
    """Return the degrees about x, y, z, in this order, by which the axes of a bone are rotated in the rest pose."""
    x, y, z = CMU_BONE_AXES_DEG.get(bone[1:], (0, 0, 0))
    return (x, y, z) if bone[0] == "l" else (x, -y, -z)


def _build_bone_data(asf_target: Path, skeleton: Skeleton, names: list[str], is_rotating: list[bool]) -> Iterator[str]:
    """Yield the text of each bone except the root."""
    for joint, name in list(enumerate(names))[1:]:
        tip = _compute_tip(asf_target, skeleton, joint) / CMU_LENGTH_UNIT_M
        length = float(np.linalg.norm(tip))
        direction = tip / length if length > 0 else np.array([0.0, 1.0, 0.0])
        direction_text, axes_text = (
            " ".join(f"{x + 0.0:.15g}" for x in vector) for vector in (direction, get_bone_axes_deg(name))
        )
        yield f"  begin\n     id {joint}\n     name {name}\n"
        yield f"     direction {direction_text}\n     length {length:.15g}\n     axis {axes_text} XYZ\n"
        if is_rotating[joint]:
            yield "    dof rx ry rz\n    limits (-180.0 180.0)\n" + "           (-180.0 180.0)\n" * 2
        yield "  end\n"


def _compute_tip(asf_target: Path, skeleton: Skeleton, joint: int) -> Float[np.ndarray, " 3"]:
    """Return the vector (m) from the beginning of a bone to its end: where its child joints begin, or the end site."""
    children = np.flatnonzero(skeleton.parents == joint)
    if not len(children):
        return np.nan_to_num(skeleton.ends[joint])
    tip = skeleton.offsets[children[0]]
    for child in children[1:]:
        if np.linalg.norm(skeleton.offsets[child] - tip) > MAX_JOINT_DISTANCE_M:
            pair = f"{skeleton.names[child]} and {skeleton.names[children[0]]}"
            raise WriteError(f"{asf_target}: {pair} do not begin at the same position, as bones on one bone of an ASF must.")
    return tip


def _build_hierarchy(skeleton: Skeleton, names: list[str]) -> Iterator[str]:
    yield ":hierarchy\n  begin\n"
    for joint, name in enumerate(names):
        if len(children := np.flatnonzero(skeleton.parents == joint)):
            yield f"    {name} {' '.join(names[child] for child in children)}\n"
    yield "  end\n"


def _build_frames(names: list[str], is_rotating: list[bool], motion: Motion, rate: float, first_frame: int) -> bytes:
    """Return the AMC: for every frame its number and a line for each bone that rotates."""
    columns = [[f"{frame}\n".encode() for frame in range(first_frame, first_frame + motion.frame_count)]]
    for joint, name in enumerate(names):
        if is_rotating[joint]:
            rotation_world_bone = Rotation.from_euler("xyz", get_bone_axes_deg(name), degrees=True).as_matrix()
            rotations = np.ascontiguousarray(rotation_world_bone.T @ motion.local_rotations[:, joint] @ rotation_world_bone)
            angles_zyx = euler_angles.compute_continuous_euler_angles(rotations, ZYX_AXES, np.zeros(3))
            degrees = np.degrees(angles_zyx)[:, ::-1]
            numbers = np.hstack([motion.root_position / CMU_LENGTH_UNIT_M, degrees]) if joint == 0 else degrees
            lines = format_rows(numbers, AMC_DECIMALS).splitlines(keepends=True)
            columns.append([name.encode() + b" " + line for line in lines])
    header = f"#!OML:ASF written by mocapfix, {rate:.10g} frames a second\n:FULLY-SPECIFIED\n:DEGREES\n".encode("ascii")
    return header + b"".join(line for frame in zip(*columns, strict=True) for line in frame)
