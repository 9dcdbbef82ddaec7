"""A take: what the cameras saw of one performance."""

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mocapfix.files.layouts import C3dLayout, TableLayout

if TYPE_CHECKING:
    from mocapfix.animation import Animation


@dataclass(frozen=True)
class Take:
    """Markers over time, in metres, Y up, right-handed.

    markers    (T, M, 3), NaN where not seen
    labels     M names as in the file, without trailing spaces, with any subject prefix ("Jim:LFHD")
    rate       frames a second
    first_frame  the file's own number of frame 0; people are always shown the file's numbers
    columns    (M,) the index of each marker among the file's points
    others     labels of the file's points that are no markers: model outputs and unlabelled points
    unlabelled  the unlabelled points' trajectories as a take of their own, None where there are none
    deviation  (T, M) metres: predicted standard deviation of the samples that mocapfix put there, NaN elsewhere
    computed   (T, M) bool: samples that no camera saw: by their residual words a program like this one put them there
    blind      (T, M) bool: samples that no camera saw, whoever put them there, where the file keeps what cameras saw
    source     (T, M) the file's point that each sample came from, where labels were changed; None: each from its own
    layout     where the samples lie in the file, or the animation whose joints the markers are; None where no file has them
               so that they could be replaced
    subjects   names of the people that the file lists, whichever of them it shows
    person     whose markers these are, where they are one person's of a take of several; else ""
    notes      sentences on what reading it brought up
    """

    markers: np.ndarray
    labels: tuple[str, ...]
    rate: float
    first_frame: int = 1
    path: Path | None = None
    layout: "C3dLayout | TableLayout | Animation | None" = None
    point_columns: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    other_labels: tuple[str, ...] = ()
    unlabelled: "Take | None" = None
    sample_sd: np.ndarray | None = None
    computed: np.ndarray | None = None
    uncaptured: np.ndarray | None = None
    relabelled_points: np.ndarray | None = None
    subject_names: tuple[str, ...] = ()
    subject_name: str = ""
    notes: tuple[str, ...] = ()

    @property
    def frame_count(self) -> int:
        return len(self.markers)

    @property
    def visible(self) -> np.ndarray:
        """(T, M) bool: is the sample there?"""
        return ~np.isnan(self.markers[..., 0])

    @property
    def name(self) -> str:
        name = self.path.name if self.path else "the take"
        return f"{name} ({self.subject_name})" if self.subject_name else name

    @property
    def output_stem(self) -> str:
        """What is written of the take is named by this: "walk", or "walk.Jim" where it is one person's."""
        stem, whose = self.path.stem if self.path else "take", re.sub(r"[^\w. -]", "_", self.subject_name)
        return f"{stem}.{whose}" if whose else stem

    @property
    def bare_labels(self) -> tuple[str, ...]:
        """The labels without subject prefixes: "Jim:LFHD" is LFHD."""
        return tuple(label.rsplit(":", 1)[-1].strip() for label in self.labels)

    @property
    def marker_subjects(self) -> tuple[str, ...]:
        """Whose each marker is: Jim's, of "Jim:LFHD"; else the only person's whom the file lists; "" where nobody is named."""
        prefixes = [label.rpartition(":")[0].strip() for label in self.labels]
        alone = self.subject_names[0] if len(self.subject_names) == 1 and not any(prefixes) else ""
        return tuple(prefix or alone for prefix in prefixes)

    @property
    def measured(self) -> np.ndarray:
        """(T, M) bool: is the sample there, and did cameras see it?"""
        return self.visible if self.computed is None else self.visible & ~self.computed

    def get_label(self, index: int) -> str:
        """A marker's label or, from their number on, that of an unlabelled trajectory."""
        if index < len(self.labels) or self.unlabelled is None:
            return self.labels[index]
        return self.unlabelled.labels[index - len(self.labels)]

    def get_frame_number(self, index: int) -> int:
        """The file's own number of the frame at `index`."""
        return self.first_frame + int(index)

    def select(self, marker_indices: np.ndarray, mask: np.ndarray) -> "Take":
        """-> the K markers at `columns` (K,) alone, in that order, NaN where `believed` (T, M) is False or a column is -1."""
        there = marker_indices >= 0
        markers = np.full((self.frame_count, len(marker_indices), 3), np.nan)
        kept = np.where(mask[..., None], self.markers, np.nan)
        markers[:, there] = kept[:, marker_indices[there]]
        labels = tuple(self.labels[c] if c >= 0 else "" for c in marker_indices)
        return Take(markers, labels, self.rate, self.first_frame, self.path, subject_name=self.subject_name)

    def extract_markers(self, marker_indices: np.ndarray, subject_name: str) -> "Take":
        """-> the markers at `which` (K,) as a take of the same file: what is written of it changes these markers alone."""
        given = {name: getattr(self, name) for name in ("deviation", "computed", "blind", "source")}
        return replace(
            self,
            markers=self.markers[:, marker_indices],
            labels=tuple(self.labels[m] for m in marker_indices),
            columns=self.point_indices[marker_indices],
            subject_name=subject_name,
            **{name: each[:, marker_indices] for name, each in given.items() if each is not None},
        )

    def find_marker_indices(self, part: "Take") -> np.ndarray:
        """-> (K,) the index here of each marker of a part of this take."""
        index = {int(point): m for m, point in enumerate(self.point_indices)}
        return np.array([index[int(point)] for point in part.point_indices], int)

    def masked(self, mask: np.ndarray) -> "Take":
        """The same take with the samples `believed` (T, M) alone, NaN elsewhere."""
        return replace(self, markers=np.where(mask[..., None], self.markers, np.nan))

    def exchange_labels(self, label_cycle: tuple[int, ...], first_frame_index: int, last_frame_index: int) -> "Take":
        """-> over first..last the samples that are under each next marker's label of the ring (of the first, for the last)
        put under its own; they change places and nothing else. For two, twice is not at all, bit for bit."""
        frames, own, carrier = (
            slice(first_frame_index, last_frame_index + 1),
            list(label_cycle),
            list(label_cycle[1:] + label_cycle[:1]),
        )
        given = {name: getattr(self, name) for name in ("markers", "deviation", "computed", "blind")}
        changed = {name: each.copy() for name, each in given.items() if each is not None} | {"source": self.source_points.copy()}
        for each in changed.values():
            each[frames, own] = each[frames, carrier]
        return replace(self, **changed)

    @property
    def point_indices(self) -> np.ndarray:
        """(M,) the file's point that each marker is."""
        return self.point_columns if len(self.point_columns) else np.arange(len(self.labels))

    @property
    def source_points(self) -> np.ndarray:
        """(T, M) the file's point that each sample came from."""
        return np.tile(self.point_indices, (self.frame_count, 1)) if self.relabelled_points is None else self.relabelled_points

    def replace_markers(self, markers: np.ndarray, sample_sd: np.ndarray | None = None) -> "Take":
        """The same take with other positions (T, M, 3)."""
        return replace(self, markers=markers, sample_sd=sample_sd)
