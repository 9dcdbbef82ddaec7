"""Marker sets as files, and which of them fits a take.

library      the shipped sets and those of a studio, as YAML
matching     the set that the labels of a take fit
label_words  the segment of a marker from the words in its label
learning     a new set from a take, from an initial guess
own_set      the set of a take that no known set fits
"""

from mocapfix.marker_sets.library import (
    MarkerSetMatch,
    build_subject_marker_set,
    choose_marker_set,
    describe_marker_set_match,
    load_marker_set,
    load_shipped_marker_sets,
    write_marker_set,
)

__all__ = [
    "MarkerSetMatch",
    "build_subject_marker_set",
    "choose_marker_set",
    "describe_marker_set_match",
    "load_marker_set",
    "load_shipped_marker_sets",
    "write_marker_set",
]
