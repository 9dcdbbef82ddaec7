"""Body outliers: samples that lie where the solved body cannot have their marker, by their residuals from it.

A residual is measured in the segment's axes, and from the marker's usual position there, so that neither motion nor a bias of
the calibration counts. It is compared with the marker's usual residuals, since a marker attracts the body, and with more where
the solver predicts more uncertainty than usual. In standard deviations one threshold holds for all markers.

A marker's path on its segment is split where it leaps, visibly or within a gap, and a segment between two leaps is judged as a
whole. It is an outlier if it lies far from the marker's usual position; if it visibly leaps there and back, a smaller distance
is sufficient. A slow deviation is skin motion or a bad calibration, and no fault. A marker that leaps once and then keeps its
position has moved. Outliers attract the body, so only the worst of simultaneous ones is accepted, and the body is solved again.

The body is wrong, rather than the marker, where its neighbours carry the marker across an end of the outlier as a rigid body,
or where several markers of a limb lie off the body in the same direction.

An outlier that lies where the body has another marker, which is not visible there itself, has that marker's samples. Where two
labels, or three in a cycle, have one another's markers, they are exchanged, from leap to leap: a label that continues smoothly
has not changed its marker.
"""

from bisect import bisect_left, bisect_right
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.detect.noise import find_shared_deviations
from mocapfix.errors import join_words
from mocapfix.kernels.label_evidence import MAX_SMOOTH_LEAP, compute_own_leaps
from mocapfix.model.faults import Fault, MarkerShift
from mocapfix.model.motion import Motion
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.solve import kinematics
from mocapfix.stats.gaussian_process import CHI2_MEDIAN_3_DOF
from mocapfix.stats.marker_distances import MarkerDistances, build_trajectories
from mocapfix.stats.rigid_alignment import compute_cross_covariance, compute_lengths, fit_rotations, transform_to_body_axes

MIN_RESIDUAL_SD_M = 0.003  # smallest standard deviation of a residual per axis, even for a marker whose errors the body follows


@dataclass(frozen=True)
class BodyResiduals:
    """The residuals of K markers over T frames."""

    measured_world: np.ndarray  # measured positions (T, K, 3) in metres, NaN where missing
    expected_world: np.ndarray  # usual positions (T, K, 3) in metres of the markers on the solved body, never NaN
    # Vectors (T, K, 3) in metres from the expected to the measured positions, in the segment's axes, NaN where missing.
    residual_segment: np.ndarray
    sd_m: np.ndarray  # standard deviation (T, K) in metres per axis of the residual of a sound sample, never NaN

    @cached_property
    def distance_m(self) -> Float[np.ndarray, "T K"]:
        """The lengths of the residuals in metres, NaN where missing."""
        return compute_lengths(self.residual_segment)


def compute_body_residuals(
    subject_take: Take, solver_mask: Bool[np.ndarray, "T K"], subject: Subject, motion: Motion
) -> BodyResiduals:
    """Compute the residuals of a subject's markers, in its order, from the solved body."""
    position, rotation = kinematics.compute_world_poses(subject.skeleton, motion)
    markers = subject_take.markers
    residual = np.empty_like(markers.swapaxes(0, 1), order="C").swapaxes(0, 1)  # path after path
    for joint in np.unique(subject.joints):
        own = np.flatnonzero(subject.joints == joint)
        from_joint = transform_to_body_axes(markers[:, own], position[:, joint], rotation[:, joint])
        residual[:, own] = from_joint - subject.marker_offsets[own]
    bias, sd_m = np.zeros(subject.marker_offsets.shape), np.full(len(subject.joints), MIN_RESIDUAL_SD_M)
    for k in np.flatnonzero(solver_mask.any(0)):
        used = np.ascontiguousarray(residual[np.flatnonzero(solver_mask[:, k]), k].T)
        bias[k] = np.median(used, axis=1)
        x, y, z = used - bias[k, :, None]
        square = x * x + y * y + z * z
        sd_m[k] = max(MIN_RESIDUAL_SD_M, np.sqrt(np.median(square) / CHI2_MEDIAN_3_DOF))
    usual = replace(subject, marker_offsets=subject.marker_offsets + bias)
    expected_world = kinematics.predict_markers(usual, (motion.root_position, motion.local_rotations))
    residual -= bias
    excess_variance = np.maximum(motion.marker_sd**2 - np.median(motion.marker_sd, axis=0) ** 2, 0)
    return BodyResiduals(markers, expected_world, residual, np.sqrt(sd_m**2 + excess_variance))


