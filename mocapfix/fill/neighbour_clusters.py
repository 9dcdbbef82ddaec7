"""Estimates from the markers that move with the missing one: those on the same head, forearm, plate or prop, and its neighbours.

Two markers on one rigid body keep their distance over the whole take (Ringer & Lasenby 2004, "A procedure for automatically
estimating model parameters in optical motion capture"). The markers with the most constant distances that are visible throughout
a gap define axes by weighted registration. In these axes the missing marker is interpolated between the edges of the gap
(`edge_interpolation`), or predicted: a regression learned from the take predicts its position from the deformation of the cluster
(a joint in between, skin), and the residual at the edges is interpolated.

Members of a cluster may also come and go within a gap. In each frame the visible ones are aligned with the common shape of the
cluster. Where the members change, the axes move by as much as the cluster deforms. Errors are therefore measured with the members
that the gap has at each point, and the estimate in a gap is shifted so that it has no steps.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.fill.edge_interpolation import ACTIVITY_POWER, interpolate_in_axes
from mocapfix.fill.gap_windows import FillMethod, Gap, GapEstimate, GapWindow, MarkersInTake, MovingAxes, select_visible_together
from mocapfix.model.take import SAMPLE_NOISE_M
from mocapfix.stats.gaussian_process import NORMAL_MEDIAN_FACTOR, estimate_roughness, map_residual
from mocapfix.stats.marker_distances import measure_distance_spread
from mocapfix.stats.rigid_alignment import (
    MIN_ALIGNMENT_MARKERS,
    align_cluster,
    align_to_shape,
    fit_common_shape,
    regress_without,
    transform_to_body_axes,
)
from mocapfix.stats.sequences import sample_evenly

CLUSTER_SIZES = (4, 8)  # numbers of the steadiest neighbours that define axes
MIN_CLUSTER_MARKERS = 3  # markers that define axes
MIN_DISTANCE_CHANGE_M = 0.003  # variation of a distance on one rigid body, which bounds the weight of a marker
MAX_DISTANCE_CHANGE_M = 0.1  # variation of the distance of two markers above which one does not predict the other
MAX_CLUSTER_MARKERS = 12  # markers that predict one position
MIN_CLUSTER_FRAMES = 30  # frames in which the missing marker and its cluster must be visible
MAX_CLUSTER_TRAINING_FRAMES = 300  # evenly spaced frames from which distances and deformations are learned
SHAPE_RIDGE_M = 0.01  # ridge of the regression: deformations far below it are ignored
INDEPENDENT_FRAME_S = 0.5
"""Time after which another frame shows an independent deformation: frames in between do not make the regression more certain."""
CLUSTER_RESIDUAL_FADE_S = 0.3  # time scale of the correlation of the residual
MIN_CLUSTER_RESIDUAL_M = 0.001  # smallest standard deviation of the residual
MIN_DISTANCE_FRAMES = 9  # frames that show how constant a distance is
MAX_EXAMINED_FRAMES = 600  # evenly spaced frames among which those with different configurations are selected
RESTING_FRAME_WEIGHT = 0.1  # weight of a frame at rest in this selection, relative to a frame with average motion
UNKNOWN_CHANGE_RATIO = 0.1  # expected variation of a distance, relative to it, where too few frames show it
HIDDEN_FOLDS = 4
"""Groups of hidden stretches, each predicted by a regression without it, and stretches of the take that give its error."""
MAX_HIDDEN_SHARE = 0.7  # share of the training frames above which a group of hidden stretches leaves too few
MAX_NOVELTY = 3.0
"""Largest factor by which the variance of a learned estimate grows for gaps that are long relative to what was learned."""


def select_configurations(markers: Float[np.ndarray, "T M 3"]) -> Int[np.ndarray, " N"]:
    """Return frames spread evenly over the motion of the markers: many while they move, few while they rest."""
    examined = sample_evenly(len(markers), MAX_EXAMINED_FRAMES)
    square = (np.diff(markers[examined], axis=0) ** 2).sum(-1)
    count = (~np.isnan(square)).sum(1)
    speed = np.sqrt(np.divide(np.nansum(square, axis=1), count, out=np.zeros(len(count)), where=count > 0))
    if not speed.any():
        return examined[sample_evenly(len(examined), MAX_CLUSTER_TRAINING_FRAMES)]
    path = np.concatenate([[0.0], np.cumsum(speed + RESTING_FRAME_WEIGHT * speed.mean())])
    places = np.linspace(0, path[-1], min(MAX_CLUSTER_TRAINING_FRAMES, len(examined)))
    return np.unique(examined[np.round(np.interp(places, path, np.arange(len(examined)))).astype(int)])


def measure_distance_changes(markers: Float[np.ndarray, "T M 3"]) -> Float[np.ndarray, "M M"]:
    """Return the variation of the distance of each pair of markers in metres, while they move; infinite where unknown."""
    change = measure_distance_spread(markers[select_configurations(markers)])
    for i in np.flatnonzero(~np.isfinite(change).any(1) & ~np.isnan(markers[..., 0]).all(0)):
        change[i] = guess_distance_changes(markers, int(i))
    return change


def guess_distance_changes(markers: Float[np.ndarray, "T M 3"], marker: int) -> Float[np.ndarray, " M"]:
    """Return the expected variation of the distances of a marker that is seldom visible: near markers are the steadiest."""
    visible = np.flatnonzero(~np.isnan(markers[:, marker, 0]))
    sampled = markers[visible[sample_evenly(len(visible), MIN_DISTANCE_FRAMES)]]
    distance = np.linalg.norm(sampled - sampled[:, [marker]], axis=-1)
    count = (~np.isnan(distance)).sum(0)
    mean = np.divide(np.nansum(distance, axis=0), count, out=np.full(len(count), np.inf), where=count > 0)
    mean[marker] = np.inf
    return UNKNOWN_CHANGE_RATIO * mean


def build_cluster_axes(
    take: MarkersInTake, cluster: Int[np.ndarray, " K"], change_m: Float[np.ndarray, " K"], frames: Int[np.ndarray, " N"]
) -> MovingAxes | None:
    """Return the axes of a cluster in the given frames, unknown where not all of it is known; None if they never are.

    The variation `change_m` of its distances weights each marker.
    """
    known = np.flatnonzero(take.is_known.T[cluster[:, None], frames].all(0))
    if not len(known):
        return None
    axes = align_cluster(take.markers, frames[known], cluster, compute_marker_weights(change_m))[1:]
    if len(known) == len(frames):
        return MovingAxes(*axes)
    rotation, origin = np.zeros((len(frames), 3, 3)), np.full((len(frames), 3), np.nan)
    rotation[known], origin[known] = axes
    return MovingAxes(rotation, origin)


def compute_marker_weights(change_m: Float[np.ndarray, " K"]) -> Float[np.ndarray, " K"]:
    """Return the weights of markers in the registration of a cluster, from the variations of their distances."""
    return 1 / (change_m**2 + MIN_DISTANCE_CHANGE_M**2)


class ClusterInterpolation(NamedTuple):
    """Estimates a marker on a line between the edges of a gap, in axes of its steadiest neighbours."""

    take: MarkersInTake

    def __call__(self, gap: Gap) -> list[GapEstimate]:
        take, estimates = self.take, list[GapEstimate]()
        for size in CLUSTER_SIZES:
            cluster = gap.neighbours[:size]
            if len(cluster) >= MIN_CLUSTER_MARKERS and (size == CLUSTER_SIZES[0] or len(gap.neighbours) > CLUSTER_SIZES[0]):
                change = take.distance_change_m[gap.marker, cluster]
                axes = build_cluster_axes(take, cluster, change, gap.frames)
                if axes:
                    estimates += interpolate_in_axes(take.markers[:, gap.marker], axes, gap, take.rate, f"{size} neighbours")
        return estimates


class NeighbourRegression(NamedTuple):
    """Estimates a marker from the deformation of a cluster that is visible throughout the gap, by a regression."""

    take: MarkersInTake

    def __call__(self, gap: Gap) -> list[GapEstimate]:
        take, w, rate, path = self.take, gap.window, self.take.rate, self.take.markers[:, gap.marker]
        change, is_shown = take.distance_change_m[gap.marker], take.is_known[:, gap.marker]
        steady = gap.neighbours[change[gap.neighbours] < MAX_DISTANCE_CHANGE_M]
        together, shared = select_visible_together(take.is_known, gap.marker, steady, MIN_CLUSTER_FRAMES, MAX_CLUSTER_MARKERS)
        cluster, training = np.array(together, int), np.flatnonzero(shared)
        if len(cluster) < MIN_CLUSTER_MARKERS:
            return []
        training = training[sample_evenly(len(training), MAX_CLUSTER_TRAINING_FRAMES)]
        frames = w.list_frames(training, len(path))[0]
        frames = frames[take.is_known.T[cluster[:, None], frames].all(0)]
        row = np.full(len(path), -1)
        row[frames] = np.arange(len(frames))
        if len(training) < MIN_CLUSTER_FRAMES or (row[w.gap_frames] < 0).any() or (row[w.context_frames] < 0).any():
            return []
        shape, rotation, centre = align_cluster(take.markers, frames, cluster, compute_marker_weights(change[cluster]))
        local = transform_to_body_axes(path[frames][:, None], centre, rotation)[:, 0]
        rows, mean = row[w.gap_frames], local[row[training]].mean(0)
        local -= mean
        # stretches of one group are left out together
        is_out = (training >= w.starts[:, None]) & (training < w.starts[:, None] + w.hidden_length)
        group = number_parts(len(w.starts))
        left_out = np.logical_or.reduceat(is_out, np.flatnonzero(np.diff(group, prepend=-1))) if len(group) else is_out
        x, count, examples = shape.reshape(len(frames), -1), len(training), row[training]
        x -= x[examples].mean(0)
        folds = np.arange(HIDDEN_FOLDS)[:, None] == number_parts(count)
        groups = np.concatenate([np.zeros((1, count), bool), folds, left_out])
        coefficients, judged, leverage = regress_without(
            x[examples], local[examples], groups, SHAPE_RIDGE_M**2, x[rows[w.points]]
        )
        predicted, (square, usual) = x @ coefficients[0], judged[1 : 1 + HIDDEN_FOLDS].sum(0)
        # how much larger errors in the gap are than usual: one of so many training frames is independent of the others
        repeated = len(training) / len(np.unique((training / (rate * INDEPENDENT_FRAME_S)).astype(int)))
        inflation = np.sqrt(np.maximum((1 + repeated * leverage) / (1 + repeated * usual / len(training)), 1.0))
        learned_sd = np.sqrt(square / (3 * len(training)))
        residual, is_measured = local - predicted, ~np.isnan(local[:, 0])
        gap_map, hidden_map = _build_residual_maps(residual[is_measured], frames[is_measured], w, rate)
        position = mean + predicted[rows] + gap_map @ residual[row[w.context_frames]]
        position = np.einsum("tab,tb->ta", rotation[rows], position) + centre[rows]
        hidden = row[np.concatenate([w.hidden_context_frames, w.hidden_frames], axis=1)]
        is_enough = left_out.sum(1) <= MAX_HIDDEN_SHARE * len(training)
        error, complete = np.full((*w.hidden_frames.shape, 3), np.nan), np.flatnonzero(is_enough[group] & (hidden >= 0).all(1))
        hidden, split = hidden[complete], len(w.context_frames)
        misfit = local[hidden] - x[hidden] @ coefficients[1 + HIDDEN_FOLDS + group[complete]]
        local_error = (hidden_map @ misfit[:, :split] - misfit[:, split:]) * inflation[:, None]
        error[complete] = np.einsum("ksab,ksb->ksa", rotation[hidden[:, split:]], local_error)
        novelty = np.sqrt(min(1 + 2 * w.length / np.count_nonzero(is_shown), MAX_NOVELTY))
        decay = 1 - np.exp(-2 * w.compute_distance_to_edges() / rate / CLUSTER_RESIDUAL_FADE_S)
        learned_sd = learned_sd * inflation * novelty * gap.activity**ACTIVITY_POWER
        expected_sd = np.sqrt(learned_sd**2 * decay + SAMPLE_NOISE_M**2)
        return [GapEstimate(FillMethod.CLUSTER, position, error, expected_sd)]


@cache
def number_parts(count: int) -> Int[np.ndarray, " count"]:
    """Return the number of the part of each of so many elements in HIDDEN_FOLDS nearly equal parts, the larger ones first."""
    return np.repeat(np.arange(HIDDEN_FOLDS), [(count + fold) // HIDDEN_FOLDS for fold in range(HIDDEN_FOLDS)[::-1]])


def _build_residual_maps(
    residual: Float[np.ndarray, "N 3"], frames: Int[np.ndarray, " N"], w: GapWindow, rate: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the maps that interpolate a residual, known in some frames, from beside a gap and beside its hidden stretches."""
    power = max(float(np.median(residual**2)) * NORMAL_MEDIAN_FACTOR, MIN_CLUSTER_RESIDUAL_M**2)
    roughness = estimate_roughness(residual, frames, rate, CLUSTER_RESIDUAL_FADE_S, SAMPLE_NOISE_M, power)

    shape = {"power": power, "time_scale_s": CLUSTER_RESIDUAL_FADE_S, "roughness": roughness}
    noise = np.full(len(w.before) + len(w.after), SAMPLE_NOISE_M**2)

    def build_map(after: np.ndarray, points: np.ndarray) -> np.ndarray:
        return map_residual(np.concatenate([w.before, after]) / rate, points / rate, noise_variance=noise, **shape)[0]

    gap_map = build_map(w.after, np.arange(w.length))
    if w.hidden_length == w.length:
        return gap_map, gap_map[w.points]
    return gap_map, build_map(w.hidden_after, w.hidden_points)


