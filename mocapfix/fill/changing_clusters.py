"""Axes of a cluster whose members come and go within a gap.

In each frame the visible members are aligned with the common shape of the cluster. Where the members change, the axes move by as
much as the cluster deforms. Errors are therefore measured with the members that the gap has at each point, and the estimate in a
gap is shifted so that it has no steps.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.fill.fill_methods import GapEstimate, GapWindow, MovingAxes
from mocapfix.stats.rigid_alignment import MIN_ALIGNMENT_MARKERS, align_to_shape, fit_common_shape
from mocapfix.stats.sequences import sample_evenly

MAX_CLUSTER_SHAPE_FRAMES = 200
"""Evenly spread frames from which the common shape of a cluster is estimated."""


class ChangingCluster(NamedTuple):
    """Markers of which different ones are visible in the frames of a gap.

    markers     K columns of the take
    is_visible  (n, K) in the frames of the gap
    """

    markers: np.ndarray
    is_visible: np.ndarray

    @property
    def steps(self) -> Int[np.ndarray, " C"]:
        """The frames of the gap, from 1, in which the members differ from those of the frame before."""
        return 1 + np.flatnonzero((self.is_visible[1:] != self.is_visible[:-1]).any(axis=1))


def select_changing_cluster(
    is_known: Bool[np.ndarray, "T M"], change_m: Float[np.ndarray, " M"], window: GapWindow, size: int
) -> ChangingCluster | None:
    """Return the markers with the most constant distances that are visible in a part of a gap or all of it.

    None if no member comes or goes, or if some frame of the gap shows too few.

    change_m  variation of the distance of each marker to the missing one, infinite where unknown
    size      number of markers at most
    """
    in_gap = is_known[window.gap_frames]
    order = np.argsort(change_m, kind="stable")
    members = order[np.isfinite(change_m[order]) & in_gap[:, order].any(axis=0)][:size]
    cluster = ChangingCluster(members, in_gap[:, members])
    if not len(cluster.steps) or (cluster.is_visible.sum(axis=1) < MIN_ALIGNMENT_MARKERS).any():
        return None
    return cluster


def build_changing_axes(
    markers: Float[np.ndarray, "T M 3"], cluster: ChangingCluster, window: GapWindow, frames: Int[np.ndarray, " N"]
) -> MovingAxes | None:
    """Return the axes of a cluster in those of the given frames that show enough of it; None if its shape is unknown.

    In the hidden stretches only those members are used that are visible in the gap at the same point.

    markers  in metres, NaN if not visible
    frames   the frames of the gap, of its hidden stretches and of the samples beside them, and others
    """
    selected = markers[:, cluster.markers]
    is_used = ~np.isnan(selected[..., 0])
    shape_frames = frames[is_used[frames].sum(axis=1) >= MIN_ALIGNMENT_MARKERS]
    if not len(shape_frames):
        return None
    shape = fit_common_shape(selected[shape_frames[sample_evenly(len(shape_frames), MAX_CLUSTER_SHAPE_FRAMES)]])
    for frames_of_point, is_visible in zip(window.hidden_frames.T, cluster.is_visible[window.points], strict=True):
        is_used[frames_of_point] &= is_visible
    rotation, origin = np.full((len(markers), 3, 3), np.nan), np.full((len(markers), 3), np.nan)
    aligned_rotation, aligned_origin, is_aligned = align_to_shape(selected[frames], is_used[frames], shape)
    rotation[frames[is_aligned]], origin[frames[is_aligned]] = aligned_rotation[is_aligned], aligned_origin[is_aligned]
    return MovingAxes(rotation, origin)


def remove_steps(estimate: GapEstimate, cluster: ChangingCluster, window: GapWindow) -> GapEstimate:
    """Return an estimate without the steps where the members of its cluster change.

    A step is what the position changes by beyond its motion in the frames before and after. The edges of the gap that have a
    visible sample stay where they are: between two of them the sum of the steps is subtracted evenly.
    """
    position, steps = estimate.position, cluster.steps
    motion = np.diff(position, axis=0)
    before, after = motion[np.maximum(steps - 2, 0)], motion[np.minimum(steps, len(motion) - 1)]
    heights = np.zeros_like(position)
    heights[steps] = motion[steps - 1] - (before + after) / 2
    shift = heights.cumsum(axis=0)
    if len(window.after):
        share = (np.arange(window.length) + 1) / (window.length + 1) if len(window.before) else np.ones(window.length)
        shift -= share[:, None] * shift[-1]
    return estimate._replace(position=position - shift)
