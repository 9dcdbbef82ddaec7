"""Guess the segment and the position of a marker from the words in its label: knee, KNE, Knie, and a word for its side."""

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mocapfix.files.shipped import read_shipped_yaml
from mocapfix.marker_set import MarkerSet, fold_label
from mocapfix.marker_sets.landmarks import MIRROR_X
from mocapfix.marker_sets.library import load_marker_set
from mocapfix.skeleton import load_cmu31_body

LABEL_WORDS_FILE = "words/markers.yaml"
SIDE_SIGNS = {"LEFT": 1, "LINKS": 1, "GAUCHE": 1, "L": 1, "RIGHT": -1, "RECHTS": -1, "DROITE": -1, "DROIT": -1, "R": -1}
"""words for a side: 1 for the left, -1 for the right"""
MAX_MIDLINE_DISTANCE_M = 0.03
"""a marker that is nearer to the median plane of the body needs no word for its side"""
WORD_MARKER_SPREAD_M = 0.05
"""standard deviation per axis of markers with the same word about the position for the word"""
MIN_INNER_WORD_LENGTH = 4
"""letters of a word that may stand anywhere in a label"""
MIN_FIRST_WORD_LENGTH = 3
"""letters of a word that may stand at the beginning of a label; a shorter one, or one with a digit, is a label of its own"""


class WordLocation(NamedTuple):
    """The joint of a left or median marker and its position (3,) in the joint's axes, m."""

    joint_name: str
    offset: Float[np.ndarray, "3"]
    is_median: bool


def guess_marker_set_from_words(labels: Sequence[str]) -> MarkerSet:
    """Return those of the labels whose words locate a marker, as a marker set; the labels have no subject prefixes."""
    locations = {label: location for label in labels if (location := locate_label(label))}
    joint_names = load_cmu31_body().skeleton.names
    return MarkerSet(
        name="words",
        title="words",
        skeleton="cmu31",
        labels=tuple(locations),
        joints=np.array([joint_names.index(joint_name) for joint_name, _ in locations.values()], int),
        marker_offsets=np.array([offset for _, offset in locations.values()], float).reshape(-1, 3),
        marker_spread=np.full(len(locations), WORD_MARKER_SPREAD_M),
        aliases=((),) * len(locations),
    )


def locate_label(label: str) -> tuple[str, Float[np.ndarray, "3"]] | None:
    """Return the name of the joint and the position in its axes, m, that the words of a label mean.

    Returns None if the label has no known word, or has no word for the side of a marker that needs one.
    """
    for word, side in _list_side_splits(fold_label(label)):
        location = _find_first_word(word)
        if location is None or not (side or location.is_median):
            continue
        if side < 0 and not location.is_median:
            return location.joint_name.replace("Left", "Right"), location.offset * MIRROR_X
        return location.joint_name, location.offset
    return None


def _list_side_splits(name: str) -> list[tuple[str, int]]:
    """Return the possible splits of a folded name into the rest and the sign of its side (0 for none), most certain first."""
    splits = [(name.removeprefix(word), side) for word, side in SIDE_SIGNS.items() if name.startswith(word)]
    splits += [(name.removesuffix(word), side) for word, side in SIDE_SIGNS.items() if name.endswith(word)]
    return [*splits, (name, 0)]


def _find_first_word(name: str) -> WordLocation | None:
    """Return the location of the first known word in a folded name, of several that begin there of the longest."""
    locations = _load_word_locations()
    words = [word for word in locations if _contains_word(word, name)]
    return locations[min(words, key=lambda word: (name.index(word), -len(word)))] if words else None


def _contains_word(word: str, name: str) -> bool:
    name_without_number = name.rstrip("0123456789")
    if len(word) < MIN_FIRST_WORD_LENGTH or not word.isalpha():
        return word in (name, name_without_number)
    return word in name if len(word) >= MIN_INNER_WORD_LENGTH else name.startswith(word)


@cache
def _load_word_locations() -> dict[str, WordLocation]:
    """Return the location of the left or median marker for every word."""
    locations: dict[str, WordLocation] = {}
    for entry in read_shipped_yaml(LABEL_WORDS_FILE).values():
        set_name, _, label = entry["as"].partition(".")
        marker_set = load_marker_set(set_name)
        k = marker_set.labels.index(label)
        joint_name, offset = load_cmu31_body().skeleton.names[marker_set.joints[k]], marker_set.marker_offsets[k]
        is_median = bool(abs(offset[0]) < MAX_MIDLINE_DISTANCE_M and not joint_name.startswith("Left"))
        locations |= {word.upper(): WordLocation(joint_name, offset, is_median) for word in entry["words"]}
    return locations
