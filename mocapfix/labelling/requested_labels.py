"""Labels for a take without any, by the marker set or the person that the user names."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from mocapfix.errors import TakeError
from mocapfix.labelling.label_summary import describe_labelling
from mocapfix.labelling.labeller import label_points
from mocapfix.labelling.linking import find_tracklets
from mocapfix.labelling.several_people import label_people, separate_people
from mocapfix.labelling.take_labelling import apply_labels, collect_unlabelled_points
from mocapfix.marker_sets.library import SubjectChoice, load_requested_subject
from mocapfix.options import CleanOptions
from mocapfix.subject import Subject
from mocapfix.take import Take


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
        subject = calibrate([Path(requested.like)], CleanOptions(read=options.read))
        options = options.change(subject=subject, like=None)
    return label_take(take, load_requested_subject(options.subject)), options


def label_take(take: Take, request: SubjectChoice) -> Take:
    """Return a take with labels if its points have none, by the marker set or the subject that the user names.

    Raises TakeError if no set is named for a take without any label, or no person with the markers of the set is found in it.
    """
    points = collect_unlabelled_points(take)
    if points is None or (request.marker_set is None and take.labels):
        return take
    count = points.positions.shape[1]
    if request.marker_set is None:
        raise TakeError(
            f"{take.name}: none of its {count} points has a label; name the markers with --marker-set, the person with "
            "--subject, or a labelled take of the person with --like."
        )
    tracklets = find_tracklets(points.positions, take.rate)
    if request.subject is None:
        labels = label_people(tracklets, request.marker_set, label_points)
    else:
        labels = label_points(tracklets, request.marker_set, request.subject)
    if not (labels.marker_indices >= 0).any():
        raise TakeError(
            f"{take.name}: no person with the markers of {request.marker_set.name} was found in its {count} points; "
            "check the marker set, the unit and the up axis (--up)."
        )
    labelled = apply_labels(take, points, *separate_people(labels, request.marker_set.labels))
    return replace(labelled, notes=(*labelled.notes, *describe_labelling(labelled, request.marker_set.required_labels)))
