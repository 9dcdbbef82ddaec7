"""A first guess at a marker from what a laboratory calls it: knee, KNE, Knie, and whether it is a left or a right one."""

from collections.abc import Sequence
from functools import cache

import numpy as np

from mocapfix.marker_set.file import load
from mocapfix.marker_set.labels import folded
from mocapfix.marker_set.nominal import MarkerSet
from mocapfix.scenes import load_yaml
from mocapfix.skeleton import cmu31

WORDS = "words/markers.yaml"
SIDES = {"LEFT": 1, "LINKS": 1, "GAUCHE": 1, "L": 1, "RIGHT": -1, "RECHTS": -1, "DROITE": -1, "DROIT": -1, "R": -1}
MIDDLE = 0.03  # metres: a place that lies nearer to the middle of the body has no side
SPREAD = 0.05  # metres: of markers that bear one word, about the place for it
MIRROR = np.array([-1.0, 1.0, 1.0])


def guessed(labels: Sequence[str]) -> MarkerSet:
    """-> those of the labels, without subjects' prefixes, whose words tell the segment, as a set of wide spread."""
    names, joints, places = cmu31().skeleton.names, [], []
    found = {label: spot for label in labels if (spot := place_of(label))}
    for joint, place in found.values():
        joints.append(names.index(joint))
        places.append(place)
    spread, aliases = np.full(len(found), SPREAD), ((),) * len(found)
    where = np.array(joints, int), np.array(places).reshape(-1, 3)
    return MarkerSet("words", "words", "cmu31", tuple(found), *where, spread, aliases)


def place_of(label: str) -> tuple[str, np.ndarray] | None:
    """-> the joint and the place (3,) in metres that a label's words tell; None where they tell none, or not on which side."""
    name = folded(label)
    for word, side in _sides(name):
        if (spot := _first(word)) and (side or spot[2]):
            joint, place, middle = spot
            if side < 0 and not middle:
                return joint.replace("Left", "Right"), place * MIRROR
            return joint, place
    return None


def _sides(name: str) -> list[tuple[str, int]]:
    """-> the ways to read a folded name as a word and a side (1 left, -1 right, 0 not told), surest first."""
    ways = [(name.removeprefix(word), side) for word, side in SIDES.items() if name.startswith(word)]
    ways += [(name.removesuffix(word), side) for word, side in SIDES.items() if name.endswith(word)]
    return [*ways, (name, 0)]


def _first(name: str) -> tuple[str, np.ndarray, bool] | None:
    """-> joint, place and whether it is in the middle, of the first word that stands in a name; of several there the longest."""
    fits = [word for word in _spots() if _stands(word, name)]
    return _spots()[min(fits, key=lambda word: (name.index(word), -len(word)))] if fits else None


def _stands(word: str, name: str) -> bool:
    bare = name.rstrip("0123456789")
    if len(word) < 3 or not word.isalpha():
        return word in (name, bare)
    return word in name if len(word) > 3 else name.startswith(word)


@cache
def _spots() -> dict[str, tuple[str, np.ndarray, bool]]:
    """-> for every word the joint, the place of a left or middle marker (3,), metres, and whether it is in the middle."""
    spots = {}
    for spot in load_yaml(WORDS).values():
        name, _, label = spot["as"].partition(".")
        worn = load(name)
        k = worn.labels.index(label)
        joint, place = cmu31().skeleton.names[worn.joints[k]], worn.places[k]
        middle = abs(place[0]) < MIDDLE and not joint.startswith("Left")
        spots |= {word.upper(): (joint, place, middle) for word in spot["words"]}
    return spots
