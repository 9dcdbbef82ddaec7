"""Estimates from the solved body: a lost marker has its place on its joint, plus the residual that is known beside the gap.

The residual consists of the marker's motion relative to its joint and of the error of the pose. In a gap the pose was solved
without the marker, in the hidden stretches with it. So where the marker is lost its place on the body makes a step, which is
measured and added to the residual at the edges; and the errors in the hidden stretches are increased by the variance that the
pose has in the gap beyond that with the marker.

Where no marker shows a limb, the motion prior predicts its pose, too (`PredictedPlacement`). To measure the errors of this, the
limb is hidden in the stretches and predicted there as well.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from mocapfix.fill.edge_interpolation import fill_with_splines
from mocapfix.fill.gap_windows import FillMethod, Gap, GapEstimate, GapWindow, MarkerEstimate, MarkersInTake, MovingAxes
from mocapfix.model.body_fit import BodyFit
from mocapfix.model.take import SAMPLE_NOISE_M
from mocapfix.solve import kinematics
from mocapfix.solve.occluded_joints import KnownMotion, predict_hidden_joints
from mocapfix.solve.pose_problem import find_unobserved_joints
from mocapfix.stats.gaussian_process import estimate_roughness, map_residual
from mocapfix.stats.rigid_alignment import compute_lengths
from mocapfix.stats.sequences import find_runs, sample_evenly

BODY_RESIDUAL_FADE_S = 0.2  # time scale of the correlation of a marker's residual
MIN_BODY_RESIDUAL_M = 0.002  # smallest standard deviation of the residual
MIN_BODY_FILL_SD_M = 0.0005  # smallest standard deviation of a fill
STEP_NOISE_M = 0.001  # standard deviation per axis of the measured step at an edge
BODY_ERROR_RATIO = 1.5
"""Ratio of the errors in gaps to what the residual and the pose predict: a body does not fit as well as its markers say."""
MAX_EDGE_RESIDUAL_M, MAX_EDGE_RESIDUAL_RATIO = 0.05, 4.0  # and the same over the marker's median: samples above both are no edges
MAX_PREDICTED_STRETCHES = 4  # in which the motion prior predicts a hidden limb; with 12, composed takes are hardly better


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

    def find_marker(self, marker: int) -> MarkerOnBody:
        """Return a marker of `rows` on its body."""
        if marker not in self.markers:
            (body, row), path = self.rows[marker], self.take.visible_markers[:, marker]
            rotations, places = self.poses[id(body)]
            axes = MovingAxes(rotations[:, body.extended_subject.joints[row]], places[:, row])
            self.markers[marker] = place_marker(body, row, axes, path, self.rate)
        return self.markers[marker]

    def __call__(self, gap: Gap) -> list[GapEstimate]:
        return [self.estimate_gap(self.find_marker(gap.marker), gap.window)[0]] if gap.marker in self.rows else []

    def estimate_gap(self, on_body: MarkerOnBody, window: GapWindow) -> tuple[GapEstimate, Float[np.ndarray, "K S 3"]]:
        """Return the estimate of a marker in a gap, and the residuals that are estimated in the hidden stretches."""
        rate = self.rate
        axes, residual = on_body.axes, on_body.residual
        w = window.keep_known_context(~np.isnan(residual[window.context_frames, 0]))
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
        hidden = hidden_map @ residual[w.hidden_context_frames]
        error = hidden - residual[w.hidden_frames]
        known_count, squares = (~np.isnan(error)).sum((0, 2)), np.nansum(error**2, axis=(0, 2))
        shown = np.maximum(squares / np.maximum(known_count, 1), MIN_BODY_FILL_SD_M**2)
        added = np.maximum(gap_variance[w.points] - hidden_variance, 0.0)
        error = np.einsum("...ab,...b->...a", axes.rotation_world_axes[w.hidden_frames], error)
        error *= (BODY_ERROR_RATIO * np.sqrt(1 + added / shown))[:, None]
        expected_sd = BODY_ERROR_RATIO * np.sqrt(np.maximum(gap_variance[w.points], MIN_BODY_FILL_SD_M**2))
        evidence = float((shown / (shown + added)).mean())
        return GapEstimate(FillMethod.BODY, position, error, expected_sd, evidence=evidence), hidden


Places: TypeAlias = tuple[Float[np.ndarray, "n K 3"], Float[np.ndarray, "n J 3 3"]]  # of markers in m; world rotations of joints


class PredictedPlacement(BodyPlacement):
    """Estimates a marker from its place on the body, of which the motion prior predicts the joints that no marker shows."""

    def __init__(self, take: MarkersInTake) -> None:
        body = take.body if take.body and take.body.evidence and take.body.has_motion_prior else None
        super().__init__(take, [body] if body else [])
        self._latest: tuple[GapWindow | None, dict[int, Places]] = None, {}
        if body:
            self.subject, free = body.extended_subject, body.extended_subject.body_model.free_joints
            is_used = take.is_visible[:, body.marker_columns] & (body.marker_columns >= 0)
            is_hidden = find_unobserved_joints(is_used, self.subject, free)
            parts = body.motion.root_position, body.motion.local_rotations, np.zeros(is_hidden.shape), is_hidden
            self.motion = KnownMotion(*parts, np.flatnonzero(free)[1:], take.rate)

    def __call__(self, gap: Gap) -> list[GapEstimate]:
        w = gap.window
        if gap.marker in self.rows and self._latest[0] is not w:
            self._latest = w, self.predict_places(w)
        if gap.marker not in self.rows or not self._latest[1]:
            return []
        on_body, row = self.find_marker(gap.marker), self.rows[gap.marker][1]
        joint, axes = self.subject.joints[row], MovingAxes(*(each.copy() for each in on_body.axes))
        places, rotations = self._latest[1][-1]
        axes.origin[w.gap_frames], axes.rotation_world_axes[w.gap_frames] = places[:, row], rotations[:, joint]
        estimate, residual = self.estimate_gap(on_body._replace(axes=axes), w)
        error = np.full(residual.shape, np.nan)
        for k, (places, rotations) in self._latest[1].items():
            if k >= 0:
                placed = places[:, row] + np.einsum("sab,sb->sa", rotations[:, joint], residual[k])
                error[k] = BODY_ERROR_RATIO * (placed - self.take.visible_markers[w.hidden_frames[k], gap.marker])
        shown_sd = np.sqrt(np.nansum(error**2) / max(np.count_nonzero(~np.isnan(error)), 1))  # an inferred pose's can be far less
        expected_sd = np.maximum(estimate.expected_sd / BODY_ERROR_RATIO, shown_sd)  # measured errors raised an inferred pose's
        return [estimate._replace(error=error, expected_sd=expected_sd, evidence=1.0)]

    def predict_places(self, window: GapWindow) -> dict[int, Places]:
        """Return the places in a gap by the number -1, and those at the points of hidden stretches by theirs.

        It is empty for a gap in which no joint is hidden, or predicted.
        """
        w, motion, placed = window, self.motion, dict[int, Places]()
        joints = np.flatnonzero(motion.is_unobserved[w.gap_frames].all(0))
        tree, size_ratio = kinematics.build_kinematic_tree(self.subject.skeleton), self.subject.skeleton.size_ratio
        for k in [-1, *sample_evenly(len(w.starts), MAX_PREDICTED_STRETCHES).tolist()] if len(joints) else []:
            points = np.arange(w.length) if k < 0 else w.hidden_points
            frames = w.gap_frames if k < 0 else w.starts[k] + np.arange(w.hidden_length)
            is_comparable = k < 0 or not motion.is_unobserved[np.ix_(frames, joints)].any()
            prediction = predict_hidden_joints(motion, frames, joints, size_ratio) if is_comparable else None
            if prediction:
                pose = motion.root_position[frames[points]], motion.local_rotations[frames[points]]
                pose[1][:, joints] = prediction.rotations[points]
                placed[k] = kinematics.predict_markers(self.subject, pose), kinematics.compute_tree_poses(tree, *pose)[1]
            elif k < 0:
                break
        return placed


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
