"""Marker sets: the markers of a set on the average body, and how they are matched with the labels of a take."""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mocapfix.skeleton import load_cmu31_body

LABEL_SEPARATORS = re.compile(r"[\s._-]+")
"""the characters between the words of a label"""
MIN_REQUIRED_MARKER_FRACTION = 0.6
"""the fraction of the required markers of a set that a take must have to show a whole body"""
MIN_MARKERS_PER_LIMB = 2
"""the number of markers on a limb with which its pose can be estimated"""
MAX_MISSING_LIMBS = 1
"""the number of limbs that may have fewer markers"""
MAX_LISTED_NAMES = 12
"""the number of names that messages list"""
LIMB_JOINT_NAMES = {
    "left arm": ("LeftArm", "LeftForeArm", "LeftHand"),
    "right arm": ("RightArm", "RightForeArm", "RightHand"),
    "left leg": ("LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase"),
    "right leg": ("RightUpLeg", "RightLeg", "RightFoot", "RightToeBase"),
}


@dataclass(frozen=True)
class MarkerSet:
    """K markers on the average body.

    name             the name by which --marker-set and subject files refer to the set
    title            the name in texts
    skeleton         the name of the skeleton
    labels           K names
    joints           (K,) the index of the joint to which each marker is attached
    marker_offsets   (K, 3) m: the position of each marker in the axes of its joint
    marker_spread    (K,) m: standard deviation per axis, over people, of the marker about its offset
    aliases          for each marker, its other names
    optional_labels  those of the labels that a complete set may lack
    other_names      other names of the set
    """

    name: str
    title: str
    skeleton: str
    labels: tuple[str, ...]
    joints: Int[np.ndarray, " K"]
    marker_offsets: Float[np.ndarray, "K 3"]
    marker_spread: Float[np.ndarray, " K"]
    aliases: tuple[tuple[str, ...], ...]
    optional_labels: frozenset[str] = frozenset()
    other_names: tuple[str, ...] = ()

    @property
    def required_labels(self) -> tuple[str, ...]:
        """The labels that a complete set has."""
        return tuple(label for label in self.labels if label not in self.optional_labels)

    def match_labels(self, labels: Sequence[str]) -> dict[str, int]:
        """Return the index among a take's labels of each marker of this set that the take has, by the marker's name.

        Case and separators are ignored. A marker's own name takes precedence over its aliases, and the first of several equal
        labels counts. If labels have subject prefixes ("Jim:LFHD", "Q_LThigh"), the prefix with the most markers of this set is
        used.
        """
        return max((self._match_names(names) for names in index_labels_by_prefix(labels).values()), key=len, default={})

    def find_columns(self, labels: Sequence[str]) -> Int[np.ndarray, " K"]:
        """Return the index of each marker of this set among a take's labels, -1 for those that the take does not have."""
        found = self.match_labels(labels)
        return np.array([found.get(label, -1) for label in self.labels], int)

    def list_missing_labels(self, found_labels: Collection[str]) -> tuple[str, ...]:
        """Return the required markers that are not among `found_labels`."""
        return tuple(label for label in self.required_labels if label not in found_labels)

    def describe_missing_body(self, found_labels: Collection[str]) -> str:
        """Return why the markers `found_labels` do not show a whole body, as part of a sentence; "" if they do.

        A whole body has markers on hips and thorax, at least three limbs, and most of the required markers.
        """
        joint_names = load_cmu31_body().skeleton.names
        marked = [joint_names[j] for label, j in zip(self.labels, self.joints, strict=True) if label in found_labels]
        missing_trunk = [part for part, joint in (("hips", "Hips"), ("thorax", "Spine1")) if joint not in marked]
        missing_limbs = [
            limb for limb, joints in LIMB_JOINT_NAMES.items() if sum(joint in joints for joint in marked) < MIN_MARKERS_PER_LIMB
        ]
        missing_labels = self.list_missing_labels(found_labels)
        if missing_trunk or len(missing_limbs) > MAX_MISSING_LIMBS:
            reason = f"the {format_name_list([*missing_trunk, *missing_limbs])} cannot be located"
        elif len(missing_labels) > (1 - MIN_REQUIRED_MARKER_FRACTION) * len(self.required_labels):
            reason = f"at least {MIN_REQUIRED_MARKER_FRACTION:.0%} are needed"
        else:
            return ""
        return f"{reason}; not found: {format_name_list(missing_labels)}"

    def _match_names(self, index_of_name: Mapping[str, int]) -> dict[str, int]:
        found: dict[str, int] = {}
        for label, aliases in zip(self.labels, self.aliases, strict=True):
            indices = [index_of_name[name] for name in map(fold_label, (label, *aliases)) if name in index_of_name]
            if indices:
                found[label] = indices[0]
        return found


def fold_label(name: str) -> str:
    """Return a name in upper case without separators: R.Thigh.Upper, R_Thigh_Upper and rthighupper become equal."""
    return LABEL_SEPARATORS.sub("", name).upper()


def iterate_label_readings(label: str) -> Iterator[tuple[str, str]]:
    """Yield the possible splits of a label into a subject prefix and a folded marker name.

    "Jim:LFHD" has one split; "Q_LThigh" may be a marker of that name, or the marker LThigh of the subject Q.
    """
    subject, colon, name = label.rpartition(":")
    yield subject + colon, fold_label(name)
    for separator in re.finditer("_", name):
        if fold_label(name[separator.end() :]):
            yield subject + colon + name[: separator.end()], fold_label(name[separator.end() :])


def index_labels_by_prefix(labels: Sequence[str]) -> dict[str, dict[str, int]]:
    """Return for every possible prefix the folded names with the index of the first label that has them."""
    index_of_name: dict[str, dict[str, int]] = {}
    for index, label in enumerate(labels):
        for prefix, name in iterate_label_readings(label):
            index_of_name.setdefault(prefix, {}).setdefault(name, index)
    return index_of_name


def format_name_list(names: Sequence[str], max_count: int = MAX_LISTED_NAMES) -> str:
    """Return names as a list in a sentence: the first `max_count`, and the number of the others."""
    if not names:
        return "(none)"
    more = f" and {len(names) - max_count} more" if len(names) > max_count else ""
    return ", ".join(names[:max_count]) + more
