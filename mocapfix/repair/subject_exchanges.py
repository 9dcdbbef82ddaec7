"""Labels that the subjects of a take exchanged, exchanged back before each subject is cleaned as a take of its own."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np

from mocapfix.changes import Change, build_changes
from mocapfix.detect.subject_exchanges import detect_subject_exchanges
from mocapfix.errors import format_name_list
from mocapfix.faults import MIN_LABEL_CONFIDENCE, Fault
from mocapfix.fill.gap_filling import compute_editable_mask
from mocapfix.marker_sets.library import UNASSIGNED_SUBJECT
from mocapfix.options import CleanOptions
from mocapfix.review.changes_file import Review
from mocapfix.solve.parallel import map_in_processes
from mocapfix.take import Take


@dataclass(frozen=True)
class SubjectExchanges:
    """The exchanges of labels between the subjects of a take.

    Attributes:
        original_take: The take as read.
        take: The take with the labels exchanged back.
        faults: The exchanges, as label swaps of markers of the take.
    """

    original_take: Take
    take: Take
    faults: tuple[Fault, ...] = ()

    def add_notes(self, part: Take) -> Take:
        """Return one subject's part of the take with notes on the labels that it exchanged."""
        return replace(part, notes=(*part.notes, *_describe_exchanges(self, part.subject_name)))

    def build_changes(self, cleaned: Take) -> dict[str, list[Change]]:
        """Return the changes by subject, that of the first marker of each. `cleaned` is the cleaned take of all subjects."""
        changes: dict[str, list[Change]] = {}
        methods = np.full(cleaned.visible.shape, "", object)
        for change, fault in build_changes(self.original_take, self.take, cleaned, self.faults, None, methods):
            changes.setdefault(self.take.marker_subjects[fault.marker], []).append(change)
        return changes


def correct_subject_labels(
    take: Take, parts: Sequence[Take], reviews: Sequence[Review], options: CleanOptions
) -> SubjectExchanges:
    """Find the labels that subjects exchanged, and exchange them back.

    Args:
        take: The take of all subjects.
        parts: The takes of the subjects.
        reviews: The review of each part: exchanges that it declined are left as they are.
        options: `detect.repair_kinds`, `fill.keep` and `fill.frames` restrict what is changed.
    """
    names = [part.subject_name for part in parts if part.subject_name != UNASSIGNED_SUBJECT]
    if len(names) < 2 or (options.detect.repair_kinds and "swap" not in options.detect.repair_kinds):
        return SubjectExchanges(take, take)
    is_editable = compute_editable_mask(take, options.fill)
    is_declined = _build_declined_filter(take, reviews)
    faults: list[Fault] = []
    corrected = take
    pairs, done = list(combinations(names, 2)), 0
    while done < len(pairs):
        detect = partial(_detect_in_pair, corrected)
        for detected in map_in_processes(detect, pairs[done:]):
            done += 1
            found = [
                fault
                for fault in detected
                if fault.confidence >= MIN_LABEL_CONFIDENCE
                and is_editable[fault.frame_slice][:, list(fault.markers)].all()
                and not is_declined(fault)
            ]
            if found:  # the pairs that follow are compared with these labels corrected
                corrected = corrected.exchange_labels_in_turn([(fault.markers, fault.first, fault.last) for fault in found])
                faults += found
                break
    return SubjectExchanges(take, corrected, tuple(faults)) if faults else SubjectExchanges(take, take)


def _detect_in_pair(take: Take, pair: tuple[str, str]) -> list[Fault]:
    return detect_subject_exchanges(take, *pair)


def _build_declined_filter(take: Take, reviews: Sequence[Review]) -> Callable[[Fault], bool]:
    declined = [each for review in reviews for each in review.declined if each.entry.kind == "swap"]

    def is_declined(fault: Fault) -> bool:
        labels = [take.labels[m] for m in fault.markers]
        return any(each.entry.markers == labels and each.first <= fault.last and fault.first <= each.last for each in declined)

    return is_declined


def _describe_exchanges(exchanges: SubjectExchanges, subject: str) -> list[str]:
    """Return a sentence for each interval in which a subject exchanged labels with another one."""
    take = exchanges.take
    labels: dict[tuple[str, int, int], list[str]] = {}
    for fault in exchanges.faults:
        subjects = [take.marker_subjects[m] for m in fault.markers]
        if subject in subjects:
            other = next(name for name in subjects if name != subject)
            labels.setdefault((other, fault.first, fault.last), []).append(take.bare_labels[fault.marker])
    return [
        f"{subject} and {other} had exchanged the labels {format_name_list(names)} in frames {take.get_frame_number(first)} to "
        f"{take.get_frame_number(last)}; they are exchanged back."
        for (other, first, last), names in labels.items()
    ]
