"""Marker takes: the trajectories of one recorded performance."""

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, SupportsIndex

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.files.layouts import C3dLayout, TableLayout
from mocapfix.stats.point_functions import PointFunction

if TYPE_CHECKING:
    from mocapfix.files.read_options import ReadOptions

SUBJECT_SEPARATORS = re.compile(r"[._-]")  # characters, besides the colon, that may follow the name of a subject in a label


@dataclass(frozen=True)
class UpAxis:
    """The axis of a file that points up.

    Attributes:
        letter: "X", "Y" or "Z", with "-" before it if the axis points down.
        basis: From what it is known, in a few words.
        is_certain: Whether other axes are far less likely.
    """

    letter: str
    basis: str
    is_certain: bool = True


@dataclass(frozen=True)
class Take:
    """Marker positions over time: T frames of M markers, in metres, Y up, right-handed.

    Attributes:
        markers: Positions, NaN where a sample is missing.
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
        read_options: The options with which the file was read; None if there is no file.
        point_kind: "joint" if the points are the joints of an animation (see mocapfix.animations.joint_points).
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
    read_options: "ReadOptions | None" = None
    point_kind: Literal["marker", "joint"] = "marker"

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
    def name(self) -> str:
        """Name of the take in messages: the file name, with the subject's name if the take is one subject's part."""
        name = self.path.name if self.path else "the take"
        return f"{name} ({self.subject_name})" if self.subject_name else name

    @property
    def output_stem(self) -> str:
        """Stem of the names of output files: "walk", or "walk.Jim" if the take is one subject's part."""
        stem, subject = self.path.stem if self.path else "take", re.sub(r"[^\w. -]", "_", self.subject_name)
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
        return np.tile(self.point_indices, (self.frame_count, 1)) if self.relabelled_points is None else self.relabelled_points

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
        names = ("sample_sd", "computed", "uncaptured", "relabelled_points", "label_confidence")
        arrays: dict[str, Any] = {name: getattr(self, name) for name in names}
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
        take: The points as a take of their own.
        evidence: For each point, how it was recognised.
        functions: For each point, how its position follows from other points of the file; None if that is not known.
    """

    take: Take
    evidence: tuple["ComputedEvidence", ...]
    functions: tuple[PointFunction | None, ...]

    @property
    def updated_counts(self) -> Int[np.ndarray, " C"]:
        """Number of samples of each point that mocapfix filled or computed again."""
        sample_sd = self.take.sample_sd
        return np.zeros(len(self.functions), int) if sample_sd is None else (~np.isnan(sample_sd)).sum(0)

    def list_parent_labels(self, point: int, markers: Take) -> tuple[str, ...]:
        """Return the labels of the markers, or of the other computed points, from which a point follows."""
        function = self.functions[point]
        labels = dict(zip(self.take.point_indices.tolist(), self.take.labels, strict=True))
        labels |= dict(zip(markers.point_indices.tolist(), markers.labels, strict=True))
        return tuple(labels[parent] for parent in function.parents if parent in labels) if function else ()


ComputedEvidence = Literal["name", "function"]
"""how a computed point was recognised: by its name or the lists of the file, or as an exact function of markers"""
