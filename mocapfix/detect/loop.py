"""The second look at a take, against the solved body: what its trajectories alone did not tell."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from mocapfix.detect import body_label_swaps, body_outliers, body_residuals, marker_shifts
from mocapfix.detect.body_outliers import overlap_in_time
from mocapfix.detect.fragments import detect_fragments
from mocapfix.detect.label_swaps import detect_label_swaps
from mocapfix.detect.mislabelled import detect_mislabelled
from mocapfix.detect.sample_faults import detect_sample_faults
from mocapfix.detect.trajectory_segments import find_namesakes
from mocapfix.faults import (
    EXTERNAL_FILL_KINDS,
    LABEL_KINDS,
    MIN_LABEL_CONFIDENCE,
    REPLACED_SAMPLE_KINDS,
    SHIFT_KINDS,
    Fault,
    FaultKind,
    Faults,
    Fragment,
)
from mocapfix.marker_sets import MarkerSet
from mocapfix.motion import Motion
from mocapfix.repair import MarkerEpochs, join_fragments, undo_label_exchanges
from mocapfix.solve.body_fit import BodyFit
from mocapfix.subject import Subject
from mocapfix.take import Take


# MERGED: mocapfix.detect.second_look
def detect_body_faults(
    subject_take: Take,
    solver_mask: np.ndarray,
    subject: Subject,
    motion: Motion,
    min_distance_m: float = 0.02,
    max_spike_duration_s: float = 0.05,
) -> list[Fault]:
    """-> exchanged labels, ghosts, spikes and moves, by marker and first frame; what seems one because of a worse one waits.

    worn   the take's markers in the subject's order, NaN where not seen or not believed
    heard  (T, K) bool: the samples that the solve listened to
    smallest  metres: what lies off by less is none
    longest_spike  seconds: what lasts longer is a ghost
    """
    off = body_residuals.compute_body_residuals(subject_take, solver_mask, subject, motion)
    pieces = body_outliers.detect_body_outliers(off, subject_take.rate, min_distance_m)
    swaps = body_label_swaps.detect_body_label_swaps(off, pieces, subject_take)
    lone = [
        piece
        for piece in body_outliers.select_dominant_outliers(pieces)
        if not any(overlap_in_time(piece, swap) for swap in swaps)
    ]
    ghosts = [body_outliers.build_outlier_fault(piece, subject_take, max_spike_duration_s) for piece in lone]
    strays = swaps + ghosts
    moves = [
        marker_shifts.build_shift_fault(shift, subject_take)
        for shift in marker_shifts.select_dominant_shifts(
            marker_shifts.detect_marker_shifts(off, subject, motion, subject_take.rate), subject
        )
        if not any(
            marker_shifts.are_joints_adjacent(subject, shift.marker, marker) for fault in strays for marker in fault.markers
        )
    ]
    return sorted(strays + moves, key=lambda fault: (fault.marker, fault.first))


# MERGED: mocapfix.looks
# Looking for what is wrong, and putting labels right as it is found: swaps before spikes, spikes before gaps.
#
# The first look is at the trajectories alone, the next ones at the body that was solved. What one repair uncovers the next
# search sees, so they go on until nothing new is found.
MAX_DETECTION_ROUNDS = 3  # at most
MIN_CONFIRMED_SHIFT_FRACTION = 0.6  # of how far a marker moved: what its new place lies from the old one on the body at least
FaultFilter = Callable[[Fault], bool]  # may it be a fault, or does somebody vouch for the samples?


@dataclass(frozen=True)
class DetectionState:
    """A take with its labels put right, and what was and is wrong with it.

    labels   what was wrong with the labels, in the order in which it was put right
    samples  what is wrong with what is under the right labels now
    replaced  the kinds whose samples are not believed
    strays   those of them that only the solved body showed
    dismissed  moves that the body did not bear out
    """

    take: Take
    label_faults: tuple[Fault, ...]
    sample_faults: Faults
    replaced_kinds: tuple[FaultKind, ...] = REPLACED_SAMPLE_KINDS
    body_faults: tuple[Fault, ...] = ()
    rejected_shifts: tuple[Fault, ...] = ()

    @property
    def faults(self) -> Faults:
        return self.sample_faults.add_faults(self.label_faults)

    @property
    def inlier_take(self) -> Take:
        """The samples that were measured and are not judged faulty."""
        return self.take.masked(self.sample_faults.compute_inlier_mask(self.take, self.replaced_kinds) & self.take.measured)

    @property
    def donor_markers(self) -> tuple[int, ...]:
        """The markers whose labels only name pieces of other markers: they are neither judged nor filled."""
        return tuple(sorted(find_namesakes(self.take)))

    @property
    def solver_mask(self) -> np.ndarray:
        """(T, M) bool: the samples that the body listens to (see faults.Faults.heard)."""
        return self.sample_faults.compute_solver_mask(self.take, self.replaced_kinds) & self.take.measured


def detect_on_trajectories(
    take: Take, marker_set: MarkerSet | None, subject: Subject | None, is_accepted: FaultFilter, refill: bool = False
) -> DetectionState:
    """-> the take after the first look.

    worn_set  what the labels say that it wears, None where they say nothing; subject  who wears it, where that is known
    stands    says whether a fault may be one
    refill    other programs' fills are to be replaced where the rest contradicts them
    """
    labels: list[Fault] = []
    if marker_set:
        labels += [fault for fault in detect_mislabelled(take, marker_set, subject) if is_accepted(fault)]
        take = undo_label_exchanges(take, labels)
    for _ in range(MAX_DETECTION_ROUNDS):
        pieces = [fault for fault in detect_fragments(take) if is_accepted(fault)]
        joined = join_fragments(take, pieces)
        swaps = [
            fault
            for fault in detect_label_swaps(joined.masked(joined.measured))
            if is_accepted(fault) and fault.confidence >= MIN_LABEL_CONFIDENCE
        ]
        labels = [*(fault for fault in labels if not _is_unused_fragment(fault)), *pieces, *swaps]
        take = undo_label_exchanges(joined, swaps)
        if not swaps:
            break
    return DetectionState(
        take,
        tuple(labels),
        detect_remaining_faults(take, marker_set, is_accepted),
        (*REPLACED_SAMPLE_KINDS, *EXTERNAL_FILL_KINDS) if refill else REPLACED_SAMPLE_KINDS,
    )


def detect_remaining_faults(take: Take, marker_set: MarkerSet | None, is_accepted: FaultFilter) -> Faults:
    """-> what is wrong with the samples of a take whose labels are right; what is no marker's own label is not judged.

    What is judged faulty will be replaced, and beside it more may show: it is looked for until there is none, for else it would
    be found when the cleaned take is cleaned again.
    """
    donors, known = find_namesakes(take), Faults()
    for _ in range(MAX_DETECTION_ROUNDS):
        left = replace(take, computed=take.visible & ~take.measured | known.compute_faulty_mask(take))
        found = [
            fault for fault in detect_sample_faults(left, marker_set).items if fault.marker not in donors and is_accepted(fault)
        ]
        worse = [fault for fault in found if fault.kind in REPLACED_SAMPLE_KINDS]
        known = Faults(tuple(fault for fault in found if fault.kind not in REPLACED_SAMPLE_KINDS)).add_faults(
            (*known.select_kinds(*REPLACED_SAMPLE_KINDS), *worse)
        )
        if not worse:
            break
    return known


def detect_on_body(
    state: DetectionState, epochs: MarkerEpochs, body: BodyFit, marker_set: MarkerSet, is_accepted: FaultFilter
) -> DetectionState | None:
    """-> the take after a look at the solved body; None where that shows nothing new."""
    old, dismissed = state.faults.items, (*state.rejected_shifts, *find_unconfirmed_shifts(state, epochs, body))
    more = [
        fault
        for fault in detect_epoch_body_faults(state, epochs, body)
        if is_accepted(fault) and not any(_is_same_fault(fault, each) for each in old)
    ]
    swaps = [fault for fault in more if fault.kind in LABEL_KINDS]
    new = [fault for fault in more if fault.kind not in LABEL_KINDS and not any(fault.overlaps(swap) for swap in swaps)]
    if not swaps and not new and len(dismissed) == len(state.rejected_shifts):
        return None
    take, labels = undo_label_exchanges(state.take, swaps), (*state.label_faults, *swaps)
    strays = (*(fault for fault in state.body_faults if not any(fault.overlaps(swap) for swap in swaps)), *new)
    known = (
        detect_remaining_faults(take, marker_set, is_accepted).add_faults(strays)
        if swaps
        else state.sample_faults.add_faults(new)
    )
    left = tuple(fault for fault in known.items if not any(_is_same_fault(fault, each) for each in dismissed))
    return DetectionState(take, labels, Faults(left), state.replaced_kinds, strays, dismissed)


def find_unconfirmed_shifts(state: DetectionState, epochs: MarkerEpochs, body: BodyFit) -> list[Fault]:
    """-> the moves after which the body has the marker where it was before: a joint or skin, not the marker."""
    place = {int(column): body.extended_subject.marker_offsets[k] for k, column in enumerate(body.marker_columns) if column >= 0}
    found = []
    for fault in state.sample_faults.select_kinds(*SHIFT_KINDS):
        before, after = (epochs.find_column(fault.marker, frame) for frame in (fault.first - 1, fault.last))
        if fault.marker in place and (
            after not in place
            or np.linalg.norm(place[after] - place.get(before, np.inf)) < MIN_CONFIRMED_SHIFT_FRACTION * fault.severity
        ):
            found.append(fault)
    return found


def detect_epoch_body_faults(state: DetectionState, epochs: MarkerEpochs, body: BodyFit) -> list[Fault]:
    """-> what does not fit the solved body, by the take's own markers; of exchanged labels only what is sure, and of a burst
    of jitter nothing, for that is known."""
    believed, heard = (
        epochs.take.select(body.marker_columns, epochs.split_mask(mask))
        for mask in (state.inlier_take.visible, state.solver_mask)
    )
    found = detect_body_faults(believed, heard.visible, body.extended_subject, body.motion)
    whose = [epochs.column_marker[column] if column >= 0 else -1 for column in body.marker_columns]
    more = [replace(f, marker=int(whose[f.marker]), other_markers=tuple(int(whose[m]) for m in f.other_markers)) for f in found]
    known = state.sample_faults.select_kinds("jitter")
    return [
        fault
        for fault in more
        if -1 not in fault.markers
        and not (fault.kind in LABEL_KINDS and fault.confidence < MIN_LABEL_CONFIDENCE)
        and (fault.kind in SHIFT_KINDS or not any(fault.overlaps(burst) for burst in known))
    ]


def _is_unused_fragment(fault: Fault) -> bool:
    """Is it a piece of a trajectory that nothing came of, to be told of again?"""
    return isinstance(fault, Fragment) and fault.relation in ("other", "doubles")


def _is_same_fault(one: Fault, other: Fault) -> bool:
    return one.kind == other.kind and one.markers == other.markers and (one.first, one.last) == (other.first, other.last)
