"""Update points that a program computed from markers, where these markers were changed.

A point that was recognised as a function of markers is computed where it is missing, as a fill. Where it has a sample and its
parents were changed, it is computed again on request only, and so are points that were recognised by their names.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.model.changes import compute_editable_mask
from mocapfix.model.take import ComputedPoints, Take
from mocapfix.options import FillOptions
from mocapfix.stats.point_function_search import find_point_functions
from mocapfix.stats.sequences import estimate_resolution


def update_computed_points(original: Take, cleaned: Take, options: FillOptions) -> Take:
    """Return the cleaned take with its computed points filled and, if `options` ask for it, computed again.

    Their `sample_sd` is the largest of their parents'; where these were measured it is 0.
    """
    computed = cleaned.computed_points
    if computed is None:
        return cleaned
    if options.update_computed:
        computed = find_missing_functions(original, computed)
    points, is_editable = computed.take, compute_editable_mask(computed.take, options)
    positions, sd_m = points.markers.copy(), np.full(points.visible.shape, np.nan)
    is_changed = ~np.all((original.markers == cleaned.markers) | np.isnan(original.markers), axis=-1)
    is_changed |= original.visible != cleaned.visible
    column = {int(point): m for m, point in enumerate(cleaned.point_indices)}
    for c, function in enumerate(computed.functions):
        if function is None or not all(parent in column for parent in function.parents):
            continue
        parents = np.array([column[parent] for parent in function.parents])
        is_updated = is_editable[:, c] & _find_updated_frames(points.visible[:, c], is_changed[:, parents], options)
        if computed.evidence[c] == "name" and not options.update_computed:
            continue
        new = function.evaluate(cleaned.markers[is_updated][:, parents])
        is_known = ~np.isnan(new).any(-1)
        frames = np.flatnonzero(is_updated)[is_known]
        positions[frames, c] = new[is_known]
        sd_m[frames, c] = _get_parent_sd(cleaned, frames, parents)
    updated = replace(computed, take=points.replace_markers(positions, sd_m))
    return replace(cleaned, computed_points=updated)


def find_missing_functions(take: Take, computed: ComputedPoints) -> ComputedPoints:
    """Return the computed points with the functions of those that were recognised by their names, where these are exact."""
    points = np.concatenate([take.markers, computed.take.markers], axis=1)
    count, is_unknown = len(take.labels), np.array([function is None for function in computed.functions], bool)
    is_candidate = np.r_[np.zeros(count, bool), is_unknown & computed.take.visible.any(0)]
    is_parent = np.r_[take.visible.any(0), np.zeros(len(is_unknown), bool)]
    found = find_point_functions(points, estimate_resolution(points), is_candidate, is_parent)
    functions = list(computed.functions)
    for point, function in found.items():
        parents = tuple(int(take.point_indices[parent]) for parent in function.parents)
        functions[point - count] = replace(function, parents=parents)
    return replace(computed, functions=tuple(functions))


def _find_updated_frames(
    is_visible: Bool[np.ndarray, " T"], is_parent_changed: Bool[np.ndarray, "T n"], options: FillOptions
) -> Bool[np.ndarray, " T"]:
    return ~is_visible | is_parent_changed.any(1) if options.update_computed else ~is_visible


def _get_parent_sd(take: Take, frames: Int[np.ndarray, " N"], parents: Int[np.ndarray, " n"]) -> Float[np.ndarray, " N"]:
    if take.sample_sd is None:
        return np.zeros(len(frames))
    return np.nan_to_num(take.sample_sd[frames[:, None], parents]).max(1)
