"""A synthetic take with its true subject and motion, to which faults are added."""

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np

from mocapfix.model.motion import Motion
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.synthetic import compose_take

RATE = 120.0
FAR = 0.004  # metres: predicted standard deviation of every marker


class Solved(NamedTuple):
    take: Take
    subject: Subject
    motion: Motion


@cache
def solved(seed: int = 0, seconds: float = 3.0) -> Solved:
    """Return sound markers with skin motion, and the body that carries them."""
    truth = compose_take(seed, seconds, RATE)
    motion = truth.motion
    marker_sd = np.full(truth.missing_mask.shape, FAR)
    known = replace(motion, marker_sd=marker_sd)
    return Solved(Take(truth.marker_positions, truth.labels, RATE), truth.subject, known)


def displaced(take: Take, marker: int, first: int, last: int, shift) -> Take:
    """Displace the marker's samples over first..last by `shift` (3,) metres."""
    markers = take.markers.copy()
    markers[first : last + 1, marker] += np.array(shift)
    return take.replace_markers(markers)