MIN_LEAP_M = 0.010
LEAP_GROWTH_M_PER_S = 0.4
LEAP_GROWTH_LIMIT_S = 0.04
# Deviation of a marker on a body from a straight path: a constant, and a term in the square of the time of a step.
STEP_TOLERANCE_M = 0.010
STEP_TOLERANCE_M_PER_S2 = 100.0
# Smallest score of an outlier, and of one that leaps there and back.
MIN_OUTLIER_SCORE_SD = 6.0
MIN_EXCURSION_SCORE_SD = 2.5
END_FRAMES = 5  # frames at an end of an outlier, and beside it, over whose median its position is taken there
MIN_END_SHARE = 0.5  # smallest distance at an end of an outlier, and of the leap to it, relative to the median distance
MIN_UNSEEN_DISTANCE_M = 0.035  # of an outlier that begins or ends in a gap; skin, shoes and rare poses reach 25 to 31 mm
MAX_OUTLIER_FRACTION = 0.4  # with a larger fraction of outliers among a marker's samples, its usual position is unknown
MAX_OUTLYING_MARKER_FRACTION = 0.4  # with a larger fraction in a frame the body itself is wrong there
MIN_RELATIVE_OUTLIER_SCORE = 0.5  # an outlier with a smaller score, relative to a simultaneous one, may be caused by it
# Shortest stay of a marker that has moved, and the largest deviation from its new position, in standard deviations.
MIN_SHIFTED_DURATION_S = 1.0
MAX_SHIFTED_SWAY_SD = 2.5


@dataclass(frozen=True)
class BodyOutlier:
    """An unbroken part of a marker's path on its segment that lies off the body."""

    marker: int  # index of the marker
    frames: np.ndarray  # frame indices (N,)
    distance_m: float  # median distance in metres from the marker's usual position, or the length of the leap there and back
    score_sd: float  # median distance in standard deviations
    is_persistent: bool = False  # whether the marker keeps the position to its last frame, or from its first

    @property
    def first(self) -> int:
        return int(self.frames[0])

    @property
    def last(self) -> int:
        return int(self.frames[-1])


def detect_body_outliers(residuals: BodyResiduals, rate: float, min_distance_m: float) -> list[BodyOutlier]:
    """Detect outliers at a distance of more than `min_distance_m`, ordered by marker and first frame."""
    distance_m = residuals.distance_m
    visible, is_far = ~np.isnan(distance_m), distance_m > MIN_OUTLIER_SCORE_SD * residuals.sd_m
    is_valid = visible & (is_far.sum(1) <= MAX_OUTLYING_MARKER_FRACTION * visible.sum(1))[:, None]
    outliers: list[BodyOutlier] = []
    for k in range(distance_m.shape[1]):
        frames, is_leap = np.flatnonzero(is_valid[:, k]), _detect_leaps(residuals.measured_world[:, k], rate)
        candidates = [
            _build_outlier(residuals, k, segment, frames, is_leap, rate, min_distance_m)
            for segment in _split_at_leaps(residuals, k, frames, is_leap, rate)
        ]
        found = [outlier for outlier in candidates if outlier]
        if sum(len(outlier.frames) for outlier in found) < MAX_OUTLIER_FRACTION * len(frames):
            outliers += found
    return outliers


MIN_FALLEN_M = 0.25  # from its place on the body, of a marker that has fallen off: none in 393 recordings of training people
MAX_FALLEN_SWAY_M = 0.015  # within which it lies
MIN_FALLEN_SHARE = 0.5  # of its samples that lie so far away, in one place
FALLEN_NEIGHBOURS = 4  # markers with the nearest places, which lie off the body too where it is the limb that is wrong


