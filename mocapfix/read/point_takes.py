"""Takes of the points of a file by type: markers, unlabelled trajectories, and points that a program computed from markers."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from mocapfix.read.point_types import MIN_LABELLED_POINTS, PointTypes
from mocapfix.stats.point_function_search import find_point_functions
from mocapfix.stats.point_functions import PointFunction
from mocapfix.stats.resolution import estimate_resolution
from mocapfix.take import ComputedEvidence, ComputedPoints, Take

MAX_RESOLUTION_FRAMES = 2000  # from which the resolution of the coordinates is estimated
PointConverter = Callable[[Int[np.ndarray, " K"]], Float[np.ndarray, "T K 3"]]


def add_other_points(take: Take, types: PointTypes, convert: PointConverter) -> Take:
    """Return a take of the markers of a file with its other points, and without those markers that are functions of others.

    Args:
        take: The markers, with `point_columns`.
        types: The types of the points of the file.
        convert: Returns the positions (m) of points in the axes of the take, NaN where missing.
    """
    unlabelled, computed = (
        _build_points_take(take, types, columns, convert) if len(columns) else None
        for columns in (types.unlabelled, types.computed)
    )
    named = None
    if computed:
        named = ComputedPoints(computed, ("name",) * len(types.computed), (None,) * len(types.computed))
    take = replace(take, unlabelled=unlabelled, computed_points=named, notes=(*take.notes, *types.notes))
    take = separate_computed_markers(take)
    markers = set(take.point_columns.tolist())
    return replace(take, other_labels=tuple(label for i, label in enumerate(types.labels) if i not in markers))


def separate_computed_markers(take: Take) -> Take:
    """Return a take without the markers that are exact functions of others; they are among its computed points."""
    if len(take.labels) < MIN_LABELLED_POINTS:
        return take
    resolution_m, is_visible = estimate_resolution(take.markers[:MAX_RESOLUTION_FRAMES]), np.any(take.visible, axis=0)
    functions = find_point_functions(take.markers, resolution_m, is_visible, is_visible)
    found = np.array(sorted(functions), int)
    kept = np.setdiff1d(np.arange(len(is_visible)), found)
    if not len(found) or is_visible[kept].sum() < MIN_LABELLED_POINTS:
        return take
    points = take.point_indices
    in_file: list[PointFunction | None] = [
        replace(functions[m], parents=tuple(int(points[parent]) for parent in functions[m].parents)) for m in found.tolist()
    ]
    evidence: list[ComputedEvidence] = ["function"] * len(found)
    named = take.computed_points
    computed = Take(
        take.markers[:, found],
        tuple(take.labels[m] for m in found),
        take.rate,
        take.first_frame,
        take.path,
        point_columns=points[found],
    )
    if named:
        computed = _join_takes(named.take, computed)
        evidence, in_file = [*named.evidence, *evidence], [*named.functions, *in_file]
    remaining = take.extract_markers(kept, take.subject_name)
    return replace(remaining, computed_points=ComputedPoints(computed, tuple(evidence), tuple(in_file)))


def _build_points_take(take: Take, types: PointTypes, columns: Int[np.ndarray, " K"], convert: PointConverter) -> Take:
    labels = tuple(types.labels[i] for i in columns)
    return Take(convert(columns), labels, take.rate, take.first_frame, take.path, point_columns=columns)


def _join_takes(first: Take, second: Take) -> Take:
    return replace(
        first,
        markers=np.concatenate([first.markers, second.markers], axis=1),
        labels=(*first.labels, *second.labels),
        point_columns=np.concatenate([first.point_columns, second.point_columns]),
    )
