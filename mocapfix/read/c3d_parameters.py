"""What a C3D's header and parameters say, through the `c3d` library, and without its gaps."""

import io
import warnings
from dataclasses import dataclass

import c3d
import numpy as np

PROCESSOR_TYPES = (84, 85, 86)  # Intel, DEC, SGI/MIPS
MAX_HEADER_WORD = 65_535  # that a word holds
VICON_OUTPUT_GROUPS = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS", "REACTIONS", "MODELED_MARKERS")


@dataclass(frozen=True)
class C3dParameters:
    """A C3D's description of itself, in its own units.

    labels       of all points, blanks stripped, as many as the file has (more or fewer than points)
    outputs      labels of the points that the file itself lists as model outputs
    subjects     names of the people that the file lists, as Vicon's do
    vertical     "+Z" or the like, the file's axis that its makers show upwards; empty where not given
    units        POINT:UNITS; empty where not given
    start        offset in bytes of the first frame
    header_frames, promised  frames by the header, and by whichever of header and parameters promises most: the
                 header's words end at 65,535
    saturated    does nothing promise more than those words can?
    """

    processor_type: int
    point_count: int
    header_point_count: int
    analog_values_per_frame: int
    data_start_byte: int
    scale_factor: float
    rate: float
    unit_name: str
    screen_axis: str
    labels: tuple[str, ...]
    model_outputs: frozenset[str]
    subject_names: tuple[str, ...]
    first_frame: int
    header_frame_count: int
    declared_frame_count: int
    is_count_saturated: bool


def read_c3d_parameters(data: bytes) -> C3dParameters:
    """-> what the C3D in `data` says of itself.

    Raises ValueError where the header or a parameter cannot be made sense of (C3D User Guide, chapters "The Header
    Section" and "The Parameter Section").
    """
    try:
        return _parse_parameters(data)
    except Exception as error:  # the library trips over damaged files in any way there is
        raise ValueError(str(error)) from error


def _parse_parameters(data: bytes) -> C3dParameters:
    processor = data[512 * (data[0] - 1) + 3]
    if processor not in PROCESSOR_TYPES:
        raise ValueError(f"unknown processor type {processor}")
    with warnings.catch_warnings(action="ignore"):
        # Buffered, for a plain BytesIO takes the negative length in a broken chain of parameters for "all the rest".
        reader = _LenientReader(io.BufferedReader(io.BytesIO(data)))
    header = reader.header
    first, last = _read_whole_number(reader, "TRIAL:ACTUAL_START_FIELD"), _read_whole_number(reader, "TRIAL:ACTUAL_END_FIELD")
    trial_frames = last - first + 1 if last and first is not None else None
    header_frames = header.last_frame - header.first_frame + 1
    if first is not None and first > MAX_HEADER_WORD:  # than the header's words, cut off or run over, can tell
        header_frames = trial_frames or 0
    counts = (
        header_frames,
        _read_whole_number(reader, "POINT:FRAMES"),
        _read_whole_number(reader, "POINT:LONG_FRAMES"),
        trial_frames,
    )
    promised = max(n for n in counts if n is not None)
    return C3dParameters(
        processor_type=processor,
        point_count=int(reader.point_used),
        header_point_count=header.point_count,
        analog_values_per_frame=header.analog_count,
        data_start_byte=512 * ((header.data_block or _read_whole_number(reader, "POINT:DATA_START") or 1) - 1),
        scale_factor=float(reader.point_scale),
        rate=float(reader.point_rate),
        unit_name=next(iter(_read_texts(reader, "POINT:UNITS")), ""),
        screen_axis="".join(_read_texts(reader, "POINT:Y_SCREEN")).upper(),
        labels=tuple(_read_text_series(reader, "POINT:LABELS")),
        model_outputs=frozenset(_read_model_outputs(reader)),
        subject_names=tuple(name for name in _read_texts(reader, "SUBJECTS:NAMES") if name),
        first_frame=header.first_frame if first is None else first,
        header_frame_count=header_frames,
        declared_frame_count=promised,
        is_count_saturated=header.last_frame == MAX_HEADER_WORD and promised <= MAX_HEADER_WORD,
    )


class _LenientGroup(c3d.Group):
    """Parameters by name; of two that have one name, as Vicon's BODYMASS sometimes, the first stays."""

    def add_param(self, name: str, **value) -> None:
        if name.upper() not in self:
            super().add_param(name, **value)


class _LenientReader(c3d.Reader):
    """The library's reader, without its refusals of contradictions that do not matter here."""

    def add_group(self, *args, **options) -> c3d.Group:
        group = super().add_group(*args, **options)
        group.__class__ = _LenientGroup  # the library makes its groups itself
        return group

    def _check_metadata(self) -> None:
        """CMU's files disagree on the analog rate; what matters here is held against the file's length instead."""


def _read_whole_number(reader: _LenientReader, name: str) -> int | None:
    """A whole number, stored as a 16-bit word, as two (the low one first), or as a float; None where there is none."""
    parameter = reader.get(name)
    if parameter is None or not parameter.bytes:
        return None
    if parameter.bytes_per_element == 4:
        return int(np.ravel(parameter.float_array if parameter.dimensions else parameter.float_value)[0])
    words = np.ravel(parameter.uint16_array if parameter.dimensions else parameter.uint16_value)
    return sum(int(word) << 16 * i for i, word in enumerate(words))


def _read_texts(reader: _LenientReader, name: str) -> list[str]:
    parameter = reader.get(name)
    if parameter is None:
        return []
    texts = np.ravel(parameter.string_array) if len(parameter.dimensions) > 1 else [parameter.string_value]
    return [text.strip(" \0\t\r\n") for text in texts]


def _read_text_series(reader: _LenientReader, name: str) -> list[str]:
    """One list spread over NAME, NAME2, NAME3 ...: a parameter holds 255 labels at most."""
    texts, more = _read_texts(reader, name), 2
    while reader.get(f"{name}{more}") is not None:
        texts += _read_texts(reader, f"{name}{more}")
        more += 1
    return texts


def _read_model_outputs(reader: _LenientReader) -> list[str]:
    """Labels listed in POINT:ANGLES and its like; TYPE_GROUPS names lists beside the usual ones."""
    groups = {*VICON_OUTPUT_GROUPS, *_read_texts(reader, "POINT:TYPE_GROUPS")} - {""}
    return [label for group in groups for label in _read_text_series(reader, f"POINT:{group}")]
