"""A marker's fingerprint: the distances it keeps to the markers of its segment, and on which side of them it lies.

Which distances are kept, and how well, is learnt from the take (Ringer & Lasenby 2004, "A procedure for automatically estimating
model parameters in optical motion capture"). Distances cannot tell a place from its mirror image: the signed height over the
plane of three of the markers does.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from mocapfix.detect.distances import usual

LEARNING = 300  # frames at most, evenly spread, from which fingerprints are learnt
FEWEST = 20  # of these in which the corners and the marker must be seen
STEADY = 0.004  # metres: by which even a distance on one rigid thing varies
UNTRIED = 0.04  # of a distance: by which it may vary in what the take does not show often, so that near markers count for more
LOOSE = 0.04  # metres: a distance that varies by more tells nothing
PARTNERS, CORNERS = 4, 5  # whose distances are asked, and among which three make a plane
HOPELESS = 10.0  # standard deviations of the distances, from which on the side is no matter
PRESENT = 0.8  # part of a piece's frames in which a partner must be seen
HELD = 0.9  # of the frames, over which a distance's spread is taken: limbs bend in a part of a take only
LOW, HIGH, WIDTH = 0.05, 0.95, 3.29  # quantiles of heights, and the standard deviations between them
SAMPLES = 60  # of a piece that are looked at, at most


@dataclass(frozen=True)
class Likeness:
    """How well a piece bears a marker's fingerprint.

    distance  standard deviations, root mean square over the partners
    side      standard deviations, of the height over the plane of three of them; 0 where none is known, or distances are hopeless
    off       metres, root mean square over the partners
    partners  indices of those asked
    """

    distance: float
    side: float
    off: float
    partners: tuple[int, ...]


class Fingerprints:
    """The fingerprints of a take's markers (T, M, 3) in metres, NaN where not seen."""

    def __init__(self, markers: np.ndarray):
        self.markers = markers
        self.sample = markers[np.unique(np.linspace(0, len(markers) - 1, LEARNING).astype(int))]
        self.middle, spread = usual(self.sample, HELD)
        self.spread = np.hypot(spread, UNTRIED * np.where(np.isfinite(self.middle), self.middle, 0.0))

    def likeness(self, frames: np.ndarray, points: np.ndarray, marker: int) -> Likeness | None:
        """-> how well points (N, 3) at `frames` (N,) would do as the marker; None where fewer than three others tell."""
        pick = np.unique(np.linspace(0, len(frames) - 1, SAMPLES).astype(int))
        points, there = points[pick], self.markers[frames[pick]]
        near = np.argsort(self.spread[marker], kind="stable")
        near = near[self.spread[marker, near] < LOOSE]
        near = near[(~np.isnan(there[:, near, 0])).mean(0) >= PRESENT]
        if len(near) < 3:
            return None
        asked = near[:PARTNERS]
        miss = np.linalg.norm(there[:, asked] - points[:, None], axis=-1) - self.middle[marker, asked]
        off = np.nanmedian(np.abs(miss), axis=0)  # over the frames: a partner's spike has no say
        distance = _rms(off / np.hypot(self.spread[marker, asked], STEADY))
        side = self._side(points, there, marker, near[:CORNERS]) if distance < HOPELESS else 0.0
        return Likeness(distance, side, _rms(off), tuple(asked.tolist()))

    def _side(self, points: np.ndarray, there: np.ndarray, marker: int, near: np.ndarray) -> float:
        """-> standard deviations: of the height over the plane that tells the sides apart best."""
        surest, side = 0.0, 0.0
        for corners in combinations(near, 3):
            low, usual_height, high = _quantiles(heights(self.sample[:, marker], self.sample[:, corners])[:, None])[:, 0]
            deviation = np.hypot((high - low) / WIDTH, STEADY) if np.isfinite(high) else np.inf
            if abs(usual_height) > surest * deviation:
                surest = abs(usual_height) / deviation
                height = float(np.nanmedian(heights(points, there[:, corners])))
                side = abs(height - usual_height) / deviation
        return float(side)


def heights(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """-> (T,) metres: of points (T, 3) over planes of three corners (T, 3, 3), positive on the side of the right-hand normal."""
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    return np.einsum("ta,ta->t", points - a, normal) / np.maximum(np.linalg.norm(normal, axis=1), 1e-9)


def _quantiles(values: np.ndarray) -> np.ndarray:
    """-> (3, N): the low, middle and high quantile of each column (T, N), NaN not counting; infinite where few are known."""
    ordered = np.sort(values, axis=0)  # NaN comes last
    known = (~np.isnan(ordered)).sum(0)
    rows = np.rint(np.outer([LOW, 0.5, HIGH], np.maximum(known - 1, 0))).astype(int)
    return np.where(known >= min(FEWEST, len(values)), ordered[rows, np.arange(values.shape[1])], np.inf)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))
