"""Trajectory segments: unbroken parts of trajectories that may belong to another label, and what continues them.

These are the unlabelled trajectories, and those whose label is another label with a number appended (`RBAC-1` beside `RBAC`) or
a repetition of it. Cameras lose a point and pick up another one under the same label, so a trajectory is split at pauses
and leaps.

Leaps (`kernels.label_evidence.compute_leap`) compare two samples. Both are extrapolated with their own velocities to the
moment half way between them, where a constant acceleration cancels. As a velocity may be corrupted by a leap of its own,
extrapolating one of them all the way is tried as well, and the smallest mismatch counts. After some tenths of a second
nothing can be concluded.

`compute_join_cost` compares a trajectory segment with the trajectory that precedes and follows it.
"""

import re
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mocapfix.model.take import Take

# A label with a number appended: "RBAC-1", "RBAC_12", "RBAC (2)".
NUMBERED_LABEL = re.compile(r"(.*[^\W_])(?:[-_.#* ]+\d+|\s*\(\d+\))")
# A longer pause ends a segment.
MAX_PAUSE_S = 0.025
# A step that deviates more from a straight path belongs to another point: a constant, and a term in the square of its time.
SEGMENT_STEP_TOLERANCE_M = 0.015
SEGMENT_STEP_TOLERANCE_M_PER_S2 = 200.0


@dataclass(frozen=True)
class TrajectorySegment:
    """An unbroken part of one trajectory.

    Attributes:
        donor: Index into the take's labels or, from their number on, into its unlabelled trajectories.
        namesake: Index of the marker whose label it has, -1 if none.
        frames: Frame indices (N,).
        points: World positions (N, 3) in metres.
    """

    donor: int
    namesake: int
    frames: np.ndarray
    points: np.ndarray

    @property
    def first(self) -> int:
        """Index of the first frame."""
        return int(self.frames[0])

    @property
    def last(self) -> int:
        """Index of the last frame."""
        return int(self.frames[-1])

    def pick_samples(self, max_count: int) -> "TrajectorySegment":
        """Return the segment with at most `max_count` of its samples, evenly spread."""
        pick = np.unique(np.linspace(0, len(self.frames) - 1, max_count).astype(int))
        return replace(self, frames=self.frames[pick], points=self.points[pick])

    def measure_distances(self, markers: Float[np.ndarray, "T M 3"], columns: Int[np.ndarray, " K"]) -> Float[np.ndarray, "N K"]:
        """Measure the distances in metres from each sample to the positions of some markers in its frame."""
        return np.linalg.norm(markers[np.ix_(self.frames, columns)] - self.points[:, None], axis=-1)


def find_loose_segments(take: Take) -> list[TrajectorySegment]:
    """Split the trajectories that may belong to another label into segments, ordered by donor and first frame."""
    loose = [(donor, marker, take.markers[:, donor]) for donor, marker in find_namesakes(take).items()]
    if take.unlabelled is not None:
        loose += [(len(take.labels) + u, -1, take.unlabelled.markers[:, u]) for u in range(len(take.unlabelled.labels))]
    return [
        TrajectorySegment(donor, marker, frames, path[frames])
        for donor, marker, path in loose
        for frames in split_trajectory(np.flatnonzero(~np.isnan(path[:, 0])), path, take.rate)
    ]


def find_namesakes(take: Take) -> dict[int, int]:
    """Find the markers that have another marker's label; return their indices and those of the other markers.

    If several markers have the same label, the one that is visible longest is the marker. A numbered label whose base label
    is not in the take is a label of its own.
    """
    visible_count = take.visible.sum(0)
    first_of_label: dict[str, int] = {}
    for m in np.argsort(-visible_count, kind="stable"):
        first_of_label.setdefault(take.labels[m], int(m))
    bases = [label if first_of_label[label] != m else _strip_number(label) for m, label in enumerate(take.labels)]
    return {m: first_of_label[base] for m, base in enumerate(bases) if base in first_of_label}


def _strip_number(label: str) -> str | None:
    numbered = NUMBERED_LABEL.fullmatch(label)
    return numbered.group(1) if numbered else None


def split_trajectory(frames: Int[np.ndarray, " N"], path: Float[np.ndarray, "T 3"], rate: float) -> list[Int[np.ndarray, " _"]]:
    """Split the frames at which a path is visible at pauses, and at steps that are leaps as seen from both sides."""
    if not len(frames):
        return []
    lag, step = np.diff(frames)[:, None] / rate, np.diff(path[frames], axis=0)
    error_before, error_after = np.full(len(step), np.inf), np.full(len(step), np.inf)
    error_before[1:] = np.linalg.norm(step[1:] - step[:-1] / lag[:-1] * lag[1:], axis=1)
    error_after[:-1] = np.linalg.norm(step[:-1] - step[1:] / lag[1:] * lag[:-1], axis=1)
    error, lag = np.minimum(error_before, error_after), lag[:, 0]
    is_leap = np.isfinite(error) & (error > SEGMENT_STEP_TOLERANCE_M + SEGMENT_STEP_TOLERANCE_M_PER_S2 * lag**2)
    return np.split(frames, np.flatnonzero(is_leap | (lag > MAX_PAUSE_S)) + 1)


