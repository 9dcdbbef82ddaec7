"""A motion as BVH: the file animators' programs open.

Y up, facing +Z in the rest pose; centimetres (BVH carries no unit). The root has six channels, every other joint three;
all rotations are Z Y X in degrees, R = Rz Ry Rx, continuous from frame to frame. A rig may want another unit and order.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numba import njit

from mocapfix.errors import WriteError
from mocapfix.files import replacing
from mocapfix.motion import Motion
from mocapfix.rig import Rig
from mocapfix.skeleton import Skeleton
from mocapfix.write.rigged import rigged

CENTIMETRE = 0.01  # metres
GIMBAL = 1e-7  # cos(y) below which z and x cannot be told apart; what is lost there is far below a rounded degree


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
    row = " ".join(["%.6f"] * channels.shape[1]) + "\n"
    with replacing(Path(target)) as part, part.open("w", encoding="ascii", newline="\n") as file:
        file.writelines(_hierarchy(target, skeleton, order, unit, rotations))
        file.write(f"MOTION\nFrames: {motion.frames}\nFrame Time: {1 / rate:.10f}\n")
        file.writelines(row % tuple(frame) for frame in channels.tolist())


def bvh_for(target: Path, rig: Rig, skeleton: Skeleton, motion: Motion, rate: float) -> None:
    """Write `motion` as another program wants it; raises WriteError as `bvh` and `rigged` do."""
    told, moved = rigged(rig, skeleton, motion)
    bvh(target, told, moved, rate, rig.unit, rig.rotations)


def euler(rotations: np.ndarray, order: str) -> np.ndarray:
    """-> (T, J, 3) radians about the axes of `order`, as `euler_zyx` for "ZYX": R is the product of the three turns in order.

    Any order is Z Y X in axes of other names; where naming them so mirrors the world, angles are the other way round.
    """
    axes = ["XYZ".index(axis) for axis in reversed(order)]  # what takes the part of x, y and z
    sign = np.linalg.det(np.eye(3)[axes])
    return sign * euler_zyx(rotations[..., axes, :][..., axes])


def euler_zyx(rotations: np.ndarray) -> np.ndarray:
    """-> (T, J, 3) radians z, y, x with R = Rz Ry Rx, of rotations (T, J, 3, 3), each joint continuous over time.

    Two triples turn alike, (z, y, x) and (z + pi, pi - y, x + pi), each up to whole turns. Frame by frame the one nearest
    to the frame before is taken (in the first, nearest to no turn). No look-ahead would do better, for what a step costs
    does not depend on which of the two was taken before. A step is at most a right angle and what the motion itself
    turns; it comes near that only where the motion passes closer to gimbal lock than it turns in a frame.
    """
    angles = np.empty(rotations.shape[:-1])
    _follow(np.ascontiguousarray(rotations), angles)
    return angles


@njit(cache=True)
def _follow(rotations, angles):
    for j in range(rotations.shape[1]):
        z, y, x = 0.0, 0.0, 0.0
        for t in range(rotations.shape[0]):
            z, y, x = _nearest(rotations[t, j], z, y, x)
            angles[t, j, 0], angles[t, j, 1], angles[t, j, 2] = z, y, x


@njit(cache=True)
def _nearest(r, z, y, x):
    """The angles of rotation `r` nearest to z, y, x."""
    cosine = np.hypot(r[0, 0], r[1, 0])
    pitch = np.arctan2(-r[2, 0], cosine)
    if cosine < GIMBAL:
        # Only x - z (looking up: x + z) is known: both angles share the change.
        side = 1.0 if pitch > 0 else -1.0
        change = _wrapped(np.arctan2(side * r[0, 1], r[1, 1]) - (x - side * z))
        return z - side * change / 2, y + _wrapped(pitch - y), x + change / 2
    yaw, roll = np.arctan2(r[1, 0], r[0, 0]), np.arctan2(r[2, 1], r[2, 2])
    dz, dy, dx = _wrapped(yaw - z), _wrapped(pitch - y), _wrapped(roll - x)
    ez, ey, ex = _wrapped(yaw + np.pi - z), _wrapped(np.pi - pitch - y), _wrapped(roll + np.pi - x)
    if ez * ez + ey * ey + ex * ex < dz * dz + dy * dy + dx * dx:
        return z + ez, y + ey, x + ex
    return z + dz, y + dy, x + dx


@njit(cache=True)
def _wrapped(angle):
    """The same angle within half a turn of zero."""
    return angle - 2 * np.pi * np.round(angle / (2 * np.pi))


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
    return " ".join(f"{x * (1 / unit):.6f}" for x in vector)
