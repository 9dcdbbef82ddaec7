"""The labels of a take whose trajectories have none: the points of its file, labelled and read again."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.errors import TakeError
from mocapfix.files.layouts import C3dLayout
from mocapfix.labelling.labeller import label_points
from mocapfix.labelling.linking import find_tracklets
from mocapfix.labelling.points import PointLabels
from mocapfix.marker_set import MarkerSet
from mocapfix.marker_sets.library import SubjectChoice
from mocapfix.read.c3d_parameters import read_c3d_parameters
from mocapfix.read.capture import read_capture_bytes
from mocapfix.read.file_content import read_file_bytes
from mocapfix.read.point_types import NUMBERED_POINT_NAME
from mocapfix.subject import Subject
from mocapfix.take import Take
from mocapfix.write.labelled_files import LabelledColumns, build_labelled_c3d, build_labelled_table, plan_columns


@dataclass(frozen=True)
class FilePoints:
    """The points of a take that have no labels.

    Attributes:
        positions: Metres, Y up, NaN where missing.
        columns: Their indices among the points of the file.
    """

    positions: Float[np.ndarray, "T C 3"]
    columns: Int[np.ndarray, " C"]


def collect_unlabelled_points(take: Take) -> FilePoints | None:
    """Return the points of a take in which no point has a label, None for any other take."""
    is_numbered = [label.startswith(f"{NUMBERED_POINT_NAME} ") for label in take.labels]
    if not all(is_numbered):
        return None
    parts = [each for each in (take if take.labels else None, take.unlabelled) if each is not None]
    if not parts:
        return None
    return FilePoints(
        np.concatenate([each.markers for each in parts], axis=1), np.concatenate([each.point_indices for each in parts])
    )


def label_requested_take(take: Take, request: SubjectChoice) -> Take:
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
    labelled = label_take(take, points, request.marker_set, request.subject)
    if labelled is take:
        raise TakeError(
            f"{take.name}: no person with the markers of {request.marker_set.name} was found in its {count} points; "
            "check the marker set, the unit and the up axis (--up)."
        )
    return labelled


def label_take(take: Take, points: FilePoints, marker_set: MarkerSet, subject: Subject | None = None) -> Take:
    """Return a take with the labels of a set for its unlabelled points; the same take if no body was found in it.

    Args:
        take: The take.
        points: Its points, by `collect_unlabelled_points`.
        marker_set: The markers of the person.
        subject: The person, if known.
    """
    tracklets = find_tracklets(points.positions, take.rate)
    labels = label_points(tracklets, marker_set, subject)
    if not (labels.marker_indices >= 0).any():
        return take
    return apply_labels(take, points, labels, marker_set.labels)


def apply_labels(take: Take, points: FilePoints, point_labels: PointLabels, labels: tuple[str, ...]) -> Take:
    """Return the take as it is read from its file with labels."""
    is_visible = ~np.isnan(points.positions[..., 0])
    names = list_point_names(take)
    columns = plan_columns(names, points.columns, point_labels.marker_indices, is_visible, labels)
    if isinstance(take.layout, C3dLayout):
        data = build_labelled_c3d(take, columns)
    else:
        data = build_labelled_table(take, gather_positions(points, columns), columns.labels)
    assert take.path is not None
    labelled = read_capture_bytes(take.path, data, take.up_axis.letter if take.up_axis else None)
    assert isinstance(labelled, Take)
    confidence = gather_confidence(points, point_labels.confidence, columns)[:, labelled.point_indices]
    return replace(labelled, labelled_file=data, label_confidence=confidence, up_axis=take.up_axis)


def list_point_names(take: Take) -> list[str]:
    """Return the labels of all points of a take's file, in the order of the file."""
    if isinstance(take.layout, C3dLayout):
        assert take.path is not None
        names = list(read_c3d_parameters(read_file_bytes(take.path)).labels)[: take.layout.point_count]
        return names + [""] * (take.layout.point_count - len(names))
    parts = [each for each in (take, take.unlabelled, take.computed_points and take.computed_points.take) if each is not None]
    names = [""] * (1 + max(int(each.point_indices.max(initial=0)) for each in parts))
    for part in parts:
        for point, label in zip(part.point_indices.tolist(), part.labels, strict=True):
            names[point] = label
    return names


def gather_positions(points: FilePoints, columns: LabelledColumns) -> Float[np.ndarray, "T P 3"]:
    """Return the positions in metres in the columns of a labelled file."""
    return np.stack([_gather(points, points.positions[..., axis], columns) for axis in range(3)], axis=-1)


def gather_confidence(points: FilePoints, confidence: Float[np.ndarray, "T C"], columns: LabelledColumns) -> np.ndarray:
    """Return the confidence (T, P) in the columns of a labelled file."""
    return _gather(points, confidence, columns)


def _gather(points: FilePoints, values: Float[np.ndarray, "T C"], columns: LabelledColumns) -> Float[np.ndarray, "T P"]:
    place = np.full(int(max(columns.source_points.max(), points.columns.max())) + 2, -1)
    place[points.columns] = np.arange(len(points.columns))
    sources = place[columns.source_points]
    is_known: Bool[np.ndarray, "T P"] = (sources >= 0) & (columns.source_points >= 0)
    return np.where(is_known, np.take_along_axis(values, np.maximum(sources, 0), axis=1), np.nan)