# Number of samples of a segment, evenly spread, by which the markers are chosen that are compared with all of them.
MAX_SCREENED_SAMPLES = 60
# Two trajectories of the same marker are at most this far apart.
MAX_DUPLICATE_DISTANCE_M = 0.010
# Part of a trajectory, next to its end, to which the velocity is fitted.
VELOCITY_WINDOW_S = 0.03
# Standard deviation of the join error: a constant, and a term that grows with the square of the time across the join.
JOIN_TOLERANCE_M = 0.002
JOIN_TOLERANCE_M_PER_S2 = 2.5
# The join error of one end counts no more than this, because the last sample of a label is often an outlier.
MAX_END_DEVIATION_SD = 3.5


class MarkerTrajectories(NamedTuple):
    """The trajectories of M labels over T frames.

    Attributes:
        markers: World positions (T, M, 3) in metres, NaN where missing.
        previous_frame: Index (T, M) of the latest earlier frame in which the label is visible, -1 if there is none.
        rate: Frame rate in Hz.
    """

    markers: np.ndarray
    previous_frame: np.ndarray
    rate: float


def build_trajectories(markers: Float[np.ndarray, "T M 3"], rate: float) -> MarkerTrajectories:
    """Build the trajectories of markers at world positions in metres (NaN where missing), at `rate` Hz."""
    markers = np.ascontiguousarray(markers, float)
    visible = ~np.isnan(markers[..., 0])
    latest = np.maximum.accumulate(np.where(visible, np.arange(len(visible))[:, None], -1), axis=0)
    previous_frame = np.full(visible.shape, -1)
    previous_frame[1:] = latest[:-1]
    return MarkerTrajectories(markers, previous_frame, float(rate))


def compute_join_cost(segment: TrajectorySegment, path: Float[np.ndarray, "T 3"], rate: float, max_gap_s: float) -> float:
    """Compute the cost of joining a trajectory segment to a marker's path.

    Returns:
        The mean square of the join errors at both ends, in standard deviations. NaN if the path has no sample within
        `max_gap_s` of either end. Infinite if the segment and the path are visible together but apart.
    """
    visible = ~np.isnan(path[:, 0])
    is_shared = visible[segment.frames]
    if is_shared.any():
        shared = replace(segment, frames=segment.frames[is_shared], points=segment.points[is_shared])
        few = shared.pick_samples(MAX_SCREENED_SAMPLES)
        if np.linalg.norm(few.points - path[few.frames], axis=1).min() > MAX_DUPLICATE_DISTANCE_M:
            return np.inf
        distance = float(np.median(np.linalg.norm(shared.points - path[shared.frames], axis=1)))
        return (2 * distance / MAX_DUPLICATE_DISTANCE_M) ** 2 if distance <= MAX_DUPLICATE_DISTANCE_M else np.inf
    first, last, reach = segment.frames[0], segment.frames[-1], round(max_gap_s * rate) + 1
    start = max(0, first - reach)
    early = start + np.flatnonzero(visible[start:first])
    late = last + 1 + np.flatnonzero(visible[last + 1 : last + 1 + reach])
    ends: list[tuple[float, float]] = []
    if len(early):
        ends.append(measure_join_error(early, path[early], segment.frames, segment.points, rate))
    if len(late):
        ends.append(measure_join_error(segment.frames, segment.points, late, path[late], rate))
    if not ends:
        return np.nan
    return float(
        np.mean(
            [min(MAX_END_DEVIATION_SD, error / (JOIN_TOLERANCE_M + JOIN_TOLERANCE_M_PER_S2 * lag**2)) ** 2 for error, lag in ends]
        )
    )


def measure_join_error(
    early_frames: Int[np.ndarray, " N"],
    early_points: Float[np.ndarray, "N 3"],
    late_frames: Int[np.ndarray, " K"],
    late_points: Float[np.ndarray, "K 3"],
    rate: float,
) -> tuple[float, float]:
    """Measure how far the extrapolation of one path misses the first point of the next.

    The extrapolation goes from the last early point at the mean of the velocities on both sides.

    Returns:
        The distance in metres and the time across the join in seconds.
    """
    lag = (late_frames[0] - early_frames[-1]) / rate
    velocity = (
        _fit_end_velocity(early_frames[::-1], early_points[::-1], rate) + _fit_end_velocity(late_frames, late_points, rate)
    ) / 2
    return float(np.linalg.norm(late_points[0] - early_points[-1] - velocity * lag)), float(lag)


def _fit_end_velocity(frames: np.ndarray, points: np.ndarray, rate: float) -> np.ndarray:
    """Fit a straight line to the points (N, 3) nearest to the first frame; return its velocity (3,) in m/s, 0 for one point."""
    count = max(2, int(np.searchsorted(np.abs(frames - frames[0]), VELOCITY_WINDOW_S * rate, side="right")))
    time = (frames[:count] - frames[:count].mean()) / rate
    return time @ points[:count] / max(float(time @ time), 1e-12)


def is_smoother(segment: TrajectorySegment, path: Float[np.ndarray, "T 3"], rate: float) -> bool:
    """Return whether a marker's path continues more smoothly, at both ends, with the segment than with its own samples."""
    first, last = segment.frames[0], segment.frames[-1]
    visible = np.flatnonzero(~np.isnan(path[:, 0]))
    early, late = visible[visible < first], visible[visible > last]
    own = visible[(visible >= first) & (visible <= last)]
    ends: list[tuple[float, float]] = []
    for frames, points in ((segment.frames, segment.points), (own, path[own])):
        into = measure_join_error(early, path[early], frames, points, rate)[0] if len(early) else 0.0
        out = measure_join_error(frames, points, late, path[late], rate)[0] if len(late) else 0.0
        ends.append((into, out))
    (into, out), (own_into, own_out) = ends
    return max(own_into, own_out) > JOIN_TOLERANCE_M and into < own_into and out < own_out
