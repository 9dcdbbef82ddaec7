"""How studios spell a marker's name: whose it is, and what it is called whatever the case and the marks between its words."""

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mocapfix.skeleton import load_cmu31_body

# MERGED: mocapfix.marker_set.labels
LABEL_SEPARATORS = re.compile(r"[\s._-]+")


def fold_label(name: str) -> str:
    """-> a name without case and without the marks between its words: R.Thigh.Upper, R_Thigh_Upper and rthighupper are one."""
    return LABEL_SEPARATORS.sub("", name).upper()


def iterate_label_readings(label: str) -> Iterator[tuple[str, str]]:
    """-> the ways to read a label as a subject's prefix and a marker's folded name.

    "Jim:LFHD" is Jim's. "Q_LThigh" may be a marker of that name or Q's LThigh, "Skeleton_2_LThigh" one of Skeleton_2.
    """
    subject, colon, name = label.rpartition(":")
    yield subject + colon, fold_label(name)
    for mark in re.finditer("_", name):
        if fold_label(name[mark.end() :]):
            yield subject + colon + name[: mark.end()], fold_label(name[mark.end() :])


def index_labels_by_prefix(labels: Sequence[str]) -> dict[str, dict[str, int]]:
    """-> for every prefix, folded names and the index of the first label that reads so."""
    subjects: dict[str, dict[str, int]] = {}
    for index, label in enumerate(labels):
        for prefix, name in iterate_label_readings(label):
            subjects.setdefault(prefix, {}).setdefault(name, index)
    return subjects


def format_name_list(names: Sequence[str], max_count: int = 12) -> str:
    """-> names as one reads them in a sentence, the first dozen and how many more."""
    if not names:
        return "(none)"
    more = f" and {len(names) - max_count} more" if len(names) > max_count else ""
    return ", ".join(names[:max_count]) + more


# MERGED: mocapfix.marker_set.nominal
# A marker set: its markers on the average body, and which of them are among a take's labels.
MIN_REQUIRED_MARKER_FRACTION = 0.6  # of a set's markers: with fewer the body is guessed rather than seen
MIN_MARKERS_PER_LIMB = 2  # on a limb before it counts as seen
LIMB_JOINT_NAMES = {
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
    marker_offsets: np.ndarray
    marker_spread: np.ndarray
    aliases: tuple[tuple[str, ...], ...]
    optional_labels: frozenset[str] = frozenset()
    other_names: tuple[str, ...] = ()

    @property
    def required_labels(self) -> tuple[str, ...]:
        """The labels that a whole set has."""
        return tuple(label for label in self.labels if label not in self.optional_labels)

    def match_labels(self, labels: Sequence[str]) -> dict[str, int]:
        """-> this set's marker name: index among a take's labels, for the markers that are there.

        Case and the marks between words do not matter, a marker's own name goes before its aliases, and the first of several
        equal labels counts. Where labels carry subjects' prefixes ("Jim:LFHD", "Q_LThigh"), the subject with the most of this
        set's markers is taken.
        """
        return max((self._match_names(names) for names in index_labels_by_prefix(labels).values()), key=len, default={})

    def find_columns(self, labels: Sequence[str]) -> np.ndarray:
        """-> (K,) the index of each of this set's markers among a take's labels, -1 where it is not there."""
        found = self.match_labels(labels)
        return np.array([found.get(label, -1) for label in self.labels])

    def _match_names(self, indices: dict[str, int]) -> dict[str, int]:
        found = {}
        for label, aliases in zip(self.labels, self.aliases, strict=True):
            there = [indices[name] for name in map(fold_label, (label, *aliases)) if name in indices]
            if there:
                found[label] = there[0]
        return found

    def list_missing_labels(self, found_labels: Collection[str]) -> tuple[str, ...]:
        """-> the markers of a whole set that are not among `found`."""
        return tuple(label for label in self.required_labels if label not in found_labels)

    def describe_missing_body(self, found_labels: Collection[str]) -> str:
        """-> what the markers `found` lack to show a whole body, as part of a sentence; "" where they show one."""
        joints = [
            load_cmu31_body().skeleton.names[j]
            for label, j in zip(self.labels, self.joints, strict=True)
            if label in found_labels
        ]
        missing = [part for part, joint in (("hips", "Hips"), ("thorax", "Spine1")) if joint not in joints]
        hidden = [
            limb for limb, bones in LIMB_JOINT_NAMES.items() if sum(joint in bones for joint in joints) < MIN_MARKERS_PER_LIMB
        ]
        absent = self.list_missing_labels(found_labels)
        if missing or len(hidden) > 1:
            need = f"the {format_name_list([*missing, *hidden])} can hardly be seen"
        elif len(absent) > (1 - MIN_REQUIRED_MARKER_FRACTION) * len(self.required_labels):
            need = f"at least {MIN_REQUIRED_MARKER_FRACTION:.0%} are needed"
        else:
            return ""
        return f"{need}; not found: {format_name_list(absent)}"
