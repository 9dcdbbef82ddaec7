"""A first guess at a marker from what a laboratory calls it: knee, KNE, Knie, and whether it is a left or a right one."""

from collections.abc import Sequence
from functools import cache

import numpy as np

from mocapfix.files.shipped import read_shipped_yaml
from mocapfix.marker_set import MarkerSet, fold_label
from mocapfix.marker_sets.library import load_marker_set
from mocapfix.skeleton import load_cmu31_body

LABEL_WORDS_FILE = "words/markers.yaml"
SIDE_SIGNS = {"LEFT": 1, "LINKS": 1, "GAUCHE": 1, "L": 1, "RIGHT": -1, "RECHTS": -1, "DROITE": -1, "DROIT": -1, "R": -1}
MAX_MIDLINE_DISTANCE_M = 0.03  # metres: a place that lies nearer to the middle of the body has no side
WORD_MARKER_SPREAD_M = 0.05  # metres: of markers that bear one word, about the place for it
MIRROR_X = np.array([-1.0, 1.0, 1.0])


def guess_marker_set_from_words(labels: Sequence[str]) -> MarkerSet:
    """-> those of the labels, without subjects' prefixes, whose words tell the segment, as a set of wide spread."""
    names, joints, places = load_cmu31_body().skeleton.names, [], []
    found = {label: spot for label in labels if (spot := locate_label(label))}
    for joint, place in found.values():
        joints.append(names.index(joint))
        places.append(place)
    spread, aliases = np.full(len(found), WORD_MARKER_SPREAD_M), ((),) * len(found)
    where = np.array(joints, int), np.array(places).reshape(-1, 3)
    return MarkerSet("words", "words", "cmu31", tuple(found), *where, spread, aliases)


def locate_label(label: str) -> tuple[str, np.ndarray] | None:
    """-> the joint and the place (3,) in metres that a label's words tell; None where they tell none, or not on which side."""
    name = fold_label(label)
    for word, side in _split_side_words(name):
        if (spot := _find_first_word(word)) and (side or spot[2]):
            joint, place, middle = spot
            if side < 0 and not middle:
                return joint.replace("Left", "Right"), place * MIRROR_X
            return joint, place
    return None


def _split_side_words(name: str) -> list[tuple[str, int]]:
    """-> the ways to read a folded name as a word and a side (1 left, -1 right, 0 not told), surest first."""
    ways = [(name.removeprefix(word), side) for word, side in SIDE_SIGNS.items() if name.startswith(word)]
    ways += [(name.removesuffix(word), side) for word, side in SIDE_SIGNS.items() if name.endswith(word)]
    return [*ways, (name, 0)]


def _find_first_word(name: str) -> tuple[str, np.ndarray, bool] | None:
    """-> joint, place and whether it is in the middle, of the first word that stands in a name; of several there the longest."""
    fits = [word for word in _load_word_locations() if _contains_word(word, name)]
    return _load_word_locations()[min(fits, key=lambda word: (name.index(word), -len(word)))] if fits else None


def _contains_word(word: str, name: str) -> bool:
    bare = name.rstrip("0123456789")
    if len(word) < 3 or not word.isalpha():
        return word in (name, bare)
    return word in name if len(word) > 3 else name.startswith(word)


@cache
def _load_word_locations() -> dict[str, tuple[str, np.ndarray, bool]]:
    """-> for every word the joint, the place of a left or middle marker (3,), metres, and whether it is in the middle."""
    spots = {}
    for spot in read_shipped_yaml(LABEL_WORDS_FILE).values():
        name, _, label = spot["as"].partition(".")
        worn = load_marker_set(name)
        k = worn.labels.index(label)
        joint, place = load_cmu31_body().skeleton.names[worn.joints[k]], worn.marker_offsets[k]
        middle = abs(place[0]) < MAX_MIDLINE_DISTANCE_M and not joint.startswith("Left")
        spots |= {word.upper(): (joint, place, middle) for word in spot["words"]}
    return spots
