"""Corrections by a reviewer: faults that mocapfix did not detect, and how gaps are to be filled."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from mocapfix.errors import SceneError, format_name_list
from mocapfix.faults import Fault, Fragment
from mocapfix.review.file_models import CorrectionModel
from mocapfix.take import Take

MARK_REASONS = {"wrong": "A reviewer marked the samples as wrong.", "missing": "A reviewer marked the samples as missing."}
SWAP_REASON = "A reviewer exchanged the labels."
ASSIGNMENT_REASON = "A reviewer assigned the trajectory to the marker."


@dataclass(frozen=True)
class Correction:
    """A correction of a take.

    entry        the correction as in the file
    markers      indices of its markers and of an unlabelled trajectory in the take
    first, last  frame indices, inclusive
    """

    entry: CorrectionModel
    markers: tuple[int, ...]
    first: int
    last: int

    @property
    def label_fault(self) -> Fault | None:
        """The fault of a swap or an assignment, None for other corrections."""
        marker, frames = self.markers[0], (self.first, self.last)
        if self.entry.kind == "swap":
            return Fault("swap", marker, *frames, np.nan, SWAP_REASON, other_markers=self.markers[1:])
        if self.entry.kind == "assign":
            reason, donor = ASSIGNMENT_REASON, self.markers[1]
            return Fragment("fragment", marker, *frames, np.nan, reason, donor=donor, relation="replaces")
        return None

    @property
    def marked_fault(self) -> Fault | None:
        """The fault of a stretch that is wrong or missing, None for other corrections."""
        reason = MARK_REASONS.get(self.entry.kind)
        return Fault("marked", self.markers[0], self.first, self.last, np.nan, reason) if reason else None


def list_label_corrections(corrections: Sequence[Correction]) -> list[Fault]:
    """Return the faults of labels that corrections name, in their order."""
    return [fault for each in corrections if (fault := each.label_fault)]


def list_marked_faults(corrections: Sequence[Correction]) -> list[Fault]:
    """Return the faults of samples that corrections name, in their order."""
    return [fault for each in corrections if (fault := each.marked_fault)]


def locate_correction(entry: CorrectionModel, take: Take, place: str) -> Correction:
    """Return a correction with the indices of its markers and frames.

    place  where the entry is, for the message of an error

    Raises SceneError if the take does not have the markers or the frames.
    """
    trajectories = len(take.labels) + (len(take.unlabelled.labels) if take.unlabelled else 0)
    index_by_label = {take.get_label(index): index for index in reversed(range(trajectories))}  # the first of equal labels
    if unknown := [label for label in entry.markers if label not in index_by_label]:
        raise SceneError(f"{place}.markers: {take.name} has no marker {format_name_list(unknown)}.")
    first, last = take.first_frame, take.get_frame_number(take.frame_count - 1)
    if not first <= entry.first <= entry.last <= last:
        raise SceneError(f"{place}: frames {entry.first} to {entry.last} are not in {take.name}, which has {first} to {last}.")
    markers = tuple(index_by_label[label] for label in entry.markers)
    labelled = markers[:1] if entry.kind == "assign" else markers
    if any(marker >= len(take.labels) for marker in labelled):
        raise SceneError(f"{place}.markers: {entry.kind} must name labelled markers; assign gives a trajectory to a marker.")
    if entry.kind == "assign" and markers[1] < len(take.labels):
        raise SceneError(f"{place}.markers: {entry.markers[1]} is a labelled marker; exchange labels with swap.")
    return Correction(entry, markers, entry.first - first, entry.last - first)


def build_corrected_label_mask(corrections: Sequence[Correction], shape: tuple[int, int]) -> Bool[np.ndarray, "T M"]:
    """Return the mask of the samples, of `shape` (T, M), whose labels the reviewer corrected."""
    mask = np.zeros(shape, bool)
    for fault in list_label_corrections(corrections):
        mask[fault.frame_slice, list(fault.markers)] = True
    return mask
