"""Estimates from rigid groups: a missing marker of a prop has its place in the group's shape, in every frame by itself.

Three visible markers of a group give its pose in a frame. Two give it but for the angle about the line through them, which is
interpolated from the frames before and after. Which markers are visible may change from frame to frame. The standard deviation
follows from the deviations of the markers from the shape, and from where the visible ones are in it.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.fill.gap_windows import MIN_FILL_SD_M, FillMethod, Gap, GapEstimate, MarkersInTake
from mocapfix.stats import rigid_alignment
from mocapfix.stats.sequences import sample_evenly

MAX_SHAPE_FRAMES = 600  # evenly spread frames in which the shape of a group is measured
MIN_SHAPE_FRAMES = 10  # frames in which a marker must be visible with three others of the group to have a place in its shape
MAX_POSE_SD_RATIO = 10.0
"""Error of a pose at a missing marker relative to that of one marker, above which the visible ones are nearly on one line."""
MAX_POSE_CONDITION = 1e6  # condition number of the information on a pose above which the visible markers are on one line
MAX_TWIST_LAGS = 8  # distances in time, doubled each, at which the error of an interpolated angle is measured
MIN_TWIST_FRAMES = 20  # frames that show this error


class RigidGroupPlacement:
    """Estimates a marker from the rigid group to which it belongs."""

    def __init__(self, take: MarkersInTake) -> None:
        self.take, self.shapes = take, dict[int, _GroupShape]()
        for group in take.rigid_groups:
            if not take.is_visible[:, group.markers].all():
                shape = _GroupShape(take.visible_markers[:, group.markers])
                self.shapes |= dict.fromkeys(group.markers, shape)
        self.columns = {marker: group.markers for group in take.rigid_groups for marker in group.markers}

    def __call__(self, gap: Gap) -> list[GapEstimate]:
        if gap.marker not in self.shapes:
            return []
        shape, member = self.shapes[gap.marker], self.columns[gap.marker].index(gap.marker)
        w, frames = gap.window, gap.window.gap_frames
        position, sd = shape.place(member, frames, shape.is_used[frames], np.stack([frames, frames]))
        if np.isnan(sd).all():
            return []
        hidden = w.hidden_frames.ravel()
        used = shape.is_used[hidden] & np.tile(shape.is_used[frames[w.points]], (len(w.starts), 1))
        around = np.repeat([w.starts, w.starts + w.hidden_length - 1], len(w.points), axis=1)
        placed, _ = shape.place(member, hidden, used, around)
        error = (placed - self.take.visible_markers[hidden, gap.marker]).reshape(*w.hidden_frames.shape, 3)
        return [GapEstimate(FillMethod.RIGID_GROUP, position, error, sd[w.points])]


class _GroupShape:
    """The shape of a rigid group and its poses. A marker that is seldom visible with others has no place in it."""

    def __init__(self, markers: Float[np.ndarray, "T K 3"]) -> None:
        self.markers = markers
        self.shape, self.marker_sd = measure_group_shape(markers)
        self.is_used = ~np.isnan(markers[..., 0]) & np.isfinite(self.marker_sd)
        rotation, _, is_known = rigid_alignment.align_to_shape(markers, self.is_used, self.shape)
        patterns, rows = np.unique(self.is_used, axis=0, return_inverse=True)
        members = np.flatnonzero(np.isfinite(self.marker_sd))
        is_determined = np.array([np.isfinite(self._compute_pose_sd(each, members)).all() for each in patterns], bool)
        self.rotation, self.is_known = rotation, is_known & is_determined[rows.ravel()]
        self._twist_errors: dict[tuple[int, ...], tuple[tuple[np.ndarray, np.ndarray], ...]] = {}

    def _compute_pose_sd(self, is_used: np.ndarray, members: np.ndarray) -> np.ndarray:
        """Return the error of a pose at some members; infinite where the used ones are nearly on one line."""
        pose_sd = compute_group_pose_sd(self.shape.positions, self.marker_sd, is_used, members)
        return np.where(pose_sd <= MAX_POSE_SD_RATIO * np.nanmax(self.marker_sd, initial=0.0), pose_sd, np.inf)

    def place(
        self, member: int, frames: Int[np.ndarray, " N"], is_used: Bool[np.ndarray, "N K"], around: Int[np.ndarray, "2 N"]
    ) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, " N"]]:
        """Return the positions of a member of the group in some frames and their standard deviations per axis; NaN if unknown.

        Args:
            is_used: The other members that are used in each frame.
            around: First and last frame of the gap of each frame, in which no pose is used to interpolate the angle about a line.
        """
        position, sd = np.full((len(frames), 3), np.nan), np.full(len(frames), np.nan)
        if np.isnan(self.marker_sd[member]):
            return position, sd
        is_used = is_used.copy()
        is_used[:, member] = False
        rotation, origin, _ = rigid_alignment.align_to_shape(self.markers[frames], is_used, self.shape)
        patterns, rows = np.unique(is_used, axis=0, return_inverse=True)
        for p, pattern in enumerate(patterns):
            n = np.flatnonzero(rows.ravel() == p)
            pose_sd = self._compute_pose_sd(pattern, np.array([member]))[0]
            if np.isfinite(pose_sd):
                position[n] = rotation[n] @ self.shape.positions[member] + origin[n]
                sd[n] = np.hypot(pose_sd, self.marker_sd[member])
            elif pattern.sum() == 2 and self.is_known.sum() >= MIN_TWIST_FRAMES:
                pair = np.flatnonzero(pattern)
                position[n], twist_sd = self._place_by_pair(member, pair, frames[n], around[:, n])
                sd[n] = np.sqrt(twist_sd**2 + self.marker_sd[member] ** 2 + (self.marker_sd[pair] ** 2).sum())
        return position, sd

    def _place_by_pair(
        self, member: int, pair: Int[np.ndarray, "2"], frames: Int[np.ndarray, " N"], around: Int[np.ndarray, "2 N"]
    ) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, " N"]]:
        """Return the positions of a member in frames that show a pair, and the error of the angle about it per axis.

        The angle about the line through the pair is interpolated between the frames whose poses are known.
        """
        known, shape = np.flatnonzero(self.is_known), self.shape.positions
        first = known[np.maximum(np.searchsorted(known, around[0]) - 1, 0)]
        last = known[np.minimum(np.searchsorted(known, around[1], side="right"), len(known) - 1)]
        share = np.clip((frames - first) / np.maximum(last - first, 1), 0, 1)
        line = shape[pair[1]] - shape[pair[0]]
        markers = self.markers[frames]
        seen = markers[:, pair[1]] - markers[:, pair[0]]
        rotation = turn_about_line(self.rotation[first], self.rotation[last], share, line, seen)
        arm, direction = shape[member] - shape[pair].mean(0), line / np.linalg.norm(line)
        radius = np.linalg.norm(arm - arm @ direction * direction)
        is_inside = (frames > first) & (frames < last)
        between = 2 * (frames - first) * (last - frames) / np.maximum(last - first, 1)
        reach = np.where(is_inside, between, np.maximum(first - frames, frames - last))
        if (key := tuple(pair.tolist())) not in self._twist_errors:
            errors = [measure_twist_error(self.rotation, self.is_known, line, is_one_sided=each) for each in (False, True)]
            self._twist_errors[key] = errors[0], errors[1]
        twist_sd = np.where(is_inside, *(np.interp(reach, *error) for error in self._twist_errors[key]))
        return markers[:, pair].mean(1) + rotation @ arm, twist_sd * radius / np.sqrt(3)


def measure_group_shape(markers: Float[np.ndarray, "T K 3"]) -> tuple[rigid_alignment.CommonShape, Float[np.ndarray, " K"]]:
    """Return the shape of a group and each marker's standard deviation per axis about it, NaN for a marker without a place."""
    is_visible = ~np.isnan(markers[..., 0])
    counts = is_visible.sum(1)
    complete = np.flatnonzero(counts >= min(rigid_alignment.MIN_ALIGNMENT_MARKERS + 1, markers.shape[1]))
    frames = complete[sample_evenly(len(complete), MAX_SHAPE_FRAMES)]
    if len(frames) < MIN_SHAPE_FRAMES:
        unknown = np.full(markers.shape[1:], np.nan)
        return rigid_alignment.CommonShape(unknown, np.ones(len(unknown))), unknown[:, 0]
    shape = rigid_alignment.fit_common_shape(markers[frames])
    count = is_visible[frames].sum(0)
    coordinates = 3 * counts[frames].mean()
    freedom = coordinates / (coordinates - 6)  # of which six determine the pose
    sd = np.sqrt(np.maximum(shape.variance * freedom, MIN_FILL_SD_M**2))
    return shape, np.where((count >= MIN_SHAPE_FRAMES) & np.isfinite(shape.positions[:, 0]), sd, np.nan)


