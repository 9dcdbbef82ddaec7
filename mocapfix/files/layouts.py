"""Where each sample of a C3D lies in its bytes: what reading and patching must agree upon."""

from dataclasses import dataclass, field

import numpy as np


# MERGED: mocapfix.c3d_layout
@dataclass(frozen=True)
class C3dLayout:
    """The geometry of a C3D's point block and the map from its coordinates to mocapfix's.

    A point is four words, X Y Z and the residual word: 32-bit floats, or 16-bit integers times `scale`.
    mocapfix's metres, Y up, are `axes @ xyz * unit`, and the file's own `axes.T @ markers / unit`.
    """

    processor_type: int  # 84 Intel, 85 DEC (VAX floats), 86 SGI/MIPS (big endian)
    is_float: bool
    scale_factor: float  # |POINT:SCALE|: metres-free counts to file units; scales residuals in float files too
    data_start_byte: int  # offset in bytes of the first point of the first frame
    frame_stride_bytes: int  # bytes from one frame's first point to the next frame's: points, then analog
    point_count: int  # points in a frame, markers and others
    frame_count: int
    unit_m: float  # metres per file unit
    rotation_y_up_file: np.ndarray  # (3, 3) rotation: file axes -> Y up

    @property
    def word_size_bytes(self) -> int:
        return 4 if self.is_float else 2

    @property
    def word_dtype(self) -> np.dtype:
        """The dtype of one stored word; a DEC float is shown as its raw 32 bits, little endian."""
        if self.is_float:
            return np.dtype({84: "<f4", 85: "<u4", 86: ">f4"}[self.processor_type])
        return np.dtype({84: "<i2", 85: "<i2", 86: ">i2"}[self.processor_type])

    def view_words(self, data: bytes | bytearray | memoryview) -> np.ndarray:
        """-> (frames, points, 4) stored words as a view of `data`, writable where `data` is."""
        shape = (self.frame_count, self.point_count, 4)
        strides = (self.frame_stride_bytes, 4 * self.word_size_bytes, self.word_size_bytes)
        return np.ndarray(shape, self.word_dtype, data, self.data_start_byte, strides)


# MERGED: mocapfix.table_layout
# Where each sample of a text file lies in its lines: what reading and patching must agree upon.
@dataclass(frozen=True)
class TableLayout:
    """The geometry of a table of trajectories, a line a frame, and the map from its coordinates to mocapfix's.

    A point is three fields of each frame's line. mocapfix's metres, Y up, are `axes @ xyz * unit`, and the file's own
    `axes.T @ markers / unit`.
    """

    encoding: str  # of the file; a byte-order mark is the first character of its text
    newline: str  # between lines; of "\r\n" the "\r" is each line's last character
    delimiter: str  # between fields
    decimal_sign: str  # the decimal sign: "." or ","
    unit_m: float  # metres per file unit
    line_indices: np.ndarray = field(default_factory=lambda: np.zeros(0, int))  # (T,) index of each frame's line in the file
    field_indices: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), int))  # (P, 3) of a line, with a point's x, y, z
    number_format: str = ".6f"  # how a coordinate is written, as in format()
    missing_text: str = ""  # how a coordinate that is not there is written: "", "NaN", "0.000"
    rotation_y_up_file: np.ndarray = field(default_factory=lambda: np.eye(3))  # rotation: file axes -> Y up

    @property
    def has_field_per_sample(self) -> bool:
        """Is there a place in the file for every sample? Not where its lines list only what was seen."""
        return len(self.field_indices) > 0

    def format_coordinate(self, coordinate: float) -> str:
        """-> a coordinate in file units as the file writes it; NaN is missing."""
        if coordinate != coordinate:
            return self.missing_text
        return format(coordinate, self.number_format).replace(".", self.decimal_sign)
