"""The points of a file by type: markers, unlabelled trajectories, model outputs, and points that a program computed from markers.

Joint centres, bone axes, virtual markers, centres of mass and the outputs of models are positions that no camera measured. They
are kept in the file and are no evidence of where markers are. They are recognised by their names and the lists of the file;
points that are exact functions of markers by their trajectories (`mocapfix.stats.point_function_search`).
"""

import re
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.errors import ReadError
from mocapfix.model.take import MAX_RESIDUAL_COUNTS, ComputedEvidence, ComputedPoints, Take
from mocapfix.stats.point_function_search import MAX_FUNCTION_FRAMES, find_point_functions
from mocapfix.stats.point_functions import PointFunction
from mocapfix.stats.sequences import estimate_resolution, sample_evenly

# Outputs of models that are no positions but angles, forces and the like, as Vicon's models name them.
MODEL_OUTPUT_PATTERN = re.compile(r".*(Angles?|Forces?|Moments?|Powers?|GRF)")
CENTRE_OF_MASS_PATTERN = re.compile(r".*(CentreOfMass(Floor)?)|(.+[ _.])?(CoM|CoG|COM|COG|CenterOfMass|CenterOfGravity)")
# Centres of joints, without separators and in capitals: LHJC, R_Knee_JC, LeftHipCenter, LHipJointCentre_static.
_SIDE = "(L|R|LEFT|RIGHT)?"
_JOINT = "(HIP|KNEE|KNE|ANKLE|ANK|SHOULDER|SHO|ELBOW|ELB|WRIST|WRI)"
JOINT_CENTRE_PATTERN = re.compile(
    rf"(V|MID)?{_SIDE}({_JOINT}|GH|H|K|A|S|E|W)JC(L|R|LEFT|RIGHT|S|STATIC|FUNC|FUNCTIONAL)?\d*|{_SIDE}{_JOINT}(JOINT)?CENT(ER|RE).*"
)
VIRTUAL_PATTERN = re.compile(r"(?<![a-z])virtual(?![a-z])", re.IGNORECASE)
COMPUTED_DESCRIPTION_PATTERN = re.compile(r"\b(virtual|computed|calculated|joint cent(er|re)|model output)\b", re.IGNORECASE)
NAME_SEPARATORS = re.compile(r"[\s_.\-]")

# Points of one segment: its origin and the ends of its axes, named by the same stem with each of these suffixes.
SEGMENT_SUFFIXES = (("O", "A", "L", "P"), ("O", "X", "Y", "Z"))
# Stems of Plug-in Gait's segments. Their origins are recognised where a file has only some of the four points.
PLUG_IN_GAIT_STEMS = frozenset(
    ("PEL", "LFE", "RFE", "LTI", "RTI", "LFO", "RFO", "LTO", "RTO", "HED", "LCL", "RCL", "TRX", "LHU", "RHU", "LRA", "RRA",
     "LHN", "RHN")
)  # fmt: skip
PLUG_IN_GAIT_STEM_LENGTH = 3


def strip_subject_prefix(label: str) -> str:
    """Return a label without the name of the subject before it: "LFHD" for "Jim:LFHD"."""
    return label.rsplit(":", 1)[-1].strip()


def find_named_computed_points(labels: Sequence[str], descriptions: Sequence[str], listed: Set[str]) -> Bool[np.ndarray, " P"]:
    """Return which points are positions that a program computed, by their names, their descriptions or the file's lists.

    Args:
        labels: Labels of the P points, without blanks around them.
        descriptions: Descriptions of the points in the file; there may be more or fewer.
        listed: Labels that the file lists as modelled markers.
    """
    names = set(labels)
    padded = [*descriptions[: len(labels)], *[""] * (len(labels) - len(descriptions))]
    return np.array(
        [
            bool(
                label in listed
                or CENTRE_OF_MASS_PATTERN.fullmatch(bare := strip_subject_prefix(label))
                or VIRTUAL_PATTERN.search(bare)
                or JOINT_CENTRE_PATTERN.fullmatch(NAME_SEPARATORS.sub("", bare).upper())
                or _is_segment_point(label, names)
                or COMPUTED_DESCRIPTION_PATTERN.search(description)
            )
            for label, description in zip(labels, padded, strict=True)
        ],
        bool,
    )


def _is_segment_point(label: str, names: Set[str]) -> bool:
    """Return whether a label names the origin of a segment or the end of one of its axes."""
    stem, suffix = label[:-1], label[-1:]
    bare_stem = strip_subject_prefix(stem)
    if bare_stem in PLUG_IN_GAIT_STEMS and suffix in SEGMENT_SUFFIXES[0] and f"{stem}O" in names:
        return True
    return any(
        suffix in suffixes and all(stem + each in names for each in suffixes)
        for suffixes in SEGMENT_SUFFIXES
        if len(bare_stem) == PLUG_IN_GAIT_STEM_LENGTH or (suffixes != SEGMENT_SUFFIXES[0] and bare_stem)
    )


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
    ) -> Float[np.ndarray, "F K 3"]: ...


