"""Marker takes: the trajectories of one recorded performance, and where their samples lie in the bytes or lines of a file."""

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from mmap import mmap
from pathlib import Path
from typing import Any, Literal, SupportsIndex

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from mocapfix.model.system import make_file_name
from mocapfix.stats.point_functions import PointFunction

# C3D processor types: byte order and floating-point format of the file.
INTEL_PROCESSOR = 84  # little endian, IEEE floats
DEC_PROCESSOR = 85  # little endian, VAX F floats
SGI_PROCESSOR = 86  # big endian, IEEE floats

C3D_BLOCK_BYTES = 512  # sections of a C3D begin at multiples of a block
MAX_C3D_WORD = 65_535  # largest value of a 16-bit word
MAX_RESIDUAL_COUNTS = 255  # largest residual: a residual word has cameras in its high byte and the residual in its low byte


SAMPLE_NOISE_M = 0.0005  # noise of a measured sample per axis, caused by the cameras


@dataclass(frozen=True)
class C3dLayout:
    """The point block of a C3D file, and the map from its coordinates to those of a take.

    A point is stored as four words: X, Y, Z and the residual word. Words are 32-bit floats, or 16-bit integers that are
    multiplied by `scale_factor`. With coordinates `xyz` in file units and file axes, a take (metres, Y up) has
    `rotation_y_up_file @ xyz * unit_m`; the inverse is `rotation_y_up_file.T @ marker / unit_m`.

    Attributes:
        scale_factor: Absolute value of POINT:SCALE. File units per count in integer files, and the unit of the residual in
            both kinds of file.
    """

    processor_type: int  # Intel, DEC or SGI
    is_float: bool  # whether words are 32-bit floats
    scale_factor: float
    data_start_byte: int  # offset of the first point of the first frame
    frame_stride_bytes: int  # bytes from the first point of one frame to that of the next, analog samples included
    point_count: int  # points per frame, markers and others
    frame_count: int  # number of frames
    unit_m: float  # metres per file unit
    rotation_y_up_file: Float[np.ndarray, "3 3"]  # rotation from file axes to Y-up axes

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

    def view_words(self, data: bytes | bytearray | memoryview | mmap) -> Shaped[np.ndarray, "T P 4"]:
        """Return the stored words of all frames and points as a view of `data`, which is writable if `data` is."""
        shape = (self.frame_count, self.point_count, 4)
        strides = (self.frame_stride_bytes, 4 * self.word_size_bytes, self.word_size_bytes)
        return np.ndarray(shape, self.word_dtype, data, self.data_start_byte, strides)

    def view_analog_words(self, data: bytes | bytearray | memoryview | mmap) -> Shaped[np.ndarray, "T A"]:
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
        line_indices: Index of the line of each of the T frames, -1 for a frame that has no line.
        field_indices: Index of the X, Y and Z field of each of the P points. Empty if lines list only the visible markers.
        rotation_y_up_file: Rotation from file axes to Y-up axes.
    """

    encoding: str  # text encoding of the file; a byte-order mark is the first character of its text
    newline: str  # line separator; with "\\r\\n" the "\\r" is the last character of each line
    delimiter: str  # field separator
    decimal_sign: str  # "." or ","
    unit_m: float  # metres per file unit
    line_indices: Int[np.ndarray, " T"] = field(default_factory=lambda: np.zeros(0, int))
    field_indices: Int[np.ndarray, "P 3"] = field(default_factory=lambda: np.zeros((0, 3), int))
    number_format: str = ".6f"  # format specification of a coordinate, as for `format`
    missing_text: str = ""  # text of a missing coordinate, such as "", "NaN" or "0.000"
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


SAMPLE_ARRAYS = ("sample_sd", "computed", "uncaptured", "relabelled_points", "label_confidence")
"""the fields of a take with a value for each sample, besides the positions"""
SUBJECT_SEPARATORS = re.compile(r"[._-]")  # characters, besides the colon, that may follow the name of a subject in a label


@dataclass(frozen=True)
class UpAxis:
    """The axis of a file that points up."""

    letter: str  # "X", "Y" or "Z", with "-" before it if the axis points down
    basis: str  # from what it is known, in a few words
    is_certain: bool = True  # whether other axes are far less likely


@dataclass(frozen=True)
class TakePart:
    """Some frames of a longer take, which are cleaned alone, and how its M markers are seen in the frames around them."""

    first: int  # index in the longer take of the first frame
    missing: Int[np.ndarray, "2 M"]  # number of frames for which each marker is missing directly before and after the part
    is_seen: Bool[np.ndarray, "2 M"]  # whether it is seen anywhere before and after

    def select(self, markers: Int[np.ndarray, " K"]) -> "TakePart":
        """Return the part for some of the markers."""
        return TakePart(self.first, self.missing[:, markers], self.is_seen[:, markers])


@dataclass(frozen=True)
class Take:
    """Marker positions over time: T frames of M markers, in metres, Y up, right-handed.

    Attributes:
        markers: Positions in metres, NaN where a sample is missing.
        labels: Marker names as in the file, without trailing spaces, with any subject prefix ("Jim:LFHD").
        rate: Frames per second.
        first_frame: Number that the file gives to frame index 0. Users are always shown the file's frame numbers.
        path: The file that the take was read from.
        layout: Where the samples lie in the file; None if there is no file in which they could be replaced.
        point_columns: Index of each marker among the points of the file; empty if the markers are the points.
        other_labels: Labels of the points that are not markers: model outputs and unlabelled points.
        unlabelled: The unlabelled trajectories as a take of their own, if there are any.
        labelled_file: The bytes of the file with its trajectories labelled, if mocapfix labelled them; then `layout` and
            `point_columns` are those of these bytes. None: the file has its labels itself.
        label_confidence: The probability that the label of each sample is right, if mocapfix labelled them.
        computed_points: The positions that a program computed from markers, such as joint centres, if there are any.
        sample_sd: Predicted standard deviation (m) of the samples that mocapfix estimated, NaN for all others.
        computed: Samples that software estimated, according to the residual words of a C3D file.
        uncaptured: Samples that no camera contributed to, in a file that records which cameras contributed.
        relabelled_points: Index of the file's point that each sample comes from; None if no label was changed.
        subject_prefixes: What the labels of each subject begin with where it does not end in a colon: "Jim_" of "Jim_LFHD".
        subject_names: Names of the subjects that the file lists, whether or not it holds their markers.
        subject_name: Whose markers these are, if the take is one subject's part of a take of several; otherwise "".
        notes: Sentences about assumptions and irregularities found when the file was read.
        up_axis: The axis of the file that points up; None if there is no file.
        point_kind: "joint" if the points are the joints of an animation (see mocapfix.model.animation).
        part: Which part of a longer take this is; None for a whole take.
    """

    markers: Float[np.ndarray, "T M 3"]
    labels: tuple[str, ...]
    rate: float
    first_frame: int = 1
    path: Path | None = None
    layout: C3dLayout | TableLayout | None = None
    point_columns: Int[np.ndarray, " K"] = field(default_factory=lambda: np.zeros(0, int))
    other_labels: tuple[str, ...] = ()
    unlabelled: "Take | None" = None
    labelled_file: bytes | None = None
    label_confidence: Float[np.ndarray, "T M"] | None = None
    computed_points: "ComputedPoints | None" = None
    sample_sd: Float[np.ndarray, "T M"] | None = None
    computed: Bool[np.ndarray, "T M"] | None = None
    uncaptured: Bool[np.ndarray, "T M"] | None = None
    relabelled_points: Int[np.ndarray, "T M"] | None = None
    subject_prefixes: tuple[str, ...] = ()
    subject_names: tuple[str, ...] = ()
    subject_name: str = ""
    notes: tuple[str, ...] = ()
    up_axis: UpAxis | None = None
    point_kind: Literal["marker", "joint"] = "marker"
    part: TakePart | None = None

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return len(self.markers)

    @cached_property
    def visible(self) -> Bool[np.ndarray, "T M"]:
        """Whether each sample is present. Read-only."""
        visible = ~np.isnan(self.markers[..., 0])
        visible.flags.writeable = False
        return visible

    @cached_property
    def measured(self) -> Bool[np.ndarray, "T M"]:
        """Whether each sample is present and was measured by cameras. Read-only."""
        if self.computed is None:
            return self.visible
        measured = self.visible & ~self.computed
        measured.flags.writeable = False
        return measured

    @property
    def is_ever_visible(self) -> Bool[np.ndarray, " M"]:
        """Whether each marker is visible in any frame, also of the longer take of which this is a part."""
        beyond = self.part.is_seen if self.part else self.visible[:0]
        return np.any(np.concatenate([self.visible, beyond]), axis=0)

    @property
    def estimated_sd(self) -> Float[np.ndarray, "T M"]:
        """Predicted standard deviation in metres of the samples that mocapfix estimated, NaN for all others."""
        return np.full(self.visible.shape, np.nan) if self.sample_sd is None else self.sample_sd

    @property
    def name(self) -> str:
        """Name of the take in messages: the file name, with the subject's name if the take is one subject's part."""
        name = self.path.name if self.path else "the take"
        return f"{name} ({self.subject_name})" if self.subject_name else name

    @property
    def output_stem(self) -> str:
        """Stem of the names of output files: "walk", or "walk.Jim" if the take is one subject's part."""
        stem, subject = self.path.stem if self.path else "take", make_file_name(self.subject_name)
        return f"{stem}.{subject}" if subject else stem

    @cached_property
    def bare_labels(self) -> tuple[str, ...]:
        """The labels without subject prefixes: "LFHD" for "Jim:LFHD"."""
        return tuple(self._split_label(label)[1] for label in self.labels)

    @property
    def marker_subjects(self) -> tuple[str, ...]:
        """Subject of each marker: its label's prefix, else the only subject that the file lists, else ""."""
        prefixes = [self._split_label(label)[0] for label in self.labels]
        default = self.subject_names[0] if len(self.subject_names) == 1 and not any(prefixes) else ""
        return tuple(prefix or default for prefix in prefixes)

    def _split_label(self, label: str) -> tuple[str, str]:
        """Return the name of the subject in a label, "" without one, and that of the marker."""
        if prefix := max((each for each in self.subject_prefixes if label.startswith(each)), key=len, default=""):
            return prefix[:-1].strip(), label.removeprefix(prefix).strip()
        subject, _, name = label.rpartition(":")
        return subject.strip(), name.strip()

    @property
    def main_subject(self) -> str:
        """Whose markers these are: the subject of most markers by their labels; "" if they name none."""
        return self.subject_name or max(Counter(self.marker_subjects).items(), key=lambda each: each[1], default=("", 0))[0]

    @property
    def point_indices(self) -> Int[np.ndarray, " M"]:
        """Index of each marker among the points of the file."""
        return self.point_columns if len(self.point_columns) else np.arange(len(self.labels))

    @property
    def source_points(self) -> Int[np.ndarray, "T M"]:
        """Index of the file's point that each sample comes from."""
        of_labels = np.broadcast_to(self.point_indices, (self.frame_count, len(self.labels)))
        return of_labels if self.relabelled_points is None else self.relabelled_points

    def get_label(self, index: SupportsIndex) -> str:
        """Return the label of a marker or, for an index beyond the markers, of an unlabelled trajectory."""
        beyond = int(index) - len(self.labels)
        return self.labels[index] if beyond < 0 or self.unlabelled is None else self.unlabelled.labels[beyond]

    def get_frame_number(self, index: SupportsIndex) -> int:
        """Return the number that the file gives to the frame at `index`."""
        return self.first_frame + int(index)

    def select(self, marker_indices: Int[np.ndarray, " K"], mask: Bool[np.ndarray, "T M"]) -> "Take":
        """Return a take of K markers in the given order, without layout.

        Args:
            marker_indices: Index of each marker; -1 for a marker that the take does not have.
            mask: Samples to keep; all others are set to NaN, as are the markers that the take does not have.
        """
        markers = np.take(self.markers, marker_indices, axis=1)
        markers[~np.take(mask, marker_indices, axis=1)] = np.nan
        markers[:, marker_indices < 0] = np.nan
        labels = tuple(self.labels[m] if m >= 0 else "" for m in marker_indices)
        return Take(markers, labels, self.rate, self.first_frame, self.path, subject_name=self.subject_name)

    def extract_markers(self, marker_indices: Int[np.ndarray, " K"], subject_name: str) -> "Take":
        """Return some markers as a take of the same file. Writing it changes the samples of these markers only."""
        arrays: dict[str, Any] = {name: getattr(self, name) for name in SAMPLE_ARRAYS}
        return replace(
            self,
            markers=self.markers[:, marker_indices],
            labels=tuple(self.labels[m] for m in marker_indices),
            point_columns=self.point_indices[marker_indices],
            subject_name=subject_name,
            **{name: array[:, marker_indices] for name, array in arrays.items() if array is not None},
        )

    def find_marker_indices(self, part: "Take") -> Int[np.ndarray, " K"]:
        """Return the index in this take of each marker of a part that `extract_markers` returned."""
        indices = {int(point): m for m, point in enumerate(self.point_indices)}
        return np.array([indices[int(point)] for point in part.point_indices], int)

    def masked(self, mask: Bool[np.ndarray, "T M"]) -> "Take":
        """Return the take with only the samples in `mask`, NaN elsewhere."""
        return replace(self, markers=np.where(mask[..., None], self.markers, np.nan))

    def exchange_labels(self, label_cycle: tuple[int, ...], first_frame_index: int, last_frame_index: int) -> "Take":
        """Return the take with samples exchanged among a cycle of markers.

        In the frames from first to last inclusive, each marker of the cycle gets the samples of the next one, and the last
        marker those of the first. Exchanging two markers twice restores the take bit for bit.
        """
        return self.exchange_labels_in_turn([(label_cycle, first_frame_index, last_frame_index)])

    def exchange_labels_in_turn(self, exchanges: Iterable[tuple[tuple[int, ...], int, int]]) -> "Take":
        """Return the take with each exchange (cycle, first, last) made as by `exchange_labels`, one after the other.

        The samples are copied once, however many exchanges there are.
        """
        arrays: dict[str, Any] = {name: getattr(self, name) for name in ("markers", "sample_sd", "computed", "uncaptured")}
        changed = {name: array.copy() for name, array in arrays.items() if array is not None}
        changed["relabelled_points"] = self.source_points.copy()
        for label_cycle, first_frame_index, last_frame_index in exchanges:
            frames = slice(first_frame_index, last_frame_index + 1)
            targets, origins = list(label_cycle), list(label_cycle[1:] + label_cycle[:1])
            for array in changed.values():
                array[frames, targets] = array[frames, origins]
        return replace(self, **changed)

    def replace_markers(self, markers: Float[np.ndarray, "T M 3"], sample_sd: Float[np.ndarray, "T M"] | None = None) -> "Take":
        """Return the take with other positions and standard deviations of the estimated samples."""
        return replace(self, markers=markers, sample_sd=sample_sd)


@dataclass(frozen=True)
class ComputedPoints:
    """Positions that a program computed from markers. They are kept, and are no evidence of where markers are.

    Attributes:
        functions: For each point, how its position follows from other points of the file; None if that is not known.
    """

    take: Take  # the points as a take of their own
    evidence: tuple["ComputedEvidence", ...]  # for each point, how it was recognised
    functions: tuple[PointFunction | None, ...]

    @property
    def updated_counts(self) -> Int[np.ndarray, " C"]:
        """Number of samples of each point that mocapfix filled or computed again."""
        return (~np.isnan(self.take.estimated_sd)).sum(0)

    def list_parent_labels(self, point: int, markers: Take) -> tuple[str, ...]:
        """Return the labels of the markers, or of the other computed points, from which a point follows."""
        function = self.functions[point]
        labels = dict(zip(self.take.point_indices.tolist(), self.take.labels, strict=True))
        labels |= dict(zip(markers.point_indices.tolist(), markers.labels, strict=True))
        return tuple(labels[parent] for parent in function.parents if parent in labels) if function else ()


ComputedEvidence = Literal["name", "function"]
"""how a computed point was recognised: by its name or the lists of the file, or as an exact function of markers"""
