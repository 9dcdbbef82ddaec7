"""Types of points and samples in a file: markers, model outputs, unlabelled trajectories, computed samples."""

import re
from collections.abc import Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.errors import ReadError
from mocapfix.files.layouts import MAX_RESIDUAL_COUNTS
from mocapfix.read.computed_points import find_model_outputs, find_named_computed_points, strip_subject_prefix

# Names that Vicon, Qualisys, Motive and Cortex give to unlabelled trajectories. So is a label without any letter ("*12").
UNLABELLED_PATTERN = re.compile(r"(uname|unlabell?ed|unnamed|unidentified|new |c_)[\s_*]*\d*", re.IGNORECASE)
# Qualisys' default name of an identified trajectory. These are markers if no point has a better name.
QUALISYS_NEW_PATTERN = re.compile(r"new \d+", re.IGNORECASE)
NUMBERED_POINT_NAME = "Point"  # with its number, the name of a point of a file without labels
MIN_COMPUTED_OUTPUTS = 3  # fewer computed points at the end of a file may be markers that were edited throughout

MIN_CAMERA_FRACTION = 0.9  # of the samples: if so many have cameras, the file records them, and the others were uncaptured
MIN_RESIDUAL_FRACTION = 0.9  # of a marker's samples: with a residual and no camera in so many, its file records no cameras for it
MAX_RESIDUAL_MARKER_FRACTION = 0.5  # of the markers with residuals: if more are without cameras, all samples were measured
MIN_RESIDUAL_MARKERS = 3  # number of such markers: a single one may have been filled nearly throughout


MIN_LABELLED_POINTS = 3  # with fewer points left, points with the names of computed ones or with numbers for names are markers


@runtime_checkable
class PointConverter(Protocol):
    """Returns the positions (m) of points of a file, given by their columns, in some frames; NaN where missing."""

    def __call__(
        self, columns: Int[np.ndarray, " K"], frames: slice | Int[np.ndarray, " F"] = slice(None)
    ) -> Float[np.ndarray, "F K 3"]:
        """Return the positions."""
        ...


@dataclass(frozen=True)
class DeclaredPoints:
    """What a file states about its P points.

    Attributes:
        labels: Labels in the file's order, without blanks around them.
        descriptions: Descriptions of the points; there may be more or fewer.
        model_outputs: Labels that the file lists as angles, forces and other outputs that are no positions.
        modelled_markers: Labels that the file lists as computed positions.
    """

    labels: Sequence[str]
    descriptions: Sequence[str] = ()
    model_outputs: Set[str] = frozenset()
    modelled_markers: Set[str] = frozenset()


@dataclass(frozen=True)
class PointTypes:
    """The points of a file by type, as indices among them. Points that are neither are outputs of models.

    Attributes:
        labels: Labels of all P points; in files without labels, those by which they are called here.
        markers: The markers.
        unlabelled: The unlabelled trajectories that are visible in at least one frame.
        computed: The positions that a program computed from markers.
        notes: Sentences about assumptions.
    """

    labels: tuple[str, ...]
    markers: Int[np.ndarray, " M"]
    unlabelled: Int[np.ndarray, " U"]
    computed: Int[np.ndarray, " C"]
    notes: tuple[str, ...] = ()


def classify_points(
    declared: DeclaredPoints, visible: Bool[np.ndarray, "T P"], residual_words: Float[np.ndarray, "T P"]
) -> PointTypes:
    """Return the type of each point.

    A point is a marker unless it is unlabelled, named or listed as the output of a model, or computed. In files that record
    cameras, Vicon appends the outputs of its models behind the last captured point, with all residual words 0. A sample that
    mocapfix filled has a residual and no cameras, so a cleaned file has the same markers as the original. Of a file that has
    numbers in place of all its labels, and of one that has computed positions only, these are the markers.

    Args:
        declared: What the file states about its P points.
        visible: Whether each sample is valid.
        residual_words: Cameras in the high byte, residual in the low byte.
    """
    labels, notes = tuple(declared.labels), tuple[str, ...]()
    is_output = find_model_outputs(labels, declared.model_outputs)
    is_unlabelled_point = _find_unlabelled(labels, is_output)
    numbered = ~is_output & [not label or label.isdecimal() for label in labels]
    if (numbered | is_output).all() and (numbered & visible.any(0)).sum() >= MIN_LABELLED_POINTS:
        labels, notes = _name_numbered_points(declared, numbered)
        is_unlabelled_point = np.zeros_like(is_output)
    is_marker = ~is_unlabelled_point & ~is_output
    is_named = is_marker & find_named_computed_points(labels, declared.descriptions, declared.modelled_markers)
    if (is_marker & ~is_named).sum() < MIN_LABELLED_POINTS <= is_marker.sum():
        notes += ("All labels are names of computed points, such as joint centres: they were read as markers.",)
        is_named[:] = False
    is_computed = is_named | _find_points_behind_captured(visible, residual_words, is_marker)
    return PointTypes(
        labels,
        np.flatnonzero(is_marker & ~is_computed),
        np.flatnonzero(is_unlabelled_point & visible.any(0)),
        np.flatnonzero(is_computed),
        notes,
    )


