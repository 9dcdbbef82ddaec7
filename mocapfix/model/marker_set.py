"""Marker sets: the markers of a set on the average body, and how they are matched with the labels of a take."""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int

from mocapfix.errors import format_name_list
from mocapfix.model.skeleton import BODY_SECTIONS, MIN_WHOLE_BODY_LIMBS, load_cmu31_body
from mocapfix.model.take import SUBJECT_SEPARATORS

LABEL_SEPARATORS = re.compile(r"[\s._-]+")  # the characters between the words of a label
MIN_REQUIRED_MARKER_FRACTION = 0.6  # the fraction of the required markers of a set that a take must have to show a whole body
MIN_MARKERS_PER_LIMB = 2  # the number of markers on a limb with which its pose can be estimated
MIN_SECTION_MARKERS = 3  # the number of markers on a section of the body with which it belongs to a part of a body
MIN_SECTION_MARKER_FRACTION = 0.6
"""the fraction of the required markers on a section that a take must have, so that a few equal labels are no match"""
MIN_SINGLE_LIMB_MARKERS = 5  # the number of markers on a limb with which it is a part of a body without pelvis or trunk
MIN_SINGLE_SEGMENT_MARKERS = 2  # the number of them on its upper and on its lower segment
SHOULDER_JOINTS = frozenset(("LeftArm", "RightArm"))  # joints whose centres move with the thorax: both of them locate it
ARMS, LEGS = ("left arm", "right arm"), ("left leg", "right leg")
MAX_LISTED_MISSING = 4  # missing markers that a sentence lists after the limbs that cannot be located
MAX_LISTED_PARTS = 3  # parts of the body that a sentence lists
LIMB_JOINT_NAMES = {
    "left arm": ("LeftArm", "LeftForeArm", "LeftHand"),
    "right arm": ("RightArm", "RightForeArm", "RightHand"),
    "left leg": ("LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase"),
    "right leg": ("RightUpLeg", "RightLeg", "RightFoot", "RightToeBase"),
}
MAX_MISSING_LIMBS = len(LIMB_JOINT_NAMES) - MIN_WHOLE_BODY_LIMBS  # the number of limbs that may have fewer markers


