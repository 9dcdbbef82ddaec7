"""Estimates from the solved body: a lost marker has its place on its joint, plus the residual that is known beside the gap.

The residual consists of the marker's motion relative to its joint and of the error of the pose. In a gap the pose was solved
without the marker, in the hidden stretches with it. So where the marker is lost its place on the body makes a step, which is
measured and added to the residual at the edges; and the errors in the hidden stretches are increased by the variance that the
pose has in the gap beyond that with the marker.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mocapfix.fill.edge_interpolation import fill_with_splines
from mocapfix.fill.gap_windows import FillMethod, Gap, GapEstimate, MarkerEstimate, MarkersInTake, MovingAxes
from mocapfix.model.body_fit import BodyFit
from mocapfix.model.take import SAMPLE_NOISE_M
from mocapfix.solve import kinematics
from mocapfix.stats.gaussian_process import estimate_roughness, map_residual
from mocapfix.stats.rigid_alignment import compute_lengths
from mocapfix.stats.sequences import find_runs

BODY_RESIDUAL_FADE_S = 0.2  # time scale of the correlation of a marker's residual
MIN_BODY_RESIDUAL_M = 0.002  # smallest standard deviation of the residual
MIN_BODY_FILL_SD_M = 0.0005  # smallest standard deviation of a fill
STEP_NOISE_M = 0.001  # standard deviation per axis of the measured step at an edge
BODY_ERROR_RATIO = 1.5
"""Ratio of the errors in gaps to what the residual and the pose predict: a body does not fit as well as its markers say."""
MAX_EDGE_RESIDUAL_M = 0.05
"""Residual of a sample above which it may be unusable as the edge of a gap; it must also exceed MAX_EDGE_RESIDUAL_RATIO."""
MAX_EDGE_RESIDUAL_RATIO = 4.0  # the same relative to the marker's median residual


class MarkerOnBody(NamedTuple):
    """A marker on the body.

    Attributes:
        axes: Those of its joint, with its place on the body as their origin.
        residual: Metres: the measured marker in these axes, NaN where it is not visible or an outlier.
        power: Square metres per axis: mean square of the residual, with what the pose varies besides.
        roughness: Part of it that is rough, 0 to 1.
        pose_excess: Square metres per axis: variance of the place on the body beyond that where the marker is visible.
    """

    axes: MovingAxes
    residual: Float[np.ndarray, "T 3"]
    power: float
    roughness: float
    pose_excess: Float[np.ndarray, " T"]


class BodyPlacement:
    """Estimates a marker from its place on the body, or on one of several: hands are bodies too."""

    def __init__(self, take: MarkersInTake, bodies: Sequence[BodyFit] | None = None) -> None:
        self.take, self.rate, self.rows = take, take.rate, dict[int, tuple[BodyFit, int]]()
        self.markers: dict[int, MarkerOnBody] = {}
        self.poses: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        for body in [take.body] if bodies is None and take.body else bodies or ():
            subject, motion = body.extended_subject, body.motion
            rotations = kinematics.compute_world_poses(subject.skeleton, motion)[1]
            self.poses[id(body)] = rotations, kinematics.predict_markers(subject, (motion.root_position, motion.local_rotations))
            self.rows |= {marker: (body, row) for row, marker in enumerate(body.marker_columns.tolist()) if marker >= 0}

    def __call__(self, gap: Gap) -> list[GapEstimate]:
        if gap.marker not in self.rows:
            return []
        if gap.marker not in self.markers:
            (body, row), path = self.rows[gap.marker], self.take.visible_markers[:, gap.marker]
            rotations, places = self.poses[id(body)]
            axes = MovingAxes(rotations[:, body.extended_subject.joints[row]], places[:, row])
            self.markers[gap.marker] = place_marker(body, row, axes, path, self.rate)
        on_body, rate = self.markers[gap.marker], self.rate
        axes, residual = on_body.axes, on_body.residual
        w = gap.window.keep_known_context(~np.isnan(residual[gap.window.context_frames, 0]))
        excess, inside = on_body.pose_excess[w.gap_frames], np.arange(w.length)
        edges = np.concatenate([np.zeros(len(w.before), int), np.full(len(w.after), w.length - 1)])
        beside = np.concatenate([w.before, w.after])
        shape = {"power": on_body.power, "time_scale_s": BODY_RESIDUAL_FADE_S, "roughness": on_body.roughness}
        noise, known = np.full(len(edges), SAMPLE_NOISE_M**2), excess[edges]
        gap_map, gap_variance = map_residual(
            beside / rate, inside / rate, noise_variance=noise + STEP_NOISE_M**2 * (known > 0), known_excess=known,
            wanted_excess=excess, **shape,
        )  # fmt: skip
        beside = np.concatenate([w.before, w.hidden_after])
        hidden_map, hidden_variance = map_residual(beside / rate, w.hidden_points / rate, **shape, noise_variance=noise)
        steps = _measure_steps(axes, w.first, w.length)[np.where(edges > 0, 1, 0)]
        context = residual[w.context_frames] - (known / (known + STEP_NOISE_M**2))[:, None] * steps
        position = axes.transform_to_world(gap_map @ context, w.gap_frames)
        error = hidden_map @ residual[w.hidden_context_frames] - residual[w.hidden_frames]
        known_count, squares = (~np.isnan(error)).sum((0, 2)), np.nansum(error**2, axis=(0, 2))
        shown = np.maximum(squares / np.maximum(known_count, 1), MIN_BODY_FILL_SD_M**2)
        added = np.maximum(gap_variance[w.points] - hidden_variance, 0.0)
        error = np.einsum("...ab,...b->...a", axes.rotation_world_axes[w.hidden_frames], error)
        error *= (BODY_ERROR_RATIO * np.sqrt(1 + added / shown))[:, None]
        expected_sd = BODY_ERROR_RATIO * np.sqrt(np.maximum(gap_variance[w.points], MIN_BODY_FILL_SD_M**2))
        evidence = float((shown / (shown + added)).mean())
        return [GapEstimate(FillMethod.BODY, position, error, expected_sd, evidence=evidence)]


def place_marker(body: BodyFit, row: int, axes: MovingAxes, path: Float[np.ndarray, "T 3"], rate: float) -> MarkerOnBody:
    """Return a marker on the body.

    Args:
        row: Index of the marker in its extended subject.
        axes: Those of its joint, with its place on the body as their origin.
        path: Metres: the measured marker, NaN if not visible or an outlier.
        rate: Frame rate in Hz.
    """
    residual, variance = axes.transform_from_world(path), body.motion.marker_sd[:, row] ** 2
    distance = compute_lengths(residual)
    if not np.isnan(distance).all():
        usual_m = float(np.median(distance[~np.isnan(distance)]))
        residual[distance > max(MAX_EDGE_RESIDUAL_M, MAX_EDGE_RESIDUAL_RATIO * usual_m)] = np.nan
    known = residual[shown := np.flatnonzero(~np.isnan(residual[:, 0]))]
    power = max(float((known**2).mean()), MIN_BODY_RESIDUAL_M**2) if len(known) else MIN_BODY_RESIDUAL_M**2
    roughness = estimate_roughness(known, shown, rate, BODY_RESIDUAL_FADE_S, SAMPLE_NOISE_M, power)
    shown_variance = float(np.median(variance[shown])) if len(known) else 0.0
    return MarkerOnBody(axes, residual, power + shown_variance, roughness, np.maximum(variance - shown_variance, 0.0))


def _measure_steps(axes: MovingAxes, first: int, length: int) -> Float[np.ndarray, "2 3"]:
    """Return how far the place on the body steps in the first frame of a gap, and backwards in its last one, in its axes.

    A step is what it moves beyond its motion in the frames before and after.
    """
    steps, last = np.zeros((2, 3)), first + length - 1
    for side, (edge, direction) in enumerate(((first - 1, 1), (last + 1, -1))):
        frames = edge + direction * np.arange(-1, 3)
        if length > 1 and frames.min() >= 0 and frames.max() < len(axes.origin):
            motion = np.diff(axes.origin[frames], axis=0)
            steps[side] = axes.rotation_world_axes[edge].T @ (motion[1] - (motion[0] + motion[2]) / 2)
    return steps


MAX_PREVIEW_SPLINE_S = 0.5  # duration of the longest gap of a preview that is filled by a spline


def estimate_preview(markers: Float[np.ndarray, "T M 3"], rate: float, body: BodyFit) -> MarkerEstimate:
    """Return the estimates of a preview: a spline, or the place on the body with the residual on a line between the gap's edges.

    The standard deviation of the line is that of lines across visible stretches as long as the gap. Markers off the body, and
    gaps in which no marker shows the segment, are not estimated.

    Args:
        markers: Metres, NaN if not visible or an outlier.
        rate: Frame rate in Hz.
        body: The body with the poses of a preview.
    """
    position, sd, _ = fill_with_splines(markers, rate, MAX_PREVIEW_SPLINE_S)
    method, is_lost = np.full(sd.shape, FillMethod.SPLINE, np.int8), np.isnan(markers[..., 0])
    rotations = kinematics.compute_world_poses(body.extended_subject.skeleton, body.motion)[1]
    for row, m in enumerate(body.marker_columns.tolist()):
        path, is_unseen = markers[:, m], body.motion.marker_sd[:, row] > body.motion.marker_sd[:, row].min()
        if m < 0 or is_lost[:, m].all() or not is_lost[:, m].any():
            continue
        axes = MovingAxes(rotations[:, body.extended_subject.joints[row]], body.marker_positions[:, row])
        residual = axes.transform_from_world(path)
        for first, last in find_runs(is_lost[:, m]):
            frames, length = np.arange(first, last + 1), last - first + 1
            edges = [residual[frame] for frame in (first - 1, last + 1) if 0 <= frame < len(path)]
            if is_unseen[frames].any():
                continue
            share = np.linspace(0.0, 1.0, length + 2)[1:-1]
            growth = 4 * share * (1 - share) if len(edges) > 1 else 1 - share if first == 0 else share
            lag = -(-length // len(edges))  # to the middle between two edges, or to the end of a stretch with one
            change = residual[lag:] - residual[:-lag]
            change = change[~np.isnan(change[:, 0])]
            shown = change if len(change) else residual[~is_lost[:, m]]
            error = np.sqrt((shown * shown).mean() / len(edges))
            line_sd = BODY_ERROR_RATIO * error * np.sqrt(growth)
            line = axes.transform_to_world(edges[0] + share[:, None] * (edges[-1] - edges[0]), frames)
            is_better = ~(sd[frames, m] <= line_sd)
            better = frames[is_better], m
            position[better], sd[better], method[better] = line[is_better], line_sd[is_better], FillMethod.BODY
    return MarkerEstimate(position, np.maximum(sd, MIN_BODY_FILL_SD_M), method)
