"""Several subjects in one file: split into one take for each, and their results merged again.

Labels name the subject ("Jim:LFHD"). A file with one body, whole or in part, or with none is cleaned as one take: markers
that are not the body's (such as a prop) are filled from markers that move with them. Of a file with several bodies each is
cleaned separately, and the unassigned markers are cleaned together as one more take without a body.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from mocapfix.errors import TakeError, format_name_list, join_names
from mocapfix.io.changes_file import Review, read_changes_files
from mocapfix.labels.subject_exchanges import SubjectExchanges, correct_subject_labels
from mocapfix.model.changes import Change, serialize_changes
from mocapfix.model.faults import Fault, Faults, Fragment
from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.take import ComputedPoints, Take
from mocapfix.options import CleanOptions, SubjectOptions
from mocapfix.result import CleaningResult
from mocapfix.subject.library import UNASSIGNED_SUBJECT, choose_marker_set, load_requested_subject, select_subject

MIN_UNASSIGNED_MARKERS = 3  # the number of unassigned markers visible in one frame that is needed to fill them from each other


def split_known_subjects(take: Take, options: SubjectOptions) -> tuple[Take, ...]:
    """Split a take as `split_subjects`, with the marker set and the name that the options give.

    Raises TakeError where the options give one subject for a take of several, or subjects of whom it shows none.
    """
    takes = split_subjects(take, load_requested_subject(options).marker_set, options.subject_prefix)
    if isinstance(options.subject, tuple) and not any(choose_subject(each, options).subject for each in takes):
        given = " and ".join(name for name, _ in options.subject)
        shown = format_subject_names(takes) or take.main_subject or "no named subject"
        raise TakeError(f"{take.name}: shows {shown}, but --subject is for {given}.")
    if options.subject is not None and not isinstance(options.subject, tuple) and len(takes) > 1:
        names = format_subject_names(takes)
        raise TakeError(
            f"{take.name}: shows {names}, but --subject describes one person; name that person with --subject-prefix."
        )
    return takes


def split_corrected_subjects(take: Take, options: CleanOptions) -> tuple[tuple[Take, ...], list[Review], SubjectExchanges]:
    """Split a take as `split_known_subjects`, with the labels that its subjects exchanged exchanged back.

    Returns the takes, the review of each, and the exchanges. Raises as `split_known_subjects`.
    """
    parts = split_known_subjects(take, options.subject)
    reviews = read_changes_files(options.review.review_files, parts, take.labels)
    exchanges = correct_subject_labels(take, parts, reviews, options)
    if exchanges.faults:
        parts = tuple(exchanges.add_notes(part) for part in split_known_subjects(exchanges.take, options.subject))
    return parts, reviews, exchanges


def choose_subject(take: Take, options: SubjectOptions) -> SubjectOptions:
    """Return the options with the subject of one subject's take, where they name several by prefix; None without one for it."""
    if not isinstance(options.subject, tuple):
        return options
    by_prefix = {prefix.casefold(): path for prefix, path in options.subject}
    return replace(options, subject=by_prefix.get(take.main_subject.casefold()))


