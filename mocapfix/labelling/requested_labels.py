"""Labels for a take that has none with a meaning: of the named marker set or person, of the shipped set that fits clearly, or
numbers."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mocapfix.animation import Animation
from mocapfix.errors import TakeError, format_name_list
from mocapfix.labelling.arbitrary_labels import are_labels_arbitrary
from mocapfix.labelling.fragment_joining import join_trajectories
from mocapfix.labelling.label_summary import CERTAIN_LABEL_CONFIDENCE, describe_labelling
from mocapfix.labelling.labeller import find_labelled_body, label_points
from mocapfix.labelling.linking import are_points_unordered
from mocapfix.labelling.points import PointLabels, UnlabelledPoints
from mocapfix.labelling.reference_labeller import label_points_like
from mocapfix.labelling.reference_markers import build_reference_markers
from mocapfix.labelling.set_comparison import assume_marker_set, describe_better_set
from mocapfix.labelling.several_people import label_people, separate_people
from mocapfix.labelling.take_labelling import (
    FilePoints,
    apply_labels,
    collect_labelled_points,
    collect_unlabelled_points,
    find_file_tracklets,
)
from mocapfix.marker_set import MarkerSet
from mocapfix.marker_sets.library import (
    SubjectChoice,
    choose_marker_set,
    find_subject_prefixes,
    load_requested_subject,
    load_shipped_marker_sets,
)
from mocapfix.options import CleanOptions, ReadOptions
from mocapfix.read.capture import read_capture
from mocapfix.subject import Subject
from mocapfix.take import Take

MIN_CERTAIN_SHARE = 0.9
"""Share of the points that must get certain labels of a set that the user did not name."""
MIN_NAMED_SET_EVIDENCE = 0.5
"""Evidence per marker below which the points show no person with the markers of a named set; that of right sets is 1.8 to 3.7."""
MAX_COMMON_LABEL_SHARE = 0.1
"""Share of the labels of a take up to which labels that another take has as well are a coincidence."""
MIN_REFERENCE_SHARE = 0.1
"""Share of the frames in which a labelled take shows the markers that are looked for."""
MIN_FOUND_MARKER_SHARE = 0.5
"""Share of these markers that must be found."""
MIN_JOINED_SHARE = 0.8
"""Share of the points that must be joined to markers where no set is known."""
MAX_LISTED_ARBITRARY_LABELS = 3
"""Labels without a meaning that a sentence lists."""


def label_capture(
    take: Take, options: CleanOptions, calibrate: Callable[[Sequence[Path], CleanOptions], Subject]
) -> tuple[Take, CleanOptions]:
    """Return the take with labels if it has none, and the options with the subject of the labelled take that they name.

    Args:
        take: The take.
        options: `options.subject` names a marker set, a subject or a labelled take.
        calibrate: Returns the subject of labelled takes.

    Raises:
        TakeError: As `label_take`, or where the options name a labelled take and a marker set or a subject.
    """
    requested = options.subject
    if requested.like is not None:
        if requested.subject is not None or requested.marker_set is not None:
            raise TakeError("--like takes the markers and the person from a take; leave out --marker-set and --subject.")
        labelled = label_take_like(take, Path(requested.like), options.read)
        if labelled is not None:
            return labelled, options.change(like=None)
        subject = calibrate([Path(requested.like)], CleanOptions(read=options.read))
        options = options.change(subject=subject, like=None)
    return label_take(take, load_requested_subject(options.subject)), options


def label_take(take: Take, request: SubjectChoice) -> Take:
    """Return a take with labels if its points have none, or none with a meaning, and with the prefixes of its subjects.

    They are those of the marker set or the subject that the user names, or else of the shipped set that fits clearly. Where none
    does, fragments of the same markers are joined and numbered, and a take whose points cannot be joined, or are joined already,
    is returned as it is. Labels without a meaning are replaced only by those of a set or a subject that the user names.

    Raises TakeError if the points of a take without any label cannot be joined, or no person with the markers of a set that the
    user names is found.
    """
    take = replace(take, subject_prefixes=find_subject_prefixes(take.labels, request.marker_set))
    points = collect_unlabelled_points(take)
    if points is None:
        if request.marker_set is None or not are_labels_arbitrary(take.labels, request.marker_set):
            return take
        points = collect_labelled_points(take)
    count = points.positions.shape[1]
    tracklets = find_file_tracklets(points, take.rate)
    if request.marker_set is None:
        labelled, reason = label_by_assumed_set(take, points, tracklets)
        labelled = labelled or join_and_number(take, points, tracklets, reason)
        if labelled is None and not take.labels:
            raise TakeError(
                f"{take.name}: none of its {count} points has a label; name the markers with --marker-set, the person with "
                f"--subject, or a labelled take of the person with --like. {reason}"
            )
        return labelled or replace(take, notes=(*take.notes, reason))
    if request.subject is None:
        labels = label_people(tracklets, request.marker_set, label_points)
    else:
        labels = label_points(tracklets, request.marker_set, request.subject)
    if not (labels.marker_indices >= 0).any() or labels.evidence_per_marker < MIN_NAMED_SET_EVIDENCE:
        raise TakeError(
            f"{take.name}: no person with the markers of {request.marker_set.name} was found in its {count} points; "
            "check the marker set, the unit and the up axis (--up)."
        )
    labelled = _apply_labels_of_set(take, points, labels, request.marker_set)
    if request.subject is None and not labels.subject_indices.size:
        candidates = _load_candidates()
        if warning := describe_better_set(tracklets, labels, request.marker_set, candidates, find_labelled_body):
            return replace(labelled, notes=(warning, *labelled.notes))
    return labelled


def label_take_like(take: Take, path: Path, options: ReadOptions) -> Take | None:
    """Return a take without labels with those of a labelled take of the same person whose markers are in no shipped set.

    Returns None where the take has labels that may be those of the other one, or where a shipped set fits that.
    """
    other = read_capture(path, options)
    if isinstance(other, Animation) or collect_unlabelled_points(other) or choose_marker_set(other.labels).marker_set:
        return None
    points = collect_unlabelled_points(take)
    if points is None:
        if len(set(take.labels).intersection(other.labels)) > MAX_COMMON_LABEL_SHARE * len(take.labels):
            return None
        points = collect_labelled_points(take)
    shown = np.flatnonzero((other.visible & other.measured).mean(0) >= MIN_REFERENCE_SHARE)
    labels = tuple(other.labels[m] for m in shown)
    reference = build_reference_markers(other.masked(other.measured).markers[:, shown], labels)
    found = label_points_like(find_file_tracklets(points, take.rate), reference)
    count = len(np.unique(found.marker_indices[found.marker_indices >= 0]))
    if count < MIN_FOUND_MARKER_SHARE * len(labels):
        raise TakeError(
            f"{take.name}: only {count} of the {len(labels)} markers of {other.name} were found in its points; "
            "check that both takes show the same person with the same markers."
        )
    labelled = apply_labels(take, points, found, labels)
    bare_labels = tuple(label.rpartition(":")[2] for label in labels)
    note = f"No shipped marker set fits {other.name}: the points were labelled by the distances of its markers."
    return replace(labelled, notes=(*labelled.notes, note, *describe_labelling(labelled, bare_labels)))


def label_by_assumed_set(take: Take, points: FilePoints, tracklets: UnlabelledPoints) -> tuple[Take | None, str]:
    """Return the take with the labels of the shipped set that fits its points clearly, None if there is none, and the reason."""
    marker_set, reason = assume_marker_set(tracklets, _load_candidates(), find_labelled_body)
    if marker_set is None:
        return None, reason
    labels = label_points(tracklets, marker_set)
    is_certain = (labels.marker_indices >= 0) & (labels.confidence >= CERTAIN_LABEL_CONFIDENCE)
    share = float(is_certain.sum() / max(1, (tracklets.tracklet_indices >= 0).sum()))
    if share < MIN_CERTAIN_SHARE:
        return (
            None,
            f"The nearest shipped marker set is {marker_set.name}, but only {share:.0%} of the points get certain labels.",
        )
    labelled = _apply_labels_of_set(take, points, labels, marker_set)
    return replace(labelled, notes=(reason, *labelled.notes)), reason


def join_and_number(take: Take, points: FilePoints, tracklets: UnlabelledPoints, reason: str) -> Take | None:
    """Return the take with the fragments of each marker joined, where no set is known; None if there is little to join.

    reason  why no set is known
    """
    largest = int((tracklets.tracklet_indices >= 0).sum(axis=1).max(initial=0))
    if take.labels and points.positions.shape[1] <= largest and not are_points_unordered(points.positions):
        return None
    labels, names = join_trajectories(tracklets, label_points_like)
    share = float((labels.marker_indices >= 0).sum() / max(1, (tracklets.tracklet_indices >= 0).sum()))
    if share < MIN_JOINED_SHARE:
        return None
    labelled = apply_labels(take, points, labels, names)
    note = f"{reason} The trajectories of each marker were joined by how markers move together: {names[0]} to {names[-1]}."
    return replace(labelled, notes=(*labelled.notes, note, *describe_labelling(labelled, names)))


def _load_candidates() -> list[MarkerSet]:
    """Return the shipped sets of markers, without those of keypoints."""
    return [each for each in load_shipped_marker_sets() if not each.point_sd]


def _apply_labels_of_set(take: Take, points: FilePoints, labels: PointLabels, marker_set: MarkerSet) -> Take:
    labelled = apply_labels(take, points, *separate_people(labels, marker_set.labels))
    notes = list(describe_labelling(labelled, marker_set.required_labels))
    if points.replaced_labels:
        names = format_name_list(points.replaced_labels, MAX_LISTED_ARBITRARY_LABELS)
        notes.insert(
            0, f"The labels {names} mean nothing in {marker_set.name}: the trajectories were labelled by their positions."
        )
    return replace(labelled, notes=(*labelled.notes, *notes))


def describe_missing_labels(take: Take, result: Take) -> str:
    """Return why `label_take` gave a take no labels and returned it as `result`."""
    if collect_unlabelled_points(take) is not None:
        return f"{take.name}: {result.notes[-1]} Name the markers with --marker-set, the person with --subject, or --like."
    names = format_name_list(take.labels, MAX_LISTED_ARBITRARY_LABELS)
    return (
        f"{take.name}: has labels already ({names}); `mocapfix clean` finds those that are wrong. Labels that mean nothing, such "
        "as M01, are replaced if --marker-set, --subject or --like names the markers."
    )