def detect_fallen_markers(take: Take, place_world: Float[np.ndarray, "T K 3"]) -> list[Fault]:
    """Detect markers that leave their places on the body (in metres) without a leap, and lie in one place to their end."""
    faults, distance_m = list[Fault](), compute_lengths(take.markers - place_world)
    for k in np.flatnonzero((distance_m > MIN_FALLEN_M).any(0)).tolist():
        frames = np.flatnonzero(take.visible[:, k])
        own_m, path = distance_m[frames, k], take.markers[frames, k]
        at_home = np.flatnonzero(own_m < MIN_UNSEEN_DISTANCE_M)
        start, usual_m = (int(at_home[-1]), np.median(own_m[at_home])) if len(at_home) else (0, np.inf)
        while start > 0 and own_m[start] > max(own_m[start - 1], 2 * usual_m):
            start -= 1  # to where it goes off
        if min(len(at_home), len(frames) - start - 1) < MIN_SHIFTED_DURATION_S * take.rate:
            continue
        off, away_m = frames[start + 1 :], own_m[start + 1 :]
        is_lying = compute_lengths(path[start + 1 :] - np.median(path[start + 1 :], axis=0)) < MAX_FALLEN_SWAY_M
        is_fallen = (is_lying & (away_m > MIN_FALLEN_M)).mean() > MIN_FALLEN_SHARE
        near = compute_lengths(place_world[off[0]] - place_world[off[0], k]).argsort()[1 : 1 + FALLEN_NEIGHBOURS]
        near_m = distance_m[np.ix_(off, near)]
        if is_fallen and (near_m < MIN_UNSEEN_DISTANCE_M).sum() > (near_m >= MIN_UNSEEN_DISTANCE_M).sum():
            off_m = float(np.median(away_m))
            reason = f"{take.bare_labels[k]} has left the body and lies in one place to its end, {off_m * 1e3:.0f} mm off."
            faults.append(Fault("ghost", k, int(off[0]), int(off[-1]), off_m, reason, 0.95))
    return faults


def select_dominant_outliers(outliers: list[BodyOutlier]) -> list[BodyOutlier]:
    """Remove the outliers that a simultaneous one with a much larger score may cause."""
    if not outliers:
        return []
    selected: list[BodyOutlier] = []
    largest_score_sd = np.zeros(max(outlier.last for outlier in outliers) + 1)  # of those selected, in each frame
    for outlier in sorted(outliers, key=lambda outlier: -outlier.score_sd):
        frames = slice(outlier.first, outlier.last + 1)
        if outlier.score_sd >= MIN_RELATIVE_OUTLIER_SCORE * largest_score_sd[frames].max():
            selected.append(outlier)
            largest_score_sd[frames] = np.maximum(largest_score_sd[frames], outlier.score_sd)
    return selected


