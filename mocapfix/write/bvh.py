"""A motion as BVH: the file animators' programs open.

Y up, facing +Z in the rest pose; centimetres (BVH carries no unit). The root has six channels, every other joint three;
all rotations are Z Y X in degrees, R = Rz Ry Rx, continuous from frame to frame. A rig may want another unit and order.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mocapfix.errors import WriteError
from mocapfix.files.output_files import replace_atomically
from mocapfix.kernels import euler_angles
from mocapfix.motion import Motion
from mocapfix.skeleton import Skeleton
from mocapfix.write.number_format import format_rows
from mocapfix.write.rig import Rig, retarget_to_rig

CENTIMETRE_M = 0.01  # metres
BVH_DECIMALS = 6


def write_bvh(
    target: Path, skeleton: Skeleton, motion: Motion, rate: float, unit_m: float = CENTIMETRE_M, rotation_order: str = "ZYX"
) -> None:
    """Write `motion` at `rate` frames a second; `target` is put into place whole or not at all.

    unit       metres in one unit of the file
    rotations  the order of a joint's rotation channels, first the one that turns last

    Raises WriteError where the folder cannot be written or a leaf of the skeleton has no end site.
    """
    order = list(_iterate_depth_first(skeleton))
    angles = np.degrees(compute_euler_angles(motion.local_rotations[:, [joint for joint, _ in order]], rotation_order))
    channels = np.hstack([motion.root_position * (1 / unit_m), angles.reshape(motion.frame_count, -1)])
    head = "".join(_build_hierarchy(target, skeleton, order, unit_m, rotation_order))
    head += f"MOTION\nFrames: {motion.frame_count}\nFrame Time: {1 / rate:.10f}\n"
    with replace_atomically(Path(target)) as part:
        part.write_bytes(head.encode("ascii") + format_rows(channels, BVH_DECIMALS))


def write_rig_bvh(target: Path, rig: Rig, skeleton: Skeleton, motion: Motion, rate: float) -> None:
    """Write `motion` as another program wants it; raises WriteError as `bvh` and `rigged` do."""
    told, moved = retarget_to_rig(rig, skeleton, motion)
    write_bvh(target, told, moved, rate, rig.unit_m, rig.rotation_order)


def compute_euler_angles(rotations: np.ndarray, rotation_order: str = "ZYX") -> np.ndarray:
    """-> (T, J, 3) radians about the axes of `order`, of rotations (T, J, 3, 3), each joint continuous over time.

    R is the product of the three turns in that order. A step is at most a right angle and what the motion itself turns; it
    comes near that only where the motion passes closer to gimbal lock than it turns in a frame.
    """
    axes = np.array(["XYZ".index(axis) for axis in rotation_order])
    by_joint = np.ascontiguousarray(np.swapaxes(rotations, 0, 1))
    return np.stack([euler_angles.compute_continuous_euler_angles(joint, axes, np.zeros(3)) for joint in by_joint], axis=1)


def _iterate_depth_first(skeleton: Skeleton, joint: int = 0, depth: int = 0) -> Iterator[tuple[int, int]]:
    """-> joint and depth in the order in which BVH lists joints and their channels."""
    yield joint, depth
    for child in np.flatnonzero(skeleton.parents == joint):
        yield from _iterate_depth_first(skeleton, int(child), depth + 1)


def _build_hierarchy(
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
        yield f"{tab}{'JOINT' if depth else 'ROOT'} {skeleton.names[joint]}\n{tab}{{\n{tab}\tOFFSET {_format_vector(offset, unit)}\n"
        yield f"{tab}\tCHANNELS {6 if depth == 0 else 3} {place}{turns}\n"
        if following <= depth:
            end = skeleton.ends[joint]
            if not np.linalg.norm(end) > 0:
                name = skeleton.names[joint]
                raise WriteError(f"{target}: the last bone {name} has no length; give it an end in the subject file.")
            yield f"{tab}\tEnd Site\n{tab}\t{{\n{tab}\t\tOFFSET {_format_vector(end, unit)}\n{tab}\t}}\n"
        yield from ("\t" * level + "}\n" for level in range(depth, following - 1, -1))


def _format_vector(vector: np.ndarray, unit: float) -> str:
    return " ".join(f"{x * (1 / unit):.{BVH_DECIMALS}f}" for x in vector)
