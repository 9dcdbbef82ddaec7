"""Points without labels over time, divided into tracklets, and the labels that they get."""

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