def build_outlier_fault(outlier: BodyOutlier, take: Take, max_spike_duration_s: float) -> Fault:
    """Build the fault of an outlier: a marker that has moved, a spike up to `max_spike_duration_s`, or else a ghost."""
    label, count = take.bare_labels[outlier.marker], outlier.last - outlier.first + 1
    relative_score = outlier.score_sd / MIN_OUTLIER_SCORE_SD
    confidence = relative_score / (1 + relative_score)
    distance = f"{outlier.distance_m * 1e3:.0f} mm"
    if outlier.is_persistent:
        is_last = outlier.first > 0 and not take.visible[outlier.last + 1 :, outlier.marker].any()
        first = outlier.first if is_last else outlier.last + 1
        reason = f"{label} jumps by {distance} and stays there, off its position on the body."
        return MarkerShift(
            "moved", outlier.marker, first, take.frame_count - 1, outlier.distance_m, reason, confidence, settled_frame=first
        )
    where = f"{label} lies {distance} off its position on the body, {outlier.score_sd:.0f} standard deviations"
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
    """Build the outlier of a segment (N,) of a marker's valid frames; None if its samples are sound."""
    path, sd_m = residuals.residual_segment[:, marker], residuals.sd_m[segment_frames, marker]
    sample_distance_m = residuals.distance_m[segment_frames, marker]
    if np.count_nonzero(sample_distance_m > MIN_EXCURSION_SCORE_SD * sd_m) < len(segment_frames) / 2:
        return None  # the smallest score of an outlier is larger
    distance_m, score_sd = float(np.median(sample_distance_m)), float(np.median(sample_distance_m / sd_m))
    first, stop = int(segment_frames[0]), int(segment_frames[-1]) + 1
    excursion_m = _measure_excursion(path, is_leap, first, stop)
    is_far = distance_m > min_distance_m and score_sd > MIN_OUTLIER_SCORE_SD
    is_excursion = excursion_m > min_distance_m and score_sd > MIN_EXCURSION_SCORE_SD
    if not is_far and not is_excursion:
        return None
    sway_m = compute_lengths(path[segment_frames] - np.median(path[segment_frames], axis=0))
    sway_sd = float(np.median(sway_m / sd_m))
    is_at_end = segment_frames[0] == valid_frames[0] or segment_frames[-1] == valid_frames[-1]
    is_long = len(segment_frames) >= MIN_SHIFTED_DURATION_S * rate
    is_persistent = bool(is_at_end and is_long and sway_sd < MAX_SHIFTED_SWAY_SD)
    if not is_excursion and not is_persistent and not _begins_and_ends_abruptly(path, segment_frames, distance_m):
        return None
    return BodyOutlier(marker, segment_frames, max(distance_m, excursion_m), score_sd, is_persistent)


def _split_at_leaps(
    residuals: BodyResiduals, marker: int, frames: Int[np.ndarray, " N"], is_leap: np.ndarray, rate: float
) -> list[np.ndarray]:
    """Split the frames of a marker where its path on the segment leaps.

    Between visible samples the marker itself must leap as well (`is_leap` (T,)): otherwise the body leaps.
    """
    if not len(frames):
        return []
    step_m = compute_lengths(np.diff(residuals.residual_segment[frames, marker], axis=0))
    max_step_m = MIN_LEAP_M + LEAP_GROWTH_M_PER_S * np.minimum(np.diff(frames) / rate, LEAP_GROWTH_LIMIT_S)
    return np.split(frames, np.flatnonzero((step_m > max_step_m) & (is_leap[frames[1:]] | (np.diff(frames) > 1))) + 1)


def _detect_leaps(path: np.ndarray, rate: float) -> np.ndarray:
    """Detect (T,) the steps of a path (T, 3) from the frame before that differ from the steps beside them and from their mean.

    If none of these is known, the step may be a leap and counts as one.
    """
    step = np.full((len(path) + 2, 3), np.nan)
    step[1 : len(path)] = np.diff(path, axis=0)
    before, own, after = step[:-2], step[1:-1], step[2:]
    difference_m = [compute_lengths(own - other) for other in (before, after, (before + after) / 2)]
    is_leap = ~(np.fmin.reduce(difference_m) < STEP_TOLERANCE_M + STEP_TOLERANCE_M_PER_S2 / rate**2)
    return np.concatenate([np.ones_like(is_leap[:1]), is_leap[:-1]])


