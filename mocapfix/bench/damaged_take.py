"""A sound take into which faults are injected, one after another and at a distance from each other."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mocapfix.faults import Fault
from mocapfix.synthetic import SyntheticTake

MIN_FAULT_DISTANCE_S = 0.3  # between two faults of a marker or of neighbouring markers
NEIGHBOUR_COUNT = 3  # markers that count as neighbours of a marker
NEIGHBOUR_FRAME_COUNT = 50  # frames in which the distances between markers are measured
MAX_PLACE_TRIES = 200  # attempts to draw a place without faults


class FaultPlace(NamedTuple):
    """Markers, all but the first neighbours of the first one, and the frames first..last."""

    markers: tuple[int, ...]
    first: int
    last: int

    @property
    def frames(self) -> slice:
        """The frames as a slice."""
        return slice(self.first, self.last + 1)

    @property
    def frame_count(self) -> int:
        """The number of frames."""
        return self.last - self.first + 1


class DamagedTake:
    """A take with injected faults.

    markers           (T, M + E, 3) metres: the content of the file, E trajectories more than the M markers; labels of all of them
    true_markers      (T, M, 3) metres: the true positions
    injected_faults   the faults to be found
    secondary_faults  further faults that these imply, such as a gap before an exchange of labels
    """

    def __init__(self, sound_truth: SyntheticTake, rng: np.random.Generator) -> None:
        self.sound_truth, self.rng, self.rate_hz = sound_truth, rng, sound_truth.rate
        positions = sound_truth.marker_positions
        self.markers, self.true_markers, self.labels = positions.copy(), positions.copy(), sound_truth.labels
        self.frame_count, self.marker_count = sound_truth.missing_mask.shape
        self.injected_faults: list[Fault] = []
        self.secondary_faults: list[Fault] = []
        self._has_fault = np.zeros(sound_truth.missing_mask.shape, bool)
        sampled = positions[:: max(1, self.frame_count // NEIGHBOUR_FRAME_COUNT)]
        distances = np.linalg.norm(sampled[:, :, None] - sampled[:, None], axis=-1).mean(0)
        self.neighbours = np.argsort(distances, axis=1)[:, 1:]

    def draw_log_uniform(self, low: float, high: float) -> float:
        """Return a number in a range from a log-uniform distribution."""
        return low * (high / low) ** self.rng.random()

    def draw_displacement(self, low: float, high: float) -> Float[np.ndarray, "3"]:
        """Return a vector of random direction and log-uniform length."""
        direction = self.rng.normal(size=3)
        return direction / np.linalg.norm(direction) * self.draw_log_uniform(low, high)

    def draw_place(
        self, duration_range_s: tuple[float, float], marker_count: int = 1, min_motion_m: float = 0.0
    ) -> FaultPlace | None:
        """Return a place inside the take without faults, of log-uniform duration, or None if none was found.

        marker_count  number of neighbouring markers
        min_motion_m  minimum range of the first marker's motion along one axis
        """
        for _ in range(MAX_PLACE_TRIES):
            marker = int(self.rng.integers(self.marker_count))
            length = max(1, round(self.rate_hz * self.draw_log_uniform(*duration_range_s)))
            if length > self.frame_count - 4:
                continue
            first = int(self.rng.integers(2, self.frame_count - length - 1))
            others = self.rng.permutation(self.neighbours[marker, :NEIGHBOUR_COUNT])[: marker_count - 1]
            place = FaultPlace((marker, *others.tolist()), first, first + length - 1)
            if self.is_free(place) and np.ptp(self.true_markers[place.frames, marker], axis=0).max() >= min_motion_m:
                return place
        return None

    def is_free(self, place: FaultPlace) -> bool:
        """Return whether a place and its surroundings have no faults."""
        margin = round(MIN_FAULT_DISTANCE_S * self.rate_hz)
        own = np.array(place.markers)
        markers = np.concatenate([own, self.neighbours[own, :NEIGHBOUR_COUNT].ravel()])
        frames = slice(max(0, place.first - margin), place.last + margin + 1)
        return not self._has_fault[frames, markers].any()

    def record_fault(self, fault: Fault, *, is_main: bool = True) -> None:
        """Record a fault; one that is not a main fault need not be found."""
        (self.injected_faults if is_main else self.secondary_faults).append(fault)
        self._has_fault[fault.frame_slice, list(fault.markers)] = True

    def hide_samples(self, marker: int, first: int, last: int, *, is_main: bool = False) -> None:
        """Remove a marker's samples in the frames first..last."""
        first, last = max(first, 0), min(last, self.frame_count - 1)
        self.markers[first : last + 1, marker] = np.nan
        self.record_fault(Fault("gap", marker, first, last, np.nan, ""), is_main=is_main)

    def add_trajectory(self, label: str, path: Float[np.ndarray, "T 3"]) -> None:
        """Add a trajectory to the file."""
        self.labels += (label,)
        self.markers = np.concatenate([self.markers, path[:, None]], axis=1)

    @property
    def damaged_truth(self) -> SyntheticTake:
        """The synthetic take whose measured markers and labels are the damaged ones."""
        is_missing = np.isnan(self.markers[..., 0])
        return replace(self.sound_truth, damaged_positions=self.markers, missing_mask=is_missing, labels=self.labels)
