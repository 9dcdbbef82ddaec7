"""Write a motion as BVH.

By default: Y up, facing +Z in the rest pose, in centimetres (BVH has no unit). The root has six channels, every other joint
three. All rotations are Z Y X in degrees, R = Rz Ry Rx, continuous over time. A rig may have another unit and order.
"""

from pathlib import Path

from mocapfix.motion import Motion
from mocapfix.skeleton import Skeleton
from mocapfix.write.bvh_tree import CENTIMETRE_M, write_bvh_tree
from mocapfix.write.rig import Rig, retarget_to_rig


def write_bvh(
    target: Path,
    skeleton: Skeleton,
    motion: Motion,
    rate: float,
    unit_m: float = CENTIMETRE_M,
    rotation_order: str = "ZYX",
) -> None:
    """Write a motion.

    Args:
        target: The file.
        skeleton: The skeleton.
        motion: Its motion.
        rate: Frames per second.
        unit_m: Metres per unit of the file.
        rotation_order: Order of a joint's rotation channels, the outermost first.

    Raises:
        WriteError: If `target` is not writable or a leaf of the skeleton has no end site.
    """
    write_bvh_tree(target, skeleton, {0: motion.root_position}, motion.local_rotations, rate, unit_m, rotation_order)


def write_rig_bvh(target: Path, rig: Rig, skeleton: Skeleton, motion: Motion, rate: float) -> None:
    """Write a motion on the rig of another program. Raise WriteError as `write_bvh` and `retarget_to_rig` do."""
    rig_skeleton, rig_motion = retarget_to_rig(rig, skeleton, motion)
    write_bvh(target, rig_skeleton, rig_motion, rate, rig.unit_m, rig.rotation_order)
