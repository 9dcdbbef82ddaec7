"""Marker sets: which labels there are, which joint each marker rides on, and where; and which set a take wears.

nominal  a set: its markers on the average body, and which of them a take has
labels   how studios spell a marker: prefixes, case, marks between the words
file     sets as YAML, those that travel with mocapfix and one's own
choice   the set that a take's labels fit
words    what labels of no set tell
"""

from mocapfix.marker_set import LIMB_JOINT_NAMES, MarkerSet
from mocapfix.marker_sets.library import build_subject_marker_set, load_marker_set, load_shipped_marker_sets, write_marker_set
from mocapfix.marker_sets.matching import MarkerSetMatch, choose_marker_set, describe_marker_set_match

__all__ = [
    "LIMB_JOINT_NAMES",
    "MarkerSet",
    "MarkerSetMatch",
    "build_subject_marker_set",
    "choose_marker_set",
    "describe_marker_set_match",
    "load_marker_set",
    "load_shipped_marker_sets",
    "write_marker_set",
]
