"""Guess the segment and the position of a marker from the words in its label: knee, KNE, Knie, and a word for its side."""

import re
from collections.abc import Collection, Iterator, Sequence
from functools import cache
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from mocapfix.io.shipped import read_shipped_yaml
from mocapfix.model.marker_set import MarkerSet, fold_label
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.subject.library import MIRROR_X, load_marker_set

LABEL_WORDS_FILE = "words/markers.yaml"
OTHER_WORDS_FILE = "words/other-points.yaml"
# Words for a side: 1 for the left, -1 for the right.
SIDE_SIGNS = {"LEFT": 1, "LINKS": 1, "GAUCHE": 1, "L": 1, "RIGHT": -1, "RECHTS": -1, "DROITE": -1, "DROIT": -1, "R": -1}
MAX_MIDLINE_DISTANCE_M = 0.03  # a marker that is nearer to the median plane of the body needs no word for its side
WORD_MARKER_SPREAD_M = 0.05  # standard deviation per axis of markers with the same word about the position for the word
MIN_INNER_WORD_LENGTH = 4  # letters of a word that may stand within a label
MIN_FIRST_WORD_LENGTH = 3  # letters; a shorter word at the beginning, or one with a digit, is a label of its own
ALL_SIDE_PLACES = ("first letter", "first word", "last letter", "last word")  # of a side's letter or word
# The words of a label: letters of one case, or a capital with small letters, or digits.
TOKEN_PATTERN = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W\d_a-zA-Z]+")


class WordLocation(NamedTuple):
    """The joint of a left or median marker and its position (3,) in the joint's axes, m."""

    joint_name: str
    offset: Float[np.ndarray, "3"]
    is_median: bool


class SideSplit(NamedTuple):
    """One reading of a folded label: the rest without the word for a side, its sign (0 for none), and where that word stands."""

    rest: str
    side: int
    place: str


def guess_marker_set_from_words(labels: Sequence[str]) -> MarkerSet:
    """Return those of the labels whose words locate a marker, as a marker set; the labels have no subject prefixes.

    A letter is a word for a side only where the other labels agree: if some labels have a counterpart on the other side ("ASISl"
    and "ASISr"), the "L" of "LARM" without a counterpart may mean lower, and the "l" of "ARMl" beside "ARMm" lateral.
    """
    places, names = _find_side_places(labels), frozenset(map(fold_label, labels))
    places_of_label = {label: places - ({"last letter"} if _is_lateral(label, names) else set()) for label in labels}
    locations = {label: location for label in labels if (location := locate_label(label, places_of_label[label]))}
    joint_names = load_cmu31_body().skeleton.names
    joints = np.array([joint_names.index(joint_name) for joint_name, _ in locations.values()], int)
    offsets = np.array([offset for _, offset in locations.values()], float).reshape(-1, 3)
    spread, aliases = np.full(len(locations), WORD_MARKER_SPREAD_M), ((),) * len(locations)
    return MarkerSet("words", "words", "cmu31", tuple(locations), joints, offsets, spread, aliases)


def locate_label(label: str, side_places: Collection[str] = ALL_SIDE_PLACES) -> tuple[str, Float[np.ndarray, "3"]] | None:
    """Return the name of the joint and the position in its axes, m, that the words of a label mean.

    Returns None if the label has no known word, names an object, or has no word for the side of a marker that needs one.
    """
    name = fold_label(label)
    if names_object(label) or name in _load_other_words("modifiers"):
        return None
    for split in _list_side_splits(name):
        if split.side and split.place not in side_places:
            continue
        location = _find_first_word(split.rest, _list_word_starts(label, name.index(split.rest) if split.rest else 0))
        if location is None or not (split.side or location.is_median):
            continue
        if split.side < 0 and not location.is_median:
            return location.joint_name.replace("Left", "Right"), location.offset * MIRROR_X
        return location.joint_name, location.offset
    return None