@dataclass(frozen=True)
class MarkerSet:
    """K markers on the average body.

    Attributes:
        name: The name by which --marker-set and subject files refer to the set.
        title: The name in texts.
        skeleton: The name of the skeleton.
        labels: K names.
        joints: The index of the joint to which each marker is attached.
        marker_offsets: Metres: the position of each marker in the axes of its joint.
        marker_spread: Metres: standard deviation per axis, over people, of the marker about its offset.
        aliases: For each marker, its other names.
        optional_labels: Those of the labels that a complete set may lack.
        other_names: Other names of the set.
        point_sd: Metres: standard deviation per axis of a point of the set in one frame; 0 for markers, whose errors options
            state.
        props: Labels of the markers on each prop, by its name; they are not on the body.
        is_laboratory: Whether the set is one of laboratories that measure gait or sports, rather than of animation.
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
    point_sd: float = 0.0
    props: Mapping[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])
    is_laboratory: bool = False

    @property
    def required_labels(self) -> tuple[str, ...]:
        """The labels that a complete set has."""
        return tuple(label for label in self.labels if label not in self.optional_labels)

    @property
    def covers_whole_body(self) -> bool:
        """Whether the set has markers on every section of the body."""
        return all(self._group_labels().values())

    def match_labels(self, labels: Sequence[str]) -> dict[str, int]:
        """Return the index among a take's labels of each marker of this set that the take has, by the marker's name.

        Case and separators are ignored. A marker's own name takes precedence over its aliases, and the first of several equal
        labels counts. If labels have subject prefixes ("Jim:LFHD", "Q_LThigh"), the prefix with the most markers of this set is
        used.
        """
        return max((self.match_names(names) for names in index_labels_by_prefix(labels).values()), key=len, default={})

    def find_columns(self, labels: Sequence[str]) -> Int[np.ndarray, " K"]:
        """Return the index of each marker of this set among a take's labels, -1 for those that the take does not have."""
        found = self.match_labels(labels)
        return np.array([found.get(label, -1) for label in self.labels], int)

    def list_missing_labels(self, found_labels: Collection[str]) -> tuple[str, ...]:
        """Return the required markers that are not among `found_labels`."""
        return tuple(label for label in self.required_labels if label not in found_labels)

    def find_shown_sections(self, found_labels: Collection[str]) -> tuple[str, ...]:
        """Return the sections (BODY_SECTIONS) of the body, or of the part of a body, that the markers `found_labels` show.

        A part is connected: a pelvis with legs, a trunk with arms and head, both, or a single limb. Each of its sections has
        most of its required markers; a pelvis between two legs may have fewer. Returns an empty tuple if there is neither a
        whole body nor such a part.
        """
        labels_of_section = self._group_labels()
        found = {section: [x for x in labels if x in found_labels] for section, labels in labels_of_section.items()}
        if not self.describe_incomplete_body(found_labels):
            return tuple(section for section, labels in found.items() if labels)
        shown = {section for section, labels in found.items() if self._shows_section(labels, labels_of_section[section])}
        single_limbs = {limb for limb in shown.intersection(LIMB_JOINT_NAMES) if self._shows_single_limb(limb, found[limb])}
        if single_limbs.issuperset(LEGS) and found["pelvis"]:
            shown.add("pelvis")
        legs, arms = shown.intersection(LEGS), shown.intersection(ARMS)
        lower, upper = {"pelvis", *legs}, (shown & {"trunk", "head"}) | arms
        groups = [lower] if legs and "pelvis" in shown else []
        groups += [upper] if arms and "trunk" in shown else []
        if {"pelvis", "trunk"} <= shown and groups:
            groups = [lower | upper]
        groups = groups or [{limb} for limb in sorted(single_limbs)]
        part = max(groups, key=lambda group: sum(len(found[section]) for section in group), default=set[str]())
        return tuple(section for section in BODY_SECTIONS if section in part)

    def select_shown_part(self, found_labels: Collection[str]) -> "MarkerSet":
        """Return the set without the markers of the joints that the markers `found_labels` do not show.

        A set all of whose joints are shown is returned as it is, with the markers that were not found.
        """
        sections, labels_of_section = self.find_shown_sections(found_labels), self._group_labels()
        candidates = {label for section in sections for label in labels_of_section[section]}
        joint_of_label = dict(zip(self.labels, self.joints.tolist(), strict=True))
        shown_joints = {joint_of_label[label] for label in candidates.intersection(found_labels)}
        return self.select_markers({label for label in candidates if joint_of_label[label] in shown_joints})

    def select_markers(self, labels: Collection[str]) -> "MarkerSet":
        """Return the set with those of its markers that are among `labels`."""
        kept = [k for k, label in enumerate(self.labels) if label in labels]
        if len(kept) == len(self.labels):
            return self
        return replace(
            self,
            labels=tuple(self.labels[k] for k in kept),
            joints=self.joints[kept],
            marker_offsets=self.marker_offsets[kept],
            marker_spread=self.marker_spread[kept],
            aliases=tuple(self.aliases[k] for k in kept),
            optional_labels=self.optional_labels.intersection(labels),
        )

    def describe_missing_body(self, found_labels: Collection[str], max_listed: int = MAX_LISTED_MISSING) -> str:
        """Return why the markers `found_labels` show neither a whole body nor a part, as part of a sentence; "" if they do.

        Args:
            max_listed: The number of missing markers that it lists; none if it is 0.
        """
        return "" if self.find_shown_sections(found_labels) else self.describe_incomplete_body(found_labels, max_listed)

    def describe_incomplete_body(self, found_labels: Collection[str], max_listed: int = MAX_LISTED_MISSING) -> str:
        """Return the same of markers that do not show a whole body.

        A whole body has markers on hips and thorax, at least three limbs, and most of the required markers. Keypoints at both
        shoulders locate the thorax.
        """
        joint_names = load_cmu31_body().skeleton.names
        marked = [joint_names[j] for label, j in zip(self.labels, self.joints, strict=True) if label in found_labels]
        has_shoulders = SHOULDER_JOINTS.issubset(self._find_joint_centres(found_labels))
        is_missing = {"hips": "Hips" not in marked, "thorax": "Spine1" not in marked and not has_shoulders}
        missing_trunk = [part for part, missing in is_missing.items() if missing]
        missing_limbs = [
            limb for limb, joints in LIMB_JOINT_NAMES.items() if sum(joint in joints for joint in marked) < MIN_MARKERS_PER_LIMB
        ]
        missing_labels = self.list_missing_labels(found_labels)
        if missing_trunk or len(missing_limbs) > MAX_MISSING_LIMBS:
            reason = f"the {format_name_list([*missing_trunk, *missing_limbs], MAX_LISTED_PARTS)} cannot be located"
        elif len(missing_labels) > (1 - MIN_REQUIRED_MARKER_FRACTION) * len(self.required_labels):
            reason = f"at least {MIN_REQUIRED_MARKER_FRACTION:.0%} are needed"
        else:
            return ""
        return f"{reason}; not found: {format_name_list(missing_labels, max_listed)}" if max_listed else reason

    def _find_joint_centres(self, found_labels: Collection[str]) -> set[str]:
        """Return the joints at whose centres there are keypoints among `found_labels`."""
        joint_names = load_cmu31_body().skeleton.names
        rows = [k for k, label in enumerate(self.labels) if label in found_labels]
        return {joint_names[self.joints[k]] for k in rows if not self.marker_offsets[k].any()}

    def _group_labels(self) -> dict[str, list[str]]:
        """Return the labels of the markers on each section of the body."""
        joint_names = load_cmu31_body().skeleton.names
        names = dict(zip(self.labels, (joint_names[j] for j in self.joints), strict=True))
        return {section: [label for label in self.labels if names[label] in joints] for section, joints in BODY_SECTIONS.items()}

    def _shows_section(self, found: Collection[str], labels: Collection[str]) -> bool:
        required = [label for label in labels if label not in self.optional_labels]
        found_required = [label for label in required if label in found]
        return len(found) >= MIN_SECTION_MARKERS and len(found_required) >= MIN_SECTION_MARKER_FRACTION * len(required)

    def _shows_single_limb(self, limb: str, found: Collection[str]) -> bool:
        joint_names = load_cmu31_body().skeleton.names
        joints = [joint_names[j] for label, j in zip(self.labels, self.joints, strict=True) if label in found]
        is_marked = all(joints.count(segment) >= MIN_SINGLE_SEGMENT_MARKERS for segment in LIMB_JOINT_NAMES[limb][:2])
        return is_marked and len(found) >= MIN_SINGLE_LIMB_MARKERS

    def match_names(self, index_of_name: Mapping[str, int]) -> dict[str, int]:
        """Return the index of each marker of this set, by the marker's name, from those of folded names without prefixes."""
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
    for separator in SUBJECT_SEPARATORS.finditer(name):
        if fold_label(name[separator.end() :]):
            yield subject + colon + name[: separator.end()], fold_label(name[separator.end() :])


def index_labels_by_prefix(labels: Sequence[str]) -> dict[str, dict[str, int]]:
    """Return for every possible prefix the folded names with the index of the first label that has them."""
    index_of_name: dict[str, dict[str, int]] = {}
    for index, label in enumerate(labels):
        for prefix, name in iterate_label_readings(label):
            index_of_name.setdefault(prefix, {}).setdefault(name, index)
    return index_of_name
