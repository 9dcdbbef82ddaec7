"""Labels without a meaning: those that programs number (M01, Marker_17), or that are in no marker set and have no known word."""

from collections.abc import Sequence

from mocapfix.marker_set import MarkerSet, fold_label
from mocapfix.marker_sets.label_words import guess_marker_set_from_words
from mocapfix.marker_sets.library import choose_marker_set

MAX_KNOWN_WORD_SHARE = 0.1
"""Share of labels with words for places on the body up to which labels have no meaning; some words are short."""
MAX_STEM_SHARE = 0.1
"""Number of different labels without their digits up to which labels are numbers, as a share of the labels."""


def are_labels_arbitrary(labels: Sequence[str], marker_set: MarkerSet) -> bool:
    """Return whether the labels of a take mean nothing, so that its trajectories must be labelled to be those of a marker set.

    This is so if neither the set nor a shipped one finds a body in the labels, and they are numbered or have no known words.
    """
    if not labels or not marker_set.describe_missing_body(marker_set.match_labels(labels)):
        return False
    if choose_marker_set(labels).marker_set is not None:
        return False
    names = [label.rpartition(":")[2] for label in labels]
    stems = {fold_label(name).strip("0123456789") for name in names}
    if len(stems) <= max(1.0, MAX_STEM_SHARE * len(names)):
        return True
    return len(guess_marker_set_from_words(names).labels) <= MAX_KNOWN_WORD_SHARE * len(names)
