"""Read the vertical forces of the force plates in a C3D file (C3D User Guide, "The FORCE_PLATFORM Group")."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from mocapfix.io.c3d_parameters import LenientReader, open_c3d_reader, read_texts
from mocapfix.model.take import MAX_C3D_WORD, C3dLayout

VERTICAL_CHANNELS = {1: (2,), 2: (2,), 3: (4, 5, 6, 7), 4: (2,)}
"""the channels of a plate, from 0, whose sum is the vertical force, by the type of the plate; type 4 after calibration"""
CALIBRATED_TYPE = 4


@dataclass(frozen=True)
class ForcePlate:
    """One force plate.

    vertical_force_n  (N,) newtons, positive under load, `rate` samples per second from the first frame on
    corners           (4, 3) m, Y up
    """

    vertical_force_n: Float[np.ndarray, " N"]
    rate: float
    corners: Float[np.ndarray, "4 3"]


def read_force_plates(data: bytes, layout: C3dLayout, frame_rate: float) -> list[ForcePlate]:
    """Return the force plates in the bytes of a C3D file, none where they are described incompletely.

    Args:
        data: The bytes.
        layout: The layout of the file.
        frame_rate: Frames per second of the take, whatever POINT:RATE says.
    """
    if b"FORCE_PLATFORM" not in data[: layout.data_start_byte]:
        return []
    try:
        return _read_plates(data, layout, frame_rate)
    except Exception:  # the library fails on damaged parameters with exceptions of any kind; the markers are read already
        return []


def _read_plates(data: bytes, layout: C3dLayout, frame_rate: float) -> list[ForcePlate]:
    reader = open_c3d_reader(data)
    analog = read_analog(data, layout, reader)
    types = np.ravel(_read_values(reader, "FORCE_PLATFORM:TYPE")).astype(int)
    channels = _read_values(reader, "FORCE_PLATFORM:CHANNEL").astype(int)  # (channels, plates) in the file, plates first here
    corners = _read_values(reader, "FORCE_PLATFORM:CORNERS").reshape(-1, 4, 3)
    channels = channels.reshape(len(types), -1)
    rate = frame_rate * analog.shape[1]
    zero = np.ravel(_read_values(reader, "FORCE_PLATFORM:ZERO")).astype(int) if reader.get("FORCE_PLATFORM:ZERO") else np.zeros(0)
    plates: list[ForcePlate] = []
    for index, kind in enumerate(types):
        if kind not in VERTICAL_CHANNELS:
            continue
        values = analog.reshape(-1, analog.shape[2])[:, channels[index][channels[index] > 0] - 1]
        if kind == CALIBRATED_TYPE:
            matrix = _read_values(reader, "FORCE_PLATFORM:CAL_MATRIX").reshape(len(types), 6, 6)[index]
            values = values[:, :6] @ matrix
        force = values[:, VERTICAL_CHANNELS[int(kind)]].sum(1)
        if len(zero) == 2 and 0 < zero[0] <= zero[1]:
            force = force - force[(zero[0] - 1) * analog.shape[1] : zero[1] * analog.shape[1]].mean()
        if abs(force.min()) > force.max():
            force = -force
        place = corners[index] @ layout.rotation_y_up_file.T * layout.unit_m
        plates.append(ForcePlate(np.nan_to_num(force), rate, place))
    return plates


def read_analog(data: bytes, layout: C3dLayout, reader: LenientReader) -> Float[np.ndarray, "T S C"]:
    """Return the analog channels: frames, samples per frame, channels, in the units of the channels."""
    channel_count = int(np.ravel(_read_values(reader, "ANALOG:USED"))[0])
    is_unsigned = any("UNSIGNED" in text.upper() for text in read_texts(reader, "ANALOG:FORMAT"))
    words = layout.view_analog_words(data)
    if is_unsigned and not layout.is_float:
        words = words.view(words.dtype.str.replace("i", "u"))
    samples = layout.analog_word_count // channel_count
    values = layout.decode_words(words[:, : samples * channel_count]).reshape(-1, samples, channel_count)
    scale = np.ravel(_read_values(reader, "ANALOG:SCALE"))[:channel_count]
    offset = np.ravel(_read_values(reader, "ANALOG:OFFSET"))[:channel_count]
    if is_unsigned:
        offset = np.where(offset < 0, offset + MAX_C3D_WORD + 1, offset)
    general = float(np.ravel(_read_values(reader, "ANALOG:GEN_SCALE"))[0])
    return (values - offset) * scale * general


def _read_values(reader: LenientReader, name: str) -> np.ndarray:
    """Return the numbers of a parameter as the file stores them: floats, or words. Raises an error if it is missing."""
    parameter: Any = reader.get(name)
    if parameter.bytes_per_element == 4:
        return np.asarray(parameter.float_array if parameter.dimensions else [parameter.float_value], float)
    return np.asarray(parameter.int16_array if parameter.dimensions else [parameter.int16_value], float)
