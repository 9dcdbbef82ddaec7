"""Where each sample of a C3D lies in its bytes: what reading and patching must agree upon."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class C3DLayout:
    """The geometry of a C3D's point block and the map from its coordinates to mocapfix's.

    A point is four words, X Y Z and the residual word: 32-bit floats, or 16-bit integers times `scale`.
    mocapfix's metres, Y up, are `axes @ xyz * unit`, and the file's own `axes.T @ markers / unit`.
    """

    processor: int  # 84 Intel, 85 DEC (VAX floats), 86 SGI/MIPS (big endian)
    is_float: bool
    scale: float  # |POINT:SCALE|: metres-free counts to file units; scales residuals in float files too
    start: int  # offset in bytes of the first point of the first frame
    frame_bytes: int  # bytes from one frame's first point to the next frame's: points, then analog
    points: int  # points in a frame, markers and others
    frames: int
    unit: float  # metres per file unit
    axes: np.ndarray  # (3, 3) rotation: file axes -> Y up

    @property
    def word_bytes(self) -> int:
        return 4 if self.is_float else 2

    @property
    def word(self) -> np.dtype:
        """The dtype of one stored word; a DEC float is shown as its raw 32 bits, little endian."""
        if self.is_float:
            return np.dtype({84: "<f4", 85: "<u4", 86: ">f4"}[self.processor])
        return np.dtype({84: "<i2", 85: "<i2", 86: ">i2"}[self.processor])

    def words(self, data: bytes | bytearray | memoryview) -> np.ndarray:
        """-> (frames, points, 4) stored words as a view of `data`, writable where `data` is."""
        shape = (self.frames, self.points, 4)
        strides = (self.frame_bytes, 4 * self.word_bytes, self.word_bytes)
        return np.ndarray(shape, self.word, data, self.start, strides)
