"""Pack a glTF with embedded or side files into one GLB, and check the lists of its document that a writer extends.

The bytes of buffers and images are kept. A GLB without buffers in other files stays as it is.
"""

import base64
import binascii
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from mocapfix.errors import ReadError
from mocapfix.files.glb import MAX_GLB_BYTES, GlbContent, build_glb, is_glb, parse_glb, parse_gltf_document

ALIGNMENT_BYTES = 16
"""of a buffer that is appended to another: enough for every component and for compressed data"""
EXTENDED_LISTS = ("accessors", "bufferViews", "buffers", "animations", "nodes", "meshes", "skins", "scenes")
"""lists of the document in which every entry must be an object"""
COMPRESSION_EXTENSIONS = ("EXT_meshopt_compression", "KHR_meshopt_compression")
"""extensions of a bufferView that refer to a buffer of their own"""
IMAGE_TYPES = {b"\x89PNG": "image/png", b"\xff\xd8\xff": "image/jpeg", b"\xabKTX": "image/ktx2", b"RIFF": "image/webp"}
"""beginning of an image to its type"""


def read_packed_gltf(path: Path, data: bytes) -> tuple[GlbContent, bytes]:
    """Return a glTF, binary or text, as one GLB whose binary chunk holds its buffers: its content and its bytes.

    Buffers in data URIs and side files, and images in side files, are appended to the binary chunk. An image that is missing is
    left as it is: a viewer shows the mesh without it.

    Raises:
        ReadError: If the container, the document or a buffer is damaged or missing. The message names the file.
    """
    content = parse_glb(path, data) if is_glb(data) else GlbContent(parse_gltf_document(path, data), b"")
    _check_document(path, content.document)
    buffers = content.document.get("buffers", [])
    if content.binary and buffers and "uri" not in buffers[0]:
        if buffers[0]["byteLength"] > len(content.binary):
            sizes = f"{buffers[0]['byteLength']} bytes, its binary chunk {len(content.binary)}"
            raise ReadError(f"{path}: its first buffer has {sizes}; the file was cut off, so export it again.")
        if not any("uri" in each for each in buffers) and not _list_side_images(content.document):
            return content, data
    content = _pack(path, content)
    return content, build_glb(content)


def _check_document(path: Path, document: dict[str, Any]) -> None:
    """Raise ReadError unless the version is 2 and the lists that are read or extended have objects in them."""
    asset = document.get("asset")
    version = asset.get("version") if isinstance(asset, dict) else None
    if not isinstance(version, str) or not version.startswith("2."):
        raise ReadError(f"{path}: is glTF version {str(version)[:9]}, and only version 2 is read; export it as glTF 2.0.")
    for name in EXTENDED_LISTS:
        entries = document.get(name, [])
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise ReadError(f"{path}: {name} is no list of objects; the file is damaged, so export it again.")
    for index, buffer in enumerate(document.get("buffers", [])):
        length = buffer.get("byteLength")
        if not isinstance(length, int) or isinstance(length, bool) or not 1 <= length <= MAX_GLB_BYTES:
            raise ReadError(f"{path}: buffers[{index}] has no valid byteLength; the file is damaged, so export it again.")


def _pack(path: Path, content: GlbContent) -> GlbContent:
    """Append all buffers to the binary chunk. Those without data (fallbacks of compressed ones) stay entries of their own."""
    document, packed = content.document, bytearray()
    places: dict[int, tuple[int, int]] = {}  # index of an old buffer: index of its new one, and its first byte there
    kept: list[dict[str, Any]] = []
    for index, buffer in enumerate(document.get("buffers", [])):
        data = _load_buffer(path, index, buffer, content.binary)
        if data is None:
            kept.append(buffer)
            places[index] = (len(kept), 0)
        else:
            places[index] = (0, _append(packed, data))
    for view in document.get("bufferViews", []):
        extensions = view.get("extensions")
        compressions = [extensions.get(name) for name in COMPRESSION_EXTENSIONS] if isinstance(extensions, dict) else []
        for entry in (view, *(each for each in compressions if isinstance(each, dict))):
            _move_view(path, entry, places)
    for image, data, kind in _load_side_images(path, document):
        start = _append(packed, data)
        document.setdefault("bufferViews", []).append({"buffer": 0, "byteOffset": start, "byteLength": len(data)})
        del image["uri"]
        image |= {"bufferView": len(document["bufferViews"]) - 1, "mimeType": kind}
    if packed:
        document["buffers"] = [{"byteLength": len(packed)}, *kept]
    return GlbContent(document, bytes(packed), content.other_chunks)