def check_point_types(path: Path, types: PointTypes) -> None:
    """Raise ReadError if a file has neither markers nor unlabelled trajectories."""
    if not len(types.markers) and not len(types.unlabelled):
        raise ReadError(f"{path}: none of its {len(types.labels)} points is a marker; export the marker trajectories as well.")


def _name_numbered_points(declared: DeclaredPoints, numbered: Bool[np.ndarray, " P"]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return unique labels for points that have a number or nothing for a label, and a note.

    They are the descriptions of the points, if these are labels, as in files that exchange the two.
    """
    labels, columns = list(declared.labels), np.flatnonzero(numbered).tolist()
    described = [declared.descriptions[i] if i < len(declared.descriptions) else "" for i in columns]
    if len(set(described)) == len(described) and not any(is_unlabelled(text) for text in described):
        names, note = described, "The file has numbers in place of labels: its points are called by their descriptions."
    else:
        own = [labels[i] for i in columns]
        numbers = own if len(set(own)) == len(own) and all(own) else [str(i + 1) for i in columns]
        names = [f"{NUMBERED_POINT_NAME} {number}" for number in numbers]
        what = "numbers in place of labels" if any(own) else "no labels"
        note = f"The file has {what}: its points are called {names[0]} to {names[-1]} here. The file keeps its own."
    for i, name in zip(columns, names, strict=True):
        labels[i] = name
    return tuple(labels), (note,)


def _find_points_behind_captured(
    visible: Bool[np.ndarray, "T P"], residual_words: Float[np.ndarray, "T P"], is_candidate: Bool[np.ndarray, " P"]
) -> Bool[np.ndarray, " P"]:
    """Return the points without cameras and residuals behind the last captured one; none if they are few."""
    highest_word = np.max(residual_words, axis=0, where=visible, initial=-1)
    captured = np.flatnonzero(highest_word > MAX_RESIDUAL_COUNTS)
    if not len(captured):
        return np.zeros_like(is_candidate)
    is_behind = is_candidate & (highest_word == 0) & (np.arange(len(is_candidate)) > captured[-1])
    return is_behind if is_behind.sum() >= MIN_COMPUTED_OUTPUTS else np.zeros_like(is_candidate)


def is_unlabelled(label: str) -> bool:
    """Return whether a label is one that programs give to unlabelled trajectories."""
    return (
        not any(c.isalpha() for c in strip_subject_prefix(label))
        or UNLABELLED_PATTERN.fullmatch(strip_subject_prefix(label)) is not None
    )


def detect_computed_samples(
    residual_words: Float[np.ndarray, "T M"], visible: Bool[np.ndarray, "T M"]
) -> Bool[np.ndarray, "T M"]:
    """Detect the samples of markers with a residual and without cameras, as mocapfix writes filled samples.

    Programs that record no cameras write measured samples in the same way, and nearly all of them. So all are false if most of
    the markers with residuals have hardly a sample without one. Only markers may be passed: the outputs of models have no
    residuals, and may be many more.
    """
    filled = (
        visible & (residual_words >= 1) & (residual_words <= MAX_RESIDUAL_COUNTS) & (residual_words == np.rint(residual_words))
    )
    has_words = (visible & (residual_words > 0)).any(0)
    is_without_cameras = filled.sum(0) > MIN_RESIDUAL_FRACTION * visible.sum(0)
    count = is_without_cameras.sum()
    if count >= MIN_RESIDUAL_MARKERS and count > MAX_RESIDUAL_MARKER_FRACTION * has_words.sum():
        return np.zeros_like(filled)
    return filled


def detect_uncaptured_samples(
    residual_words: Float[np.ndarray, "T M"], visible: Bool[np.ndarray, "T M"]
) -> Bool[np.ndarray, "T M"]:
    """Detect samples of markers that no camera contributed to. All are false if the file records no cameras."""
    without_cameras = visible & (residual_words <= MAX_RESIDUAL_COUNTS)
    records_cameras = without_cameras.sum() <= (1 - MIN_CAMERA_FRACTION) * visible.sum()
    return without_cameras if records_cameras else np.zeros_like(without_cameras)


def _find_unlabelled(labels: Sequence[str], is_output: Bool[np.ndarray, " P"]) -> Bool[np.ndarray, " P"]:
    """Return which points are unlabelled and are no outputs of models."""
    unlabelled = np.array([is_unlabelled(label) for label in labels], bool)
    if (unlabelled | is_output).all():
        unlabelled &= [QUALISYS_NEW_PATTERN.fullmatch(strip_subject_prefix(label)) is None for label in labels]
    return unlabelled & ~is_output
