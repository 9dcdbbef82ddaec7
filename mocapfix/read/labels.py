"""Telling markers from the other points of a file: model outputs and unlabelled trajectories."""

import re
from collections.abc import Sequence, Set

import numpy as np

# What Vicon, Qualisys, Motive and Cortex call a trajectory that nobody named; so is a label without any letter ("*12").
UNLABELLED = re.compile(r"(uname|unlabell?ed|unnamed|unidentified|new |c_)[\s_*]*\d*", re.IGNORECASE)
# ... and Qualisys so one that was chosen and not named yet: where none has a better name, those are the markers.
CHOSEN = re.compile(r"new \d+", re.IGNORECASE)
OUTPUT = re.compile(r".*(Angles?|Forces?|Moments?|Powers?|GRF|CentreOfMass(Floor)?)")
# Plug-in Gait gives every segment as four points: origin, and the ends of its anterior, lateral and proximal axes.
SEGMENT = ("O", "A", "L", "P")
# Fewer computed points than this at the end of a file may as well be markers that somebody edited throughout.
FEWEST_OUTPUTS = 3
RESIDUAL_BYTE = 255


def marker_columns(labels: Sequence[str], outputs: Set[str], seen: np.ndarray, words: np.ndarray) -> np.ndarray:
    """-> (M,) indices of the points that are markers, among P points in the file's order.

    labels   P labels, blanks stripped
    outputs  labels that the file lists as model outputs
    seen     (T, P) bool: the sample is valid
    words    (T, P) residual words: cameras in the high byte, residual in the low one

    A point is a marker unless nobody named it, it is named or listed as a model output, or computed: in files that keep
    the cameras, Vicon appends what its models give behind the last point that cameras saw, all words 0. (A sample
    that mocapfix filled has a residual and no cameras, so a mended file has the same markers as before.)
    """
    names = set(labels)
    is_marker = ~_nameless(labels, outputs)
    is_marker &= [not _is_output(label, outputs) and not _is_segment(label, names) for label in labels]
    highest = np.max(words, axis=0, where=seen, initial=-1)
    measured = np.flatnonzero(highest > RESIDUAL_BYTE)
    if len(measured):
        computed = is_marker & (highest == 0) & (np.arange(len(labels)) > measured[-1])
        if computed.sum() >= FEWEST_OUTPUTS:
            is_marker &= ~computed
    return np.flatnonzero(is_marker)


def unlabelled_columns(labels: Sequence[str], outputs: Set[str], seen: np.ndarray) -> np.ndarray:
    """-> (U,) indices of the points that nobody named and that are `seen` (T, P) at some time."""
    listed = np.array([label in outputs for label in labels], bool)
    return np.flatnonzero(_nameless(labels, outputs) & ~listed & seen.any(0))


def _nameless(labels: Sequence[str], outputs: Set[str]) -> np.ndarray:
    """-> (P,) bool: did nobody name the point?"""
    nameless = np.array([is_nameless(label) for label in labels], bool)
    if all(unnamed or _is_output(label, outputs) for unnamed, label in zip(nameless, labels, strict=True)):
        nameless &= [CHOSEN.fullmatch(_bare(label)) is None for label in labels]
    return nameless


def _is_output(label: str, outputs: Set[str]) -> bool:
    return label in outputs or OUTPUT.fullmatch(_bare(label)) is not None


def is_nameless(label: str) -> bool:
    """-> is it what a program calls a trajectory that nobody named?"""
    return not any(c.isalpha() for c in _bare(label)) or UNLABELLED.fullmatch(_bare(label)) is not None


def _bare(label: str) -> str:
    return label.rsplit(":", 1)[-1].strip()


def _is_segment(label: str, names: Set[str]) -> bool:
    stem = label[:-1]
    return len(stem.rsplit(":", 1)[-1]) == 3 and label[-1] in SEGMENT and all(stem + end in names for end in SEGMENT)