MAX_CLUSTER_SHAPE_FRAMES = 200  # evenly spread frames from which the common shape of a cluster is estimated


class ChangingClusterInterpolation(NamedTuple):
    """Estimates a marker between the edges of a gap, in axes of neighbours that come and go within it."""

    take: MarkersInTake

    def __call__(self, gap: Gap) -> list[GapEstimate]:
        # What it costs that members come and go is not known where no stretch shows it.
        if not len(gap.window.starts) and len(gap.neighbours) >= MIN_CLUSTER_MARKERS:
            return []
        take, change = self.take, self.take.distance_change_m[gap.marker]
        cluster = select_changing_cluster(take.is_known, change, gap.window, CLUSTER_SIZES[-1])
        axes = build_changing_axes(take.markers, cluster, gap.window, gap.frames) if cluster else None
        if not cluster or not axes:
            return []
        estimates = interpolate_in_axes(take.markers[:, gap.marker], axes, gap, take.rate, "changing neighbours")
        return [remove_steps(each, cluster, gap.window) for each in estimates]


class ChangingCluster(NamedTuple):
    """Markers of which different ones are visible in the frames of a gap."""

    markers: np.ndarray  # K columns of the take
    is_visible: np.ndarray  # (n, K) in the frames of the gap

    @property
    def steps(self) -> Int[np.ndarray, " C"]:
        """The frames of the gap, from 1, in which the members differ from those of the frame before."""
        return 1 + np.flatnonzero((self.is_visible[1:] != self.is_visible[:-1]).any(axis=1))


