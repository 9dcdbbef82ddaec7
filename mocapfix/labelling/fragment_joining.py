"""Fragments of the same markers joined where no marker set is known: the take itself shows how its markers move.

The markers are those trajectories that are visible together in the fullest stretch of the take. There they show how each moves
with its neighbours, as a labelled take of the person does (`reference_labeller`). By that the other fragments are assigned, which
shows the markers in more poses, and all are assigned once more.
"""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, Int

from mocapfix.labelling.points import PointLabels, UnlabelledPoints
from mocapfix.labelling.reference_markers import ReferenceMarkers, build_reference_markers
from mocapfix.stats.sequences import sample_evenly

LikeLabeller: TypeAlias = Callable[[UnlabelledPoints, ReferenceMarkers], PointLabels]
"""labels points by the markers of a labelled take"""
MIN_FRAGMENT_S = 0.5
"""Duration of a fragment below which it may be a ghost and names no marker."""
MIN_LASTING_SHARE = 0.8
"""Share of the fragments of the fullest frame that are still visible at the ends of its stretch."""
MIN_JOINED_MARKERS = 5
"""Markers that a take must show together to be joined."""
MIN_MARKER_SHARE = 0.2
"""Samples of a marker, relative to those of the median one, below which it is a ghost."""
MAX_TRIED_FRAMES = 50
"""Frames with the most fragments among which the one with the longest stretch is chosen."""


def join_trajectories(points: UnlabelledPoints, label_like: LikeLabeller) -> tuple[PointLabels, tuple[str, ...]]:
    """Return the marker of each point, and the names of the markers: M01 and so on; none where too few are visible together.

    label_like  labels points by the markers of a labelled take, see `label_points_like`
    """
    fragments = select_marker_fragments(points)
    if len(fragments) < MIN_JOINED_MARKERS:
        return PointLabels(np.full(points.tracklet_indices.shape, -1), np.zeros(points.tracklet_indices.shape)), ()
    marker_of_fragment = np.full(points.tracklet_count + 1, -1)
    marker_of_fragment[fragments] = np.arange(len(fragments))
    markers = arrange_points(points, marker_of_fragment[points.tracklet_indices], len(fragments))
    names = number_markers(len(fragments))
    joined = arrange_points(points, label_like(points, build_reference_markers(markers, names)).marker_indices, len(fragments))
    sample_count = (~np.isnan(joined[..., 0])).sum(axis=0)
    joined = joined[:, sample_count >= MIN_MARKER_SHARE * np.median(sample_count)]
    names = number_markers(joined.shape[1])
    return label_like(points, build_reference_markers(joined, names)), names


def number_markers(count: int) -> tuple[str, ...]:
    """Return names of markers: M01, M02 and so on."""
    digits = max(2, len(str(count)))
    return tuple(f"M{n + 1:0{digits}d}" for n in range(count))


def select_marker_fragments(points: UnlabelledPoints) -> Int[np.ndarray, " K"]:
    """Return the fragments, none of them short, of the frame in which most are visible for the longest time."""
    count = points.tracklet_count
    first, last = np.full(count, len(points.positions)), np.full(count, -1)
    frames, columns = np.nonzero(points.tracklet_indices >= 0)
    np.minimum.at(first, points.tracklet_indices[frames, columns], frames)
    np.maximum.at(last, points.tracklet_indices[frames, columns], frames)
    lasting = np.flatnonzero(last - first + 1 >= min(MIN_FRAGMENT_S * points.rate, len(points.positions)))
    every_frame = np.arange(len(points.positions))[:, None]
    visible = (first[lasting] <= every_frame) & (every_frame <= last[lasting])
    number = visible.sum(axis=1)
    fullest = np.flatnonzero(number == number.max(initial=0)) if len(lasting) else np.zeros(0, int)
    if not len(fullest):
        return np.zeros(0, int)
    tried = fullest[sample_evenly(len(fullest), MAX_TRIED_FRAMES)]
    durations = [_measure_stretch(visible, visible[frame]) for frame in tried]
    return lasting[visible[tried[int(np.argmax(durations))]]]


def _measure_stretch(visible: np.ndarray, fragments: np.ndarray) -> int:
    """Return the number of frames that show most of some fragments."""
    return int((visible[:, fragments].mean(axis=1) >= MIN_LASTING_SHARE).sum())


def arrange_points(
    points: UnlabelledPoints, marker_indices: Int[np.ndarray, "T C"], marker_count: int
) -> Float[np.ndarray, "T K 3"]:
    """Return the positions of markers in metres, NaN where no point has the marker."""
    markers = np.full((len(points.positions), marker_count, 3), np.nan)
    frames, columns = np.nonzero(marker_indices >= 0)
    markers[frames, marker_indices[frames, columns]] = points.positions[frames, columns]
    return markers