def _begins_and_ends_abruptly(residual: np.ndarray, segment_frames: np.ndarray, distance_m: float) -> bool:
    """Return whether a marker lies off its position from the first to the last frame (N,) of a segment, and not beside it.

    A distance that grows or shrinks within the segment, or that the marker had on the other side of a gap, is skin motion, a
    shoe that bends, or a bone of a wrong length. So may be a smaller one whose beginning or end is not seen.
    """
    first, last = int(segment_frames[0]), int(segment_frames[-1])
    is_seen = first > 0 and last + 1 < len(residual) and not np.isnan(residual[[first - 1, last + 1], 0]).any()
    if not is_seen and distance_m < MIN_UNSEEN_DISTANCE_M:
        return False
    visible = np.flatnonzero(~np.isnan(residual[:, 0]))
    start, stop = np.searchsorted(visible, [first, last + 1])
    inside = segment_frames[:END_FRAMES], segment_frames[-END_FRAMES:]
    beside = visible[max(0, start - END_FRAMES) : start], visible[stop : stop + END_FRAMES]
    for own, other in zip(inside, beside, strict=True):
        position = np.median(residual[own], axis=0)
        if np.linalg.norm(position) < MIN_END_SHARE * distance_m:
            return False
        if len(other) and np.linalg.norm(position - np.median(residual[other], axis=0)) < MIN_END_SHARE * distance_m:
            return False
    return True


def _measure_excursion(residual: np.ndarray, is_leap: np.ndarray, first: int, stop: int) -> float:
    """Measure the smaller of the leaps, in metres, in frame `first` and back in frame `stop`; 0 unless both are visible.

    A leap is that of the median over END_FRAMES, so that a spike beside the segment is none.
    """
    if first == 0 or stop == len(residual) or not (is_leap[first] and is_leap[stop]):
        return 0.0
    if np.isnan(residual[[first - 1, stop], 0]).any():
        return 0.0
    inside = residual[first : min(first + END_FRAMES, stop)], residual[max(first, stop - END_FRAMES) : stop]
    beside = residual[max(0, first - END_FRAMES) : first], residual[stop : stop + END_FRAMES]
    leaps_m = [
        np.linalg.norm(np.nanmedian(own, axis=0) - np.nanmedian(other, axis=0)) for own, other in zip(inside, beside, strict=True)
    ]
    return float(min(leaps_m))


MIN_RIGID_NEIGHBOURS = 3  # number of neighbours that determine a rigid motion
MIN_NEIGHBOUR_WIDTH_M = 0.015  # smallest extent along the second longest axis (sd): a line shows no turn about it
MAX_CARRIED_LEAP_RATIO = 0.5  # largest leap from carrying neighbours, relative to the distance from the body
MIN_SHARED_FRACTION = 0.5  # smallest fraction of an outlier's frames in which other markers lie off the body alike


def is_body_wrong(outlier: BodyOutlier, residuals: BodyResiduals, distances: MarkerDistances) -> bool:
    """Return whether the body is wrong where a marker lies off it, rather than the marker."""
    visible = np.flatnonzero(~np.isnan(residuals.measured_world[:, outlier.marker, 0]))
    before, after = visible[visible < outlier.first], visible[visible > outlier.last]
    ends = [(int(outlier.frames[0]), int(before[-1]))] if len(before) else []
    ends += [(int(outlier.frames[-1]), int(after[0]))] if len(after) else []
    leap_m = measure_leaps_from_neighbours(
        residuals.measured_world, distances, outlier.marker, np.array(ends, int).reshape(-1, 2)
    )
    if (leap_m < MAX_CARRIED_LEAP_RATIO * outlier.distance_m).any():
        return True
    residual_world = residuals.measured_world[outlier.frames] - residuals.expected_world[outlier.frames]
    partners = distances.partner[outlier.marker]
    is_shared = find_shared_deviations(residual_world[:, outlier.marker], residual_world[:, partners[partners >= 0]])
    return bool(is_shared.mean() >= MIN_SHARED_FRACTION)


def measure_leaps_from_neighbours(
    markers: Float[np.ndarray, "T M 3"], distances: MarkerDistances, marker: int, ends: Int[np.ndarray, "E 2"]
) -> Float[np.ndarray, " E"]:
    """Return the distances in metres of a marker from where its neighbours carry it between pairs of frames that show it, NaN
    where they do not determine it.
    """
    leap_m = np.full(len(ends), np.nan)
    is_known = distances.partner[marker] >= 0
    partners, weight = distances.partner[marker][is_known], distances.tolerance_m[marker][is_known] ** -2
    for n, (one, other) in enumerate(ends):
        is_visible = ~np.isnan(markers[one, partners, 0] + markers[other, partners, 0])
        seen = partners[is_visible]
        carried = carry_rigidly(markers[one, seen], markers[other, seen], weight[is_visible], markers[one, marker])
        leap_m[n] = np.linalg.norm(markers[other, marker] - carried)
    return leap_m


