"""Crossed: labels that lie where the solved body has one another's markers.

What is astray under a label and lies well where the body has another marker, which is not seen there itself meanwhile, is
that marker. Where two labels, or three in a ring, are each other's they are exchanged, and so they are from leap to leap, for
a label that goes on smoothly has not changed its marker, even where the exchange led the body astray and others with it.
"""

from typing import NamedTuple

import numpy as np

from mocapfix.detect import continuity
from mocapfix.detect.body_outliers import BodyOutlier
from mocapfix.detect.body_residuals import BodyResiduals
from mocapfix.detect.swap_viterbi import MAX_SMOOTH_LEAP
from mocapfix.faults import Fault
from mocapfix.take import Take

MAX_HOME_DISTANCE_SD = 4.5  # standard deviations: so near to its place is a marker at home
MAX_RELATIVE_DISTANCE = (
    0.4  # of its distance from its own marker's place: so near to another's it is that one, if that one is elsewhere
)
MAX_HOME_FRACTION = 0.2  # of the time in which the other is seen at home at most, if it is elsewhere
MIN_OVERLAP_FRACTION = 0.5  # of the longer: for so long are two pieces astray together that are each other's
MIN_OCCUPIED_DURATION_S = 0.1  # seconds: what lies for less in the place of a marker that is not seen may do so by chance


class CarriedMarker(NamedTuple):
    """A piece that lies where the body has another marker, in standard deviations."""

    outlier: BodyOutlier
    marker: int
    distance_sd: float


def detect_body_label_swaps(residuals: BodyResiduals, outliers: list[BodyOutlier], take: Take) -> list[Fault]:
    """-> the exchanges of labels that explain what is `astray`, the surest first; none meets another."""
    at_home = residuals.distance_m < MAX_HOME_DISTANCE_SD * residuals.sd_m
    smooth = continuity.compute_own_leaps(continuity.build_trajectories(take.markers, take.rate)) < MAX_SMOOTH_LEAP
    carried = [each for piece in outliers for each in _find_carried_markers(residuals, at_home, piece)]
    found: list[Fault] = []
    for ring in sorted(
        _find_cycles_of_carried(carried, take), key=lambda ring: max(each.distance_sd / each.outlier.score_sd for each in ring)
    ):
        swap = _build_body_swap_fault(ring, smooth, take)
        if not any(swap.overlaps(other) for other in found):
            found.append(swap)
    return found


def _find_carried_markers(residuals: BodyResiduals, at_home: np.ndarray, outlier: BodyOutlier) -> list[CarriedMarker]:
    """-> the markers whose places the samples of a piece fit, while they are not seen there themselves."""
    t = outlier.frames
    away = (
        np.linalg.norm(residuals.measured_world[t, outlier.marker, None] - residuals.expected_world[t], axis=-1)
        / residuals.sd_m[t]
    )
    fit = np.median(away, axis=0)
    fitting = (fit < MAX_RELATIVE_DISTANCE * outlier.score_sd) & (at_home[t].mean(0) < MAX_HOME_FRACTION)
    return [CarriedMarker(outlier, int(k), float(fit[k])) for k in np.flatnonzero(fitting)]


def _find_cycles_of_carried(carried: list[CarriedMarker], take: Take) -> list[tuple[CarriedMarker, ...]]:
    """-> the rings: each label carries the marker whose label the next piece bears, the last the first one's.

    A marker that is not seen meanwhile may have been anywhere, also under the label of what lies in its place.
    """
    closed = []
    for one in carried:
        t, other = one.outlier.frames, one.marker
        if (
            one.distance_sd < MAX_HOME_DISTANCE_SD
            and len(t) >= MIN_OCCUPIED_DURATION_S * take.rate
            and take.visible[t, other].mean() < MAX_HOME_FRACTION
        ):
            closed.append((one,))
        for two in carried:
            if two.outlier.marker != other or not _overlap_mostly(one.outlier, two.outlier):
                continue
            if two.marker == one.outlier.marker:
                closed.append((one, two))
            ends = [each for each in carried if each.outlier.marker == two.marker and each.marker == one.outlier.marker]
            closed += [(one, two, three) for three in ends if _overlap_mostly(one.outlier, three.outlier)]
    return closed


def _overlap_mostly(one: BodyOutlier, other: BodyOutlier) -> bool:
    both = min(one.last, other.last) - max(one.first, other.first) + 1
    return both > MIN_OVERLAP_FRACTION * max(one.last - one.first + 1, other.last - other.first + 1)


def _build_body_swap_fault(cycle: tuple[CarriedMarker, ...], is_smooth: np.ndarray, take: Take) -> Fault:
    """-> the labels of a ring as exchanged, from leap to leap."""
    markers = [cycle[0].marker, *(each.outlier.marker for each in (cycle[0], *cycle[:0:-1]))][: max(2, len(cycle))]
    within = max(each.outlier.first for each in cycle), min(each.outlier.last for each in cycle)
    first, last = _extend_to_leaps(*within, take.visible[:, markers], is_smooth[:, markers])
    worst = max(cycle, key=lambda each: each.distance_sd / each.outlier.score_sd)
    labels, times = [take.bare_labels[m] for m in markers], worst.outlier.score_sd / worst.distance_sd
    far = float(np.mean([each.outlier.distance_m for each in cycle]))
    time = f"for {(last - first + 1) / take.rate:.2f} s ({last - first + 1} frames)"
    where = f"they lie {far * 1e3:.0f} mm from where the body has them, and {times:.1f} times nearer to one another's places"
    names = f"{', '.join(labels[:-1])} and {labels[-1]}"
    reason = f"{names} have exchanged their labels {time}: {where}."
    return Fault("swap", markers[0], first, last, far, reason, 1 - 1 / times, tuple(markers[1:]))


def _extend_to_leaps(first: int, last: int, visible: np.ndarray, is_smooth: np.ndarray) -> tuple[int, int]:
    """-> the frames around first..last over which none of the labels (T, N) leaps or comes out of a gap."""
    goes_on = visible[1:] & visible[:-1] & is_smooth[1:]
    backward = np.all(goes_on | ~visible[:-1], axis=1) & visible[:-1].any(1)
    forward = np.all(goes_on | ~visible[1:], axis=1) & visible[1:].any(1)
    while first > 0 and backward[first - 1]:
        first -= 1
    while last < len(visible) - 1 and forward[last]:
        last += 1
    return first, last
