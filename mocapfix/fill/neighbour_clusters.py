"""Estimates from the markers that move with the missing one: those on the same head, forearm, plate or prop, and its neighbours.

Two markers on one rigid body keep their distance over the whole take (Ringer & Lasenby 2004, "A procedure for automatically
estimating model parameters in optical motion capture"). The markers with the most constant distances that are visible throughout
a gap define axes by weighted registration. In these axes the missing marker is interpolated between the edges of the gap
(`edge_interpolation`), or predicted: a regression learned from the take predicts its position from the deformation of the cluster
(a joint in between, skin), and the residual at the edges is interpolated.

Axes of a cluster whose members come and go within a gap.

In each frame the visible members are aligned with the common shape of the cluster. Where the members change, the axes move by as
much as the cluster deforms. Errors are therefore measured with the members that the gap has at each point, and the estimate in a
gap is shifted so that it has no steps.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.fill.cluster_fill import (
    CLUSTER_RESIDUAL_FADE_S,
    MAX_CLUSTER_MARKERS,
    MAX_CLUSTER_TRAINING_FRAMES,
    MIN_CLUSTER_FRAMES,
    MIN_CLUSTER_RESIDUAL_M,
    MIN_DISTANCE_CHANGE_M,
    SHAPE_RIDGE_M,
    align_cluster,
    compute_column_percentiles,
)
from mocapfix.fill.fill_methods import FillMethod, GapEstimate, GapWindow, MovingAxes
from mocapfix.model.take import SAMPLE_NOISE_M
from mocapfix.stats.gaussian_process import NORMAL_MEDIAN_FACTOR, build_residual_map, estimate_roughness
from mocapfix.stats.rigid_alignment import MIN_ALIGNMENT_MARKERS, align_to_shape, fit_common_shape, transform_to_body_axes
from mocapfix.stats.sequences import sample_evenly

MIN_KEPT_FRAME_SHARE = 0.7  # share of these frames that the cluster must keep when a marker is added to it
MIN_DISTANCE_FRAMES = 9  # frames that show how constant a distance is
MAX_EXAMINED_FRAMES = 600  # evenly spaced frames among which those with different configurations are selected
RESTING_FRAME_WEIGHT = 0.1  # weight of a frame at rest in this selection, relative to a frame with average motion
UNKNOWN_CHANGE_RATIO = 0.1  # expected variation of a distance, relative to it, where too few frames show it
DISTANCE_PERCENTILES = (0.05, 0.95)  # quantiles of a distance, between which it varies
DISTANCE_RANGE_SD = 3.29  # their difference for a normal distribution, in standard deviations
HIDDEN_FOLDS = 4
"""Groups of hidden stretches, each predicted by a regression without it, and stretches of the take that give its error."""
MAX_HIDDEN_SHARE = 0.7  # share of the training frames above which a group of hidden stretches leaves too few
MAX_CLUSTER_INFLATION = 3.0
"""Largest factor by which the error of a learned estimate is increased for gaps that are long relative to what was learned."""
MAX_RESIDUAL_SAMPLES = 6  # samples at each edge of a gap from which the residual is interpolated


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
    sampled = markers[select_configurations(markers)]
    change = np.full((markers.shape[1],) * 2, np.inf)
    visible_count = (~np.isnan(sampled[..., 0])).sum(0)
    enough = np.flatnonzero(visible_count >= min(MIN_DISTANCE_FRAMES, len(sampled)))
    for n, i in enumerate(enough[1:], start=1):
        distance = np.sort(np.linalg.norm(sampled[:, i, None] - sampled[:, enough[:n]], axis=-1), axis=0)  # NaN comes last
        low, high = (compute_column_percentiles(distance, share) for share in DISTANCE_PERCENTILES)
        is_known = np.isfinite(high) & ((~np.isnan(distance)).sum(0) >= min(MIN_DISTANCE_FRAMES, len(sampled)))
        others = enough[:n][is_known]
        change[i, others] = change[others, i] = (high[is_known] - low[is_known]) / DISTANCE_RANGE_SD
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
    markers: Float[np.ndarray, "T M 3"],
    cluster: Int[np.ndarray, " K"],
    change_m: Float[np.ndarray, " K"],
    frames: Int[np.ndarray, " N"],
) -> MovingAxes | None:
    """Return the axes of a cluster in those of the given frames in which all of it is visible; None if there are none.

    change_m  variation of the distance of each marker, which weights it
    """
    selected = markers[np.ix_(frames, cluster)]
    is_visible = ~np.isnan(selected[..., 0]).any(1)
    if not is_visible.any():
        return None
    aligned = align_cluster(selected[is_visible], compute_marker_weights(change_m))
    rotation, origin = np.full((len(markers), 3, 3), np.nan), np.full((len(markers), 3), np.nan)
    rotation[frames[is_visible]], origin[frames[is_visible]] = aligned.rotation, aligned.centre
    return MovingAxes(rotation, origin)


def compute_marker_weights(change_m: Float[np.ndarray, " K"]) -> Float[np.ndarray, " K"]:
    """Return the weights of markers in the registration of a cluster, from the variations of their distances."""
    return 1 / (change_m**2 + MIN_DISTANCE_CHANGE_M**2)


def select_regression_cluster(
    is_visible: Bool[np.ndarray, "T M"], marker: int, neighbours: Int[np.ndarray, " N"]
) -> Int[np.ndarray, " K"]:
    """Return the neighbours, in the order given, that leave enough frames in which all of them and the marker are visible."""
    shared, cluster = is_visible[:, marker].copy(), list[int]()
    for neighbour in neighbours.tolist():
        both = shared & is_visible[:, neighbour]
        if both.sum() >= max(MIN_CLUSTER_FRAMES, MIN_KEPT_FRAME_SHARE * shared.sum()):
            cluster.append(neighbour)
            shared = both
        if len(cluster) == MAX_CLUSTER_MARKERS:
            break
    return np.array(cluster, int)


def estimate_by_regression(
    markers: Float[np.ndarray, "T M 3"],
    marker: int,
    cluster: Int[np.ndarray, " K"],
    change_m: Float[np.ndarray, " K"],
    window: GapWindow,
    rate: float,
) -> GapEstimate | None:
    """Return the estimate of a marker from the deformation of a cluster that is visible throughout the gap; None without one.

    change_m  variation of the distance of each marker of the cluster to the missing one
    """
    w, path = window, markers[:, marker]
    is_known: np.ndarray = np.all(~np.isnan(markers[:, cluster, 0]), axis=1)
    training = np.flatnonzero(is_known & ~np.isnan(path[:, 0]))
    training = training[sample_evenly(len(training), MAX_CLUSTER_TRAINING_FRAMES)]
    needed = (training, w.gap_frames, w.context_frames, w.hidden_frames.ravel(), w.hidden_context_frames.ravel())
    frames = np.unique(np.concatenate(needed))
    frames = frames[is_known[frames]]
    row = np.full(len(markers), -1)
    row[frames] = np.arange(len(frames))
    if len(training) < MIN_CLUSTER_FRAMES or (row[np.r_[w.gap_frames, w.context_frames]] < 0).any():
        return None
    aligned = align_cluster(markers[np.ix_(frames, cluster)], compute_marker_weights(change_m))
    local = transform_to_body_axes(path[frames][:, None], aligned.centre, aligned.rotation)[:, 0]
    regression = _Regression(aligned.markers.reshape(len(frames), -1), local, row[training])
    residual = np.full((len(markers), 3), np.nan)
    predicted = regression.predict(np.zeros(0, int), np.arange(len(frames)))
    residual[frames] = local - predicted
    maps = _build_residual_maps(residual, w, rate)
    gap, context = row[w.gap_frames], w.context_frames[maps.used]
    position = predicted[gap] + maps.gap @ residual[context]
    position = np.einsum("tab,tb->ta", aligned.rotation[gap], position) + aligned.centre[gap]
    error = np.full((*w.hidden_frames.shape, 3), np.nan)
    for group in np.array_split(np.arange(len(w.starts)), HIDDEN_FOLDS):
        rows = row[np.concatenate([w.hidden_context_frames[group][:, maps.used], w.hidden_frames[group]], axis=1)]
        complete, rows = group[(rows >= 0).all(1)], rows[(rows >= 0).all(1)]
        is_out = (training >= w.starts[group, None]) & (training < w.starts[group, None] + w.hidden_length)
        held_out = np.flatnonzero(is_out.any(0))
        if not len(complete) or len(held_out) > MAX_HIDDEN_SHARE * len(training):
            continue
        misfit = local[rows] - regression.predict(held_out, rows)
        split = len(context)
        local_error = maps.hidden @ misfit[:, :split] - misfit[:, split:]
        error[complete] = np.einsum("ksab,ksb->ksa", aligned.rotation[rows[:, split:]], local_error)
    novelty = min(1 + 2 * w.length / len(path[~np.isnan(path[:, 0])]), MAX_CLUSTER_INFLATION)
    decay = 1 - np.exp(-2 * w.compute_distance_to_edges() / rate / CLUSTER_RESIDUAL_FADE_S)
    expected_sd = np.sqrt((regression.cross_validate() * novelty) ** 2 * decay + SAMPLE_NOISE_M**2)
    return GapEstimate(FillMethod.CLUSTER, position, error, expected_sd)


class _ResidualMaps(NamedTuple):
    """Linear maps from the residual at the samples `used` of a window's context to the gap and to the hidden points."""

    used: np.ndarray
    gap: np.ndarray
    hidden: np.ndarray


