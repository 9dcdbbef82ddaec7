"""Estimates from rigid groups: a missing marker of a prop has its place in the group's shape, in every frame by itself.

Three visible markers of a group give its pose in a frame. Two give it but for the angle about the line through them, which is
interpolated from the frames before and after. Which markers are visible may change from frame to frame. The standard deviation
follows from the deviations of the markers from the shape, and from where the visible ones are in it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.fill.fill_methods import FillMethod, MarkerEstimate, build_marker_estimate
from mocapfix.fill.spline_fill import MIN_FILL_SD_M
from mocapfix.stats.marker_distances import RigidGroup
from mocapfix.stats.rigid_alignment import MIN_ALIGNMENT_MARKERS, CommonShape, align_to_shape, fit_common_shape
from mocapfix.stats.sequences import find_runs, sample_evenly

MAX_SHAPE_FRAMES = 600  # evenly spread frames in which the shape of a group is measured
MIN_SHAPE_FRAMES = 10  # frames in which a marker must be visible with three others of the group to have a place in its shape
MAX_POSE_SD_RATIO = 10.0
"""Error of a pose at a missing marker relative to that of one marker, above which the visible ones are nearly on one line."""
MAX_POSE_CONDITION = 1e6  # condition number of the information on a pose above which the visible markers are on one line
MAX_TWIST_LAGS = 8  # distances in time, doubled each, at which the error of an interpolated angle is measured
MIN_TWIST_FRAMES = 20  # frames that show this error


class GroupPoses(NamedTuple):
    """Poses of a rigid group: rotation (T, 3, 3), origin (T, 3) m, and whether a frame determines them (T,)."""

    rotation: np.ndarray
    origin: np.ndarray
    is_known: np.ndarray


def estimate_from_rigid_groups(markers: Float[np.ndarray, "T M 3"], groups: Sequence[RigidGroup]) -> MarkerEstimate:
    """Return the estimates of the missing samples of all markers in rigid groups.

    markers  in metres, NaN if missing
    """
    position, sd = np.full(markers.shape, np.nan), np.full(markers.shape[:2], np.nan)
    for group in groups:
        columns = np.array(group.markers)
        if np.isnan(markers[:, columns, 0]).any():
            position[:, columns], sd[:, columns] = fill_rigid_group(markers[:, columns])
    return build_marker_estimate(position, sd, FillMethod.RIGID_GROUP)


def prefer_rigid_groups(
    estimate: MarkerEstimate, group_estimate: MarkerEstimate, is_missing: Bool[np.ndarray, "T M"]
) -> MarkerEstimate:
    """Return the estimates with those of rigid groups in the gaps in which they are more precise."""
    position, sd, method = (values.copy() for values in estimate)
    for m in np.flatnonzero((is_missing & ~np.isnan(group_estimate.sd)).any(0)).tolist():
        for first, last in find_runs(is_missing[:, m]):
            gap = first + np.flatnonzero(~np.isnan(group_estimate.sd[first : last + 1, m]))
            others_sd = sd[gap, m]
            if np.nansum(group_estimate.sd[gap, m] ** 2) <= np.where(np.isnan(others_sd), np.inf, others_sd**2).sum():
                position[gap, m], sd[gap, m] = group_estimate.position[gap, m], group_estimate.sd[gap, m]
                method[gap, m] = FillMethod.RIGID_GROUP
    return MarkerEstimate(position, sd, method)


def fill_rigid_group(markers: Float[np.ndarray, "T K 3"]) -> tuple[Float[np.ndarray, "T K 3"], Float[np.ndarray, "T K"]]:
    """Return positions and standard deviations per axis of the missing samples of a group's markers, NaN where unknown."""
    is_visible = ~np.isnan(markers[..., 0])
    position, sd = np.full(markers.shape, np.nan), np.full(is_visible.shape, np.nan)
    shape, marker_sd = measure_group_shape(markers)
    has_place = np.isfinite(marker_sd)
    used = is_visible & has_place
    rotation, origin, is_known = align_to_shape(markers, used, shape)
    needed = has_place & ~is_visible
    patterns, rows = np.unique(used[needed.any(1)], axis=0, return_inverse=True)
    pairs: list[tuple[np.ndarray, np.ndarray]] = []
    for p, pattern in enumerate(patterns):
        frames, missing = np.flatnonzero(needed.any(1))[rows.ravel() == p], np.flatnonzero(has_place & ~pattern)
        pose_sd = compute_group_pose_sd(shape.positions, marker_sd, pattern, missing)
        if (pose_sd <= MAX_POSE_SD_RATIO * marker_sd[has_place].max()).all():
            placed = np.einsum("tab,kb->tka", rotation[frames], shape.positions[missing]) + origin[frames, None]
            position[np.ix_(frames, missing)], sd[np.ix_(frames, missing)] = placed, np.hypot(pose_sd, marker_sd[missing])
        else:
            is_known[frames] = False
            pairs += [(frames, np.flatnonzero(pattern))] if pattern.sum() == 2 else []
    poses = GroupPoses(rotation, origin, is_known)
    for frames, pair in pairs if is_known.sum() >= MIN_TWIST_FRAMES else ():
        placed, twist_sd = fill_from_pair(markers[frames], pair, shape, poses, frames)
        position[frames], sd[frames] = placed, np.sqrt(twist_sd**2 + marker_sd**2 + (marker_sd[pair] ** 2).sum())
    position[~needed], sd[~needed] = np.nan, np.nan
    return position, sd


