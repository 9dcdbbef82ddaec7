"""What happens to a marker's samples: they are missing, off, held, drawn straight, or somewhere else altogether."""

import numpy as np

from mocapfix.bench.stage import Place, Stage
from mocapfix.faults import Fault, Kind

TREMBLE = (0.008, 0.025)  # metres per axis
JUMP, GHOST = (0.03, 0.3), (0.05, 0.5)  # metres


def gap(stage: Stage, place: Place) -> None:
    stage.hide(place.ring[0], place.first, place.last, main=True)


def spike(stage: Stage, place: Place) -> None:
    off(stage, place, "spike", stage.way(*JUMP))


def jitter(stage: Stage, place: Place) -> None:
    off(stage, place, "jitter", stage.rng.normal(0, stage.spread(*TREMBLE), (place.length, 3)))


def off(stage: Stage, place: Place, kind: Kind, shift: np.ndarray) -> None:
    """Add `shift`, (3,) or (N, 3) metres, to a marker's samples."""
    marker = place.ring[0]
    stage.markers[place.frames, marker] += shift
    size = float(np.linalg.norm(shift, axis=-1).max())
    stage.happened(Fault(kind, marker, place.first, place.last, size, ""))


def stuck(stage: Stage, place: Place) -> None:
    """A gap that another program filled with the value before it."""
    instead(stage, place, "stuck", stage.markers[[place.first - 1], place.ring[0]])


def straight(stage: Stage, place: Place) -> None:
    """A gap that another program filled: with a line or, as often, with the cubic that goes on as the samples about it go."""
    path, (a, b) = stage.markers[:, place.ring[0]], (place.first - 1, place.last + 1)
    span = b - a
    s = (np.arange(place.first, b) - a)[:, None] / span
    line = path[a] + s * (path[b] - path[a])
    leaving, coming = (span * (path[t + 1] - path[t]) - (path[b] - path[a]) for t in (a - 1, b))
    bow = s * (1 - s) * ((1 - s) * leaving - s * coming) if stage.rng.random() < 0.5 else 0.0
    instead(stage, place, "straight", line + bow)


def ghost(stage: Stage, place: Place) -> None:
    """The label jumps to a reflection, which stays where it is or, as often, goes along with the marker."""
    marker, way = place.ring[0], stage.way(*GHOST)
    stays = stage.rng.random() < 0.5
    there = stage.markers[[place.first] if stays else place.frames, marker] + way
    instead(stage, place, "ghost", there + stage.rng.normal(0, 0.0005, (place.length, 3)))


def instead(stage: Stage, place: Place, kind: Kind, path: np.ndarray) -> None:
    """Put `path`, (N, 3) or (1, 3), in place of a marker's samples."""
    marker = place.ring[0]
    stage.markers[place.frames, marker] = path
    size = float(np.linalg.norm(stage.markers[place.frames, marker] - stage.true[place.frames, marker], axis=-1).max())
    stage.happened(Fault(kind, marker, place.first, place.last, size, ""))
