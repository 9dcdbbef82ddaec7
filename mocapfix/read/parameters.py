"""What a C3D's header and parameters say, through the `c3d` library, and without its gaps."""

import io
import warnings
from dataclasses import dataclass

import c3d
import numpy as np

ENCODINGS = (84, 85, 86)  # Intel, DEC, SGI/MIPS
LARGEST = 65_535  # that a word holds
VICON_OUTPUTS = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS", "REACTIONS", "MODELED_MARKERS")


@dataclass(frozen=True)
class Parameters:
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

    processor: int
    points: int
    header_points: int
    analog: int
    start: int
    scale: float
    rate: float
    units: str
    vertical: str
    labels: tuple[str, ...]
    outputs: frozenset[str]
    subjects: tuple[str, ...]
    first_frame: int
    header_frames: int
    promised: int
    saturated: bool


def parameters(data: bytes) -> Parameters:
    """-> what the C3D in `data` says of itself.

    Raises ValueError where the header or a parameter cannot be made sense of (C3D User Guide, chapters "The Header
    Section" and "The Parameter Section").
    """
    try:
        return _parameters(data)
    except Exception as error:  # the library trips over damaged files in any way there is
        raise ValueError(str(error)) from error


def _parameters(data: bytes) -> Parameters:
    processor = data[512 * (data[0] - 1) + 3]
    if processor not in ENCODINGS:
        raise ValueError(f"unknown processor type {processor}")
    with warnings.catch_warnings(action="ignore"):
        # Buffered, for a plain BytesIO takes the negative length in a broken chain of parameters for "all the rest".
        reader = _Reader(io.BufferedReader(io.BytesIO(data)))
    header = reader.header
    first, last = _whole(reader, "TRIAL:ACTUAL_START_FIELD"), _whole(reader, "TRIAL:ACTUAL_END_FIELD")
    trial_frames = last - first + 1 if last and first is not None else None
    header_frames = header.last_frame - header.first_frame + 1
    if first is not None and first > LARGEST:  # than the header's words, cut off or run over, can tell
        header_frames = trial_frames or 0
    counts = (header_frames, _whole(reader, "POINT:FRAMES"), _whole(reader, "POINT:LONG_FRAMES"), trial_frames)
    promised = max(n for n in counts if n is not None)
    return Parameters(
        processor=processor,
        points=int(reader.point_used),
        header_points=header.point_count,
        analog=header.analog_count,
        start=512 * ((header.data_block or _whole(reader, "POINT:DATA_START") or 1) - 1),
        scale=float(reader.point_scale),
        rate=float(reader.point_rate),
        units=next(iter(_texts(reader, "POINT:UNITS")), ""),
        vertical="".join(_texts(reader, "POINT:Y_SCREEN")).upper(),
        labels=tuple(_series(reader, "POINT:LABELS")),
        outputs=frozenset(_outputs(reader)),
        subjects=tuple(name for name in _texts(reader, "SUBJECTS:NAMES") if name),
        first_frame=header.first_frame if first is None else first,
        header_frames=header_frames,
        promised=promised,
        saturated=header.last_frame == LARGEST and promised <= LARGEST,
    )


class _Group(c3d.Group):
    """Parameters by name; of two that have one name, as Vicon's BODYMASS sometimes, the first stays."""

    def add_param(self, name: str, **value) -> None:
        if name.upper() not in self:
            super().add_param(name, **value)


class _Reader(c3d.Reader):
    """The library's reader, without its refusals of contradictions that do not matter here."""

    def add_group(self, *args, **options) -> c3d.Group:
        group = super().add_group(*args, **options)
        group.__class__ = _Group  # the library makes its groups itself
        return group

    def _check_metadata(self) -> None:
        """CMU's files disagree on the analog rate; what matters here is held against the file's length instead."""


def _whole(reader: _Reader, name: str) -> int | None:
    """A whole number, stored as a 16-bit word, as two (the low one first), or as a float; None where there is none."""
    parameter = reader.get(name)
    if parameter is None or not parameter.bytes:
        return None
    if parameter.bytes_per_element == 4:
        return int(np.ravel(parameter.float_array if parameter.dimensions else parameter.float_value)[0])
    words = np.ravel(parameter.uint16_array if parameter.dimensions else parameter.uint16_value)
    return sum(int(word) << 16 * i for i, word in enumerate(words))


def _texts(reader: _Reader, name: str) -> list[str]:
    parameter = reader.get(name)
    if parameter is None:
        return []
    texts = np.ravel(parameter.string_array) if len(parameter.dimensions) > 1 else [parameter.string_value]
    return [text.strip(" \0\t\r\n") for text in texts]


def _series(reader: _Reader, name: str) -> list[str]:
    """One list spread over NAME, NAME2, NAME3 ...: a parameter holds 255 labels at most."""
    texts, more = _texts(reader, name), 2
    while reader.get(f"{name}{more}") is not None:
        texts += _texts(reader, f"{name}{more}")
        more += 1
    return texts


def _outputs(reader: _Reader) -> list[str]:
    """Labels listed in POINT:ANGLES and its like; TYPE_GROUPS names lists beside the usual ones."""
    groups = {*VICON_OUTPUTS, *_texts(reader, "POINT:TYPE_GROUPS")} - {""}
    return [label for group in groups for label in _series(reader, f"POINT:{group}")]