def measure_group_shape(markers: Float[np.ndarray, "T K 3"]) -> tuple[CommonShape, Float[np.ndarray, " K"]]:
    """Return the shape of a group and each marker's standard deviation per axis about it, NaN for a marker without a place."""
    is_visible = ~np.isnan(markers[..., 0])
    counts = is_visible.sum(1)
    complete = np.flatnonzero(counts >= min(MIN_ALIGNMENT_MARKERS + 1, markers.shape[1]))
    frames = complete[sample_evenly(len(complete), MAX_SHAPE_FRAMES)]
    if len(frames) < MIN_SHAPE_FRAMES:
        return CommonShape(np.full(markers.shape[1:], np.nan), np.ones(markers.shape[1])), np.full(markers.shape[1], np.nan)
    shape = fit_common_shape(markers[frames])
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
    if is_used.sum() < MIN_ALIGNMENT_MARKERS:
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


def fill_from_pair(
    markers: Float[np.ndarray, "N K 3"],
    pair: Int[np.ndarray, "2"],
    shape: CommonShape,
    poses: GroupPoses,
    frames: Int[np.ndarray, " N"],
) -> tuple[Float[np.ndarray, "N K 3"], Float[np.ndarray, "N K"]]:
    """Return positions of a group's markers in N frames that show a pair of them, and the error of the angle about it per axis.

    The angle about the line through the pair is interpolated between the frames whose poses are known.

    markers  in the N frames, in metres
    poses    of all frames of the take
    """
    known = np.flatnonzero(poses.is_known)
    after = np.clip(np.searchsorted(known, frames), 1, len(known) - 1)
    first, last = known[after - 1], known[after]
    share = np.clip((frames - first) / (last - first), 0, 1)
    line = shape.positions[pair[1]] - shape.positions[pair[0]]
    seen = markers[:, pair[1]] - markers[:, pair[0]]
    rotation = turn_about_line(poses.rotation[first], poses.rotation[last], share, line, seen)
    arms = shape.positions - shape.positions[pair].mean(0)
    position = markers[:, pair].mean(1)[:, None] + np.einsum("tab,kb->tka", rotation, arms)
    direction = line / np.linalg.norm(line)
    radius = np.linalg.norm(arms - np.outer(arms @ direction, direction), axis=1)
    is_inside = (share > 0) & (share < 1)
    reach = np.where(
        is_inside, 2 * (frames - first) * (last - frames) / (last - first), np.maximum(first - frames, frames - last)
    )
    twist_sd = np.where(
        is_inside, *(np.interp(reach, *measure_twist_error(poses, line, is_one_sided=side)) for side in (False, True))
    )
    return position, np.outer(twist_sd, radius) / np.sqrt(3)


def turn_about_line(
    first: Float[np.ndarray, "N 3 3"],
    last: Float[np.ndarray, "N 3 3"],
    share: Float[np.ndarray, " N"],
    line: Float[np.ndarray, "3"],
    seen: Float[np.ndarray, "N 3"],
) -> Float[np.ndarray, "N 3 3"]:
    """Return rotations at a share of the way from first to last, turned the shortest way that directs `line` along `seen`."""
    step = (Rotation.from_matrix(last) * Rotation.from_matrix(first).inv()).as_rotvec()
    turned = Rotation.from_rotvec(share[:, None] * step).as_matrix() @ first
    before = turned @ (line / np.linalg.norm(line))
    after = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    axis, cosine = np.cross(before, after), np.einsum("ta,ta->t", before, after)
    length = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(length, cosine)
    shortest = axis * np.divide(angle, length, out=np.zeros(len(length)), where=length > 0)[:, None]
    return Rotation.from_rotvec(shortest).as_matrix() @ turned


def measure_twist_error(
    poses: GroupPoses, line: Float[np.ndarray, "3"], *, is_one_sided: bool
) -> tuple[Float[np.ndarray, " L"], Float[np.ndarray, " L"]]:
    """Return numbers of frames and the error in radians of an angle that is interpolated as far from the nearest known pose.

    is_one_sided  whether only an earlier pose is known
    """
    lags, errors = [0.0], [0.0]
    for lag in 2 ** np.arange(MAX_TWIST_LAGS):
        frames = np.arange(lag, len(poses.is_known) - lag)
        is_shown = poses.is_known[frames] & poses.is_known[frames - lag] & (is_one_sided | poses.is_known[frames + lag])
        frames = frames[is_shown]
        frames = frames[sample_evenly(len(frames), MAX_SHAPE_FRAMES)]
        if len(frames) < MIN_TWIST_FRAMES:
            break
        true, last = poses.rotation[frames], poses.rotation[frames - lag if is_one_sided else frames + lag]
        turned = turn_about_line(poses.rotation[frames - lag], last, np.full(len(frames), 0.5), line, true @ line)
        angle = Rotation.from_matrix(np.swapaxes(true, 1, 2) @ turned).magnitude()
        lags.append(float(lag))
        errors.append(float(np.sqrt((angle**2).mean())))
    if len(lags) == 1:
        return np.array([0.0, 1.0]), np.array([0.0, np.pi])
    reach = 2 * len(poses.is_known) / lags[-1]  # beyond what was measured the error grows with the time
    return np.array([*lags, lags[-1] * reach]), np.minimum([*errors, errors[-1] * reach], np.pi)
