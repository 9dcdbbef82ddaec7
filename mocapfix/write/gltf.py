"""Write a motion as binary glTF 2.0 (.glb) for Blender, Unreal, Unity, Godot and viewers in browsers.

Metres, Y up, facing +Z in the rest pose, as glTF requires (Khronos, glTF 2.0, 3.4). Every joint is a node with its rotations as
unit quaternions, and the root also has its positions. All are joints of a skin, whose mesh shows the bones.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from mocapfix.files.glb import GlbContent, build_glb
from mocapfix.files.output_files import replace_atomically
from mocapfix.motion import Motion
from mocapfix.skeleton import Skeleton
from mocapfix.stats.transform_trees import compose_transforms
from mocapfix.write.gltf_animation import add_animation
from mocapfix.write.gltf_buffer import GLTF_ASSET, GltfBuffer
from mocapfix.write.gltf_skin import add_test_skin
from mocapfix.write.key_reduction import KeyReduction, measure_key_reduction, select_motion_keys

if TYPE_CHECKING:
    from mocapfix.contacts.contacts import BodyContacts


def write_gltf(
    target: Path,
    skeleton: Skeleton,
    motion: Motion,
    rate: float,
    key_error_rad: float | None = None,
    contacts: "BodyContacts | None" = None,
) -> KeyReduction | None:
    """Write a motion at `rate` frames per second.

    With `key_error_rad` only the keys are written that keep rotations within this angle, and the root within the distance that
    it means at half the height of the skeleton, and standing feet where they are. `contacts` of the motion, at their own rate,
    have when the feet stand; without any, slow feet stand.

    Returns:
        The errors of the reduction, None without one.

    Raises:
        WriteError: If `target` is not writable.
    """
    count, positions = len(skeleton.names), skeleton.rest_positions
    nodes: list[dict[str, Any]] = [
        {"name": name, "translation": offset.tolist()} for name, offset in zip(skeleton.names, skeleton.offsets, strict=True)
    ]
    for joint, parent in enumerate(skeleton.parents):
        if parent >= 0:
            nodes[parent].setdefault("children", []).append(joint)
    document: dict[str, Any] = {
        "asset": GLTF_ASSET,
        "scene": 0,
        "scenes": [{"nodes": [0, count]}],
        "nodes": [*nodes, {"name": "Bones", "mesh": 0, "skin": 0}],
    }
    buffer = GltfBuffer(document)
    add_test_skin(buffer, skeleton.parents, positions, np.tile(np.eye(3), (count, 1, 1)), positions + skeleton.ends)
    leg_length_m = float(np.ptp(positions[:, 1])) / 2
    legs = None
    if key_error_rad is not None:
        from mocapfix.characters.cmu31_character import build_cmu31_character, convert_motion  # few cleanings need them
        from mocapfix.write.standing_feet import build_leg_curves

        legs = build_leg_curves(build_cmu31_character(skeleton), convert_motion(motion, rate), contacts)
    keys = select_motion_keys(range(count), motion.local_rotations, motion.root_position, key_error_rad, leg_length_m, legs)
    add_animation(buffer, target.stem, keys, range(count), 0, 1.0, rate)
    with replace_atomically(Path(target)) as part:
        part.write_bytes(build_glb(GlbContent(document, buffer.finish())))
    if key_error_rad is None:
        return None

    def compute_points(root: Float[np.ndarray, "T 3"], rotations: Float[np.ndarray, "T J 3 3"]) -> Float[np.ndarray, "T P 3"]:
        offsets = np.tile(skeleton.offsets, (len(root), 1, 1))
        offsets[:, 0] = root
        heads, axes = compose_transforms(skeleton.parents, offsets, rotations)
        return np.concatenate([heads, heads + (axes @ np.nan_to_num(skeleton.ends)[..., None])[..., 0]], axis=1)

    return measure_key_reduction(keys, motion.local_rotations, key_error_rad, compute_points, legs)
