"""A motion as ASF/AMC, in the form of CMU's own: its bones' names, order and axes, lengths in inches times 0.45.

A bone of the ASF has axes of its own, turned by C from the world's in the rest pose; the AMC has the angles of C^-1 R C, of
which x is turned about first. CMU's knees and elbows are hinges; here every bone that turns may turn about all three axes, so
that the motion is the same.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix import hierarchies
from mocapfix.errors import WriteError
from mocapfix.files import replacing
from mocapfix.kernels import eulers
from mocapfix.motion import Motion
from mocapfix.skeleton import Skeleton
from mocapfix.write.numbers import rows

LENGTH = 0.45  # what CMU's lengths were multiplied by
UNIT = 0.0254 / LENGTH  # metres
# degrees about x, y, z, by which the axes of CMU's left bones are turned; the right ones' are the mirror image
AXES = {"femur": (0, 0, 20), "tibia": (0, 0, 20), "foot": (-90, 0, 20), "toes": (-90, 0, 20)}
AXES |= {"humerus": (180, -30, -90), "radius": (180, -30, -90), "thumb": (-90, 45, 0)}
AXES |= {"wrist": (0, 90, 90), "hand": (0, 90, 90), "fingers": (0, 90, 90)}
STILL = ("lhipjoint", "rhipjoint")  # have no freedom, unless the motion turns them
INNERMOST_LAST = np.array([2, 1, 0])  # z, y, x
APART = 1e-7  # metres: joints nearer than this begin at the same place
DECIMALS = 6
HEAD = f"""\
:version 1.10
:name VICON
:units
  mass 1.0
  length {LENGTH}
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


def asf_amc(asf: Path, amc: Path, skeleton: Skeleton, motion: Motion, rate: float, first_frame: int = 1) -> None:
    """Write the 31-joint `skeleton` to `asf` and `motion`, at `rate` frames a second, to `amc`; they are put into place whole or
    not at all. An AMC has no place for its rate: a comment says it.

    Raises WriteError where joints that hang on one bone do not begin at the same place, where the motion is not all there, or
    where a file cannot be written.
    """
    names = bones(skeleton)
    if not (np.isfinite(motion.root).all() and np.isfinite(motion.rotations).all()):
        raise WriteError(f"{amc}: the motion is not known in every frame, and an AMC has no sign for that.")
    turning = [name not in STILL or not np.allclose(motion.rotations[:, j], np.eye(3)) for j, name in enumerate(names)]
    figure = HEAD + "".join(_bonedata(asf, skeleton, names, turning)) + "".join(_hierarchy(skeleton, names))
    with replacing(Path(asf)) as first, replacing(Path(amc)) as second:
        first.write_bytes(figure.encode("ascii"))
        second.write_bytes(_frames(names, turning, motion, rate, first_frame))


def bones(skeleton: Skeleton) -> list[str]:
    """-> CMU's name of the bone that begins at each joint."""
    acclaim = hierarchies.load("acclaim").names
    return [acclaim[name][0] for name in skeleton.names]


def axes_of(bone: str) -> tuple[float, float, float]:
    """-> degrees about x, y, z, in this order, by which a bone's axes are turned from the world's in the rest pose."""
    x, y, z = AXES.get(bone[1:], (0, 0, 0))
    return (x, y, z) if bone[0] == "l" else (x, -y, -z)


def _bonedata(asf: Path, skeleton: Skeleton, names: list[str], turning: list[bool]) -> Iterator[str]:
    """-> the text of each bone but the root."""
    for joint, name in list(enumerate(names))[1:]:
        tip = _tip(asf, skeleton, joint) / UNIT
        length = float(np.linalg.norm(tip))
        direction = tip / length if length > 0 else np.array([0.0, 1.0, 0.0])
        way, turn = (" ".join(f"{x + 0.0:.15g}" for x in vector) for vector in (direction, axes_of(name)))
        yield f"  begin\n     id {joint}\n     name {name}\n"
        yield f"     direction {way}\n     length {length:.15g}\n     axis {turn} XYZ\n"
        if turning[joint]:
            yield "    dof rx ry rz\n    limits (-180.0 180.0)\n" + "           (-180.0 180.0)\n" * 2
        yield "  end\n"


def _tip(asf: Path, skeleton: Skeleton, joint: int) -> np.ndarray:
    """-> (3,) metres from a bone's beginning to its end: where the joints that hang on it begin, or the end site."""
    children = np.flatnonzero(skeleton.parents == joint)
    if not len(children):
        return np.nan_to_num(skeleton.ends[joint])
    tip = skeleton.offsets[children[0]]
    for child in children[1:]:
        if np.linalg.norm(skeleton.offsets[child] - tip) > APART:
            ours = f"{skeleton.names[child]} and {skeleton.names[children[0]]}"
            raise WriteError(f"{asf}: {ours} do not begin at the same place, as bones on one bone of an ASF must.")
    return tip


def _hierarchy(skeleton: Skeleton, names: list[str]) -> Iterator[str]:
    yield ":hierarchy\n  begin\n"
    for joint, name in enumerate(names):
        if len(children := np.flatnonzero(skeleton.parents == joint)):
            yield f"    {name} {' '.join(names[child] for child in children)}\n"
    yield "  end\n"


def _frames(names: list[str], turning: list[bool], motion: Motion, rate: float, first_frame: int) -> bytes:
    """-> the AMC: for every frame its number and a line for each bone that turns."""
    lines = [[f"{frame}\n".encode() for frame in range(first_frame, first_frame + motion.frames)]]
    for joint, name in enumerate(names):
        if turning[joint]:
            own = Rotation.from_euler("xyz", axes_of(name), degrees=True).as_matrix()
            turns = np.ascontiguousarray(own.T @ motion.rotations[:, joint] @ own)
            degrees = np.degrees(eulers.followed(turns, INNERMOST_LAST, np.zeros(3)))[:, ::-1]
            numbers = np.hstack([motion.root / UNIT, degrees]) if joint == 0 else degrees
            told = rows(numbers, DECIMALS).splitlines(keepends=True)
            lines.append([name.encode() + b" " + line for line in told])
    head = f"#!OML:ASF written by mocapfix, {rate:.10g} frames a second\n:FULLY-SPECIFIED\n:DEGREES\n".encode("ascii")
    return head + b"".join(line for frame in zip(*lines, strict=True) for line in frame)
