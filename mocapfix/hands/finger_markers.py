"""The finger markers of marker sets: where they are on the hand, and which of them a take has.

A label says nothing by itself: LIDX3 is the middle of the finger in one scheme and its tip in another. So the files in
scenes/finger-markers name the marker sets of the body to which each scheme belongs, and only these are looked for in a take
whose body has such a set.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Int

from mocapfix.errors import SceneError
from mocapfix.hands.hand_model import MIRROR, Side, load_hand
from mocapfix.io.shipped import find_shipped_folder, read_yaml
from mocapfix.model.marker_set import MarkerSet

SIDES: tuple[Side, Side] = ("Left", "Right")


@dataclass(frozen=True)
class FingerMarkers:
    """The K finger markers of one hand: of a scheme, or those of them that a take has.

    Attributes:
        side: Of the hand.
        markers: The markers as a set on the hand's 21 joints, whose places hold for a hand of average length.
        columns: The index of each among the take's markers; empty for a scheme.
    """

    side: Side
    markers: MarkerSet
    columns: Int[np.ndarray, " N"]


@dataclass(frozen=True)
class FingerScheme:
    """The finger markers of both hands, and the marker sets of the body with which they are used."""

    name: str
    title: str
    marker_sets: tuple[str, ...]
    hands: tuple[MarkerSet, MarkerSet]  # left, right


@cache
def load_finger_schemes() -> tuple[FingerScheme, ...]:
    """Return the shipped schemes. Raises SceneError with the file and what is wrong."""
    return tuple(read_finger_scheme(path) for path in sorted(find_shipped_folder("scenes").glob("finger-markers/*.yaml")))


def read_finger_scheme(path: Path) -> FingerScheme:
    """Return the scheme in a file. Raises SceneError with the file and what is wrong."""
    data = read_yaml(path)
    try:
        name, title, entries = str(data["name"]), str(data["title"]), data["markers"]
        if wrong := [label for label in entries if not label.startswith("L")]:
            raise ValueError(f"{wrong[0]} must begin with L: markers of left hands are listed")
        places = list(entries.values())
        spread, aliases = np.array([float(each["spread"]) for each in places]), ((),) * len(places)
        hands: list[MarkerSet] = []
        for side in SIDES:
            joints = np.array([load_hand(side).skeleton.find_joint(f"{side}Hand{each['joint']}") for each in places])
            offsets = np.array([each["offset"] for each in places], float) * (1.0 if side == "Left" else MIRROR)
            labels = tuple(side[0] + label[1:] for label in entries)
            hands.append(MarkerSet(name, title, f"{side.lower()} hand", labels, joints, offsets, spread, aliases))
        return FingerScheme(name, title, tuple(data["marker_sets"]), (hands[0], hands[1]))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise SceneError(f"{path}: must hold name, title, marker_sets and markers ({error}).") from error


def find_finger_markers(marker_set_name: str, labels: tuple[str, ...]) -> tuple[FingerMarkers, ...]:
    """Return the finger markers of a take whose body has a marker set, for each hand that has any.

    Args:
        marker_set_name: Of the body.
        labels: Of the take.
    """
    for scheme in load_finger_schemes():
        if marker_set_name in scheme.marker_sets:
            found = [FingerMarkers(side, hand, hand.find_columns(labels)) for side, hand in zip(SIDES, scheme.hands, strict=True)]
            return tuple(select_shown(each) for each in found if (each.columns >= 0).any())
    return ()


def select_shown(hand: FingerMarkers) -> FingerMarkers:
    """Return the markers that the take has."""
    shown = hand.columns >= 0
    labels = {label for label, is_shown in zip(hand.markers.labels, shown, strict=True) if is_shown}
    return FingerMarkers(hand.side, hand.markers.select_markers(labels), hand.columns[shown])
