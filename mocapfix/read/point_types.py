"""Types of points and samples in a file: markers, model outputs, unlabelled trajectories, computed samples."""

import re
from collections.abc import Sequence, Set

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.files.layouts import MAX_RESIDUAL_COUNTS

# Names that Vicon, Qualisys, Motive and Cortex give to unlabelled trajectories. So is a label without any letter ("*12").
UNLABELLED_PATTERN = re.compile(r"(uname|unlabell?ed|unnamed|unidentified|new |c_)[\s_*]*\d*", re.IGNORECASE)
# Qualisys' default name of an identified trajectory. These are markers if no point has a better name.
QUALISYS_NEW_PATTERN = re.compile(r"new \d+", re.IGNORECASE)
MODEL_OUTPUT_PATTERN = re.compile(r".*(Angles?|Forces?|Moments?|Powers?|GRF|CentreOfMass(Floor)?)")
# Plug-in Gait writes each segment as four points: its origin and the ends of its anterior, lateral and proximal axis.
SEGMENT_SUFFIXES = ("O", "A", "L", "P")
MIN_COMPUTED_OUTPUTS = 3  # fewer computed points at the end of a file may be markers that were edited throughout

MIN_CAMERA_FRACTION = 0.9  # of the samples: if so many have cameras, the file records them, and the others were uncaptured
MAX_COMPUTED_FRACTION = 0.5  # of the samples: if more have a residual only, the file records no cameras: all were measured


def find_marker_columns(
    labels: Sequence[str],
    model_outputs: Set[str],
    visible: Bool[np.ndarray, "T P"],
    residual_words: Float[np.ndarray, "T P"],
) -> Int[np.ndarray, " M"]:
    """Find the points that are markers.

    A point is a marker unless it is unlabelled, named or listed as a model output, or computed. In files that record
    cameras, Vicon appends the outputs of its models behind the last captured point, with all residual words 0. A sample that
    mocapfix filled has a residual and no cameras, so a cleaned file has the same markers as the original.

    Args:
        labels: Labels of the P points in the file's order, without blanks around them.
        model_outputs: Labels that the file lists as model outputs.
        visible: Whether each sample is valid.
        residual_words: Cameras in the high byte, residual in the low byte.

    Returns:
        Indices of the M markers among the points.
    """
    names = set(labels)
    is_marker = ~_find_unlabelled(labels, model_outputs)
    is_marker &= [not _is_model_output(label, model_outputs) and not _is_segment_point(label, names) for label in labels]
    highest_word = np.max(residual_words, axis=0, where=visible, initial=-1)
    captured = np.flatnonzero(highest_word > MAX_RESIDUAL_COUNTS)
    if len(captured):
        is_computed = is_marker & (highest_word == 0) & (np.arange(len(labels)) > captured[-1])
        if is_computed.sum() >= MIN_COMPUTED_OUTPUTS:
            is_marker &= ~is_computed
    return np.flatnonzero(is_marker)


def find_unlabelled_columns(
    labels: Sequence[str], model_outputs: Set[str], visible: Bool[np.ndarray, "T P"]
) -> Int[np.ndarray, " U"]:
    """Return the indices of the unlabelled points that are visible in at least one frame."""
    is_listed = np.array([label in model_outputs for label in labels], bool)
    return np.flatnonzero(_find_unlabelled(labels, model_outputs) & ~is_listed & visible.any(0))


def is_unlabelled(label: str) -> bool:
    """Return whether a label is one that programs give to unlabelled trajectories."""
    return not any(c.isalpha() for c in _strip_prefix(label)) or UNLABELLED_PATTERN.fullmatch(_strip_prefix(label)) is not None


def detect_computed_samples(
    residual_words: Float[np.ndarray, "T P"], visible: Bool[np.ndarray, "T P"]
) -> Bool[np.ndarray, "T P"]:
    """Detect samples with a residual and without cameras, as mocapfix writes filled samples.

    All are false if they are the majority: then the file records no cameras.
    """
    filled = (
        visible & (residual_words >= 1) & (residual_words <= MAX_RESIDUAL_COUNTS) & (residual_words == np.rint(residual_words))
    )
    return filled if filled.sum() <= MAX_COMPUTED_FRACTION * visible.sum() else np.zeros_like(filled)


def detect_uncaptured_samples(
    residual_words: Float[np.ndarray, "T P"], visible: Bool[np.ndarray, "T P"]
) -> Bool[np.ndarray, "T P"]:
    """Detect samples that no camera contributed to. All are false if the file records no cameras."""
    without_cameras = visible & (residual_words <= MAX_RESIDUAL_COUNTS)
    records_cameras = without_cameras.sum() <= (1 - MIN_CAMERA_FRACTION) * visible.sum()
    return without_cameras if records_cameras else np.zeros_like(without_cameras)


def _find_unlabelled(labels: Sequence[str], model_outputs: Set[str]) -> Bool[np.ndarray, " P"]:
    """Return which points are unlabelled."""
    unlabelled = np.array([is_unlabelled(label) for label in labels], bool)
    if all(bare or _is_model_output(label, model_outputs) for bare, label in zip(unlabelled, labels, strict=True)):
        unlabelled &= [QUALISYS_NEW_PATTERN.fullmatch(_strip_prefix(label)) is None for label in labels]
    return unlabelled


def _is_model_output(label: str, model_outputs: Set[str]) -> bool:
    return label in model_outputs or MODEL_OUTPUT_PATTERN.fullmatch(_strip_prefix(label)) is not None


def _strip_prefix(label: str) -> str:
    return label.rsplit(":", 1)[-1].strip()


def _is_segment_point(label: str, names: Set[str]) -> bool:
    stem = label[:-1]
    is_segment_name = len(stem.rsplit(":", 1)[-1]) == 3 and label[-1] in SEGMENT_SUFFIXES
    return is_segment_name and all(stem + suffix in names for suffix in SEGMENT_SUFFIXES)
