"""A sound take to which things happen, one after another and apart from each other."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mocapfix.faults import Fault
from mocapfix.synthetic import SyntheticTake

MIN_FAULT_DISTANCE_S = 0.3  # seconds between two faults of a marker, or of two that are near one another
NEIGHBOUR_COUNT = 3  # markers: the nearest of each
NEIGHBOUR_FRAME_COUNT = 50  # frames, to tell which are near
MAX_PLACE_TRIES = 200  # at a place that is free


class FaultPlace(NamedTuple):
    """Markers, each but the first near to it, and frames first..last."""

    markers: tuple[int, ...]
    first: int
    last: int

    @property
    def frames(self) -> slice:
        return slice(self.first, self.last + 1)

    @property
    def frame_count(self) -> int:
        return self.last - self.first + 1


class DamagedTake:
    """What happens to a take.

    markers  (T, M + E, 3) metres: what the file will say, with E trajectories more than the M markers; labels of all of them
    true     (T, M, 3) metres: where the markers are
    put      the faults that were put in;  beside  what had to go wrong besides, to bring them about
    """

    def __init__(self, sound_truth: SyntheticTake, rng: np.random.Generator) -> None:
        self.sound_truth, self.rng, self.rate_hz = sound_truth, rng, sound_truth.rate
        self.markers, self.true_markers, self.labels = (
            sound_truth.marker_positions.copy(),
            sound_truth.marker_positions.copy(),
            sound_truth.labels,
        )
        self.frame_count, self.marker_count = sound_truth.missing_mask.shape
        self.injected_faults: list[Fault] = []
        self.secondary_faults: list[Fault] = []
        self._has_fault = np.zeros(sound_truth.missing_mask.shape, bool)
        some = sound_truth.marker_positions[:: max(1, self.frame_count // NEIGHBOUR_FRAME_COUNT)]
        apart = np.linalg.norm(some[:, :, None] - some[:, None], axis=-1).mean(0)
        self.neighbours = np.argsort(apart, axis=1)[:, 1:]

    def draw_log_uniform(self, low: float, high: float) -> float:
        """-> a number between the two, as likely between 1 and 2 as between 10 and 20."""
        return low * (high / low) ** self.rng.random()

    def draw_displacement(self, low: float, high: float) -> np.ndarray:
        """-> (3,) a step in any direction, as long as `spread` says."""
        way = self.rng.normal(size=3)
        return way / np.linalg.norm(way) * self.draw_log_uniform(low, high)

    def draw_place(
        self, duration_range_s: tuple[float, float], marker_count: int = 1, min_motion_m: float = 0.0
    ) -> FaultPlace | None:
        """-> a place inside the take where nothing has happened, lasting as long as `spread` says; None where none is left.

        together  so many markers;  moving  metres that the first of them goes meanwhile at least
        """
        for _ in range(MAX_PLACE_TRIES):
            marker, length = (
                int(self.rng.integers(self.marker_count)),
                max(1, round(self.rate_hz * self.draw_log_uniform(*duration_range_s))),
            )
            if length > self.frame_count - 4:
                continue
            first = int(self.rng.integers(2, self.frame_count - length - 1))
            others = self.rng.permutation(self.neighbours[marker, :NEIGHBOUR_COUNT])[: marker_count - 1]
            place = FaultPlace((marker, *others.tolist()), first, first + length - 1)
            if self.is_free(place) and np.ptp(self.true_markers[place.frames, marker], axis=0).max() >= min_motion_m:
                return place
        return None

    def is_free(self, place: FaultPlace) -> bool:
        margin = round(MIN_FAULT_DISTANCE_S * self.rate_hz)
        about = [*place.markers, *self.neighbours[list(place.markers), :NEIGHBOUR_COUNT].flat]
        return not self._has_fault[max(0, place.first - margin) : place.last + margin + 1, about].any()

    def record_fault(self, fault: Fault, is_main: bool = True) -> None:
        """Remember a fault; where it is not a `main` one, it is not asked for."""
        (self.injected_faults if is_main else self.secondary_faults).append(fault)
        self._has_fault[fault.frame_slice, list(fault.markers)] = True

    def hide_samples(self, marker: int, first: int, last: int, is_main: bool = False) -> None:
        """Let a marker be missing in the frames first..last."""
        first, last = max(first, 0), min(last, self.frame_count - 1)
        self.markers[first : last + 1, marker] = np.nan
        self.record_fault(Fault("gap", marker, first, last, np.nan, ""), is_main)

    def add_trajectory(self, label: str, path: np.ndarray) -> None:
        """Put one more trajectory (T, 3) into the file."""
        self.labels += (label,)
        self.markers = np.concatenate([self.markers, path[:, None]], axis=1)

    @property
    def damaged_truth(self) -> SyntheticTake:
        """The take as the cameras tell it; of its truth, what a file holds."""
        missing = np.isnan(self.markers[..., 0])
        return replace(self.sound_truth, damaged_positions=self.markers, missing_mask=missing, labels=self.labels)
