"""Read the vertical forces of the force plates in a C3D file (C3D User Guide, "The FORCE_PLATFORM Group")."""

import struct
from dataclasses import dataclass, replace
from mmap import mmap

import numpy as np
from jaxtyping import Float

from mocapfix.io.c3d_parameters import C3dHead
from mocapfix.model.take import MAX_C3D_WORD, C3dLayout

VERTICAL_CHANNELS = {1: (2,), 2: (2,), 3: (4, 5, 6, 7), 4: (2,)}  # by type of plate, whose sum is the vertical force
CALIBRATED_TYPE = 4


@dataclass(frozen=True)
class ForcePlate:
    """One force plate."""

    # (N,) newtons, positive under load, `rate` samples per second from the first frame on
    vertical_force_n: Float[np.ndarray, " N"]
    rate: float
    corners: Float[np.ndarray, "4 3"]  # m, Y up

    def select_interval(self, start_s: float, duration_s: float) -> "ForcePlate":
        """Return the plate from a time after the first frame on, for a duration."""
        start, count = round(start_s * self.rate), round(duration_s * self.rate)
        return replace(self, vertical_force_n=self.vertical_force_n[start : start + count])


def read_force_plates(data: bytes | mmap, layout: C3dLayout, frame_rate: float) -> list[ForcePlate]:
    """Return the force plates in the bytes of a C3D file, none where they are described incompletely; the rate is the take's."""
    if b"FORCE_PLATFORM" not in data[: layout.data_start_byte]:
        return []
    try:
        return _read_plates(data, layout, frame_rate)
    except (ValueError, IndexError, ZeroDivisionError, struct.error):  # damaged or without channels; the markers are read already
        return []


def _read_plates(data: bytes | mmap, layout: C3dLayout, frame_rate: float) -> list[ForcePlate]:
    head = C3dHead(data)
    analog = read_analog(head, layout)
    types = np.array(head.read_numbers("FORCE_PLATFORM:TYPE"), int)
    channels = np.array(head.read_numbers("FORCE_PLATFORM:CHANNEL"), int).reshape(len(types), -1)
    corners = np.array(head.read_numbers("FORCE_PLATFORM:CORNERS")).reshape(-1, 4, 3)
    rate = frame_rate * analog.shape[1]
    zero = [int(number) for number in head.read_numbers("FORCE_PLATFORM:ZERO")]
    plates: list[ForcePlate] = []
    for index, kind in enumerate(types):
        if kind not in VERTICAL_CHANNELS:
            continue
        values = analog.reshape(-1, analog.shape[2])[:, channels[index][channels[index] > 0] - 1]
        if kind == CALIBRATED_TYPE:
            matrix = np.array(head.read_numbers("FORCE_PLATFORM:CAL_MATRIX")).reshape(len(types), 6, 6)[index]
            values = values[:, :6] @ matrix
        force = values[:, VERTICAL_CHANNELS[int(kind)]].sum(1)
        if len(zero) == 2 and 0 < zero[0] <= zero[1]:
            force = force - force[(zero[0] - 1) * analog.shape[1] : zero[1] * analog.shape[1]].mean()
        if abs(force.min()) > force.max():
            force = -force
        place = corners[index] @ layout.rotation_y_up_file.T * layout.unit_m
        plates.append(ForcePlate(np.nan_to_num(force), rate, place))
    return plates


def read_analog(head: C3dHead, layout: C3dLayout) -> Float[np.ndarray, "T S C"]:
    """Return the analog channels of a file: frames, samples per frame, channels, in the units of the channels."""
    channel_count = int(head.read_numbers("ANALOG:USED")[0])
    is_unsigned = any("UNSIGNED" in text.upper() for text in head.read_texts("ANALOG:FORMAT"))
    words = layout.view_analog_words(head.data)
    if is_unsigned and not layout.is_float:
        words = words.view(words.dtype.str.replace("i", "u"))
    samples = layout.analog_word_count // channel_count
    values = layout.decode_words(words[:, : samples * channel_count]).reshape(-1, samples, channel_count)
    scale, offset = (np.array(head.read_numbers(f"ANALOG:{name}"))[:channel_count] for name in ("SCALE", "OFFSET"))
    if is_unsigned:
        offset = np.where(offset < 0, offset + MAX_C3D_WORD + 1, offset)
    return (values - offset) * scale * head.read_numbers("ANALOG:GEN_SCALE")[0]
