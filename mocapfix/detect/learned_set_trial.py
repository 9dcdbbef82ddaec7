"""The trial of a learned marker set: what it changes in the very take from which it was learned.

Labels and samples that are consistent without a skeleton should stay as they are with it. A wrong skeleton contradicts them.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int

from mocapfix.detect.loop import detect_on_trajectories
from mocapfix.options import CleanOptions
from mocapfix.report.stage_timer import StageTimer
from mocapfix.state import CleaningState, DetectionState

FitStage = Callable[[CleaningState, CleanOptions, StageTimer], CleaningState]

MAX_CONTRADICTED_SAMPLE_SHARE = 2e-4
"""Share of the samples of the set's markers that a body with a correct set may reject or relabel."""
MIN_CONTRADICTED_SAMPLES = 6
"""Number of samples that it may reject or relabel in a take of any length."""
MAX_LEFT_OUT_SHARE = 0.1
"""Share of the set's markers that are left out after the trial because most contradictions concern them."""


@dataclass(frozen=True)
class SetTrial:
    """What a body contradicts in a take that is consistent without it.

    contradicted_counts  (K,) samples of each marker that are rejected or relabelled
    sample_count         visible samples of the markers
    """

    contradicted_counts: Int[np.ndarray, " K"]
    sample_count: int

    @property
    def is_passed(self) -> bool:
        """Whether the contradicted samples are few."""
        return int(self.contradicted_counts.sum()) <= self._max_count

    @property
    def _max_count(self) -> float:
        return max(MIN_CONTRADICTED_SAMPLES, MAX_CONTRADICTED_SAMPLE_SHARE * self.sample_count)

    def select_kept_markers(self) -> Int[np.ndarray, " kept"]:
        """Return the markers that remain without those that cause most contradictions; none if these are too many."""
        order = np.argsort(-self.contradicted_counts, kind="stable")
        remaining = self.contradicted_counts.sum() - np.cumsum(self.contradicted_counts[order])
        left_out_count = int(np.argmax(remaining <= self._max_count)) + 1
        if left_out_count > MAX_LEFT_OUT_SHARE * len(order):
            return order[:0]
        return np.sort(order[left_out_count:])


def try_learned_set(
    first: CleaningState, fitted: CleaningState, options: CleanOptions, timer: StageTimer, detect_and_fit: FitStage
) -> CleaningState:
    """Return the fitted state if its learned set contradicts hardly any sample, else one with a part of the set or without.

    first           the state before any detection
    detect_and_fit  fits a body with a part of the set
    """
    assert first.marker_set is not None
    with timer("detect"):
        without_set = detect_on_trajectories(withdraw_marker_set(first), options)
    columns = first.marker_set.find_columns(first.original_take.labels)
    trial = compare_detections(without_set.detection, fitted.detection, columns)
    if trial.is_passed:
        return fitted
    kept, labels = trial.select_kept_markers(), first.marker_set.labels
    narrowed = first.marker_set.select_markers([labels[k] for k in kept])
    if not len(kept) or narrowed.describe_missing_body(narrowed.labels):
        return without_set
    return detect_and_fit(replace(first, marker_set=narrowed), options, timer)


def compare_detections(without_set: DetectionState, with_set: DetectionState, columns: Int[np.ndarray, " K"]) -> SetTrial:
    """Return what the detection with a learned set contradicts in the take as detected without it.

    columns  the take's columns of the K markers of the set, -1 for one that it does not have
    """
    before, after = without_set.take.markers, with_set.take.markers
    is_relabelled = ((before != after) & ~(np.isnan(before) & np.isnan(after))).any(-1) & without_set.take.visible
    is_rejected = without_set.inlier_mask & ~with_set.inlier_mask
    is_contradicted = (is_relabelled | is_rejected)[:, columns] & (columns >= 0)
    return SetTrial(is_contradicted.sum(0), int(without_set.take.visible[:, columns[columns >= 0]].sum()))


def withdraw_marker_set(state: CleaningState) -> CleaningState:
    """Return the state without its learned marker set, and with the reason."""
    notes = (*state.notes[:1], "A marker set learned from this take would reject or relabel measured samples, so it is not used.")
    notes = (*notes, "The take was cleaned without a skeleton: there is no BVH.")
    return replace(state, marker_set=None, has_learned_set=False, notes=notes)