def compute_group_pose_sd(
    positions: Float[np.ndarray, "K 3"],
    marker_sd: Float[np.ndarray, " K"],
    is_used: Bool[np.ndarray, " K"],
    missing: Int[np.ndarray, " N"],
) -> Float[np.ndarray, " N"]:
    """Return the standard deviation per axis in metres, at missing markers, of a pose that is fitted to the used ones.

    It is infinite if these do not determine a pose: fewer than three, or all on one line.
    """
    if is_used.sum() < rigid_alignment.MIN_ALIGNMENT_MARKERS:
        return np.full(len(missing), np.inf)
    centre = positions[is_used].mean(0)
    design = np.concatenate(
        [_build_pose_design(p - centre) / s for p, s in zip(positions[is_used], marker_sd[is_used], strict=True)]
    )
    scale = np.array([1.0] * 3 + [1 / max(np.linalg.norm(positions[is_used] - centre), 1e-6)] * 3)
    information = scale[:, None] * (design.T @ design) * scale
    if np.linalg.cond(information) > MAX_POSE_CONDITION:
        return np.full(len(missing), np.inf)
    covariance = scale[:, None] * np.linalg.inv(information) * scale
    designs = [_build_pose_design(positions[m] - centre) for m in missing]
    return np.array([np.sqrt(np.trace(each @ covariance @ each.T) / 3) for each in designs])


