"""A take as a new C3D: Intel floats, a header, the groups POINT and TRIAL, the samples.

Written here byte by byte (c3d.org, "The C3D file format", sections 2 to 4), for it is nearly the smallest file there can
be, and the libraries that write C3D lose the residual words or long takes.
"""

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mocapfix.errors import WriteError
from mocapfix.files.output_files import replace_atomically
from mocapfix.take import Take
from mocapfix.write.source_file import FileFrame, get_file_frame

BLOCK_BYTES = 512  # bytes
INTEL_PROCESSOR_TYPE = 84  # the processor whose byte order and floats the file has
RESIDUAL_COUNT_M = 1e-4  # metres in a count of the residual
MISSING_RESIDUAL, MEASURED_RESIDUAL, UNKNOWN_SD_RESIDUAL = (
    -1,
    0,
    1,
)  # residual words: not seen; without a residual; put there, nobody knows how surely
MAX_LABEL_BYTES, MAX_LABELS_PER_PARAMETER, MAX_PARAMETER_BYTES = (
    255,
    255,
    32_000,
)  # bytes of a label; labels and bytes in one parameter
MAX_PARAMETER_BLOCKS, MAX_C3D_POINTS, MAX_UINT16 = 255, 65_535, 65_535
UP_AXIS_NAMES = {0: "+X", 1: "+Y", 2: "+Z"}
RIGHT_AXIS_NAMES = {0: "+Y", 1: "+X", 2: "+X"}  # the axis to the right where another one is up


def write_c3d(target: str | Path, take: Take) -> None:
    """Write a take's markers, and behind them its unlabelled trajectories, in the unit and axes that its own file had.

    A measured sample has the residual word 0, one that mocapfix put there its predicted standard deviation in counts of
    0.1 mm, clamped to 1..255, camera mask 0; one that is not there coordinates 0 and residual -1. More than 255 labels go
    on in LABELS2 and so on; numbers of frames beyond the header's 65,535 are in TRIAL and POINT:LONG_FRAMES. C3D counts
    frames from 0 on, so a take that begins before is numbered from 1.

    Raises WriteError where the take has more or longer labels than a C3D can hold, or `target` cannot be written.
    """
    target, form = Path(target), get_file_frame(take)
    labels = [*take.labels, *(take.unlabelled.labels if take.unlabelled else ())]
    encoded = [label.encode("utf-8") or b" " for label in labels]
    if long := next((label for label in encoded if len(label) > MAX_LABEL_BYTES), None):
        raise WriteError(f"{target}: the label {long.decode()[:30]}... is longer than the 255 bytes a C3D can hold; shorten it.")
    first = take.first_frame if take.first_frame >= 0 else 1
    last, points = first + take.frame_count - 1, len(labels)
    start = 2 + len(_encode_parameters(form, take, encoded, first, 0)) // BLOCK_BYTES
    if points > MAX_C3D_POINTS or start - 2 > MAX_PARAMETER_BLOCKS:
        raise WriteError(f"{target}: {points} points with such labels are more than a C3D can hold; write another format.")
    scale, ends = RESIDUAL_COUNT_M / form.unit_m, (min(first, MAX_UINT16), min(last, MAX_UINT16))
    header = struct.pack("<BBHHHHHfHHf", 2, 80, points, 0, *ends, 0, -scale, start, 0, take.rate)
    with replace_atomically(target) as part, part.open("wb") as file:
        file.write(_pad_to_block(header) + _encode_parameters(form, take, encoded, first, start))
        data = _build_words(form, take).tobytes()
        # Where the header's last frame cannot be said, ezc3d would take what fills the last block for frames.
        file.write(data if last > MAX_UINT16 else _pad_to_block(data))


