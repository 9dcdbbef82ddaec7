"""A marker set: its markers on the average body, and which of them are among a take's labels."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from mocapfix.marker_set.labels import folded, listed, of_subjects
from mocapfix.skeleton import cmu31

SHARE = 0.6  # of a set's markers: with fewer the body is guessed rather than seen
LIMB_MARKERS = 2  # on a limb before it counts as seen
LIMBS = {
    "left arm": ("LeftArm", "LeftForeArm", "LeftHand"),
    "right arm": ("RightArm", "RightForeArm", "RightHand"),
    "left leg": ("LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase"),
    "right leg": ("RightUpLeg", "RightLeg", "RightFoot", "RightToeBase"),
}


@dataclass(frozen=True)
class MarkerSet:
    """K markers on the average body.

    name      what --marker-set and a subject file call it
    title     what people call it
    skeleton  the name of the skeleton it is for
    labels    K names
    joints    (K,) index of the joint each marker rides on
    places    (K, 3) metres: the marker in its joint's axes
    spread    (K,) metres: standard deviation per axis of one person's marker about its place
    aliases   K tuples of other names for the marker
    optional  those of the labels that a whole set may do without
    also_called  other names of the set itself
    """

    name: str
    title: str
    skeleton: str
    labels: tuple[str, ...]
    joints: np.ndarray
    places: np.ndarray
    spread: np.ndarray
    aliases: tuple[tuple[str, ...], ...]
    optional: frozenset[str] = frozenset()
    also_called: tuple[str, ...] = ()

    @property
    def required(self) -> tuple[str, ...]:
        """The labels that a whole set has."""
        return tuple(label for label in self.labels if label not in self.optional)

    def match(self, labels: Sequence[str]) -> dict[str, int]:
        """-> this set's marker name: index among a take's labels, for the markers that are there.

        Case and the marks between words do not matter, a marker's own name goes before its aliases, and the first of several
        equal labels counts. Where labels carry subjects' prefixes ("Jim:LFHD", "Q_LThigh"), the subject with the most of this
        set's markers is taken.
        """
        return max((self._named(names) for names in of_subjects(labels).values()), key=len, default={})

    def columns(self, labels: Sequence[str]) -> np.ndarray:
        """-> (K,) the index of each of this set's markers among a take's labels, -1 where it is not there."""
        found = self.match(labels)
        return np.array([found.get(label, -1) for label in self.labels])

    def _named(self, indices: dict[str, int]) -> dict[str, int]:
        found = {}
        for label, aliases in zip(self.labels, self.aliases, strict=True):
            there = [indices[name] for name in map(folded, (label, *aliases)) if name in indices]
            if there:
                found[label] = there[0]
        return found

    def absent(self, found: Collection[str]) -> tuple[str, ...]:
        """-> the markers of a whole set that are not among `found`."""
        return tuple(label for label in self.required if label not in found)

    def lack(self, found: Collection[str]) -> str:
        """-> what the markers `found` lack to show a whole body, as part of a sentence; "" where they show one."""
        joints = [cmu31().skeleton.names[j] for label, j in zip(self.labels, self.joints, strict=True) if label in found]
        missing = [part for part, joint in (("hips", "Hips"), ("thorax", "Spine1")) if joint not in joints]
        hidden = [limb for limb, bones in LIMBS.items() if sum(joint in bones for joint in joints) < LIMB_MARKERS]
        absent = self.absent(found)
        if missing or len(hidden) > 1:
            need = f"the {listed([*missing, *hidden])} can hardly be seen"
        elif len(absent) > (1 - SHARE) * len(self.required):
            need = f"at least {SHARE:.0%} are needed"
        else:
            return ""
        return f"{need}; not found: {listed(absent)}"