def names_object(label: str) -> bool:
    """Return whether a word of a label names an object, such as a wheelchair or a racket."""
    words, tokens = _load_other_words("objects"), [token.upper() for token in TOKEN_PATTERN.findall(label)]
    candidates = {name for token in tokens for name in (token, token.removesuffix("S"))}
    candidates |= {split.rest for split in _list_side_splits(fold_label(label))}
    return any(candidate.rstrip("0123456789") in words for candidate in candidates)


def _is_lateral(label: str, names: frozenset[str]) -> bool:
    """Return whether the last letter of a label is that of lateral: "ARMl" beside "ARMm", without "ARMr"."""
    rest, letter = fold_label(label)[:-1], fold_label(label)[-1:]
    return letter == "L" and rest + "M" in names and rest + "R" not in names


def _find_side_places(labels: Sequence[str]) -> frozenset[str]:
    """Return where the words for a side stand in the labels that have a counterpart on the other side; anywhere if none has."""
    splits = [split for label in labels for split in _list_side_splits(fold_label(label)) if split.side]
    sides = {(split.rest, split.place): set[int]() for split in splits}
    for split in splits:
        sides[split.rest, split.place].add(split.side)
    paired = frozenset(place for (_, place), signs in sides.items() if len(signs) == 2)
    return paired or frozenset(ALL_SIDE_PLACES)


def _list_side_splits(name: str) -> list[SideSplit]:
    """Return the possible splits of a folded name into the rest and its side, most certain first."""
    kinds = {word: "letter" if len(word) == 1 else "word" for word in SIDE_SIGNS}
    first = [(word, side) for word, side in SIDE_SIGNS.items() if name.startswith(word)]
    last = [(word, side) for word, side in SIDE_SIGNS.items() if name.endswith(word)]
    splits = [SideSplit(name.removeprefix(word), side, f"first {kinds[word]}") for word, side in first]
    splits += [SideSplit(name.removesuffix(word), side, f"last {kinds[word]}") for word, side in last]
    return [*splits, SideSplit(name, 0, "")]


def _list_word_starts(label: str, offset: int) -> frozenset[int]:
    """Return where words begin in a folded label from the letter `offset` on, counted from there."""
    starts, length = set[int](), 0
    for token in TOKEN_PATTERN.findall(label):
        starts.add(length - offset)
        length += len(token)
    return frozenset(start for start in starts if start >= 0)


def _find_first_word(name: str, word_starts: frozenset[int]) -> WordLocation | None:
    """Return the location of the first known word in a folded name, of several that begin there of the longest."""
    starts = sorted({0, *word_starts, *_list_modifier_ends(name)})
    matches = [(start, -len(word), word) for start in starts for word in _list_words_at(name, start)]
    return _load_word_locations()[min(matches)[2]] if matches else None


def _list_words_at(name: str, start: int) -> Iterator[str]:
    """Yield the known words that begin at a letter of a folded name, no modifier among them."""
    rest, modifiers = name[start:], _load_other_words("modifiers")
    first_starts = (0, *_list_modifier_ends(name))
    longest_modifier = max((len(word) for word in modifiers if rest.startswith(word)), default=0)
    for word in _load_word_locations():
        if len(word) < MIN_FIRST_WORD_LENGTH or not word.isalpha():
            is_found = start in first_starts and word in (rest, rest.rstrip("0123456789"))
        else:
            is_found = rest.startswith(word) and (len(word) >= MIN_INNER_WORD_LENGTH or start in first_starts)
        if is_found and (len(word) > longest_modifier or rest == word):
            yield word


@cache
def _list_modifier_ends(name: str) -> tuple[int, ...]:
    """Return where the modifiers at the beginning of a folded name end, one after the other."""
    ends, modifiers = [0], _load_other_words("modifiers")
    for end in ends:
        ends += [end + len(word) for word in modifiers if name.startswith(word, end) and end + len(word) not in ends]
    return tuple(ends[1:])


@cache
def _load_other_words(kind: Literal["objects", "modifiers"]) -> frozenset[str]:
    """Return the words that locate no marker: those of objects, or those that only modify others."""
    return frozenset(word.upper() for word in read_shipped_yaml(OTHER_WORDS_FILE)[kind])


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
