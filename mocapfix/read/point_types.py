"""Telling samples that a program put into a C3D from those that cameras measured."""

import re
from collections.abc import Sequence, Set

import numpy as np

# MERGED: mocapfix.read.computed
MAX_RESIDUAL_COUNTS = 255
MIN_CAMERA_FRACTION = 0.9  # of the samples: where so many carry their cameras, the others have none because none saw them
MAX_COMPUTED_FRACTION = (
    0.5  # of the samples: where more have a residual and no cameras, the file keeps no cameras and all were measured
)


def detect_computed_samples(residual_words: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """-> (T, P) bool: samples with a residual that no camera contributed to, as mocapfix fills gaps, in a file whose other
    samples carry their cameras or nothing at all.

    words  (T, P) residual words: cameras in the high byte, residual in the low one; seen  (T, P) bool: the sample is valid
    """
    filled = (
        visible & (residual_words >= 1) & (residual_words <= MAX_RESIDUAL_COUNTS) & (residual_words == np.rint(residual_words))
    )
    return filled if filled.sum() <= MAX_COMPUTED_FRACTION * visible.sum() else np.zeros_like(filled)


def detect_uncaptured_samples(residual_words: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """-> (T, P) bool: samples that no camera contributed to, in a file that keeps the cameras; `words`, `seen` as above."""
    without = visible & (residual_words <= MAX_RESIDUAL_COUNTS)
    return without if without.sum() <= (1 - MIN_CAMERA_FRACTION) * visible.sum() else np.zeros_like(without)


# MERGED: mocapfix.read.labels
# Telling markers from the other points of a file: model outputs and unlabelled trajectories.
# What Vicon, Qualisys, Motive and Cortex call a trajectory that nobody named; so is a label without any letter ("*12").
UNLABELLED_PATTERN = re.compile(r"(uname|unlabell?ed|unnamed|unidentified|new |c_)[\s_*]*\d*", re.IGNORECASE)
# ... and Qualisys so one that was chosen and not named yet: where none has a better name, those are the markers.
QUALISYS_NEW_PATTERN = re.compile(r"new \d+", re.IGNORECASE)
MODEL_OUTPUT_PATTERN = re.compile(r".*(Angles?|Forces?|Moments?|Powers?|GRF|CentreOfMass(Floor)?)")
# Plug-in Gait gives every segment as four points: origin, and the ends of its anterior, lateral and proximal axes.
SEGMENT_SUFFIXES = ("O", "A", "L", "P")
# Fewer computed points than this at the end of a file may as well be markers that somebody edited throughout.
MIN_COMPUTED_OUTPUTS = 3
MAX_RESIDUAL_COUNTS = 255


def find_marker_columns(
    labels: Sequence[str], model_outputs: Set[str], visible: np.ndarray, residual_words: np.ndarray
) -> np.ndarray:
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
    is_marker = ~_find_unlabelled(labels, model_outputs)
    is_marker &= [not _is_model_output(label, model_outputs) and not _is_segment_point(label, names) for label in labels]
    highest = np.max(residual_words, axis=0, where=visible, initial=-1)
    measured = np.flatnonzero(highest > MAX_RESIDUAL_COUNTS)
    if len(measured):
        computed = is_marker & (highest == 0) & (np.arange(len(labels)) > measured[-1])
        if computed.sum() >= MIN_COMPUTED_OUTPUTS:
            is_marker &= ~computed
    return np.flatnonzero(is_marker)


def find_unlabelled_columns(labels: Sequence[str], model_outputs: Set[str], visible: np.ndarray) -> np.ndarray:
    """-> (U,) indices of the points that nobody named and that are `seen` (T, P) at some time."""
    listed = np.array([label in model_outputs for label in labels], bool)
    return np.flatnonzero(_find_unlabelled(labels, model_outputs) & ~listed & visible.any(0))


def _find_unlabelled(labels: Sequence[str], outputs: Set[str]) -> np.ndarray:
    """-> (P,) bool: did nobody name the point?"""
    nameless = np.array([is_unlabelled(label) for label in labels], bool)
    if all(unnamed or _is_model_output(label, outputs) for unnamed, label in zip(nameless, labels, strict=True)):
        nameless &= [QUALISYS_NEW_PATTERN.fullmatch(_strip_prefix(label)) is None for label in labels]
    return nameless


def _is_model_output(label: str, outputs: Set[str]) -> bool:
    return label in outputs or MODEL_OUTPUT_PATTERN.fullmatch(_strip_prefix(label)) is not None


def is_unlabelled(label: str) -> bool:
    """-> is it what a program calls a trajectory that nobody named?"""
    return not any(c.isalpha() for c in _strip_prefix(label)) or UNLABELLED_PATTERN.fullmatch(_strip_prefix(label)) is not None


def _strip_prefix(label: str) -> str:
    return label.rsplit(":", 1)[-1].strip()


def _is_segment_point(label: str, names: Set[str]) -> bool:
    stem = label[:-1]
    return (
        len(stem.rsplit(":", 1)[-1]) == 3
        and label[-1] in SEGMENT_SUFFIXES
        and all(stem + end in names for end in SEGMENT_SUFFIXES)
    )
