"""What happens to labels: they are exchanged for a while or all the time, or a trajectory goes on under another."""

import numpy as np

from mocapfix.bench.stage import Place, Stage
from mocapfix.faults import Fault, Fragment, Kind

HIDDEN = (0.05, 0.25)  # seconds: how long exchanged markers are out of sight before
PAUSE = 0.05  # seconds: how long a trajectory is lost at most, before it goes on under another label
NAMES = ("{label}-{n}", "*{n}", "C_{n}", "{label}-{n}")
LIMBS = {"arm": ("Arm", "Hand", "Shoulder", "Finger", "Thumb"), "leg": ("Leg", "Foot", "Toe"), "body": ("",)}


def exchange(stage: Stage, place: Place) -> None:
    """Labels go round the ring: half the time after their markers were hidden, a fifth of the time for good."""
    ring = list(place.ring)
    if stage.rng.random() < 0.2:
        good = place._replace(last=stage.frames - 1)
        place = good if stage.free(good) else place
    if stage.rng.random() < 0.5:
        length = round(stage.rate * stage.spread(*HIDDEN))
        for marker in ring:
            stage.hide(marker, place.first - length, place.first - 1)
    exchanged(stage, ring, place.first, place.last, "swap")


def exchanged(stage: Stage, ring: list[int], first: int, last: int, kind: Kind) -> None:
    """The samples of each marker in the ring are under the next one's label."""
    frames = slice(first, last + 1)
    stage.markers[frames, ring[1:] + ring[:1]] = stage.markers[frames, ring]
    stage.happened(Fault(kind, ring[0], first, last, np.nan, "", others=tuple(ring[1:])))


def fragment(stage: Stage, place: Place) -> None:
    """A piece of a trajectory goes on under another label, half the time with a pause before and after it."""
    marker, n = place.ring[0], len(stage.labels) - stage.count + 1
    pause = round(stage.rng.uniform(0, PAUSE) * stage.rate) if stage.rng.random() < 0.5 else 0
    path, frames = np.full((stage.frames, 3), np.nan), place.frames
    path[frames] = stage.markers[frames, marker]
    stage.hide(marker, place.first - pause, place.last + pause)
    stage.add(NAMES[stage.rng.integers(len(NAMES))].format(label=stage.labels[marker], n=n), path)
    donor = len(stage.labels) - 1
    stage.happened(Fragment("fragment", marker, place.first, place.last, np.nan, "", donor=donor, relation="continues"))


def mislabelled(stage: Stage) -> None:
    """Two markers near one another bear each other's label all the time."""
    marker = int(stage.rng.integers(stage.count))
    other = int(stage.rng.choice(stage.near[marker, :2]))
    exchanged(stage, [marker, other], 0, stage.frames - 1, "mislabelled")


def mirrored(stage: Stage) -> None:
    """Left and right are taken for one another all the time, in the markers of the arms, of the legs or of the whole body."""
    words = LIMBS[stage.rng.choice(list(LIMBS))]
    joints = [stage.sound.subject.skeleton.names[j] for j in stage.sound.subject.joints]
    for m, label in enumerate(stage.labels):
        other = "R" + label[1:]
        if label.startswith("L") and other in stage.labels and any(word in joints[m] for word in words):
            exchanged(stage, [m, stage.labels.index(other)], 0, stage.frames - 1, "mislabelled")
