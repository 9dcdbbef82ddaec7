"""A motion as ASF/AMC, in the form of CMU's own: its bones' names, order and axes, lengths in inches times 0.45.

A bone of the ASF has axes of its own, turned by C from the world's in the rest pose; the AMC has the angles of C^-1 R C, of
which x is turned about first. CMU's knees and elbows are hinges; here every bone that turns may turn about all three axes, so
that the motion is the same.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.animations import joint_mapping
from mocapfix.errors import WriteError
from mocapfix.files.output_files import replace_atomically
from mocapfix.kernels import euler_angles
from mocapfix.motion import Motion
from mocapfix.skeleton import Skeleton
from mocapfix.write.number_format import format_rows

CMU_LENGTH_FACTOR = 0.45  # what CMU's lengths were multiplied by
CMU_LENGTH_UNIT_M = 0.0254 / CMU_LENGTH_FACTOR  # metres
# degrees about x, y, z, by which the axes of CMU's left bones are turned; the right ones' are the mirror image
CMU_BONE_AXES_DEG = {"femur": (0, 0, 20), "tibia": (0, 0, 20), "foot": (-90, 0, 20), "toes": (-90, 0, 20)}
CMU_BONE_AXES_DEG |= {"humerus": (180, -30, -90), "radius": (180, -30, -90), "thumb": (-90, 45, 0)}
CMU_BONE_AXES_DEG |= {"wrist": (0, 90, 90), "hand": (0, 90, 90), "fingers": (0, 90, 90)}
FIXED_BONES = ("lhipjoint", "rhipjoint")  # have no freedom, unless the motion turns them
ZYX_AXES = np.array([2, 1, 0])  # z, y, x
MAX_JOINT_DISTANCE_M = 1e-7  # metres: joints nearer than this begin at the same place
AMC_DECIMALS = 6
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
    """Write the 31-joint `skeleton` to `asf` and `motion`, at `rate` frames a second, to `amc`; they are put into place whole or
    not at all. An AMC has no place for its rate: a comment says it.

    Raises WriteError where joints that hang on one bone do not begin at the same place, where the motion is not all there, or
    where a file cannot be written.
    """
    names = get_cmu_bone_names(skeleton)
    if not (np.isfinite(motion.root_position).all() and np.isfinite(motion.local_rotations).all()):
        raise WriteError(f"{amc_target}: the motion is not known in every frame, and an AMC has no sign for that.")
    turning = [
        name not in FIXED_BONES or not np.allclose(motion.local_rotations[:, j], np.eye(3)) for j, name in enumerate(names)
    ]
    figure = (
        ASF_HEADER + "".join(_build_bone_data(asf_target, skeleton, names, turning)) + "".join(_build_hierarchy(skeleton, names))
    )
    with replace_atomically(Path(asf_target)) as first, replace_atomically(Path(amc_target)) as second:
        first.write_bytes(figure.encode("ascii"))
        second.write_bytes(_build_frames(names, turning, motion, rate, first_frame))


def get_cmu_bone_names(skeleton: Skeleton) -> list[str]:
    """-> CMU's name of the bone that begins at each joint."""
    acclaim = joint_mapping.load_naming_convention("acclaim").candidate_names
    return [acclaim[name][0] for name in skeleton.names]


def get_bone_axes_deg(bone: str) -> tuple[float, float, float]:
    """-> degrees about x, y, z, in this order, by which a bone's axes are turned from the world's in the rest pose."""
    x, y, z = CMU_BONE_AXES_DEG.get(bone[1:], (0, 0, 0))
    return (x, y, z) if bone[0] == "l" else (x, -y, -z)


def _build_bone_data(asf: Path, skeleton: Skeleton, names: list[str], turning: list[bool]) -> Iterator[str]:
    """-> the text of each bone but the root."""
    for joint, name in list(enumerate(names))[1:]:
        tip = _compute_tip(asf, skeleton, joint) / CMU_LENGTH_UNIT_M
        length = float(np.linalg.norm(tip))
        direction = tip / length if length > 0 else np.array([0.0, 1.0, 0.0])
        way, turn = (" ".join(f"{x + 0.0:.15g}" for x in vector) for vector in (direction, get_bone_axes_deg(name)))
        yield f"  begin\n     id {joint}\n     name {name}\n"
        yield f"     direction {way}\n     length {length:.15g}\n     axis {turn} XYZ\n"
        if turning[joint]:
            yield "    dof rx ry rz\n    limits (-180.0 180.0)\n" + "           (-180.0 180.0)\n" * 2
        yield "  end\n"


def _compute_tip(asf: Path, skeleton: Skeleton, joint: int) -> np.ndarray:
    """-> (3,) metres from a bone's beginning to its end: where the joints that hang on it begin, or the end site."""
    children = np.flatnonzero(skeleton.parents == joint)
    if not len(children):
        return np.nan_to_num(skeleton.ends[joint])
    tip = skeleton.offsets[children[0]]
    for child in children[1:]:
        if np.linalg.norm(skeleton.offsets[child] - tip) > MAX_JOINT_DISTANCE_M:
            ours = f"{skeleton.names[child]} and {skeleton.names[children[0]]}"
            raise WriteError(f"{asf}: {ours} do not begin at the same place, as bones on one bone of an ASF must.")
    return tip


def _build_hierarchy(skeleton: Skeleton, names: list[str]) -> Iterator[str]:
    yield ":hierarchy\n  begin\n"
    for joint, name in enumerate(names):
        if len(children := np.flatnonzero(skeleton.parents == joint)):
            yield f"    {name} {' '.join(names[child] for child in children)}\n"
    yield "  end\n"


def _build_frames(names: list[str], turning: list[bool], motion: Motion, rate: float, first_frame: int) -> bytes:
    """-> the AMC: for every frame its number and a line for each bone that turns."""
    lines = [[f"{frame}\n".encode() for frame in range(first_frame, first_frame + motion.frame_count)]]
    for joint, name in enumerate(names):
        if turning[joint]:
            own = Rotation.from_euler("xyz", get_bone_axes_deg(name), degrees=True).as_matrix()
            turns = np.ascontiguousarray(own.T @ motion.local_rotations[:, joint] @ own)
            degrees = np.degrees(euler_angles.compute_continuous_euler_angles(turns, ZYX_AXES, np.zeros(3)))[:, ::-1]
            numbers = np.hstack([motion.root_position / CMU_LENGTH_UNIT_M, degrees]) if joint == 0 else degrees
            told = format_rows(numbers, AMC_DECIMALS).splitlines(keepends=True)
            lines.append([name.encode() + b" " + line for line in told])
    head = f"#!OML:ASF written by mocapfix, {rate:.10g} frames a second\n:FULLY-SPECIFIED\n:DEGREES\n".encode("ascii")
    return head + b"".join(line for frame in zip(*lines, strict=True) for line in frame)
