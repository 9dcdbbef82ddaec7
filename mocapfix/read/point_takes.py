"""Takes of the points of a file by type: markers, unlabelled trajectories, and points that a program computed from markers."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Int

from mocapfix.read.point_types import MIN_LABELLED_POINTS, PointConverter, PointTypes
from mocapfix.stats.exact_distances import MAX_FUNCTION_FRAMES
from mocapfix.stats.point_function_search import find_point_functions
from mocapfix.stats.point_functions import PointFunction
from mocapfix.stats.resolution import estimate_resolution
from mocapfix.stats.sequences import sample_evenly
from mocapfix.take import ComputedEvidence, ComputedPoints, Take

MAX_RESOLUTION_FRAMES = 2000  # from which the resolution of the coordinates is estimated


def find_computed_markers(
    types: PointTypes, visible: Bool[np.ndarray, "T P"], convert: PointConverter
) -> dict[int, PointFunction]:
    """Return those markers of a file that are exact functions of others, and the functions, all as columns of the file.

    There are none if too few markers were left. Only some frames are converted.

    Args:
        types: The types of the points of the file.
        visible: Whether each sample is valid.
        convert: Returns positions of points.
    """
    columns = types.markers
    is_visible = np.any(visible[:, columns], axis=0)
    if len(columns) < MIN_LABELLED_POINTS:
        return {}
    resolution_m = estimate_resolution(convert(columns, slice(MAX_RESOLUTION_FRAMES)))
    sampled = convert(columns, sample_evenly(len(visible), MAX_FUNCTION_FRAMES))
    functions = find_point_functions(sampled, resolution_m, is_visible, is_visible)
    if is_visible.sum() - len(functions) < MIN_LABELLED_POINTS:
        return {}
    return {
        int(columns[m]): replace(functions[m], parents=tuple(int(columns[parent]) for parent in functions[m].parents))
        for m in sorted(functions)
    }


def add_other_points(take: Take, types: PointTypes, functions: Mapping[int, PointFunction], convert: PointConverter) -> Take:
    """Return a take of the markers of a file with its other points.

    Args:
        take: The markers that are no functions of others, with `point_columns`.
        types: The types of the points of the file.
        functions: The markers that are functions of others, as `find_computed_markers` returns them.
        convert: Returns positions of points in the axes of the take.
    """
    by_name: tuple[ComputedEvidence, ...] = ("name",) * len(types.computed)
    by_function: tuple[ComputedEvidence, ...] = ("function",) * len(functions)
    unlabelled, computed = (
        _build_points_take(take, types, columns, convert) if len(columns) else None
        for columns in (types.unlabelled, np.array([*types.computed, *functions], int))
    )
    if computed:
        known = (*[None] * len(by_name), *functions.values())
        take = replace(take, computed_points=ComputedPoints(computed, by_name + by_function, known))
    markers = set(take.point_columns.tolist())
    return replace(
        take,
        unlabelled=unlabelled,
        other_labels=tuple(label for i, label in enumerate(types.labels) if i not in markers),
        notes=(*take.notes, *types.notes),
    )


def _build_points_take(take: Take, types: PointTypes, columns: Int[np.ndarray, " K"], convert: PointConverter) -> Take:
    labels = tuple(types.labels[i] for i in columns)
    return Take(convert(columns), labels, take.rate, take.first_frame, take.path, point_columns=columns)