def find_bodies(take: Take, marker_set: MarkerSet | None = None) -> tuple[str, ...]:
    """Return the names of the subjects of whom a take shows the body or a part of it, in the order of its labels.

    Args:
        take: the take. The name is "" for labels without a subject name.
        marker_set: the marker set that they must match; None: any of the shipped sets.
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
        marker_set: as for `find_bodies`.
        subject_prefix: the only subject to clean; all other markers are left out.

    Raises:
        TakeError: where no subject has that name.
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


def list_shared_data(takes: Sequence[Take]) -> list[object]:
    """Return the takes of several subjects and the arrays in them, which a result may hold as they are."""
    held = [
        each for take in takes for each in (take, take.unlabelled, take.computed_points and take.computed_points.take) if each
    ]
    return [*held, *(value for each in held for value in vars(each).values() if isinstance(value, np.ndarray | bytes))]


def is_same_data(one: Take | None, other: Take | None) -> bool:
    """Return whether two takes of unlabelled trajectories have the same samples."""
    if one is None or other is None or one is other:
        return one is other
    return one.labels == other.labels and np.array_equal(one.markers, other.markers, equal_nan=True)


def merge_results(exchanges: SubjectExchanges, subject_results: tuple[CleaningResult, ...]) -> CleaningResult:
    """Return the result of the whole take from those of its subjects, which it holds. It has no subject or motion of its own.

    The labels that subjects exchanged are changes of the subject of the first marker of each exchange. Where two subjects took
    samples from the same unlabelled trajectory, the first one keeps them.
    """
    take = exchanges.original_take
    parts = [(take.find_marker_indices(each.input_take), each) for each in subject_results]
    residual_m = np.full(take.visible.shape, np.nan)
    faults, unfilled, donors = list(exchanges.faults), [], list[int]()
    for markers, each in parts:
        trajectories = [*markers.tolist(), *range(len(take.labels), len(take.labels) + _count_unlabelled(take))]
        faults += [_map_fault_indices(fault, trajectories) for fault in each.faults.items]
        unfilled += [replace(run, marker=trajectories[run.marker]) for run in each.unfilled_runs]
        donors += [trajectories[donor] for donor in each.fragment_donors]
        if each.residual_m is not None:
            residual_m[:, markers] = each.residual_m
    cleaned = _insert_parts(exchanges.take, [(markers, each.take) for markers, each in parts])
    relabelled = _insert_parts(exchanges.take, [(markers, each.relabelled_take) for markers, each in parts])
    changes = exchanges.build_changes(cleaned)
    subject_results = tuple(_add_changes(each, changes.get(each.input_take.subject_name, [])) for each in subject_results)
    return CleaningResult(
        input_take=take,
        relabelled_take=relabelled,
        take=cleaned,
        faults=Faults().add_faults(faults),
        changes=tuple(change for each in subject_results for change in each.changes),
        unfilled_runs=tuple(sorted(unfilled, key=lambda run: (run.marker, run.first))),
        fragment_donors=tuple(sorted(donors)),
        residual_m=residual_m,
        report={"people": {each.input_take.subject_name: each.subject_report for each in subject_results}},
        subject_results=subject_results,
    )


def _add_changes(result: CleaningResult, changes: list[Change]) -> CleaningResult:
    """Return the result of one subject with further changes before its own."""
    if not changes:
        return result
    changes = [*changes, *result.changes]
    return replace(result, changes=tuple(changes), report={**result.subject_report, "changes": serialize_changes(changes)})


def _insert_parts(whole: Take, parts: Sequence[tuple[Int[np.ndarray, " M"], Take]]) -> Take:
    """Return the whole take with the markers of its parts, at their indices, and with the unlabelled trajectories of the last."""

    def insert(get: Callable[[Take], np.ndarray]) -> np.ndarray:
        merged = get(whole).copy()
        for marker_indices, part in parts:
            merged[:, marker_indices] = get(part)
        return merged

    computed_points = whole.computed_points
    for _, part in parts:
        computed_points = _merge_computed_points(computed_points, part.computed_points)
    return replace(
        whole,
        markers=insert(lambda take: take.markers),
        relabelled_points=insert(lambda take: take.source_points),
        sample_sd=insert(_get_sample_sd),
        computed=insert(lambda take: take.visible & ~take.measured),
        unlabelled=parts[-1][1].unlabelled,
        computed_points=computed_points,
    )


def _merge_computed_points(whole: ComputedPoints | None, part: ComputedPoints | None) -> ComputedPoints | None:
    """Return the computed points of the whole take with those samples that were updated in a part of it."""
    if whole is None or part is None or part.take.sample_sd is None:
        return whole
    is_updated = ~np.isnan(part.take.sample_sd)
    markers = np.where(is_updated[..., None], part.take.markers, whole.take.markers)
    sample_sd = np.where(is_updated, part.take.sample_sd, _get_sample_sd(whole.take))
    return replace(whole, take=whole.take.replace_markers(markers, sample_sd))


def _get_sample_sd(take: Take) -> Float[np.ndarray, "T M"]:
    return np.full(take.visible.shape, np.nan) if take.sample_sd is None else take.sample_sd


def _count_unlabelled(take: Take) -> int:
    return len(take.unlabelled.labels) if take.unlabelled else 0


def _map_fault_indices(fault: Fault, trajectories: list[int]) -> Fault:
    """Return a fault of a part as one of the whole take. `trajectories` are the indices of the part's trajectories there."""
    mapped = replace(fault, marker=trajectories[fault.marker], other_markers=tuple(trajectories[m] for m in fault.other_markers))
    if isinstance(mapped, Fragment) and isinstance(fault, Fragment) and fault.donor >= 0:
        return replace(mapped, donor=trajectories[fault.donor])
    return mapped