def carry_rigidly(
    before: Float[np.ndarray, "N 3"],
    after: Float[np.ndarray, "N 3"],
    weight: Float[np.ndarray, " N"],
    point: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, " 3"]:
    """Return where the rigid motion of its neighbours carries a point; NaN if these are too few, or lie on a line."""
    if len(weight) < MIN_RIGID_NEIGHBOURS:
        return np.full(3, np.nan)
    share = weight / weight.sum()
    extent_m = np.linalg.svd(np.sqrt(share)[:, None] * (before - share @ before), compute_uv=False)
    if extent_m[1] < MIN_NEIGHBOUR_WIDTH_M:
        return np.full(3, np.nan)
    cross, mean_after, mean_before = compute_cross_covariance(after[None], before, share[None])
    return mean_after[0] + fit_rotations(cross)[0] @ (point - mean_before[0])


MAX_HOME_DISTANCE_SD = 4.5  # a marker within this distance, in standard deviations, is at its position
MAX_RELATIVE_DISTANCE = 0.4  # from the other marker's position, relative to that from the label's own marker's position
MAX_HOME_FRACTION = 0.2  # largest fraction of the time in which the other marker is visible at its position
MIN_OVERLAP_FRACTION = 0.5  # smallest overlap of two outliers that are exchanged, as a fraction of the longer one
MIN_OCCUPIED_DURATION_S = 0.1  # a shorter outlier may lie at the position of a missing marker by chance


class CarriedMarker(NamedTuple):
    """An outlier that lies where the body has another marker."""

    outlier: BodyOutlier  # the outlier
    marker: int  # index of the other marker
    distance_sd: float  # median distance from the other marker's position, in standard deviations

    @property
    def relative_distance(self) -> float:
        """The distance from the other marker's position, relative to that from the label's own marker's position."""
        return self.distance_sd / self.outlier.score_sd


def detect_body_label_swaps(residuals: BodyResiduals, outliers: list[BodyOutlier], take: Take) -> list[Fault]:
    """Detect the exchanges of labels that explain outliers, the most certain first; no two of them overlap."""
    if not outliers:
        return []
    is_home = residuals.distance_m < MAX_HOME_DISTANCE_SD * residuals.sd_m
    is_smooth = compute_own_leaps(build_trajectories(take.markers, take.rate)) < MAX_SMOOTH_LEAP
    carried = [each for outlier in outliers for each in _find_carried_markers(residuals, is_home, outlier)]
    cycles = sorted(_find_cycles_of_carried(carried, take), key=lambda cycle: max(each.relative_distance for each in cycle))
    swaps: list[Fault] = []
    is_swapped = np.zeros(take.visible.shape, bool)
    for cycle in cycles:
        swap = _build_body_swap_fault(cycle, is_smooth, take)
        if not swap.meets_mask(is_swapped):
            swaps.append(swap)
            is_swapped[swap.frame_slice, list(swap.markers)] = True
    return swaps


def _find_carried_markers(residuals: BodyResiduals, is_home: np.ndarray, outlier: BodyOutlier) -> list[CarriedMarker]:
    """Find the markers at whose positions the samples of an outlier lie while they are not visible there themselves."""
    frames = outlier.frames
    offset = residuals.measured_world[frames, outlier.marker, None] - residuals.expected_world[frames]
    distance_sd = np.median(np.linalg.norm(offset, axis=-1) / residuals.sd_m[frames], axis=0)
    is_near = distance_sd < MAX_RELATIVE_DISTANCE * outlier.score_sd
    is_carried = is_near & (is_home[frames].mean(0) < MAX_HOME_FRACTION)
    return [CarriedMarker(outlier, int(k), float(distance_sd[k])) for k in np.flatnonzero(is_carried)]


