"""Points without labels over time, divided into tracklets, and the labels that they get.

The frames of a take in which labelling compares its points with a body.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True)
class UnlabelledPoints:
    """T frames of at most C points.

    Attributes:
        positions: Metres, Y up, NaN where a frame has fewer points.
        tracklet_indices: The tracklet of each point, 0 to N - 1 in the order of their first frames; -1 where there is no point.
            A tracklet has at most one point in a frame, and may change its column and miss single frames.
        rate: Frames per second.
    """

    positions: Float[np.ndarray, "T C 3"]
    tracklet_indices: Int[np.ndarray, "T C"]
    rate: float

    @property
    def tracklet_count(self) -> int:
        """Number of tracklets."""
        return int(self.tracklet_indices.max(initial=-1)) + 1

    def select_points(self, mask: Bool[np.ndarray, "T C"]) -> "UnlabelledPoints":
        """Return the points in `mask` only. The tracklets keep their indices."""
        return UnlabelledPoints(
            np.where(mask[..., None], self.positions, np.nan), np.where(mask, self.tracklet_indices, -1), self.rate
        )


@dataclass(frozen=True)
class PointLabels:
    """The marker to which each point belongs.

    Attributes:
        marker_indices: Index among the labels of the marker set, -1 for a point without a label.
        confidence: Probability that the label, or that no label, is right; 0 where there is no point.
        subject_indices: Of several persons, to whom each point belongs, -1 for none; empty if there is one person.
        evidence_per_marker: Logarithm of how much more probable a labelled point is at its marker than anywhere on the body;
            infinite for the markers of a known person.
    """

    marker_indices: Int[np.ndarray, "T C"]
    confidence: Float[np.ndarray, "T C"]
    subject_indices: Int[np.ndarray, "S C"] = field(default_factory=lambda: np.zeros((0, 0), int))
    evidence_per_marker: float = np.inf


def assign_to_tracklets(points: UnlabelledPoints, values: np.ndarray, missing: float) -> np.ndarray:
    """Return for every point (T, C) the value of its tracklet, `missing` where there is no point."""
    return np.append(values, missing)[points.tracklet_indices].astype(values.dtype)


SAMPLE_STEP_S = 0.05
"""Step between the frames that are compared."""
FRAMES_PER_TRACKLET = 4
"""Frames in which each tracklet is compared at least, if it has so many."""


@dataclass(frozen=True)
class SampledPoints:
    """The points of S frames of a take, in V columns.

    Attributes:
        frames: Indices of the frames, rising.
        positions: Metres, NaN where a frame has fewer points.
        tracklets: The tracklet of each point, -1 where there is none.
        tracklet_count: Number of tracklets of the take, N.
        times_s: Times of the frames.
    """

    frames: Int[np.ndarray, " S"]
    positions: Float[np.ndarray, "S V 3"]
    tracklets: Int[np.ndarray, "S V"]
    tracklet_count: int
    times_s: Float[np.ndarray, " S"]

    def select_frames(self, indices: Int[np.ndarray, " N"]) -> "SampledPoints":
        """Return some of the frames, given by their indices among the S."""
        return SampledPoints(
            self.frames[indices], self.positions[indices], self.tracklets[indices], self.tracklet_count, self.times_s[indices]
        )

    def select_tracklets(self, is_selected: Bool[np.ndarray, " N"]) -> "SampledPoints":
        """Return the points of some of the tracklets, which keep their indices; empty places are among those of the others."""
        is_kept = np.append(is_selected, False)[self.tracklets]
        positions = np.where(is_kept[..., None], self.positions, np.nan)
        return SampledPoints(self.frames, positions, np.where(is_kept, self.tracklets, -1), self.tracklet_count, self.times_s)

    def arrange_markers(self, labels: Int[np.ndarray, " N"], marker_count: int) -> Float[np.ndarray, "S K 3"]:
        """Return the positions of the markers, given the marker of each tracklet (-1 for none); NaN where not visible."""
        markers = np.full((len(self.frames), marker_count, 3), np.nan)
        point_labels = np.append(labels, -1)[self.tracklets]
        rows, columns = np.nonzero(point_labels >= 0)
        markers[rows, point_labels[rows, columns]] = self.positions[rows, columns]
        return markers


def sample_points(points: UnlabelledPoints) -> SampledPoints:
    """Return the points at regular steps, and in a few more frames for short tracklets."""
    frames = np.unique(np.r_[_select_regular_frames(points), _select_tracklet_frames(points)])
    indices = points.tracklet_indices[frames]
    order = np.argsort(indices < 0, axis=1, kind="stable")[:, : max(1, int((indices >= 0).sum(1).max(initial=0)))]
    rows = np.arange(len(frames))[:, None]
    return SampledPoints(
        frames, points.positions[frames][rows, order], indices[rows, order], points.tracklet_count, frames / points.rate
    )


def _select_regular_frames(points: UnlabelledPoints) -> Int[np.ndarray, " S"]:
    return np.arange(0, len(points.positions), max(1, round(SAMPLE_STEP_S * points.rate)))


def _select_tracklet_frames(points: UnlabelledPoints) -> Int[np.ndarray, " S"]:
    """Return a few frames of each tracklet."""
    frames, columns = np.nonzero(points.tracklet_indices >= 0)
    order = np.argsort(points.tracklet_indices[frames, columns], kind="stable")
    counts = np.bincount(points.tracklet_indices[frames, columns], minlength=points.tracklet_count)
    starts = np.cumsum(counts) - counts
    shares = (np.arange(FRAMES_PER_TRACKLET) + 0.5) / FRAMES_PER_TRACKLET
    return frames[order[(starts[:, None] + shares * counts[:, None]).astype(int).ravel()]] if len(frames) else frames
