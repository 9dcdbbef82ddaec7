"""Arrays that are appended to a glTF document and its binary chunk. What is in them stays byte by byte."""

from typing import Any

import numpy as np
from jaxtyping import Shaped

GLTF_ASSET = {"version": "2.0", "generator": "mocapfix"}
"""of a document that is not one of the user"""
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