def _build_residual_maps(residual: Float[np.ndarray, "T 3"], window: GapWindow, rate: float) -> _ResidualMaps:
    """Return the maps that interpolate a residual across the gap and across its hidden stretches."""
    w = window
    known = residual[~np.isnan(residual[:, 0])]
    power = max(float(np.median(known**2)) * NORMAL_MEDIAN_FACTOR, MIN_CLUSTER_RESIDUAL_M**2)
    roughness = estimate_roughness(residual, rate, CLUSTER_RESIDUAL_FADE_S, SAMPLE_NOISE_M, power)
    sides = (np.arange(len(w.before))[::-1], len(w.before) + np.arange(len(w.after)))
    used = np.concatenate([side[sample_evenly(len(side), MAX_RESIDUAL_SAMPLES)] if len(side) else side for side in sides])
    maps = [
        build_residual_map(
            np.concatenate([w.before, after])[used] / rate, points / rate,
            time_scale_s=CLUSTER_RESIDUAL_FADE_S, roughness=roughness, noise_ratio=SAMPLE_NOISE_M**2 / power,
        )
        for after, points in ((w.after, np.arange(w.length)), (w.hidden_after, w.hidden_points))
    ]  # fmt: skip
    return _ResidualMaps(used, *maps)


class _Regression:
    """A ridge regression of positions (m, in a cluster's axes) on the deformation of the cluster, with any frames left out."""

    def __init__(self, deformation: np.ndarray, position: np.ndarray, training: np.ndarray) -> None:
        self.mean = position[training].mean(0)
        self.x = deformation - deformation[training].mean(0)
        self.training_x, self.training_y = self.x[training], position[training] - self.mean
        self.square, self.moment = self.training_x.T @ self.training_x, self.training_x.T @ self.training_y

    def predict(self, held_out: Int[np.ndarray, " H"], rows: Int[np.ndarray, "*rows"]) -> Float[np.ndarray, "*rows 3"]:
        """Return the positions in some rows, learned without the training frames with the given indices."""
        return self.mean + self.x[rows] @ self._solve_without(held_out)

    def cross_validate(self) -> float:
        """Return the root mean square error in metres per axis of stretches of the take that are predicted from the others."""
        folds = np.array_split(np.arange(len(self.training_x)), HIDDEN_FOLDS)
        errors = [self.training_y[fold] - self.training_x[fold] @ self._solve_without(fold) for fold in folds]
        return float(np.sqrt((np.concatenate(errors) ** 2).mean()))

    def _solve_without(self, held_out: np.ndarray) -> np.ndarray:
        a, b = self.training_x[held_out], self.training_y[held_out]
        ridge = max(len(self.training_x) - len(a), 1) * SHAPE_RIDGE_M**2 * np.eye(self.x.shape[1])
        return np.linalg.solve(self.square - a.T @ a + ridge, self.moment - a.T @ b)


MAX_CLUSTER_SHAPE_FRAMES = 200  # evenly spread frames from which the common shape of a cluster is estimated


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
