"""Several subjects in one file: split into one take for each (`result.merge_results` merges them again).

Labels name the subject ("Jim:LFHD"). A file with one body, whole or in part, or with none is cleaned as one take: markers
that are not the body's (such as a prop) are filled from markers that move with them. Of a file with several bodies each is
cleaned separately, and the unassigned markers are cleaned together as one more take without a body.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np

from mocapfix.errors import TakeError, format_name_list, join_names
from mocapfix.io.changes_file import Review, read_changes_files
from mocapfix.labels.subject_exchanges import SubjectExchanges, correct_subject_labels
from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.take import Take
from mocapfix.options import CleanOptions, SubjectOptions
from mocapfix.subject.library import UNASSIGNED_SUBJECT, choose_marker_set, load_requested_subject, select_subject

MIN_UNASSIGNED_MARKERS = 3  # the number of unassigned markers visible in one frame that is needed to fill them from each other


def split_known_subjects(take: Take, options: SubjectOptions) -> tuple[Take, ...]:
    """Split a take as `split_subjects`, with the marker set and the name that the options give.

    Raises:
        TakeError: Where the options give one subject for a take of several, or subjects of whom it shows none.
    """
    takes = split_subjects(take, load_requested_subject(options).marker_set, options.subject_prefix)
    _check_subject_files(take, takes, "--subject", options.subject)
    return takes


def _check_subject_files(take: Take, takes: Sequence[Take], flag: str, files: object) -> None:
    """Raise TakeError if an option has one file, or a subject, for a take of several subjects, or files of others only."""
    shown = format_subject_names(takes) or take.main_subject or "no named subject"
    if isinstance(files, tuple):
        by_prefix = cast("tuple[tuple[str, Path], ...]", files)
        if not any(choose_subject_file(each, by_prefix) for each in takes):
            raise TakeError(f"{take.name}: shows {shown}, but {flag} is for {' and '.join(name for name, _ in by_prefix)}.")
    elif files is not None and len(takes) > 1:
        raise TakeError(f"{take.name}: shows {shown}, but {flag} describes one person; name that person with --subject-prefix.")


def split_corrected_subjects(take: Take, options: CleanOptions) -> tuple[tuple[Take, ...], list[Review], SubjectExchanges]:
    """Split a take as `split_known_subjects`, with the labels that its subjects exchanged exchanged back.

    Returns the takes, the review of each, and the exchanges. Raises as `split_known_subjects`.
    """
    parts = split_known_subjects(take, options.subject)
    _check_subject_files(take, parts, "--person-memory", options.prior.person_memory)
    reviews = read_changes_files(options.review.review_files, parts, take.labels)
    exchanges = correct_subject_labels(take, parts, reviews, options)
    if exchanges.faults:
        parts = tuple(exchanges.add_notes(part) for part in split_known_subjects(exchanges.take, options.subject))
    return parts, reviews, exchanges


def choose_subject(take: Take, options: SubjectOptions) -> SubjectOptions:
    """Return the options with the subject of one subject's take, where they name several by prefix; None without one for it."""
    if not isinstance(options.subject, tuple):
        return options
    return replace(options, subject=choose_subject_file(take, options.subject))


def choose_subject_file(take: Take, files: str | Path | tuple[tuple[str, Path], ...] | None) -> str | Path | None:
    """Return the file of one subject's take, from one for all or one for each prefix; None without one for it."""
    if not isinstance(files, tuple):
        return files
    return {prefix.casefold(): path for prefix, path in files}.get(take.main_subject.casefold())


def find_bodies(take: Take, marker_set: MarkerSet | None = None) -> tuple[str, ...]:
    """Return the names of the subjects of whom a take shows the body or a part of it, in the order of its labels.

    Args:
        take: The take. The name is "" for labels without a subject name.
        marker_set: The marker set that they must match; None: any of the shipped sets.
    """
    subject_of_marker, is_visible = np.array(take.marker_subjects, object), take.visible.any(0)
    labels_of_subject = {
        name: [take.labels[m] for m in np.flatnonzero((subject_of_marker == name) & is_visible)]
        for name in dict.fromkeys(take.marker_subjects)
    }
    if marker_set is None:
        return tuple(name for name, labels in labels_of_subject.items() if choose_marker_set(labels).marker_set)
    return tuple(
        name
        for name, labels in labels_of_subject.items()
        if not marker_set.describe_missing_body(marker_set.match_labels(labels))
    )


def split_subjects(take: Take, marker_set: MarkerSet | None = None, subject_prefix: str | None = None) -> tuple[Take, ...]:
    """Return the takes to clean one after the other: the take itself, unless it shows several bodies or parts of bodies.

    Args:
        marker_set: As for `find_bodies`.
        subject_prefix: The only subject to clean; all other markers are left out.
    """
    if subject_prefix is not None:
        return (select_subject(take, subject_prefix),)
    names = find_bodies(take, marker_set)
    if len(names) < 2:
        return (take,)
    subject_of_marker = np.array(take.marker_subjects, object)
    takes = [take.extract_markers(np.flatnonzero(subject_of_marker == name), name or "unnamed") for name in names]
    unassigned = np.flatnonzero(~np.isin(subject_of_marker, names))
    if take.visible[:, unassigned].sum(1).max(initial=0) >= MIN_UNASSIGNED_MARKERS:
        return (*takes, take.extract_markers(unassigned, UNASSIGNED_SUBJECT))
    labels = format_name_list([take.labels[m] for m in unassigned])
    note = f"Unassigned markers, never {MIN_UNASSIGNED_MARKERS} of them visible at once: left unchanged: {labels}."
    return tuple(replace(each, notes=(*each.notes, note)) if len(unassigned) else each for each in takes)


def format_subject_names(takes: Iterable[Take]) -> str:
    """Return the names of the subjects for a sentence: "Jim and Ann"."""
    return join_names([take.subject_name for take in takes if take.subject_name != UNASSIGNED_SUBJECT])


def is_same_data(one: Take | None, other: Take | None) -> bool:
    """Return whether two takes of unlabelled trajectories have the same samples."""
    if one is None or other is None or one is other:
        return one is other
    return one.labels == other.labels and np.array_equal(one.markers, other.markers, equal_nan=True)