def _encode_parameters(form: FileFrame, take: Take, labels: Sequence[bytes], first: int, start: int) -> bytes:
    """-> whole blocks: the groups POINT and TRIAL, with the number of the `start` block of the samples."""
    last, up = first + take.frame_count - 1, int(np.abs(form.rotation_y_up_file[1]).argmax())
    point = [
        _encode_number("USED", "H", len(labels)),
        _encode_number("FRAMES", "H", min(take.frame_count, MAX_UINT16)),
        _encode_number("LONG_FRAMES", "f", take.frame_count),
        _encode_number("DATA_START", "H", start),
        _encode_number("SCALE", "f", -RESIDUAL_COUNT_M / form.unit_m),
        _encode_number("RATE", "f", take.rate),
        _encode_texts("UNITS", [form.unit_name.encode()]),
        _encode_texts("X_SCREEN", [RIGHT_AXIS_NAMES[up].encode()]),
        _encode_texts("Y_SCREEN", [UP_AXIS_NAMES[up].encode()]),
        *_encode_text_series("LABELS", labels),
        *_encode_text_series("DESCRIPTIONS", [b" "] * len(labels)),
    ]
    trial = [
        _encode_word_pair("ACTUAL_START_FIELD", first),
        _encode_word_pair("ACTUAL_END_FIELD", last),
        _encode_number("CAMERA_RATE", "f", take.rate),
    ]
    chain = _encode_group(1, "POINT", point) + _encode_group(2, "TRIAL", trial)
    blocks = len(_pad_to_block(bytes(4) + chain)) // BLOCK_BYTES
    return _pad_to_block(struct.pack("BBBB", 1, 80, min(blocks, MAX_PARAMETER_BLOCKS), INTEL_PROCESSOR_TYPE) + chain)


def _pad_to_block(data: bytes) -> bytes:
    """-> with zeros up to the end of its last block."""
    return data + bytes(-len(data) % BLOCK_BYTES)


def _encode_group(number: int, name: str, parameters: Sequence[tuple[str, bytes]]) -> bytes:
    """-> the records of a group and of its parameters, without descriptions; a length counts itself and the description's."""
    head = struct.pack("<bb", len(name), -number) + name.encode("ascii") + struct.pack("<hB", 3, 0)
    return head + b"".join(
        struct.pack("<bb", len(each), number) + each.encode("ascii") + struct.pack("<H", len(content) + 3) + content + b"\0"
        for each, content in parameters
    )


def _encode_number(name: str, form: str, value: float) -> tuple[str, bytes]:
    """-> an integer ("H") or a float ("f")."""
    return name, struct.pack("<bB" + form, 4 if form == "f" else 2, 0, value)


def _encode_word_pair(name: str, value: int) -> tuple[str, bytes]:
    """-> a whole number as two 16-bit words, the low one first."""
    return name, struct.pack("<bBBHH", 2, 1, 2, value % 2**16, value // 2**16 % 2**16)


def _encode_texts(name: str, texts: Sequence[bytes]) -> tuple[str, bytes]:
    width = max(map(len, texts), default=1)
    shape = [width] if len(texts) == 1 and name != "LABELS" else [width, len(texts)]
    return name, struct.pack("<bB", -1, len(shape)) + bytes(shape) + b"".join(text.ljust(width) for text in texts)


def _encode_text_series(name: str, texts: Sequence[bytes]) -> list[tuple[str, bytes]]:
    """-> one list over NAME, NAME2, NAME3 ..., each of which holds as much as a parameter can."""
    most = min(MAX_LABELS_PER_PARAMETER, MAX_PARAMETER_BYTES // max(map(len, texts), default=1))
    chunks = [texts[i : i + most] for i in range(0, len(texts), most)] or [texts]
    return [_encode_texts(f"{name}{i + 1 if i else ''}", chunk) for i, chunk in enumerate(chunks)]


def _build_words(form: FileFrame, take: Take) -> np.ndarray:
    """-> (T, P, 4) x, y, z in the file's unit and axes, and the residual word; zeros and -1 where nothing is."""
    loose = take.unlabelled.markers if take.unlabelled else np.zeros((take.frame_count, 0, 3))
    xyz = form.compute_coordinates(np.concatenate([take.markers, loose], axis=1))
    words = np.zeros((*xyz.shape[:2], 4), "<f4")
    words[..., :3] = xyz
    made = np.where(take.measured | ~take.visible, MEASURED_RESIDUAL, UNKNOWN_SD_RESIDUAL).astype(float)
    if take.sample_sd is not None:
        residual = np.clip(np.rint(take.sample_sd / RESIDUAL_COUNT_M), 1, 255)
        made = np.where(np.isnan(residual), made, residual)
    words[:, : len(take.labels), 3] = made
    words[np.isnan(xyz).any(-1)] = (0, 0, 0, MISSING_RESIDUAL)
    return words
