"""Label swaps detected against the solved body: each label has the samples of another label's marker.

An outlier under a label that lies where the body has another marker, which is not visible there itself, has that marker's
samples. Where two labels, or three in a cycle, have one another's markers, they are exchanged. The exchange extends from
leap to leap, because a label that continues smoothly has not changed its marker, even where the exchange misled the body and
other markers with it.
"""

from bisect import bisect_left, bisect_right
from typing import NamedTuple

import numpy as np

from mocapfix.detect.body_outliers import BodyOutlier, BodyResiduals
from mocapfix.detect.trajectory_segments import build_trajectories
from mocapfix.faults import Fault
from mocapfix.kernels.label_evidence import MAX_SMOOTH_LEAP, compute_own_leaps
from mocapfix.take import Take

# A marker within this distance, in standard deviations, is at its position.
MAX_HOME_DISTANCE_SD = 4.5
# Largest distance from the other marker's position, relative to that from the label's own marker's position.
MAX_RELATIVE_DISTANCE = 0.4
# Largest fraction of the time in which the other marker is visible at its position.
MAX_HOME_FRACTION = 0.2
# Smallest overlap of two outliers that are exchanged, as a fraction of the longer one.
MIN_OVERLAP_FRACTION = 0.5
# A shorter outlier may lie at the position of a missing marker by chance.
MIN_OCCUPIED_DURATION_S = 0.1


class CarriedMarker(NamedTuple):
    """An outlier that lies where the body has another marker.

    Attributes:
        outlier: The outlier.
        marker: Index of the other marker.
        distance_sd: Median distance from the other marker's position, in standard deviations.
    """

    outlier: BodyOutlier
    marker: int
    distance_sd: float

    @property
    def relative_distance(self) -> float:
        """The distance from the other marker's position, relative to that from the label's own marker's position."""
        return self.distance_sd / self.outlier.score_sd


def detect_body_label_swaps(residuals: BodyResiduals, outliers: list[BodyOutlier], take: Take) -> list[Fault]:
    """Detect the exchanges of labels that explain outliers, the most certain first; no two of them overlap."""
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
    return [each for each in carried[start:stop] if _overlap_mostly(outlier, each.outlier)]


def _overlap_mostly(one: BodyOutlier, other: BodyOutlier) -> bool:
    common = min(one.last, other.last) - max(one.first, other.first) + 1
    return common > MIN_OVERLAP_FRACTION * max(one.last - one.first + 1, other.last - other.first + 1)


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
    labels = [take.bare_labels[m] for m in markers]
    reason = f"{', '.join(labels[:-1])} and {labels[-1]} have exchanged their labels {time}: {where}."
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
