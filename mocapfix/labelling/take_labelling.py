"""The labels of a take whose trajectories have none, or none with a meaning: the points of its file, labelled and read again."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.files.layouts import C3dLayout
from mocapfix.files.read_options import DEFAULT_READ_OPTIONS
from mocapfix.labelling.linking import are_points_unordered, find_tracklets
from mocapfix.labelling.points import PointLabels, UnlabelledPoints
from mocapfix.read.c3d_parameters import read_c3d_parameters
from mocapfix.read.capture import read_capture_bytes
from mocapfix.read.conventions import change_convention
from mocapfix.read.file_content import read_file_bytes
from mocapfix.read.point_types import NUMBERED_POINT_NAME
from mocapfix.take import Take
from mocapfix.write.labelled_files import LabelledColumns, build_labelled_c3d, build_labelled_table, plan_columns


@dataclass(frozen=True)
class FilePoints:
    """The points of a take that have no labels, or labels without a meaning.

    Attributes:
        positions: Metres, Y up, NaN where missing.
        columns: Their indices among the points of the file.
        replaced_labels: The labels without a meaning; empty if the points have none.
    """

    positions: Float[np.ndarray, "T C 3"]
    columns: Int[np.ndarray, " C"]
    replaced_labels: tuple[str, ...] = ()


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


def collect_labelled_points(take: Take) -> FilePoints:
    """Return the points of a take whose labels have no meaning."""
    return FilePoints(take.markers, take.point_indices, take.labels)


def find_file_tracklets(points: FilePoints, rate: float) -> UnlabelledPoints:
    """Divide the points of a take into tracklets; a trajectory with a label is one."""
    if not points.replaced_labels or are_points_unordered(points.positions):
        return find_tracklets(points.positions, rate)
    visible = ~np.isnan(points.positions[..., 0])
    first = np.where(visible.any(0), visible.argmax(0), len(visible))
    number = np.argsort(np.argsort(first, kind="stable"), kind="stable")
    return UnlabelledPoints(points.positions, np.where(visible, number, -1), rate)


def apply_labels(take: Take, points: FilePoints, point_labels: PointLabels, labels: tuple[str, ...]) -> Take:
    """Return the take as it is read from its file with labels."""
    is_visible = ~np.isnan(points.positions[..., 0])
    names = list_point_names(take)
    columns = plan_columns(names, points.columns, point_labels.marker_indices, is_visible, labels)
    if isinstance(take.layout, C3dLayout):
        data = build_labelled_c3d(take, columns)
    else:
        data = build_labelled_table(take, gather_positions(take, columns), columns.labels)
    assert take.path is not None
    known = replace(take.read_options or DEFAULT_READ_OPTIONS, accept_contradictions=True)
    labelled = read_capture_bytes(take.path, data, known)
    assert isinstance(labelled, Take)
    assert take.layout is not None
    labelled = change_convention(labelled, take.layout.unit_m, take.layout.rotation_y_up_file, take.up_axis)
    confidence = gather_confidence(points, point_labels, columns)[:, labelled.point_indices]
    return replace(labelled, labelled_file=data, label_confidence=confidence, read_options=take.read_options)


def list_point_names(take: Take) -> list[str]:
    """Return the labels of all points of a take's file, in the order of the file."""
    if isinstance(take.layout, C3dLayout):
        assert take.path is not None
        names = list(read_c3d_parameters(read_file_bytes(take.path)).labels)[: take.layout.point_count]
        return names + [""] * (take.layout.point_count - len(names))
    parts = _list_parts(take)
    names = [""] * (1 + max(int(each.point_indices.max(initial=0)) for each in parts))
    for part in parts:
        for point, label in zip(part.point_indices.tolist(), part.labels, strict=True):
            names[point] = label
    return names


def gather_positions(take: Take, columns: LabelledColumns) -> Float[np.ndarray, "T P 3"]:
    """Return the positions in metres in the columns of a labelled file."""
    parts = _list_parts(take)
    positions = np.concatenate([part.markers for part in parts], axis=1)
    points = np.concatenate([part.point_indices for part in parts])
    return np.stack([_gather(points, positions[..., axis], columns) for axis in range(3)], axis=-1)


def gather_confidence(points: FilePoints, labels: PointLabels, columns: LabelledColumns) -> Float[np.ndarray, "T P"]:
    """Return the confidence of the labels in the columns of a labelled file, NaN for points that got none."""
    return _gather(points.columns, np.where(labels.marker_indices >= 0, labels.confidence, np.nan), columns)


def _list_parts(take: Take) -> list[Take]:
    """Return the points of a take: its markers, its unlabelled trajectories and its computed points."""
    return [each for each in (take, take.unlabelled, take.computed_points and take.computed_points.take) if each is not None]


def _gather(points: Int[np.ndarray, " C"], values: Float[np.ndarray, "T C"], columns: LabelledColumns) -> np.ndarray:
    """Return values (T, P) in the columns of a labelled file, given those of some points of the file by their indices."""
    place = np.full(int(max(columns.source_points.max(), points.max())) + 2, -1)
    place[points] = np.arange(len(points))
    sources = place[columns.source_points]
    is_known: Bool[np.ndarray, "T P"] = (sources >= 0) & (columns.source_points >= 0)
    return np.where(is_known, np.take_along_axis(values, np.maximum(sources, 0), axis=1), np.nan)