@dataclass(frozen=True)
class DeclaredPoints:
    """What a file states about its P points."""

    labels: Sequence[str]  # labels in the file's order, without blanks around them
    descriptions: Sequence[str] = ()  # descriptions of the points; there may be more or fewer
    model_outputs: Set[str] = frozenset()  # labels that the file lists as angles, forces and other outputs that are no positions
    modelled_markers: Set[str] = frozenset()  # labels that the file lists as computed positions


@dataclass(frozen=True)
class PointTypes:
    """The points of a file by type, as indices among them. Points that are neither are outputs of models."""

    labels: tuple[str, ...]  # labels of all P points; in files without labels, those by which they are called here
    markers: Int[np.ndarray, " M"]  # the markers
    unlabelled: Int[np.ndarray, " U"]  # the unlabelled trajectories that are visible in at least one frame
    computed: Int[np.ndarray, " C"]  # the positions that a program computed from markers
    notes: tuple[str, ...] = ()  # sentences about assumptions


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
    listed, pattern = declared.model_outputs, MODEL_OUTPUT_PATTERN
    is_output = np.array([each in listed or pattern.fullmatch(strip_subject_prefix(each)) is not None for each in labels], bool)
    is_unlabelled_point = np.array([is_unlabelled(label) for label in labels], bool)
    # beside named markers, those of a prop may have numbers only: "Box:1"
    subjects = [label.rpartition(":")[0] for label in labels]
    named = {subject for subject, is_number in zip(subjects, is_unlabelled_point, strict=True) if not is_number}
    for n in np.flatnonzero(is_unlabelled_point) if named else ():
        is_prop = subjects[n] not in named and not is_unlabelled(subjects[n])
        is_unlabelled_point[n] = not (is_prop and labels[n].rpartition(":")[2].isdecimal())
    if (is_unlabelled_point | is_output).all():
        is_unlabelled_point &= [QUALISYS_NEW_PATTERN.fullmatch(strip_subject_prefix(label)) is None for label in labels]
    is_unlabelled_point &= ~is_output
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
    markers, unlabelled = np.flatnonzero(is_marker & ~is_computed), np.flatnonzero(is_unlabelled_point & visible.any(0))
    return PointTypes(labels, markers, unlabelled, np.flatnonzero(is_computed), notes)


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


MAX_RESOLUTION_FRAMES = 2000  # from which the resolution of the coordinates is estimated


def find_computed_markers(
    types: PointTypes, visible: Bool[np.ndarray, "T P"], convert: PointConverter
) -> dict[int, PointFunction]:
    """Return those markers of a file that are exact functions of others, and the functions, all as columns of the file.

    There are none if too few markers were left. Only some frames are converted.

    Args:
        visible: Whether each sample is valid.
        convert: Returns positions of points.
    """
    columns = types.markers
    is_visible = np.any(visible[:, columns], axis=0)
    if len(columns) < MIN_LABELLED_POINTS:
        return {}
    resolution_m = estimate_resolution(convert(columns, slice(MAX_RESOLUTION_FRAMES)))
    sampled = convert(columns, sample_evenly(len(visible), MAX_FUNCTION_FRAMES))
    functions = find_point_functions(sampled, resolution_m, is_visible, is_visible)
    if is_visible.sum() - len(functions) < MIN_LABELLED_POINTS:
        return {}
    return {
        int(columns[m]): replace(functions[m], parents=tuple(int(columns[parent]) for parent in functions[m].parents))
        for m in sorted(functions)
    }


def add_other_points(take: Take, types: PointTypes, functions: Mapping[int, PointFunction], convert: PointConverter) -> Take:
    """Return a take of the markers of a file with its other points.

    Args:
        take: The markers that are no functions of others, with `point_columns`.
        functions: The markers that are functions of others, as `find_computed_markers` returns them.
        convert: Returns positions of points in the axes of the take.
    """
    by_name: tuple[ComputedEvidence, ...] = ("name",) * len(types.computed)
    by_function: tuple[ComputedEvidence, ...] = ("function",) * len(functions)

    def build_points_take(columns: Int[np.ndarray, " K"]) -> Take | None:
        if not len(columns):
            return None
        labels = tuple(types.labels[i] for i in columns)
        return Take(convert(columns), labels, take.rate, take.first_frame, take.path, point_columns=columns)

    unlabelled, computed = map(build_points_take, (types.unlabelled, np.array([*types.computed, *functions], int)))
    if computed:
        known = (*[None] * len(by_name), *functions.values())
        take = replace(take, computed_points=ComputedPoints(computed, by_name + by_function, known))
    markers = set(take.point_columns.tolist())
    others = tuple(label for i, label in enumerate(types.labels) if i not in markers)
    return replace(take, unlabelled=unlabelled, other_labels=others, notes=(*take.notes, *types.notes))
