"""Write a tree of joints and its motion as the text of a BVH."""

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mocapfix.errors import WriteError
from mocapfix.files.output_files import replace_atomically
from mocapfix.kernels import euler_angles
from mocapfix.skeleton import Skeleton
from mocapfix.write.text_tables import format_rows

CENTIMETRE_M = 0.01
BVH_DECIMALS = 6  # of every number


def write_bvh_tree(
    target: Path,
    skeleton: Skeleton,
    positions: Mapping[int, Float[np.ndarray, "T 3"]],
    local_rotations: Float[np.ndarray, "T J 3 3"],
    rate: float,
    unit_m: float = CENTIMETRE_M,
    rotation_order: str = "ZYX",
) -> None:
    """Write a motion as `write_bvh` does, in which several joints may have position channels.

    positions  joint to its positions (T, 3) in metres in its parent's axes; the root, joint 0, must have them
    """
    joints = list(_iterate_depth_first(skeleton))
    angles = np.degrees(compute_euler_angles(local_rotations[:, [joint for joint, _ in joints]], rotation_order))
    columns: list[np.ndarray] = []
    for index, (joint, _) in enumerate(joints):
        columns += [positions[joint] * (1 / unit_m)] if joint in positions else []
        columns.append(angles[:, index])
    header = "".join(_build_hierarchy(target, skeleton, joints, positions, unit_m, rotation_order))
    header += f"MOTION\nFrames: {len(local_rotations)}\nFrame Time: {1 / rate:.10f}\n"
    with replace_atomically(Path(target)) as part:
        part.write_bytes(header.encode("utf-8") + format_rows(np.hstack(columns), BVH_DECIMALS))


def compute_euler_angles(rotations: Float[np.ndarray, "T J 3 3"], rotation_order: str = "ZYX") -> Float[np.ndarray, "T J 3"]:
    """Return the Euler angles (rad) of rotations, each joint continuous over time.

    A rotation is the product of the three rotations about the axes in `rotation_order`. A step is at most a right angle plus the
    rotation of the motion itself. It comes close to that only if the motion passes gimbal lock at a smaller angle than it
    rotates in a frame.
    """
    axes = np.array(["XYZ".index(axis) for axis in rotation_order])
    by_joint = np.ascontiguousarray(np.swapaxes(rotations, 0, 1))
    return np.stack([euler_angles.compute_continuous_euler_angles(joint, axes, np.zeros(3)) for joint in by_joint], axis=1)


def _iterate_depth_first(skeleton: Skeleton, joint: int = 0, depth: int = 0) -> Iterator[tuple[int, int]]:
    """Yield joint and depth in the order in which BVH lists joints and their channels."""
    yield joint, depth
    for child in np.flatnonzero(skeleton.parents == joint):
        yield from _iterate_depth_first(skeleton, int(child), depth + 1)


def _build_hierarchy(
    target: Path,
    skeleton: Skeleton,
    joints: list[tuple[int, int]],
    positioned_joints: Collection[int],
    unit_m: float,
    rotation_order: str,
) -> Iterator[str]:
    """Yield the lines of the HIERARCHY section."""
    yield "HIERARCHY\n"
    depths = [depth for _, depth in joints] + [0]
    rotation_channels = " ".join(f"{axis}rotation" for axis in rotation_order)
    for (joint, depth), next_depth in zip(joints, depths[1:], strict=True):
        name, indent = skeleton.names[joint], "\t" * depth
        is_positioned = joint in positioned_joints
        position_channels = "Xposition Yposition Zposition " if is_positioned else ""
        offset = skeleton.offsets[joint] if depth else np.zeros(3)  # the position of the root is in its channels
        yield f"{indent}{'JOINT' if depth else 'ROOT'} {name}\n{indent}{{\n"
        yield f"{indent}\tOFFSET {_format_vector(offset, unit_m)}\n"
        yield f"{indent}\tCHANNELS {6 if is_positioned else 3} {position_channels}{rotation_channels}\n"
        if next_depth <= depth:
            end = skeleton.ends[joint]
            if not np.linalg.norm(end) > 0:
                raise WriteError(f"{target}: the last bone {name} has no length; give it an end in the subject file.")
            yield f"{indent}\tEnd Site\n{indent}\t{{\n{indent}\t\tOFFSET {_format_vector(end, unit_m)}\n{indent}\t}}\n"
        yield from ("\t" * level + "}\n" for level in range(depth, next_depth - 1, -1))


def _format_vector(vector: Float[np.ndarray, " 3"], unit_m: float) -> str:
    return " ".join(f"{x * (1 / unit_m):.{BVH_DECIMALS}f}" for x in vector)
