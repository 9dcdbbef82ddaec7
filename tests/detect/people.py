"""A subject with the CMU 41 marker set, and the same with wrong labels."""

from functools import cache

import numpy as np

from mocapfix.model.take import Take
from mocapfix.subject.library import load_marker_set
from mocapfix.synthetic import compose_take

CMU41 = load_marker_set("cmu41")


@cache
def compose_person(seed: int = 0, seconds: float = 3.0) -> Take:
    """Return a sound take, at 30 Hz, of a subject off the average who walks and reaches."""
    truth = compose_take(seed, seconds, 30.0, asymmetric=True)
    return Take(truth.marker_positions, truth.labels, truth.rate)


def columns(take: Take, *labels: str) -> tuple[int, ...]:
    return tuple(take.bare_labels.index(label) for label in labels)


def relabelled(take: Take, *labels: str) -> Take:
    """Move the samples of each marker to the next one's label, and those of the last to the first's."""
    cycle, markers = columns(take, *labels), take.markers.copy()
    markers[:, cycle[1:] + cycle[:1]] = take.markers[:, cycle]
    return take.replace_markers(markers)


def mirrored(take: Take, *labels: str) -> Take:
    """Exchange left and right of these markers, given without L and R."""
    for label in labels:
        take = relabelled(take, f"L{label}", f"R{label}")
    return take


def without(take: Take, *labels: str, first: int = 0, last: int | None = None) -> Take:
    """Remove the samples of these markers over first..last."""
    markers = take.markers.copy()
    markers[first : None if last is None else last + 1, columns(take, *labels)] = np.nan
    return take.replace_markers(markers)
