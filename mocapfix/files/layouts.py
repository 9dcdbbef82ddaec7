"""Where the samples of a marker file lie in its bytes or lines: created by the readers, used by the patches."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Shaped

# C3D processor types: byte order and floating-point format of the file.
INTEL_PROCESSOR = 84  # little endian, IEEE floats
DEC_PROCESSOR = 85  # little endian, VAX F floats
SGI_PROCESSOR = 86  # big endian, IEEE floats

C3D_BLOCK_BYTES = 512  # sections of a C3D begin at multiples of a block
MAX_C3D_WORD = 65_535  # largest value of a 16-bit word
MAX_RESIDUAL_COUNTS = 255  # largest residual: a residual word has cameras in its high byte and the residual in its low byte


@dataclass(frozen=True)
class C3dLayout:
    """The point block of a C3D file, and the map from its coordinates to those of a take.

    A point is stored as four words: X, Y, Z and the residual word. Words are 32-bit floats, or 16-bit integers that are
    multiplied by `scale_factor`. With coordinates `xyz` in file units and file axes, a take (metres, Y up) has
    `rotation_y_up_file @ xyz * unit_m`; the inverse is `rotation_y_up_file.T @ marker / unit_m`.

    Attributes:
        processor_type: Intel, DEC or SGI.
        is_float: Whether words are 32-bit floats.
        scale_factor: Absolute value of POINT:SCALE. File units per count in integer files, and the unit of the residual in
            both kinds of file.
        data_start_byte: Offset of the first point of the first frame.
        frame_stride_bytes: Bytes from the first point of one frame to that of the next, analog samples included.
        point_count: Points per frame, markers and others.
        frame_count: Number of frames.
        unit_m: Metres per file unit.
        rotation_y_up_file: Rotation from file axes to Y-up axes.
    """

    processor_type: int
    is_float: bool
    scale_factor: float
    data_start_byte: int
    frame_stride_bytes: int
    point_count: int
    frame_count: int
    unit_m: float
    rotation_y_up_file: Float[np.ndarray, "3 3"]

    @property
    def has_vax_floats(self) -> bool:
        """Whether words are VAX F floats: IEEE floats times 4 with their 16-bit halves swapped."""
        return self.is_float and self.processor_type == DEC_PROCESSOR

    @property
    def word_size_bytes(self) -> int:
        """Size of one stored word."""
        return 4 if self.is_float else 2

    @property
    def analog_word_count(self) -> int:
        """Analog samples of a frame, which follow its points."""
        return self.frame_stride_bytes // self.word_size_bytes - 4 * self.point_count

    @property
    def word_dtype(self) -> np.dtype[Any]:
        """Data type of one stored word. A VAX float has the type of its raw bits, a little-endian 32-bit integer."""
        if self.is_float:
            return np.dtype({INTEL_PROCESSOR: "<f4", DEC_PROCESSOR: "<u4", SGI_PROCESSOR: ">f4"}[self.processor_type])
        return np.dtype({INTEL_PROCESSOR: "<i2", DEC_PROCESSOR: "<i2", SGI_PROCESSOR: ">i2"}[self.processor_type])

    def view_words(self, data: bytes | bytearray | memoryview) -> Shaped[np.ndarray, "T P 4"]:
        """Return the stored words of all frames and points as a view of `data`, which is writable if `data` is."""
        shape = (self.frame_count, self.point_count, 4)
        strides = (self.frame_stride_bytes, 4 * self.word_size_bytes, self.word_size_bytes)
        return np.ndarray(shape, self.word_dtype, data, self.data_start_byte, strides)

    def view_analog_words(self, data: bytes | bytearray | memoryview) -> Shaped[np.ndarray, "T A"]:
        """Return the stored analog words of all frames as a view of `data`."""
        size, shape = self.word_size_bytes, (self.frame_count, self.analog_word_count)
        start = self.data_start_byte + 4 * self.point_count * size
        return np.ndarray(shape, self.word_dtype, data, start, (self.frame_stride_bytes, size))

    def decode_words(self, words: Shaped[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
        """Return stored words as numbers, integers in counts."""
        if self.has_vax_floats:
            words = ((words >> 16) | (words << 16)).view("<f4")
        with np.errstate(invalid="ignore"):  # damaged bytes may spell a signalling NaN
            return words.astype(float) / (4 if self.has_vax_floats else 1)


@dataclass(frozen=True)
class TableLayout:
    """A text table of trajectories with one line per frame, and the map from its coordinates to those of a take.

    Each point has three fields in the line of a frame. Coordinates are mapped as by `C3dLayout`.

    Attributes:
        encoding: Text encoding of the file; a byte-order mark is the first character of its text.
        newline: Line separator; with "\\r\\n" the "\\r" is the last character of each line.
        delimiter: Field separator.
        decimal_sign: "." or ",".
        unit_m: Metres per file unit.
        line_indices: Index of the line of each of the T frames, -1 for a frame that has no line.
        field_indices: Index of the X, Y and Z field of each of the P points. Empty if lines list only the visible markers.
        number_format: Format specification of a coordinate, as for `format`.
        missing_text: Text of a missing coordinate, such as "", "NaN" or "0.000".
        rotation_y_up_file: Rotation from file axes to Y-up axes.
    """

    encoding: str
    newline: str
    delimiter: str
    decimal_sign: str
    unit_m: float
    line_indices: Int[np.ndarray, " T"] = field(default_factory=lambda: np.zeros(0, int))
    field_indices: Int[np.ndarray, "P 3"] = field(default_factory=lambda: np.zeros((0, 3), int))
    number_format: str = ".6f"
    missing_text: str = ""
    rotation_y_up_file: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))

    @property
    def has_field_per_sample(self) -> bool:
        """Whether the file has a field for every sample. False if its lines list only the visible markers."""
        return len(self.field_indices) > 0

    def format_coordinate(self, coordinate: float) -> str:
        """Return the text of a coordinate in file units, as the file writes it; NaN means missing."""
        if coordinate != coordinate:
            return self.missing_text
        return format(coordinate, self.number_format).replace(".", self.decimal_sign)