def select_changing_cluster(
    is_known: Bool[np.ndarray, "T M"], change_m: Float[np.ndarray, " M"], window: GapWindow, size: int
) -> ChangingCluster | None:
    """Return the markers with the most constant distances that are visible in a part of a gap or all of it.

    None if no member comes or goes, or if some frame of the gap shows too few. `change_m` is the variation of each marker's
    distance to the missing one, infinite where unknown.
    """
    in_gap, order = is_known[window.first : window.first + window.length], np.argsort(change_m, kind="stable")
    members = order[(np.isfinite(change_m) & in_gap.any(axis=0))[order]][:size]
    cluster = ChangingCluster(members, in_gap[:, members])
    if not len(cluster.steps) or (cluster.is_visible.sum(axis=1) < MIN_ALIGNMENT_MARKERS).any():
        return None
    return cluster


def build_changing_axes(
    markers: Float[np.ndarray, "T M 3"], cluster: ChangingCluster, window: GapWindow, frames: Int[np.ndarray, " N"]
) -> MovingAxes | None:
    """Return the axes of a cluster in the given frames, unknown where they do not show enough; None if its shape is unknown.

    In the hidden stretches only those members are used that are visible in the gap at the same point.

    Args:
        markers: In metres, NaN if not visible.
    """
    selected = markers[:, cluster.markers]
    is_used = ~np.isnan(selected[..., 0])
    shape_frames = frames[is_used[frames].sum(axis=1) >= MIN_ALIGNMENT_MARKERS]
    if not len(shape_frames):
        return None
    shape = fit_common_shape(selected[shape_frames[sample_evenly(len(shape_frames), MAX_CLUSTER_SHAPE_FRAMES)]])
    for frames_of_point, is_visible in zip(window.hidden_frames.T, cluster.is_visible[window.points], strict=True):
        is_used[frames_of_point] &= is_visible
    rotation, origin, is_aligned = align_to_shape(selected[frames], is_used[frames], shape)
    return MovingAxes(rotation, np.where(is_aligned[:, None], origin, np.nan))


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
