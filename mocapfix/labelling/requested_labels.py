"""Labels for a take without any, by the marker set or the person that the user names."""

from mocapfix.errors import TakeError
from mocapfix.labelling.labeller import label_points
from mocapfix.labelling.linking import find_tracklets
from mocapfix.labelling.take_labelling import apply_labels, collect_unlabelled_points
from mocapfix.marker_sets.library import SubjectChoice
from mocapfix.take import Take


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
    labels = label_points(find_tracklets(points.positions, take.rate), request.marker_set, request.subject)
    if not (labels.marker_indices >= 0).any():
        raise TakeError(
            f"{take.name}: no person with the markers of {request.marker_set.name} was found in its {count} points; "
            "check the marker set, the unit and the up axis (--up)."
        )
    return apply_labels(take, points, labels, request.marker_set.labels)
