"""Animations that are appended to a glTF document."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from mocapfix.write.gltf_buffer import GltfBuffer
from mocapfix.write.key_reduction import MotionKeys


def add_animation(
    buffer: GltfBuffer, name: str, keys: MotionKeys, nodes: Sequence[int], position_node: int, position_scale: float, rate: float
) -> None:
    """Add an animation to the document. Curves with the same keys share their times.

    Args:
        buffer: The buffer and the document.
        name: Name of the animation.
        keys: The curves and their keys.
        nodes: Node of each curve of rotations.
        position_node: Node of the curve of positions.
        position_scale: Metres in a unit of its parent.
        rate: Frames per second.
    """
    times: dict[bytes, int] = {}

    def add_times(kept: Bool[np.ndarray, " T"]) -> int:
        key = kept.tobytes()
        if key not in times:
            times[key] = buffer.add_array(np.flatnonzero(kept) / rate, "SCALAR", has_bounds=True)
        return times[key]

    position = keys.position[keys.position_keys] / position_scale
    samplers = [{"input": add_times(keys.position_keys), "output": buffer.add_array(position, "VEC3")}]
    channels = [{"sampler": 0, "target": {"node": position_node, "path": "translation"}}]
    for node, rotation, kept in zip(nodes, keys.rotations, keys.rotation_keys, strict=True):
        channels.append({"sampler": len(samplers), "target": {"node": node, "path": "rotation"}})
        samplers.append({"input": add_times(kept), "output": buffer.add_array(rotation[kept], "VEC4")})
    samplers = [each | {"interpolation": "LINEAR"} for each in samplers]
    buffer.document.setdefault("animations", []).append({"name": name, "channels": channels, "samplers": samplers})
