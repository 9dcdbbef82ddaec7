"""Somebody in the CMU 41, briefly, and the same with labels put wrong."""

from functools import cache

import numpy as np

from mocapfix import marker_sets, synthetic
from mocapfix.take import Take

CMU41 = marker_sets.load_marker_set("cmu41")


@cache
def somebody(seed: int = 0, seconds: float = 3.0) -> Take:
    """-> a person who is not the average one, walking and reaching, at 30 Hz; sound."""
    truth = synthetic.compose_take(seed, seconds, 30.0, asymmetric=True)
    return Take(truth.marker_positions, truth.labels, truth.rate)


def columns(take: Take, *labels: str) -> tuple[int, ...]:
    return tuple(take.bare_labels.index(label) for label in labels)


def relabelled(take: Take, *labels: str) -> Take:
    """-> the samples of each marker are under the next one's label, all along; of the last under the first's."""
    ring, markers = columns(take, *labels), take.markers.copy()
    markers[:, ring[1:] + ring[:1]] = take.markers[:, ring]
    return take.replace_markers(markers)


def mirrored(take: Take, *labels: str) -> Take:
    """-> left and right of these markers are exchanged, which are named without L and R."""
    for label in labels:
        take = relabelled(take, f"L{label}", f"R{label}")
    return take


def without(take: Take, *labels: str, first: int = 0, last: int | None = None) -> Take:
    """-> these markers are not seen over first..last."""
    markers = take.markers.copy()
    markers[first : None if last is None else last + 1, columns(take, *labels)] = np.nan
    return take.replace_markers(markers)