def _find_cycles_of_carried(carried: list[CarriedMarker], take: Take) -> list[tuple[CarriedMarker, ...]]:
    """Find the cycles in which each label has the samples of the marker whose label comes next, and the last of the first.

    A marker that is missing during the outlier may have been anywhere, also under the label of the outlier at its position.
    """
    cycles: list[tuple[CarriedMarker, ...]] = []
    carried_by_label: dict[int, list[CarriedMarker]] = {}
    for each in carried:
        carried_by_label.setdefault(each.outlier.marker, []).append(each)
    for one in carried:
        frames, other = one.outlier.frames, one.marker
        is_home = one.distance_sd < MAX_HOME_DISTANCE_SD
        is_long = len(frames) >= MIN_OCCUPIED_DURATION_S * take.rate
        if is_home and is_long and take.visible[frames, other].mean() < MAX_HOME_FRACTION:
            cycles.append((one,))
        for two in _select_simultaneous(carried_by_label.get(other, []), one.outlier):
            if two.marker == one.outlier.marker:
                cycles.append((one, two))
            thirds = _select_simultaneous(carried_by_label.get(two.marker, []), one.outlier)
            cycles += [(one, two, three) for three in thirds if three.marker == one.outlier.marker]
    return cycles


def _select_simultaneous(carried: list[CarriedMarker], outlier: BodyOutlier) -> list[CarriedMarker]:
    """Select from the markers carried by one label, ordered by first frame, those that overlap mostly with an outlier."""
    start = bisect_left(carried, outlier.first, key=lambda each: each.outlier.last)
    stop = bisect_right(carried, outlier.last, key=lambda each: each.outlier.first)
    selected: list[CarriedMarker] = []
    for each in carried[start:stop]:
        common = min(outlier.last, each.outlier.last) - max(outlier.first, each.outlier.first) + 1
        longer = max(outlier.last - outlier.first, each.outlier.last - each.outlier.first) + 1
        selected += [each] if common > MIN_OVERLAP_FRACTION * longer else []
    return selected


def _build_body_swap_fault(cycle: tuple[CarriedMarker, ...], is_smooth: np.ndarray, take: Take) -> Fault:
    """Build the fault of a cycle, extended from leap to leap."""
    markers = [cycle[0].marker, *(each.outlier.marker for each in (cycle[0], *cycle[:0:-1]))][: max(2, len(cycle))]
    common = max(each.outlier.first for each in cycle), min(each.outlier.last for each in cycle)
    first, last = _extend_to_leaps(*common, take.visible[:, markers], is_smooth[:, markers])
    worst = max(cycle, key=lambda each: each.relative_distance)
    ratio = worst.outlier.score_sd / worst.distance_sd
    distance_m = float(np.mean([each.outlier.distance_m for each in cycle]))
    time = f"for {(last - first + 1) / take.rate:.2f} s ({last - first + 1} frames)"
    where = f"they lie {distance_m * 1e3:.0f} mm off their positions on the body, and {ratio:.1f} times nearer to one another's"
    reason = f"{join_words([take.bare_labels[m] for m in markers])} have exchanged their labels {time}: {where}."
    return Fault("swap", markers[0], first, last, distance_m, reason, 1 - 1 / ratio, tuple(markers[1:]))


def _extend_to_leaps(first: int, last: int, visible: np.ndarray, is_smooth: np.ndarray) -> tuple[int, int]:
    """Extend first..last to the frames over which none of the labels (T, N) leaps or reappears after a gap."""
    is_continued = visible[1:] & visible[:-1] & is_smooth[1:]
    backward = np.all(is_continued | ~visible[:-1], axis=1) & visible[:-1].any(1)
    forward = np.all(is_continued | ~visible[1:], axis=1) & visible[1:].any(1)
    while first > 0 and backward[first - 1]:
        first -= 1
    while last < len(visible) - 1 and forward[last]:
        last += 1
    return first, last
