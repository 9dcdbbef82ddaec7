"""What became of every sample, and the colours that say so in the recording and on the page."""

import numpy as np

from mocapfix.faults import Faults
from mocapfix.take import Take

SAMPLE_STATE_NAMES = ("measured", "filled", "replaced", "relabelled", "taken over", "doubted", "empty")
SAMPLE_MEASURED, SAMPLE_FILLED, SAMPLE_REPLACED, SAMPLE_RELABELLED, SAMPLE_REASSIGNED, SAMPLE_SUSPECT, SAMPLE_EMPTY = range(7)

GREEN, RED, AMBER, VIOLET, BLUE = "#1f9d57", "#d93a3a", "#e08a00", "#7a5bd0", "#3f7fc4"


def classify_samples(input_take: Take, relabelled_take: Take, cleaned_take: Take, faults: Faults) -> np.ndarray:
    """-> (T, M) indices into STATES: measured and kept; missing and filled; faulty and replaced; measured, but under another
    label before; given to another label, and nothing in its place; faulty, but kept; empty.

    labelled  the take with its labels put right: what is missing and faulty in it was filled and replaced
    """
    estimated = (
        np.zeros(cleaned_take.visible.shape, bool) if cleaned_take.sample_sd is None else ~np.isnan(cleaned_take.sample_sd)
    )
    elsewhere = cleaned_take.visible & (cleaned_take.source_points != input_take.source_points)
    given = _find_reassigned_samples(input_take, cleaned_take, elsewhere & ~estimated)
    conditions = [
        ~cleaned_take.visible & given,
        ~cleaned_take.visible,
        estimated & ~relabelled_take.visible,
        estimated,
        elsewhere,
        faults.compute_faulty_mask(relabelled_take),
    ]
    return np.select(
        conditions,
        [SAMPLE_REASSIGNED, SAMPLE_EMPTY, SAMPLE_FILLED, SAMPLE_REPLACED, SAMPLE_RELABELLED, SAMPLE_SUSPECT],
        SAMPLE_MEASURED,
    )


def _find_reassigned_samples(input_take: Take, cleaned_take: Take, relabelled: np.ndarray) -> np.ndarray:
    """-> (T, M) bool: the samples of before that are under another label after, which `relabelled` (T, M) are."""
    own = input_take.point_columns if len(input_take.point_columns) else np.arange(len(input_take.labels))
    column = np.full(1 + max(own.max(initial=0), cleaned_take.source_points.max(initial=0)), -1)
    column[own] = np.arange(len(own))
    t, m = np.nonzero(relabelled)
    donor = column[cleaned_take.source_points[t, m]]
    given = np.zeros(input_take.visible.shape, bool)
    given[t[donor >= 0], donor[donor >= 0]] = True
    return given


def find_estimated_samples(sample_states: np.ndarray) -> np.ndarray:
    """-> where mocapfix estimated the sample."""
    return (sample_states == SAMPLE_FILLED) | (sample_states == SAMPLE_REPLACED)


def classify_input_samples(visible: np.ndarray, sample_states: np.ndarray) -> np.ndarray:
    """-> what the samples were before: measured; doubted, for they were replaced, taken out or only kept in doubt; or
    relabelled, for they belonged to another label. `seen`: was there one?"""
    other = np.isin(sample_states, (SAMPLE_RELABELLED, SAMPLE_REASSIGNED, SAMPLE_FILLED))
    return np.select(
        [~visible, other, sample_states != SAMPLE_MEASURED], [SAMPLE_EMPTY, SAMPLE_RELABELLED, SAMPLE_SUSPECT], SAMPLE_MEASURED
    )
