"""The finger markers of marker sets: where they are on the hand, and which of them a take has.

A label says nothing by itself: LIDX3 is the middle of the finger in one scheme and its tip in another. So the files in
scenes/finger-markers name the marker sets of the body to which each scheme belongs, and only these are looked for in a take
whose body has such a set.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
from jaxtyping import Int

from mocapfix.errors import SceneError
from mocapfix.hands.hand_model import MIRROR, RAY_ROOTS, Side, load_hand
from mocapfix.io.shipped import find_shipped_folder, read_yaml
from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.skeleton import load_cmu31_body, restrict_body

SIDES: tuple[Side, Side] = ("Left", "Right")
MAX_CENTRE_DISTANCE_M = 0.008  # of a point that is at the centre of a joint; no marker on the skin is as near


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

    @property
    def turning_joints(self) -> Int[np.ndarray, " N"]:
        """The joint whose rotation moves each marker, 0 for the palm: the joint before a point at the centre of a joint."""
        joints, before = self.markers.joints, load_hand(self.side).skeleton.parents[self.markers.joints]
        is_centre = (joints > 0) & (np.linalg.norm(self.markers.marker_offsets, axis=1) < MAX_CENTRE_DISTANCE_M)
        return np.where(is_centre, np.where(np.isin(before, RAY_ROOTS), 0, before), joints)


@dataclass(frozen=True)
class FingerScheme:
    """The finger markers of both hands, and the marker sets of the body with which they are used."""

    name: str
    title: str
    marker_sets: tuple[str, ...]
    hands: tuple[MarkerSet, MarkerSet]  # left, right
    sets: tuple[frozenset[str], ...]  # the labels of a left hand that are used together


@cache
def load_finger_schemes() -> tuple[FingerScheme, ...]:
    """Return the shipped schemes. Raises SceneError with the file and what is wrong."""
    return tuple(read_finger_scheme(path) for path in sorted(find_shipped_folder("scenes").glob("finger-markers/*.yaml")))


def read_finger_scheme(path: Path) -> FingerScheme:
    """Return the scheme in a file. Raises SceneError with the file and what is wrong."""
    data = read_yaml(path)
    try:
        name, title, entries = str(data["name"]), str(data["title"]), data["markers"]
        if wrong := [label for label in entries if not label.startswith(("L", "left_"))]:
            raise ValueError(f"{wrong[0]} must begin with L or left_: markers of left hands are listed")
        places, point_sd = list(entries.values()), float(data.get("point_sd", 0.0))
        spread = np.array([float(each["spread"]) for each in places])
        hands: list[MarkerSet] = []
        for side in SIDES:
            joints = np.array([load_hand(side).skeleton.find_joint(f"{side}Hand{each['joint']}") for each in places])
            offsets = np.array([each["offset"] for each in places], float) * (1.0 if side == "Left" else MIRROR)
            labels = tuple(_rename(label, side) for label in entries)
            aliases = tuple(tuple(_rename(alias, side) for alias in each.get("aliases", ())) for each in places)
            of_hand = f"{side.lower()} hand", labels, joints, offsets, spread, aliases
            hands.append(MarkerSet(name, title, *of_hand, point_sd=point_sd))
        sets = tuple(map(frozenset, data.get("sets", [entries])))
        return FingerScheme(name, title, tuple(data["marker_sets"]), (hands[0], hands[1]), sets)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise SceneError(f"{path}: must hold name, title, marker_sets and markers ({error}).") from error


def _rename(label: str, side: Side) -> str:
    """Return a label of a left hand for the hand of a side."""
    return side.lower() + label.removeprefix("left") if label.startswith("left") else side[0] + label[1:]


def find_finger_markers(marker_set_name: str, labels: tuple[str, ...]) -> tuple[FingerMarkers, ...]:
    """Return the finger markers of a take whose body has a marker set, for each hand that shows any finger beyond its knuckle.

    Of several schemes of the marker set it is the one with the most of the labels.

    Args:
        marker_set_name: Of the body.
        labels: Of the take.
    """
    found = [
        [FingerMarkers(side, hand, hand.find_columns(labels)) for side, hand in zip(SIDES, scheme.hands, strict=True)]
        for scheme in load_finger_schemes()
        if marker_set_name in scheme.marker_sets
    ]
    most = max(found, key=lambda hands: (sum((each.columns >= 0).sum() for each in hands), -len(hands[0].columns)), default=[])
    return tuple(select_shown(each) for each in most if ((each.columns >= 0) & (each.turning_joints > 0)).any())


def select_carried(hands: Iterable[FingerMarkers], joints: Int[np.ndarray, " K"]) -> tuple[FingerMarkers, ...]:
    """Return the hands whose forearm a body with markers on these joints shows: without that no palm carries them."""
    body = restrict_body(load_cmu31_body(), set(joints.tolist()))
    return tuple(each for each in hands if body.solved_joints[body.skeleton.find_joint(f"{each.side}Hand")])


def list_finger_sets(marker_set_name: str) -> list[tuple[FingerMarkers, FingerMarkers]]:
    """Return the finger markers of left and right hands that are used together with a marker set of the body."""
    return [
        (select(SIDES[0]), select(SIDES[1]))
        for scheme in load_finger_schemes()
        if marker_set_name in scheme.marker_sets
        for labels in scheme.sets
        for select in [partial(_select_markers, scheme, labels)]
    ]


def _select_markers(scheme: FingerScheme, labels: frozenset[str], side: Side) -> FingerMarkers:
    own = scheme.hands[SIDES.index(side)].select_markers({side[0] + label[1:] for label in labels})
    return FingerMarkers(side, own, np.full(len(own.labels), -1))


def select_shown(hand: FingerMarkers) -> FingerMarkers:
    """Return the markers that the take has."""
    shown = hand.columns >= 0
    labels = {label for label, is_shown in zip(hand.markers.labels, shown, strict=True) if is_shown}
    return FingerMarkers(hand.side, hand.markers.select_markers(labels), hand.columns[shown])
