"""State of every sample after cleaning: measured, filled, replaced, relabelled, reassigned, suspect or empty."""

from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Int

from mocapfix.faults import Faults
from mocapfix.take import Take


class SampleOutcome(IntEnum):
    """Outcome of the cleaning for one sample.

    MEASURED    measured and unchanged
    FILLED      missing before, estimated now
    REPLACED    faulty before, estimated now
    RELABELLED  measured, but under another label before
    REASSIGNED  moved to another label; nothing took its place
    SUSPECT     judged faulty, but unchanged
    EMPTY       missing
    """

    MEASURED = 0
    FILLED = 1
    REPLACED = 2
    RELABELLED = 3
    REASSIGNED = 4
    SUSPECT = 5
    EMPTY = 6

    @property
    def label(self) -> str:
        """Name in reports and class in the style sheet."""
        return self.name.lower()


# Colours of the reports.
GREEN = "#1f9d57"
RED = "#d93a3a"
AMBER = "#e08a00"
VIOLET = "#7a5bd0"
BLUE = "#3f7fc4"


def classify_samples(input_take: Take, relabelled_take: Take, cleaned_take: Take, faults: Faults) -> Int[np.ndarray, "T M"]:
    """Return the SampleOutcome of every sample.

    input_take       the take as read
    relabelled_take  the same with corrected labels; `faults` index its markers
    cleaned_take     the same with filled and replaced samples
    """
    sample_sd = cleaned_take.sample_sd
    estimated = np.zeros(cleaned_take.visible.shape, bool) if sample_sd is None else ~np.isnan(sample_sd)
    relabelled = cleaned_take.visible & (cleaned_take.source_points != input_take.source_points)
    reassigned = _find_reassigned_samples(input_take, cleaned_take, relabelled & ~estimated)
    outcomes = (
        (~cleaned_take.visible & reassigned, SampleOutcome.REASSIGNED),
        (~cleaned_take.visible, SampleOutcome.EMPTY),
        (estimated & ~relabelled_take.visible, SampleOutcome.FILLED),
        (estimated, SampleOutcome.REPLACED),
        (relabelled, SampleOutcome.RELABELLED),
        (faults.compute_faulty_mask(relabelled_take), SampleOutcome.SUSPECT),
    )
    conditions, values = zip(*outcomes, strict=True)
    return np.select(conditions, values, SampleOutcome.MEASURED)


def _find_reassigned_samples(
    input_take: Take, cleaned_take: Take, relabelled: Bool[np.ndarray, "T M"]
) -> Bool[np.ndarray, "T M"]:
    """Return the samples of the input that the cleaned take has under another label, those at `relabelled`."""
    points = input_take.point_indices
    marker_of_point = np.full(1 + max(points.max(initial=0), cleaned_take.source_points.max(initial=0)), -1)
    marker_of_point[points] = np.arange(len(points))
    frame, marker = np.nonzero(relabelled)
    donor = marker_of_point[cleaned_take.source_points[frame, marker]]
    reassigned = np.zeros(input_take.visible.shape, bool)
    reassigned[frame[donor >= 0], donor[donor >= 0]] = True
    return reassigned


def find_estimated_samples(outcome: Int[np.ndarray, "*shape"]) -> Bool[np.ndarray, "*shape"]:
    """Return the mask of the samples that were estimated: filled or replaced."""
    return (outcome == SampleOutcome.FILLED) | (outcome == SampleOutcome.REPLACED)


def classify_input_samples(visible: Bool[np.ndarray, "*shape"], outcome: Int[np.ndarray, "*shape"]) -> Int[np.ndarray, "*shape"]:
    """Return the state of every input sample: MEASURED, SUSPECT (faulty), RELABELLED (of another marker) or EMPTY.

    visible  whether the input has the sample
    outcome  what became of it
    """
    other_marker = np.isin(outcome, (SampleOutcome.RELABELLED, SampleOutcome.REASSIGNED, SampleOutcome.FILLED))
    states = [SampleOutcome.EMPTY, SampleOutcome.RELABELLED, SampleOutcome.SUSPECT]
    return np.select([~visible, other_marker, outcome != SampleOutcome.MEASURED], states, SampleOutcome.MEASURED)
