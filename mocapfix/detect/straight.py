"""Straight: samples on one exact line, parabola or cubic, as other tools fill gaps.

Through any measured tenth of a second a cubic runs past the samples by far more than the file's last digit, for cameras
are not exact and bodies not smooth. Where it hits them all, they were computed. In a file of coarse integers that takes a
longer stretch to tell, and of a marker at rest nothing can be told.
"""

from collections.abc import Iterator

import numpy as np

from mocapfix.detect.exactness import between, last_digit, misses, stretches
from mocapfix.faults import Fault
from mocapfix.take import Take

NAMES = {1: "line", 2: "parabola", 3: "cubic"}
FEWEST = 4  # samples more than such a polynomial hits anyway
LONGER = (1, 2, 4)  # times the shortest stretch: what is tried until measured samples can be told
LOOKED_AT, QUIET = 50, 0.1  # stretches of a marker, evenly spread, and the part of them that may be as exact by chance
SURE = 4.0  # times the last digit: what the polynomial misses the others of half of the markers by at least
ABOUT = 1.0  # seconds before and after a stretch from which it is known how exact the marker is there
BESIDE = 0.25  # of the stretches there may be as exact, by other fills or by chance
SURER = 8.0  # times the last digit: what the polynomial misses the others there by at least
WAY = 100.0  # times the last digit: what a marker goes at least, or it stands rather than goes straight


def found(take: Take, shortest: float = 0.1) -> list[Fault]:
    """-> exactly straight stretches of `shortest` seconds or longer, without the samples that they join, by marker and frame."""
    digit = last_digit(take.markers)
    faults = []
    for degree in NAMES:
        length = _telling(take.markers, degree, digit, max(degree + 1 + FEWEST, round(shortest * take.rate)))
        if length:
            for m in range(len(take.labels)):
                faults += _of_marker(take, m, degree, length, digit)
    return _apart(faults)


def _of_marker(take: Take, marker: int, degree: int, length: int, digit: float) -> Iterator[Fault]:
    path = take.markers[:, marker]
    for first, last in stretches(path, degree, length, digit):
        if np.ptp(path[first : last + 1], axis=0).max() > WAY * digit:
            usual = _usual(path, degree, first, last, round(ABOUT * take.rate))
            if usual > SURER * digit:
                first, last = between(take.seen[:, marker], first, last)
                seconds, name = (last - first + 1) / take.rate, take.bare_labels[marker]
                why = f"{name} lies on an exact {NAMES[degree]} for {seconds:.2f} s, as other programs fill gaps"
                reason = f"{why}; what was measured thereabouts is {usual * 1e3:.2g} mm off one."
                yield Fault("straight", marker, first, last, usual, reason, 1 - digit / usual)


def _telling(markers: np.ndarray, degree: int, digit: float, length: int) -> int:
    """-> how many samples a stretch needs so that measured ones can be told, 0 where that is more than LONGER says."""
    for longer in (longer * length for longer in LONGER if len(markers) >= longer * length):
        starts = np.unique(np.linspace(0, len(markers) - longer, LOOKED_AT).astype(int))
        missed = [misses(markers[:, m], degree, longer, starts) for m in range(markers.shape[1])]
        quiet = [np.quantile(each[~np.isnan(each)], QUIET) for each in missed if not np.isnan(each).all()]
        if quiet and np.median(quiet) > SURE * digit:
            return longer
    return 0


def _usual(path: np.ndarray, degree: int, first: int, last: int, about: int) -> float:
    """-> metres: by how much such a polynomial misses most samples `about` the stretch (frames), over a stretch as long.

    Infinite where there are none.
    """
    length = last - first + 1
    starts = np.arange(max(0, first - length - about), min(len(path) - length, last + about) + 1)
    missed = misses(path, degree, length, starts[np.abs(starts - first) > length // 2])
    missed = missed[~np.isnan(missed)]
    return float(np.quantile(missed, BESIDE)) if len(missed) else np.inf


def _apart(faults: list[Fault]) -> list[Fault]:
    """-> the longest of those that overlap, by marker and first frame; of two as long, the one of the lower degree."""
    told: dict[int, set[int]] = {}
    kept = []
    for fault in sorted(faults, key=lambda fault: fault.first - fault.last):
        frames = range(fault.first, fault.last + 1)
        known = told.setdefault(fault.marker, set())
        if 2 * len(known.intersection(frames)) < len(frames):
            known.update(frames)
            kept.append(fault)
    return sorted(kept, key=lambda fault: (fault.marker, fault.first))