def _append(packed: bytearray, data: bytes) -> int:
    """Append data at an aligned byte, and return that."""
    packed.extend(bytes(-len(packed) % ALIGNMENT_BYTES))
    start = len(packed)
    packed.extend(data)
    return start


def _move_view(path: Path, view: dict[str, Any], places: dict[int, tuple[int, int]]) -> None:
    """Let a view refer to the place that its buffer has now."""
    index, start = view.get("buffer"), view.get("byteOffset", 0)
    if not isinstance(index, int) or index not in places or not isinstance(start, int):
        raise ReadError(f"{path}: a bufferView refers to buffer {str(index)[:9]}, which is not there; export the file again.")
    view["buffer"] = places[index][0]
    if places[index][1] + start or "byteOffset" in view:
        view["byteOffset"] = places[index][1] + start


def _load_buffer(path: Path, index: int, buffer: dict[str, Any], binary: bytes) -> bytes | None:
    """Return the bytes of a buffer, None if it has none of its own."""
    uri, length = buffer.get("uri"), buffer["byteLength"]
    if uri is None:
        if index > 0 or not binary:
            if isinstance(buffer.get("extensions"), dict):
                return None
            raise ReadError(f"{path}: buffers[{index}] has no data; export the file again, best as .glb.")
        data = binary
    else:
        data = _load_uri(path, f"buffers[{index}]", uri)
    if len(data) < length:
        raise ReadError(f"{path}: buffers[{index}] has {len(data)} of {length} bytes; copy or export its file again.")
    return data[:length]


def _load_uri(path: Path, place: str, uri: object) -> bytes:
    """Return the bytes of a data URI or of a file in the folder of the glTF."""
    if not isinstance(uri, str):
        raise ReadError(f"{path}: the uri of {place} is no text; the file is damaged, so export it again.")
    if uri.startswith("data:"):
        try:
            return base64.b64decode(uri.partition(",")[2], validate=True)
        except (binascii.Error, ValueError) as error:
            raise ReadError(f"{path}: the data of {place} is not valid base64; export the file again.") from error
    side_path = _find_side_file(path, uri)
    if side_path is None:
        problem = "is no file in the folder of the glTF"
        raise ReadError(f"{path}: {uri[:60]!r} of {place} {problem}; put it beside the glTF, or export it as .glb.")
    try:
        return side_path.read_bytes()
    except (OSError, ValueError) as error:
        problem = "cannot be read" if side_path.exists() else "is missing"
        raise ReadError(f"{path}: its file {uri[:60]!r} {problem}; put it beside the glTF, or export it as .glb.") from error


def _find_side_file(path: Path, uri: str) -> Path | None:
    """Return the path of a relative URI within the folder of the glTF, None for all others."""
    try:
        parts = urlsplit(uri)
        side_path = (path.parent / unquote(parts.path)).resolve()
        side_path.exists()
    except (OSError, ValueError):
        return None
    is_inside = not parts.scheme and not parts.netloc and side_path.is_relative_to(path.parent.resolve())
    return side_path if is_inside else None


def _list_side_images(document: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the images that are in files of their own."""
    images = document.get("images", [])
    images = [image for image in images if isinstance(image, dict)] if isinstance(images, list) else []
    return [image for image in images if isinstance(image.get("uri"), str) and not image["uri"].startswith("data:")]


def _load_side_images(path: Path, document: dict[str, Any]) -> list[tuple[dict[str, Any], bytes, str]]:
    """Return the images in files of their own that can be embedded, with their bytes and types."""
    found: list[tuple[dict[str, Any], bytes, str]] = []
    for image in _list_side_images(document):
        side_path = _find_side_file(path, image["uri"])
        try:
            data = side_path.read_bytes() if side_path else b""
        except OSError:
            data = b""
        kind = next((kind for beginning, kind in IMAGE_TYPES.items() if data.startswith(beginning)), None)
        if kind:
            found.append((image, data, kind))
    return found