def _build_pose_design(arm: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 6"]:
    """Return the derivatives of a point at `arm` from the centre by translation and rotation vector."""
    x, y, z = arm
    return np.hstack([np.eye(3), np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])])


def turn_about_line(
    first: Float[np.ndarray, "N 3 3"],
    last: Float[np.ndarray, "N 3 3"],
    share: Float[np.ndarray, " N"],
    line: Float[np.ndarray, "3"],
    seen: Float[np.ndarray, "N 3"],
) -> Float[np.ndarray, "N 3 3"]:
    """Return rotations at a share of the way from first to last, turned the shortest way that directs `line` along `seen`."""
    turned = rigid_alignment.scale_rotations(last @ first.swapaxes(1, 2), share[:, None]) @ first
    return rigid_alignment.compute_shortest_rotations(turned @ line, seen) @ turned


def measure_twist_error(
    rotation: Float[np.ndarray, "T 3 3"], is_known: Bool[np.ndarray, " T"], line: Float[np.ndarray, "3"], *, is_one_sided: bool
) -> tuple[Float[np.ndarray, " L"], Float[np.ndarray, " L"]]:
    """Return distances in frames from known poses, and the error (rad) there of an interpolated angle about a line.

    Where `is_one_sided`, only an earlier pose is known.
    """
    lags, errors = [0.0], [0.0]
    for lag in 2 ** np.arange(MAX_TWIST_LAGS):
        frames = np.arange(lag, len(is_known) - lag)
        is_shown = is_known[frames] & is_known[frames - lag] & (is_one_sided | is_known[frames + lag])
        frames = frames[is_shown]
        frames = frames[sample_evenly(len(frames), MAX_SHAPE_FRAMES)]
        if len(frames) < MIN_TWIST_FRAMES:
            break
        true, last = rotation[frames], rotation[frames - lag if is_one_sided else frames + lag]
        turned = turn_about_line(rotation[frames - lag], last, np.full(len(frames), 0.5), line, true @ line)
        angle = rigid_alignment.compute_lengths(rigid_alignment.compute_rotation_vectors(np.swapaxes(true, 1, 2) @ turned))
        lags.append(float(lag))
        errors.append(float(np.sqrt((angle**2).mean())))
    if len(lags) == 1:
        return np.array([0.0, 1.0]), np.array([0.0, np.pi])
    reach = 2 * len(is_known) / lags[-1]  # beyond what was measured the error grows with the time
    return (np.array([*lags, lags[-1] * reach]), np.minimum([*errors, errors[-1] * reach], np.pi))
