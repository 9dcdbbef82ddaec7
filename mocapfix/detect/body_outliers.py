"""Astray: samples that lie where the solved body cannot have their marker.

A marker's path on its segment is cut where it leaps, in sight or within a gap, and a piece between two cuts is judged as
a whole: it is astray where it lies far from the marker's usual place, beside how far it may; and by less where the marker
leaps there and back in sight, for the body leans towards a marker for as long as that is elsewhere. What comes there slowly
is no piece of its own: that is skin, or a marker badly calibrated, and no fault of the samples. What leaps once and then
keeps its place on the segment is a marker that was moved.

The body leans towards what is astray, so that sound samples around look wrong, too: only the worst of what is astray at one
time is believed, and then the body is asked again.
"""

from dataclasses import dataclass

import numpy as np

from mocapfix.detect.body_residuals import BodyResiduals
from mocapfix.faults import Fault, MarkerShift
from mocapfix.take import Take

MIN_LEAP_M, LEAP_GROWTH_M_PER_S, LEAP_GROWTH_LIMIT_S = (
    0.010,
    0.4,
    0.04,
)  # metres, m/s, and the seconds after which skin carries a marker no farther
STEP_TOLERANCE_M, STEP_TOLERANCE_M_PER_S2 = (
    0.010,
    100.0,
)  # metres and m/s2: what a marker on a body misses a straight course by, and in its time squared
MIN_OUTLIER_SCORE_SD = 6.0  # standard deviations
MIN_EXCURSION_SCORE_SD = 2.5  # standard deviations: for what leaps there and back
MAX_OUTLIER_FRACTION = 0.4  # of a marker's samples: where more are astray nobody knows where the marker sits
MAX_OUTLYING_MARKER_FRACTION = (
    0.4  # of the markers seen: where more are far off the body is astray, and none of them can be judged
)
MIN_RELATIVE_OUTLIER_SCORE = 0.5  # of the worst: what is astray by less at the same time may be so for the worst's sake
MIN_SHIFTED_DURATION_S, MAX_SHIFTED_SWAY_SD = (
    1.0,
    2.5,
)  # seconds, and standard deviations: for how long and how well a moved marker keeps its place


@dataclass(frozen=True)
class BodyOutlier:
    """What one marker's label drew on its segment without a leap.

    frames    (N,) indices into the take
    distance  metres from the marker's usual place, the median, or by which it leaps there and back
    score     the distance in standard deviations, the median
    stays     does it keep its place to the marker's last frame, or from the first?
    """

    marker: int
    frames: np.ndarray
    distance_m: float
    score_sd: float
    is_persistent: bool = False

    @property
    def first(self) -> int:
        return int(self.frames[0])

    @property
    def last(self) -> int:
        return int(self.frames[-1])


def detect_body_outliers(residuals: BodyResiduals, rate: float, min_distance_m: float) -> list[BodyOutlier]:
    """-> the pieces that are astray by at least `smallest` metres, by marker and first frame."""
    distance = residuals.distance_m
    seen, wrong = ~np.isnan(distance), distance > MIN_OUTLIER_SCORE_SD * residuals.sd_m
    told = seen & (wrong.sum(1) <= MAX_OUTLYING_MARKER_FRACTION * seen.sum(1))[:, None]
    leaps, found = _detect_leaps(residuals.measured_world, rate), []
    for k in range(distance.shape[1]):
        frames = np.flatnonzero(told[:, k])
        cut = _split_at_leaps(residuals, k, frames, leaps[:, k], rate)
        astray = [
            each for piece in cut if (each := _build_outlier(residuals, k, piece, frames, leaps[:, k], rate, min_distance_m))
        ]
        if sum(len(piece.frames) for piece in astray) < MAX_OUTLIER_FRACTION * len(frames):
            found += astray
    return found


def select_dominant_outliers(outliers: list[BodyOutlier]) -> list[BodyOutlier]:
    """-> those that are not there for another's sake, which is astray at the same time and by much more."""
    chosen: list[BodyOutlier] = []
    for piece in sorted(outliers, key=lambda each: -each.score_sd):
        if not any(
            piece.score_sd < MIN_RELATIVE_OUTLIER_SCORE * other.score_sd and overlap_in_time(piece, other) for other in chosen
        ):
            chosen.append(piece)
    return chosen


def overlap_in_time(one: BodyOutlier | Fault, other: BodyOutlier | Fault) -> bool:
    """Are the two at one time?"""
    return one.first <= other.last and other.first <= one.last


