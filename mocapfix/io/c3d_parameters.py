"""Header and parameters of a C3D file, read with the `c3d` library, whose gaps are closed here."""

import io
import math
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import c3d
import numpy as np

from mocapfix.model.take import C3D_BLOCK_BYTES, DEC_PROCESSOR, INTEL_PROCESSOR, MAX_C3D_WORD, SGI_PROCESSOR

PROCESSOR_TYPES = (INTEL_PROCESSOR, DEC_PROCESSOR, SGI_PROCESSOR)
VICON_OUTPUT_GROUPS = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS", "REACTIONS")
VICON_MARKER_GROUPS = ("MODELED_MARKERS", "MODELED_MARKER")  # lists of outputs that are positions


@dataclass(frozen=True)
class C3dParameters:
    """What a C3D file declares about itself, in its own units.

    Attributes:
        processor_type: One of PROCESSOR_TYPES.
        point_count: Points per frame, by POINT:USED.
        header_point_count: Points per frame, by the header.
        header_analog_words: Analog values after the points of a frame, by the header's third word.
        header_samples_per_frame: Analog samples of a channel in a frame, by the header's tenth word.
        analog_channel_count: ANALOG:USED, None if not given.
        analog_rate: ANALOG:RATE, NaN if not given.
        header_data_block: Number of the first block of data by the header, 0 if not given.
        data_start_block: POINT:DATA_START, 0 if not given.
        section_end_byte: First block boundary after the last parameter.
        scale_factor: POINT:SCALE, negative if samples are floats.
        header_scale_factor: The same by the header.
        rate: Frames per second.
        header_rate: The same by the header.
        unit_name: POINT:UNITS, "" if not given.
        screen_axis: The file axis that its program draws upwards, such as "+Z", "" if not given.
        labels: Labels of all points, without blanks around them. There may be more or fewer than points.
        descriptions: Descriptions of the points, if there are any.
        model_outputs: Labels of the points that the file lists as angles, forces and other outputs that are no positions.
        modelled_markers: Labels of the points that the file lists as computed positions.
        subject_names: Names of the subjects that the file lists, as Vicon's files do.
        first_frame: Number of the first frame.
        header_frame_count: Number of frames by the header.
        frame_counts: Numbers of frames by header and parameters; the header's words end at 65535.
        is_count_saturated: Whether the header's last frame is 65535 and no parameter declares more.
    """

    processor_type: int
    point_count: int
    header_point_count: int
    header_analog_words: int
    header_samples_per_frame: int
    analog_channel_count: int | None
    analog_rate: float
    header_data_block: int
    data_start_block: int
    section_end_byte: int
    scale_factor: float
    header_scale_factor: float
    rate: float
    header_rate: float
    unit_name: str
    screen_axis: str
    labels: tuple[str, ...]
    descriptions: tuple[str, ...]
    model_outputs: frozenset[str]
    modelled_markers: frozenset[str]
    subject_names: tuple[str, ...]
    first_frame: int
    header_frame_count: int
    frame_counts: tuple[int, ...]
    is_count_saturated: bool


def read_c3d_parameters(data: bytes) -> C3dParameters:
    """Return what the C3D file with the bytes `data` declares about itself.

    Raises:
        ValueError: If the header or a parameter is invalid (C3D User Guide, "The Header Section" and "The Parameter Section").
    """
    try:
        return _parse_parameters(data)
    except Exception as error:  # the library fails on damaged files with exceptions of any kind
        raise ValueError(str(error)) from error


