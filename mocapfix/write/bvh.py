"""A motion as BVH: the file animators' programs open.

Y up, facing +Z in the rest pose; centimetres (BVH carries no unit). The root has six channels, every other joint three;
all rotations are Z Y X in degrees, R = Rz Ry Rx, continuous from frame to frame. A rig may want another unit and order.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mocapfix.errors import WriteError
from mocapfix.files import replacing
from mocapfix.kernels import eulers
from mocapfix.motion import Motion
from mocapfix.rig import Rig
from mocapfix.skeleton import Skeleton
from mocapfix.write.numbers import rows
from mocapfix.write.rigged import rigged

CENTIMETRE = 0.01  # metres
DECIMALS = 6


def bvh(
    target: Path, skeleton: Skeleton, motion: Motion, rate: float, unit: float = CENTIMETRE, rotations: str = "ZYX"
) -> None:
    """Write `motion` at `rate` frames a second; `target` is put into place whole or not at all.

    unit       metres in one unit of the file
    rotations  the order of a joint's rotation channels, first the one that turns last

    Raises WriteError where the folder cannot be written or a leaf of the skeleton has no end site.
    """
    order = list(_depth_first(skeleton))
    angles = np.degrees(euler(motion.rotations[:, [joint for joint, _ in order]], rotations))
    channels = np.hstack([motion.root * (1 / unit), angles.reshape(motion.frames, -1)])
    head = "".join(_hierarchy(target, skeleton, order, unit, rotations))
    head += f"MOTION\nFrames: {motion.frames}\nFrame Time: {1 / rate:.10f}\n"
    with replacing(Path(target)) as part:
        part.write_bytes(head.encode("ascii") + rows(channels, DECIMALS))


def bvh_for(target: Path, rig: Rig, skeleton: Skeleton, motion: Motion, rate: float) -> None:
    """Write `motion` as another program wants it; raises WriteError as `bvh` and `rigged` do."""
    told, moved = rigged(rig, skeleton, motion)
    bvh(target, told, moved, rate, rig.unit, rig.rotations)


def euler(rotations: np.ndarray, order: str = "ZYX") -> np.ndarray:
    """-> (T, J, 3) radians about the axes of `order`, of rotations (T, J, 3, 3), each joint continuous over time.

    R is the product of the three turns in that order. A step is at most a right angle and what the motion itself turns; it
    comes near that only where the motion passes closer to gimbal lock than it turns in a frame.
    """
    axes = np.array(["XYZ".index(axis) for axis in order])
    by_joint = np.ascontiguousarray(np.swapaxes(rotations, 0, 1))
    return np.stack([eulers.followed(joint, axes, np.zeros(3)) for joint in by_joint], axis=1)


def _depth_first(skeleton: Skeleton, joint: int = 0, depth: int = 0) -> Iterator[tuple[int, int]]:
    """-> joint and depth in the order in which BVH lists joints and their channels."""
    yield joint, depth
    for child in np.flatnonzero(skeleton.parents == joint):
        yield from _depth_first(skeleton, int(child), depth + 1)


def _hierarchy(
    target: Path, skeleton: Skeleton, order: list[tuple[int, int]], unit: float, rotations: str
) -> Iterator[str]:
    """-> the lines of the HIERARCHY section."""
    yield "HIERARCHY\n"
    depths = [depth for _, depth in order] + [0]
    turns = " ".join(f"{axis}rotation" for axis in rotations)
    for (joint, depth), following in zip(order, depths[1:], strict=True):
        tab = "\t" * depth
        place = "Xposition Yposition Zposition " if depth == 0 else ""
        offset = skeleton.offsets[joint] if depth else np.zeros(3)  # the root's place is in its channels
        yield f"{tab}{'JOINT' if depth else 'ROOT'} {skeleton.names[joint]}\n{tab}{{\n{tab}\tOFFSET {_written(offset, unit)}\n"
        yield f"{tab}\tCHANNELS {6 if depth == 0 else 3} {place}{turns}\n"
        if following <= depth:
            end = skeleton.ends[joint]
            if not np.linalg.norm(end) > 0:
                name = skeleton.names[joint]
                raise WriteError(f"{target}: the last bone {name} has no length; give it an end in the subject file.")
            yield f"{tab}\tEnd Site\n{tab}\t{{\n{tab}\t\tOFFSET {_written(end, unit)}\n{tab}\t}}\n"
        yield from ("\t" * level + "}\n" for level in range(depth, following - 1, -1))


def _written(vector: np.ndarray, unit: float) -> str:
    return " ".join(f"{x * (1 / unit):.{DECIMALS}f}" for x in vector)
