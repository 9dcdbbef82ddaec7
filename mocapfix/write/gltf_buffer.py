"""Arrays and animations that are appended to a glTF document and its binary chunk. What is in them stays byte by byte."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Shaped

from mocapfix.write.key_reduction import MotionKeys

FLOAT, UNSIGNED_SHORT = 5126, 5123
"""component types of glTF"""
ARRAY_BUFFER = 34962
"""target of the bufferView of vertices"""
ELEMENT_ALIGNMENT = 4
"""bytes"""


class GltfBuffer:
    """The first buffer of a document, the binary chunk of the GLB, with a view and an accessor for each array added to it.

    document  the document, whose lists are extended
    data      the binary chunk so far
    """

    def __init__(self, document: dict[str, Any], data: bytes = b"") -> None:
        self.document = document
        self.data = bytearray(data)

    def add_array(
        self,
        values: Shaped[np.ndarray, "N ..."],
        kind: str,
        target: int | None = None,
        *,
        has_bounds: bool = False,
    ) -> int:
        """Add an array with one element per row, and return the index of its accessor.

        Integers are stored in two bytes (always four of them), other numbers as floats, so that every element lies at a multiple
        of four bytes, as the format requires.
        """
        is_integer = values.dtype.kind == "i"
        values = np.ascontiguousarray(values, "<u2" if is_integer else "<f4")
        self.data += bytes(-len(self.data) % ELEMENT_ALIGNMENT)
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.data), "byteLength": values.nbytes}
        if target is not None:
            view["target"] = target
        self.data += values.tobytes()
        views, accessors = (self.document.setdefault(name, []) for name in ("bufferViews", "accessors"))
        views.append(view)
        component = UNSIGNED_SHORT if is_integer else FLOAT
        accessor: dict[str, Any] = {
            "bufferView": len(views) - 1, "componentType": component, "count": len(values), "type": kind,
        }  # fmt: skip
        if has_bounds:
            rows = values.reshape(len(values), -1)
            accessor |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        accessors.append(accessor)
        return len(accessors) - 1

    def finish(self) -> bytes:
        """Set the length of the buffer in the document, and return the binary chunk."""
        buffers = self.document.setdefault("buffers", [])
        if buffers:
            buffers[0]["byteLength"] = len(self.data)
        else:
            buffers.append({"byteLength": len(self.data)})
        return bytes(self.data)


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
