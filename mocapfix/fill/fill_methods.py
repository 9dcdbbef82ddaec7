"""The ways to fill a sample, as reports name them, and estimates that are made in these ways."""

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Int8


class FillMethod(IntEnum):
    """How a sample was filled."""

    SPLINE = 0
    CLUSTER = 1
    BODY = 2
    GAUSSIAN_PROCESS = 3
    RIGID_GROUP = 4

    @property
    def description(self) -> str:
        """The source of the sample, as a phrase for reports."""
        return _FILL_METHOD_DESCRIPTIONS[self]


_FILL_METHOD_DESCRIPTIONS = {
    FillMethod.SPLINE: "a spline through its own trajectory",
    FillMethod.CLUSTER: "the markers that move with it",
    FillMethod.BODY: "the solved body",
    FillMethod.GAUSSIAN_PROCESS: "all markers, in frames with a similar body state",
    FillMethod.RIGID_GROUP: "the rigid group to which it belongs",
}


class MarkerEstimate(NamedTuple):
    """Estimates of samples: positions in metres, standard deviations per axis, NaN for none, and FillMethods.

    They are those of a take (T, M), or those of its missing samples only (N,).
    """

    position: Float[np.ndarray, "*samples 3"]
    sd: Float[np.ndarray, "*samples"]
    method: Int8[np.ndarray, "*samples"]

    def select(self, is_missing: Bool[np.ndarray, "T M"]) -> "MarkerEstimate":
        """Return the estimates of the missing samples of a take."""
        return MarkerEstimate(*(values[is_missing] for values in self))

    def expand(self, is_missing: Bool[np.ndarray, "T M"]) -> "MarkerEstimate":
        """Return the estimates of a take from those of its missing samples."""
        position, sd = np.full((*is_missing.shape, 3), np.nan), np.full(is_missing.shape, np.nan)
        method = np.zeros(is_missing.shape, np.int8)
        position[is_missing], sd[is_missing], method[is_missing] = self
        return MarkerEstimate(position, sd, method)


def build_marker_estimate(
    position: Float[np.ndarray, "*samples 3"], sd: Float[np.ndarray, "*samples"], method: FillMethod
) -> MarkerEstimate:
    """Return an estimate from one method."""
    return MarkerEstimate(position, sd, np.full(sd.shape, method, np.int8))


class GapWindow(NamedTuple):
    """A gap, the visible samples beside it, and the hidden stretches that imitate it.

    Offsets count frames from the first frame of the gap, or of a stretch.

    first, length  of the gap, in frames
    before, after  offsets of the visible samples beside the gap, ascending; they reach up to it without interruption or are empty
    points         (S,) offsets of the points in the gap at which errors are measured
    starts         (K,) first frames of the hidden stretches
    hidden_length  of each stretch, in frames
    hidden_after   offsets of the samples after a stretch; those before it are `before`
    hidden_points  (S,) offsets of the points in a stretch
    """

    first: int
    length: int
    before: np.ndarray
    after: np.ndarray
    points: np.ndarray
    starts: np.ndarray
    hidden_length: int
    hidden_after: np.ndarray
    hidden_points: np.ndarray

    @property
    def gap_frames(self) -> Int[np.ndarray, " n"]:
        """The frames of the gap."""
        return self.first + np.arange(self.length)

    @property
    def context_frames(self) -> Int[np.ndarray, " C"]:
        """The frames of the samples beside the gap."""
        return self.first + np.concatenate([self.before, self.after])

    @property
    def hidden_frames(self) -> Int[np.ndarray, "K S"]:
        """The frames at which errors are measured."""
        return self.starts[:, None] + self.hidden_points

    @property
    def hidden_context_frames(self) -> Int[np.ndarray, "K C"]:
        """The frames of the samples beside the stretches."""
        return self.starts[:, None] + np.concatenate([self.before, self.hidden_after])

    def count_independent_stretches(self) -> float:
        """Return the number of stretches of this length in the frames that are hidden at least once."""
        if not len(self.starts):
            return 0.0
        steps = np.minimum(np.diff(self.starts), self.hidden_length)
        return min(len(self.starts), (float(steps.sum()) + self.hidden_length) / self.hidden_length)

    def compute_distance_to_edges(self) -> Float[np.ndarray, " S"]:
        """Return the distance of each point, in frames, from the nearest edge of the gap that has a visible sample."""
        to_first, to_last = self.points + 1.0, self.length - self.points * 1.0
        if not len(self.after):
            return to_first
        return np.minimum(to_first, to_last) if len(self.before) else to_last


class MovingAxes(NamedTuple):
    """Axes that move with some markers: rotation (T, 3, 3) to the world, and origin (T, 3) m; NaN where unknown."""

    rotation: np.ndarray
    origin: np.ndarray

    def transform_from_world(self, path: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3"]:
        """Return a path in these axes."""
        local = np.full(path.shape, np.nan)
        known = np.flatnonzero(~np.isnan(self.origin[:, 0]) & ~np.isnan(path[:, 0]))
        local[known] = np.einsum("tba,tb->ta", self.rotation[known], path[known] - self.origin[known])
        return local


class GapEstimate(NamedTuple):
    """One estimate of a marker in one gap of n frames.

    method       how it was made
    position     (n, 3) m in the world
    error        (K, S, 3) m in the world, in the hidden stretches of the gap's window; NaN where unknown
    expected_sd  (S,) m per axis, of the error at the points of the window, expected without looking at hidden stretches
    axes_number  of the axes in which it was made; estimates in the same axes have similar errors. None: in none of its own
    """

    method: FillMethod
    position: np.ndarray
    error: np.ndarray
    expected_sd: np.ndarray
    axes_number: int | None = None

    def grow(self, factor: float) -> "GapEstimate":
        """Return the estimate with a larger expected error."""
        return self._replace(expected_sd=self.expected_sd * factor)
