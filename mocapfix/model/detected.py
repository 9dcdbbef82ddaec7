"""What detection returns: the faults of a take, the take with its labels corrected, and which of its samples can be used.

A marker that moved on its segment has one column for each position, since samples at one say nothing about another.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from mocapfix.model.body_fit import BodyFit
from mocapfix.model.faults import REPLACED_SAMPLE_KINDS, Fault, FaultKind, Faults, MarkerShift
from mocapfix.model.take import Take

MIN_EPOCH_DURATION_S = 0.5  # visible time of a marker at a position that makes it a position of its own


@dataclass(frozen=True)
class MarkerEpochs:
    """A take in which each position of a moved marker has a column of its own.

    Attributes:
        take: The take with its M columns and one more for each additional position. The original column of a moved marker
            holds the position at which it is visible longest.
    """

    take: Take
    column_marker: np.ndarray  # the marker (C,) of each column
    is_active: np.ndarray  # the frames (T, C) in which a column represents its marker; one column for each marker and frame
    is_near: np.ndarray  # the frames (T, C) in which a marker is at a column's position, or slides to or from it

    @property
    def added_columns(self) -> Int[np.ndarray, " E"]:
        """The indices of the additional columns."""
        return np.arange(len(np.unique(self.column_marker)), len(self.column_marker))

    def find_column(self, marker: int, frame: int) -> int:
        """Return the column that represents a marker in a frame."""
        return int(np.flatnonzero((self.column_marker == marker) & self.is_active[frame])[0])

    def split_mask(self, mask: Bool[np.ndarray, "T M"]) -> Bool[np.ndarray, "T C"]:
        """Return a mask of columns from a mask of markers, False where another column represents the marker."""
        return mask[:, self.column_marker] & self.is_active

    def merge_columns(self, values: Shaped[np.ndarray, "T C *rest"]) -> Shaped[np.ndarray, "T M *rest"]:
        """Return values of markers from values of columns."""
        merged = values[:, : len(self.column_marker) - len(self.added_columns)].copy() if len(self.added_columns) else values
        for column in self.added_columns:
            frames = self.is_active[:, column]
            merged[frames, self.column_marker[column]] = values[frames, column]
        return merged


class _Epoch(NamedTuple):
    """The frames of a marker at one position."""

    settled: slice  # at this position
    active: slice  # that represent it: up to the middle of the slides to and from it
    near: slice  # with these slides


def split_moved_markers(take: Take, faults: Iterable[Fault]) -> MarkerEpochs:
    """Split the markers that moved into one column for each position.

    While a marker slides it is at neither position. Its samples then are in no column, but near both (`is_near`).
    """
    count, frames, whole = len(take.labels), np.arange(take.frame_count), slice(0, take.frame_count)
    columns = [(m, _Epoch(whole, whole, whole)) for m in range(count)]
    shifts = sorted((fault for fault in faults if isinstance(fault, MarkerShift)), key=lambda fault: (fault.marker, fault.first))
    for m, group in groupby(shifts, key=lambda shift: shift.marker):
        visible = take.visible[:, m]
        epochs = _list_epochs(_select_lasting_shifts(list(group), visible, round(MIN_EPOCH_DURATION_S * take.rate)), len(visible))
        longest, *others = sorted(epochs, key=lambda epoch, visible=visible: -visible[epoch.settled].sum())
        columns[m] = m, longest
        columns.extend((m, each) for each in others)
    column_marker = np.array([m for m, _ in columns], int)
    if len(columns) == count:
        everywhere = np.ones((take.frame_count, count), bool)
        return MarkerEpochs(take, column_marker, everywhere, everywhere)
    is_settled, is_active, is_near = (
        np.stack([(frames >= each.start) & (frames < each.stop) for each in spans], 1)
        for spans in zip(*(epoch for _, epoch in columns), strict=True)
    )
    labels = tuple(take.labels[m] for m in column_marker)
    computed = None if take.computed is None else take.computed[:, column_marker]
    uncaptured = None if take.uncaptured is None else take.uncaptured[:, column_marker]
    split = replace(
        take,
        markers=np.where(is_settled[..., None], take.markers[:, column_marker], np.nan),
        labels=labels,
        computed=computed,
        uncaptured=uncaptured,
        point_columns=column_marker,
        relabelled_points=None,
        part=take.part and take.part.select(column_marker),
    )
    return MarkerEpochs(split, column_marker, is_active, is_near)


def _list_epochs(shifts: list[MarkerShift], frame_count: int) -> list[_Epoch]:
    """List the epochs between the shifts of a marker, which are ordered by first frame."""

    def list_spans(starts: list[int], stops: list[int]) -> list[slice]:
        return [slice(*each) for each in zip([0, *starts], [*stops, frame_count], strict=True)]

    firsts, settled = [shift.first for shift in shifts], [shift.settled_frame for shift in shifts]
    middles = [(shift.first + shift.settled_frame) // 2 for shift in shifts]
    return list(map(_Epoch, list_spans(settled, firsts), list_spans(middles, middles), list_spans(firsts, settled)))


def _select_lasting_shifts(shifts: list[MarkerShift], visible: np.ndarray, min_frames: int) -> list[MarkerShift]:
    """Select the shifts, ordered by first frame, with at least `min_frames` visible frames (T,) before and after them."""
    selected: list[MarkerShift] = []
    for shift in shifts:
        start = selected[-1].settled_frame if selected else 0
        if visible[start : shift.first].sum() >= min_frames and visible[shift.settled_frame :].sum() >= min_frames:
            selected.append(shift)
    return selected


NUMBERED_LABEL = re.compile(r"(.*[^\W_])(?:[-_.#* ]+\d+|\s*\(\d+\))")


def find_namesakes(take: Take) -> dict[int, int]:
    """Find the markers that have another marker's label; return their indices and those of the other markers.

    If several markers have the same label, the one that is visible longest is the marker. A numbered label whose base label
    is not in the take is a label of its own.
    """
    first_of_label: dict[str, int] = {}
    for m in np.argsort(-take.visible.sum(0), kind="stable"):
        first_of_label.setdefault(take.labels[m], int(m))
    numbered = [found and found[1] for found in map(NUMBERED_LABEL.fullmatch, take.labels)]
    bases = [label if first_of_label[label] != m else numbered[m] for m, label in enumerate(take.labels)]
    return {m: first_of_label[base] for m, base in enumerate(bases) if base in first_of_label}


@dataclass(frozen=True)
class Detected:
    """The detected faults of a take, and the take with its labels corrected."""

    take: Take  # the take with its labels corrected
    label_faults: tuple[Fault, ...] = ()  # faults of labels, in the order in which they were corrected
    sample_faults: Faults = field(default_factory=Faults)  # faults of samples, found under the corrected labels
    replaced_kinds: tuple[FaultKind, ...] = REPLACED_SAMPLE_KINDS  # the kinds of fault whose samples are replaced
    body_faults: tuple[Fault, ...] = ()  # those of `sample_faults` that only the solved body showed
    unconfirmed_shifts: tuple[Fault, ...] = ()  # marker shifts that the solved body did not confirm
    notes: tuple[str, ...] = ()  # sentences for the report

    @cached_property
    def faults(self) -> Faults:
        """All faults, of labels and of samples."""
        return self.sample_faults.add_faults(self.label_faults)

    @cached_property
    def inlier_mask(self) -> Bool[np.ndarray, "T M"]:
        """The samples that were measured and are not faulty."""
        return self.sample_faults.compute_inlier_mask(self.take, self.replaced_kinds) & self.take.measured

    @cached_property
    def solver_mask(self) -> Bool[np.ndarray, "T M"]:
        """The samples that the solver uses (see `Faults.compute_solver_mask`)."""
        return self.sample_faults.compute_solver_mask(self.take, self.replaced_kinds) & self.take.measured

    @cached_property
    def donor_markers(self) -> tuple[int, ...]:
        """The markers whose labels only name fragments of other markers. They are neither judged nor filled."""
        return tuple(sorted(find_namesakes(self.take)))

    @cached_property
    def epochs(self) -> MarkerEpochs:
        """The take with a column for every place of a marker that moved on its segment."""
        return split_moved_markers(self.take, self.faults.items)

    def select_columns(self, columns: Int[np.ndarray, " K"], mask: Bool[np.ndarray, "T M"]) -> Take:
        """Return the samples in a mask of the take, of the markers in K columns of `epochs`; -1 for one without samples."""
        return self.epochs.take.select(columns, self.epochs.split_mask(mask))

    def place_on_body(self, body: BodyFit) -> Float[np.ndarray, "T M 3"]:
        """Return where a body carries the take's markers, in metres; NaN for markers that it does not carry."""
        place = np.full(len(self.epochs.column_marker), -1)
        place[body.marker_columns[body.marker_columns >= 0]] = np.flatnonzero(body.marker_columns >= 0)
        positions = np.take(body.marker_positions, place, axis=1)
        positions[:, place < 0] = np.nan
        return self.epochs.merge_columns(positions)