def build_outlier_fault(outlier: BodyOutlier, take: Take, max_spike_duration_s: float) -> Fault:
    """-> a piece that is astray as a marker that was moved, a ghost, or, up to `longest_spike` seconds, a spike."""
    label, count = take.bare_labels[outlier.marker], outlier.last - outlier.first + 1
    sure = outlier.score_sd / MIN_OUTLIER_SCORE_SD
    confidence = sure / (1 + sure)
    if outlier.is_persistent:
        first = (
            outlier.first
            if outlier.first > 0 and not take.visible[outlier.last + 1 :, outlier.marker].any()
            else outlier.last + 1
        )
        reason = f"{label} is knocked by {outlier.distance_m * 1e3:.0f} mm and stays there: so far from it the body had it on its segment."
        return MarkerShift(
            "moved", outlier.marker, first, take.frame_count - 1, outlier.distance_m, reason, confidence, settled_frame=first
        )
    where = (
        f"{label} lies {outlier.distance_m * 1e3:.0f} mm from where the body has it, {outlier.score_sd:.0f} standard deviations"
    )
    reason = f"{where}, for {count / take.rate:.2f} s ({count} frame{'s' if count > 1 else ''})."
    kind = "spike" if count <= max_spike_duration_s * take.rate else "ghost"
    return Fault(kind, outlier.marker, outlier.first, outlier.last, outlier.distance_m, reason, confidence)


def _build_outlier(
    residuals: BodyResiduals,
    marker: int,
    segment_frames: np.ndarray,
    valid_frames: np.ndarray,
    is_leap: np.ndarray,
    rate: float,
    min_distance_m: float,
) -> BodyOutlier | None:
    """-> the samples `piece` (N,) of all that are told, `frames`, if they are astray."""
    path, sd = residuals.residual_segment[:, marker], residuals.sd_m[segment_frames, marker]
    distance = np.linalg.norm(path[segment_frames], axis=1)
    far, score = float(np.median(distance)), float(np.median(distance / sd))
    excursion = _measure_excursion(path, is_leap, int(segment_frames[0]), int(segment_frames[-1]) + 1)
    if not (far > min_distance_m and score > MIN_OUTLIER_SCORE_SD) and not (
        excursion > min_distance_m and score > MIN_EXCURSION_SCORE_SD
    ):
        return None
    sway = float(np.median(np.linalg.norm(path[segment_frames] - np.median(path[segment_frames], axis=0), axis=1) / sd))
    at_end = segment_frames[0] == valid_frames[0] or segment_frames[-1] == valid_frames[-1]
    stays = bool(at_end and len(segment_frames) >= MIN_SHIFTED_DURATION_S * rate and sway < MAX_SHIFTED_SWAY_SD)
    return BodyOutlier(marker, segment_frames, max(far, excursion), score, stays)


def _split_at_leaps(
    residuals: BodyResiduals, marker: int, frames: np.ndarray, is_leap: np.ndarray, rate: float
) -> list[np.ndarray]:
    """-> the `frames` (N,) at which a marker is seen, cut where its path on the segment leaps.

    In sight the marker itself must leap there, too (T,): else it is the body that does.
    """
    if not len(frames):
        return []
    step = np.linalg.norm(np.diff(residuals.residual_segment[frames, marker], axis=0), axis=1)
    far = step > MIN_LEAP_M + LEAP_GROWTH_M_PER_S * np.minimum(np.diff(frames) / rate, LEAP_GROWTH_LIMIT_S)
    return np.split(frames, np.flatnonzero(far & (is_leap[frames[1:]] | (np.diff(frames) > 1))) + 1)


def _detect_leaps(markers: np.ndarray, rate: float) -> np.ndarray:
    """-> (T, K) bool: is the step from the frame before unlike the step before it, the one after it and the mean of both?

    markers  (T, K, 3) metres; where neither is known it may be
    """
    step = np.full((len(markers) + 2, *markers.shape[1:]), np.nan)
    step[1 : len(markers)] = np.diff(markers, axis=0)
    before, own, after = step[:-2], step[1:-1], step[2:]
    miss = [np.linalg.norm(own - other, axis=-1) for other in (before, after, (before + after) / 2)]
    leaps = ~(np.fmin.reduce(miss) < STEP_TOLERANCE_M + STEP_TOLERANCE_M_PER_S2 / rate**2)
    return np.concatenate([np.ones_like(leaps[:1]), leaps[:-1]])


def _measure_excursion(residual: np.ndarray, is_leap: np.ndarray, first: int, stop: int) -> float:
    """-> metres by which a marker leaps in `first` and back in `stop`, the lesser; 0 where it does not, or not in sight."""
    if first == 0 or stop == len(residual) or not (is_leap[first] and is_leap[stop]):
        return 0.0
    into, back = residual[first] - residual[first - 1], residual[stop] - residual[stop - 1]
    return float(np.nan_to_num(min(np.linalg.norm(into), np.linalg.norm(back))))