def _parse_parameters(data: bytes) -> C3dParameters:
    processor_type = data[C3D_BLOCK_BYTES * (data[0] - 1) + 3]
    if processor_type not in PROCESSOR_TYPES:
        raise ValueError(f"unknown processor type {processor_type}")
    reader = open_c3d_reader(data)
    header = reader.header
    first = _read_whole_number(reader, "TRIAL:ACTUAL_START_FIELD")
    last = _read_whole_number(reader, "TRIAL:ACTUAL_END_FIELD")
    trial_frame_count = last - first + 1 if last and first is not None else None
    header_frame_count = header.last_frame - header.first_frame + 1
    if first is not None and first > MAX_C3D_WORD:  # the header's words are cut off or have overflowed
        header_frame_count = trial_frame_count or 0
    declared = (_read_whole_number(reader, name) for name in ("POINT:FRAMES", "POINT:LONG_FRAMES"))
    counts = tuple(n for n in (header_frame_count, *declared, trial_frame_count) if n is not None)
    return C3dParameters(
        processor_type=processor_type,
        point_count=int(reader.point_used),
        header_point_count=header.point_count,
        header_analog_words=header.analog_count,
        header_samples_per_frame=header.analog_per_frame,
        analog_channel_count=_read_whole_number(reader, "ANALOG:USED"),
        analog_rate=_read_float(reader, "ANALOG:RATE"),
        header_data_block=header.data_block,
        data_start_block=_read_whole_number(reader, "POINT:DATA_START") or 0,
        section_end_byte=-(-reader.stop_byte // C3D_BLOCK_BYTES) * C3D_BLOCK_BYTES,
        scale_factor=float(reader.point_scale),
        header_scale_factor=float(header.scale_factor),
        rate=float(reader.point_rate),
        header_rate=float(header.frame_rate),
        unit_name=next(iter(read_texts(reader, "POINT:UNITS")), ""),
        screen_axis="".join(read_texts(reader, "POINT:Y_SCREEN")).upper(),
        labels=tuple(_read_text_series(reader, "POINT:LABELS")),
        descriptions=tuple(_read_descriptions(reader)),
        model_outputs=frozenset(_read_model_outputs(reader)),
        modelled_markers=frozenset(_read_listed_labels(reader, VICON_MARKER_GROUPS)),
        subject_names=tuple(name for name in read_texts(reader, "SUBJECTS:NAMES") if name),
        first_frame=header.first_frame if first is None else first,
        header_frame_count=header_frame_count,
        frame_counts=counts,
        is_count_saturated=header.last_frame == MAX_C3D_WORD and max(*counts, last or 0) <= MAX_C3D_WORD,
    )


def open_c3d_reader(data: bytes) -> "LenientReader":
    """Return the library's reader of the header and parameters in the bytes of a file. It fails with exceptions of any kind."""
    with warnings.catch_warnings(action="ignore"):
        # Buffered, because a BytesIO reads everything for the negative length in a broken chain of parameters.
        return LenientReader(io.BufferedReader(io.BytesIO(data)))


class _LenientGroup(c3d.Group):
    """Parameters by name. Of two with the same name, as BODYMASS in some Vicon files, the first is kept."""

    def add_param(self, name: str, **value: Any) -> None:
        if name.upper() not in self:
            super().add_param(name, **value)


class LenientReader(c3d.Reader):
    """The library's reader, without its checks for contradictions that do not matter here.

    Attributes:
        stop_byte: End of the last parameter.
    """

    def __init__(self, handle: io.BufferedReader) -> None:
        super().__init__(handle)
        self.stop_byte = handle.tell()

    def add_group(self, *args: Any, **options: Any) -> c3d.Group:
        group = super().add_group(*args, **options)
        group.__class__ = _LenientGroup  # the library creates its groups itself
        return group

    def _check_metadata(self) -> None:
        """Check nothing: CMU's files disagree on the analog rate, and the rest is compared with the file's size instead."""


def _read_whole_number(reader: LenientReader, name: str) -> int | None:
    """Return a whole number stored as one 16-bit word, two (the low one first) or a float; None if there is none."""
    parameter = reader.get(name)
    if parameter is None or not parameter.bytes:
        return None
    if parameter.bytes_per_element == 4:
        return int(np.ravel(parameter.float_array if parameter.dimensions else parameter.float_value)[0])
    words = np.ravel(parameter.uint16_array if parameter.dimensions else parameter.uint16_value)
    return sum(int(word) << 16 * i for i, word in enumerate(words))


def _read_float(reader: LenientReader, name: str) -> float:
    """Return a number stored as a float, NaN if there is none."""
    parameter = reader.get(name)
    if parameter is None or parameter.bytes_per_element != 4 or not parameter.bytes:
        return math.nan
    return float(np.ravel(parameter.float_array if parameter.dimensions else parameter.float_value)[0])


def read_texts(reader: LenientReader, name: str) -> list[str]:
    """Return the texts of a parameter, without blanks around them; none if there is no such parameter."""
    parameter = reader.get(name)
    if parameter is None:
        return []
    texts = np.ravel(parameter.string_array) if len(parameter.dimensions) > 1 else [parameter.string_value]
    return [text.strip(" \0\t\r\n") for text in texts]


def _read_text_series(reader: LenientReader, name: str) -> list[str]:
    """Return a list that is spread over NAME, NAME2, NAME3 ...: a parameter has at most 255 labels."""
    texts, number = read_texts(reader, name), 2
    while reader.get(f"{name}{number}") is not None:
        texts += read_texts(reader, f"{name}{number}")
        number += 1
    return texts


def _read_descriptions(reader: LenientReader) -> list[str]:
    """Return the descriptions of the points; none if they are in an unknown encoding."""
    try:
        return _read_text_series(reader, "POINT:DESCRIPTIONS")
    except UnicodeDecodeError:
        return []


def _read_model_outputs(reader: LenientReader) -> list[str]:
    """Return the labels in POINT:ANGLES and similar lists; TYPE_GROUPS names further lists."""
    groups = {*VICON_OUTPUT_GROUPS, *read_texts(reader, "POINT:TYPE_GROUPS")} - {"", *VICON_MARKER_GROUPS}
    return _read_listed_labels(reader, groups)


def _read_listed_labels(reader: LenientReader, groups: Iterable[str]) -> list[str]:
    return [label for group in groups for label in _read_text_series(reader, f"POINT:{group}") if label]
