"""The container of binary glTF (.glb): a JSON document, the binary chunk, and chunks of other programs.

Source: Khronos, glTF 2.0, section 4 (GLB File Format).

Arrays that are appended to a glTF document and its binary chunk. What is in them stays byte by byte.
"""

import json
import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from jaxtyping import Shaped

from mocapfix.errors import ReadError, WriteError

GLB_MAGIC = b"glTF"
GLB_VERSION = 2
GLB_HEADER = struct.Struct("<4sII")
GLB_CHUNK_HEADER = struct.Struct("<II")
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942
CHUNK_ALIGNMENT = 4
"""bytes; every chunk begins and ends at a multiple of it"""
MAX_GLB_BYTES = 2**32 - 1
"""the length of the file is stored in four bytes"""


@dataclass(frozen=True)
class GlbContent:
    """The content of a .glb.

    document      the JSON document, an object
    binary        the binary chunk with its padding, empty if there is none
    other_chunks  type and content of each further chunk
    """

    document: dict[str, Any]
    binary: bytes
    other_chunks: tuple[tuple[int, bytes], ...] = ()


def is_glb(head: bytes) -> bool:
    """Return whether a file with this beginning is a GLB."""
    return head.startswith(GLB_MAGIC)


def parse_glb(path: Path, data: bytes) -> GlbContent:
    """Return the content of a GLB. Bytes after its declared length are ignored.

    Raises:
        ReadError: If the container or its JSON is damaged. The message names the file.
    """
    if len(data) < GLB_HEADER.size + GLB_CHUNK_HEADER.size or not is_glb(data):
        raise ReadError(f"{path}: is no GLB, or was cut off within its header; export it again.")
    _, version, length = GLB_HEADER.unpack_from(data)
    if version != GLB_VERSION:
        raise ReadError(f"{path}: is version {version} of GLB, and only version {GLB_VERSION} is read; export it as glTF 2.0.")
    if length > len(data):
        raise ReadError(f"{path}: was cut off: it has {len(data)} of {length} bytes; copy or export it again.")
    chunks = list(_split_chunks(path, data[:length]))
    if chunks[0][0] != JSON_CHUNK:
        raise ReadError(f"{path}: its first chunk is not JSON; export it again.")
    binary = chunks[1][1] if len(chunks) > 1 and chunks[1][0] == BINARY_CHUNK else b""
    other_chunks = tuple(chunks[2 if binary else 1 :])
    return GlbContent(parse_gltf_document(path, chunks[0][1]), binary, other_chunks)


def _split_chunks(path: Path, data: bytes) -> list[tuple[int, bytes]]:
    """Return type and content of each chunk."""
    chunks: list[tuple[int, bytes]] = []
    start = GLB_HEADER.size
    while start + GLB_CHUNK_HEADER.size <= len(data):
        length, kind = GLB_CHUNK_HEADER.unpack_from(data, start)
        start += GLB_CHUNK_HEADER.size
        if start + length > len(data):
            raise ReadError(f"{path}: chunk {len(chunks) + 1} has {length} bytes and ends beyond the file; export it again.")
        chunks.append((kind, data[start : start + length]))
        start += length
    return chunks


def parse_gltf_document(path: Path, data: bytes) -> dict[str, Any]:
    """Return the JSON document of a glTF file. Raises ReadError if it is not one object of valid JSON with finite numbers."""

    def refuse_constant(text: str) -> NoReturn:
        raise ValueError(f"{text} is not a number of JSON")

    def parse_finite(text: str) -> float:
        number = float(text)
        return number if math.isfinite(number) else refuse_constant(text)

    try:
        document = json.loads(data.decode("utf-8-sig"), parse_constant=refuse_constant, parse_float=parse_finite)
    except UnicodeDecodeError as error:
        raise ReadError(f"{path}: its JSON is not valid UTF-8 at byte {error.start}; export it again.") from error
    except json.JSONDecodeError as error:
        problem = f"{error.msg} in line {error.lineno}, column {error.colno}"
        raise ReadError(f"{path}: its JSON is damaged ({problem}); export it again.") from error
    except (ValueError, RecursionError) as error:
        problem = "it is nested too deeply" if isinstance(error, RecursionError) else str(error).split(";")[0]
        raise ReadError(f"{path}: its JSON is invalid ({problem}); export it again.") from error
    if not isinstance(document, dict):
        raise ReadError(f"{path}: its JSON is no object, so it is no glTF; export it again.")
    return document


def build_glb(content: GlbContent) -> bytes:
    """Return the bytes of a GLB. Raises WriteError if they are more than the format can hold."""
    try:
        encoded = json.dumps(content.document, ensure_ascii=False, separators=(",", ":")).encode()
    except UnicodeEncodeError:  # half of a surrogate pair, which only an escape can give
        encoded = json.dumps(content.document, separators=(",", ":")).encode()
    chunks = [(JSON_CHUNK, encoded + b" " * (-len(encoded) % CHUNK_ALIGNMENT))]
    if content.binary:
        chunks.append((BINARY_CHUNK, content.binary + bytes(-len(content.binary) % CHUNK_ALIGNMENT)))
    chunks += content.other_chunks
    length = GLB_HEADER.size + sum(GLB_CHUNK_HEADER.size + len(chunk) for _, chunk in chunks)
    if length > MAX_GLB_BYTES:
        raise WriteError(f"A GLB of {length / 1e9:.1f} GB cannot be written, as the format ends at 4.3 GB; use a smaller mesh.")
    parts = [GLB_HEADER.pack(GLB_MAGIC, GLB_VERSION, length)]
    for kind, chunk in chunks:
        parts += [GLB_CHUNK_HEADER.pack(len(chunk), kind), chunk]
    return b"".join(parts)


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
