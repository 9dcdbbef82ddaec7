"""A sound take to which things happen, one after another and apart from each other."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mocapfix.faults import Fault
from mocapfix.synthetic import Truth

APART = 0.3  # seconds between two faults of a marker, or of two that are near one another
NEAR = 3  # markers: the nearest of each
LOOKED_AT = 50  # frames, to tell which are near
TRIES = 200  # at a place that is free


class Place(NamedTuple):
    """Markers, each but the first near to it, and frames first..last."""

    ring: tuple[int, ...]
    first: int
    last: int

    @property
    def frames(self) -> slice:
        return slice(self.first, self.last + 1)

    @property
    def length(self) -> int:
        return self.last - self.first + 1


class Stage:
    """What happens to a take.

    markers  (T, M + E, 3) metres: what the file will say, with E trajectories more than the M markers; labels of all of them
    true     (T, M, 3) metres: where the markers are
    put      the faults that were put in;  beside  what had to go wrong besides, to bring them about
    """

    def __init__(self, sound: Truth, rng: np.random.Generator) -> None:
        self.sound, self.rng, self.rate = sound, rng, sound.rate
        self.markers, self.true, self.labels = sound.markers.copy(), sound.markers.copy(), sound.labels
        self.frames, self.count = sound.struck.shape
        self.put: list[Fault] = []
        self.beside: list[Fault] = []
        self._taken = np.zeros(sound.struck.shape, bool)
        some = sound.markers[:: max(1, self.frames // LOOKED_AT)]
        apart = np.linalg.norm(some[:, :, None] - some[:, None], axis=-1).mean(0)
        self.near = np.argsort(apart, axis=1)[:, 1:]

    def spread(self, low: float, high: float) -> float:
        """-> a number between the two, as likely between 1 and 2 as between 10 and 20."""
        return low * (high / low) ** self.rng.random()

    def way(self, low: float, high: float) -> np.ndarray:
        """-> (3,) a step in any direction, as long as `spread` says."""
        way = self.rng.normal(size=3)
        return way / np.linalg.norm(way) * self.spread(low, high)

    def place(self, seconds: tuple[float, float], together: int = 1, moving: float = 0.0) -> Place | None:
        """-> a place inside the take where nothing has happened, lasting as long as `spread` says; None where none is left.

        together  so many markers;  moving  metres that the first of them goes meanwhile at least
        """
        for _ in range(TRIES):
            marker, length = int(self.rng.integers(self.count)), max(1, round(self.rate * self.spread(*seconds)))
            if length > self.frames - 4:
                continue
            first = int(self.rng.integers(2, self.frames - length - 1))
            others = self.rng.permutation(self.near[marker, :NEAR])[: together - 1]
            place = Place((marker, *others.tolist()), first, first + length - 1)
            if self.free(place) and np.ptp(self.true[place.frames, marker], axis=0).max() >= moving:
                return place
        return None

    def free(self, place: Place) -> bool:
        margin = round(APART * self.rate)
        about = [*place.ring, *self.near[list(place.ring), :NEAR].flat]
        return not self._taken[max(0, place.first - margin) : place.last + margin + 1, about].any()

    def happened(self, fault: Fault, main: bool = True) -> None:
        """Remember a fault; where it is not a `main` one, it is not asked for."""
        (self.put if main else self.beside).append(fault)
        self._taken[fault.frames, list(fault.markers)] = True

    def hide(self, marker: int, first: int, last: int, main: bool = False) -> None:
        """Let a marker be missing in the frames first..last."""
        first, last = max(first, 0), min(last, self.frames - 1)
        self.markers[first : last + 1, marker] = np.nan
        self.happened(Fault("gap", marker, first, last, np.nan, ""), main)

    def add(self, label: str, path: np.ndarray) -> None:
        """Put one more trajectory (T, 3) into the file."""
        self.labels += (label,)
        self.markers = np.concatenate([self.markers, path[:, None]], axis=1)

    @property
    def damaged(self) -> Truth:
        """The take as the cameras tell it; of its truth, what a file holds."""
        missing = np.isnan(self.markers[..., 0])
        return replace(self.sound, damaged=self.markers, struck=missing, labels=self.labels)
