"""What the labelled markers of a file show of its person: how tall it is, how it stands, and whether it is mirrored.

Labels are recognised by their words in any marker set (see `classify_label_height`). Positions are in file axes, in metres or in
a unit that is still to be found.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.io.points import PointConverter, PointTypes
from mocapfix.model.take import SUBJECT_SEPARATORS
from mocapfix.stats.sequences import sample_evenly

# Labels without the letter or word for a side, and words of labels, by the height of the body part on an upright person.
HEAD_NAMES = frozenset(
    ("FHD", "BHD", "HDF", "HDB", "ARIEL", "C7", "CV7", "CLAV", "STRN", "SHO", "FSH", "BSH", "SH", "IJ", "SNJ", "SAJ", "HEAD",
     "NECK", "SHOULDER", "ACROMION", "ACROMIUM", "TEMPLE", "FOREHEAD", "STERNUM", "CHEST", "EAR", "NOSE", "EYE")
)  # fmt: skip
PELVIS_NAMES = frozenset(
    ("ASI", "ASIS", "PSI", "PSIS", "IAS", "IPS", "SACR", "SACRUM", "SACRAL", "FWT", "BWT", "MWT", "WAIST", "PELVIS", "HIP")
)  # fmt: skip
FOOT_NAMES = frozenset(
    ("TOE", "HEE", "HEL", "HEEL", "ANK", "ANKLE", "MT1", "MT2", "MT5", "CAL", "FCC", "FM1", "FM2", "FM5", "FAL", "TAM", "LMAL",
     "MMAL", "MALLEOLUS", "FOOT", "FOREFOOT", "MIDFOOT")
)  # fmt: skip
# Names at the front and at the back of a part of the body.
FRONT_BACK_NAMES = (
    (frozenset(("FHD", "HDF", "FOREHEAD", "NOSE", "EYE")), frozenset(("BHD", "HDB", "EAR"))),
    (frozenset(("CLAV", "STRN", "STERNUM", "IJ", "CHEST")), frozenset(("C7", "CV7", "T10", "RBAK", "TV10"))),
    (frozenset(("ASI", "ASIS", "IAS", "FWT")), frozenset(("PSI", "PSIS", "IPS", "BWT", "SACR", "SACRUM", "SACRAL"))),
    (frozenset(("TOE", "MT1", "MT2", "MT5", "FM1", "FM2", "FM5", "FOREFOOT")), frozenset(("HEE", "HEL", "HEEL", "CAL", "FCC"))),
)  # fmt: skip
TOE_NAMES, HEEL_NAMES = FRONT_BACK_NAMES[-1]
LABEL_SIDES = (("LEFT", "RIGHT"), ("L", "R"))
WORD_PATTERN = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")

MIN_PART_DISTANCE_M = 0.2  # between body parts of different height
MIN_FACING_DISTANCE_M = 0.02  # between the front and the back of a body part
MAX_INSPECTED_FRAMES = 300  # evenly spread frames in which a body is looked for
STEP_S = 0.1  # between the two frames from which the motion of a foot is measured
MAX_STANDING_SPEED_M_PER_S = 0.15  # of a marker on a foot that stands


@dataclass(frozen=True)
class BodyEvidence:
    """The labelled markers of the person with the most of them, in evenly spread frames."""

    labels: tuple[str, ...]  # labels of M markers
    positions: Float[np.ndarray, "T M 3"]  # (T, M, 3) in the axes of the file, NaN where missing
    later_positions: Float[np.ndarray, "T M 3"]  # the same markers `step_s` later
    step_s: float  # time between both (s)

    @cached_property
    def heights(self) -> tuple[int | None, ...]:
        """The height of each marker (see `classify_label_height`)."""
        return tuple(classify_label_height(label) for label in self.labels)

    def scale(self, factor: float) -> "BodyEvidence":
        return BodyEvidence(self.labels, self.positions * factor, self.later_positions * factor, self.step_s)

    def select_height(self, height: int) -> Bool[np.ndarray, " M"]:
        """Return which markers are on the feet (0), the pelvis (1), or the head and shoulders (2)."""
        return np.array([each == height for each in self.heights], bool)

    def select_names(self, names: frozenset[str]) -> Bool[np.ndarray, " M"]:
        return np.array([bool(list_label_names(label) & names) for label in self.labels], bool)

    @cached_property
    def pairs(self) -> Int[np.ndarray, "N 2"]:
        """The left and the right marker of each pair whose labels differ in the side."""
        return np.array(find_pairs(self.labels), int).reshape(-1, 2)

    @property
    def sides(self) -> tuple[Bool[np.ndarray, " M"], Bool[np.ndarray, " M"]]:
        """Which markers are the left and which the right ones of pairs."""
        left, right = (np.isin(np.arange(len(self.labels)), self.pairs[:, side]) for side in (0, 1))
        return left, right

    @cached_property
    def lateral(self) -> Float[np.ndarray, "T 3"]:
        """The mean vector from right to left of the pairs whose markers are both visible, in each frame."""
        return compute_means(self.positions[:, self.pairs[:, 0]] - self.positions[:, self.pairs[:, 1]])

    def compute_centre(self, markers: Bool[np.ndarray, " M"]) -> Float[np.ndarray, "T 3"]:
        """Return the mean of some markers in each frame, NaN where none is visible."""
        return compute_means(self.positions[:, markers])

    def compute_direction(self, end: Bool[np.ndarray, " M"], start: Bool[np.ndarray, " M"]) -> Float[np.ndarray, "T 3"]:
        """Return the vector between the means of two groups of markers in each frame."""
        return self.compute_centre(end) - self.compute_centre(start)

    @cached_property
    def body_axis(self) -> Float[np.ndarray, "T 3"] | None:
        """The vector from a lower to a higher part of the body in each frame, None if the labels name fewer than two."""
        for high, low in ((2, 0), (1, 0), (2, 1)):
            vector = self.compute_direction(self.select_height(high), self.select_height(low))
            if np.isfinite(vector).all(1).any():
                return vector
        return None


class InspectedPoints(NamedTuple):
    """The points of a file from which its unit and its axes are judged."""

    labels: tuple[str, ...]  # labels of M markers, with the names of subjects, or of unlabelled trajectories
    columns: Int[np.ndarray, " M"]  # their indices among the points of the file
    frame_count: int  # number of frames
    rate: float  # frames per second
    convert: PointConverter  # returns positions in the axes of the file, in metres if its unit is right


def inspect_points(types: PointTypes, frame_count: int, rate: float, convert: PointConverter) -> InspectedPoints:
    """Return the markers of a file, or its unlabelled trajectories if it has no markers."""
    columns = types.markers if len(types.markers) else types.unlabelled
    return InspectedPoints(tuple(types.labels[i] for i in columns), columns, frame_count, rate, convert)


def collect_body_evidence(points: InspectedPoints) -> BodyEvidence:
    """Return the evidence of the subject with the most labels that name parts of a body, or with the most labels if none do."""
    subjects, labels = split_subjects_off(points.labels)
    markers = {name: [m for m, subject in enumerate(subjects) if subject == name] for name in dict.fromkeys(subjects)}
    own = max(markers.values(), key=lambda each: (_count_known_labels([labels[m] for m in each]), len(each)), default=[])
    step = min(max(1, round(STEP_S * points.rate)), max(points.frame_count - 1, 0))
    frames = sample_evenly(points.frame_count - step, MAX_INSPECTED_FRAMES)
    positions, later = (points.convert(points.columns[own], each) for each in (frames, frames + step))
    return BodyEvidence(tuple(labels[m] for m in own), positions, later, max(step, 1) / points.rate)


def measure_handedness(body: BodyEvidence) -> list[float]:
    """Return for each part of the body whose front and back, and whose sides, have labels how right-handed its coordinates are.

    A value is the mean sine of the volume of left, up and front: about 1 for a person, about -1 for a mirrored one.
    """
    lateral, up = body.lateral, body.body_axis
    if up is None:
        return []
    found: list[float] = []
    for front_names, back_names in FRONT_BACK_NAMES:
        front = body.compute_direction(body.select_names(front_names), body.select_names(back_names))
        lengths = np.linalg.norm([lateral, up, front], axis=-1)
        is_known = np.isfinite(lengths).all(0) & (lengths.min(0) > MIN_FACING_DISTANCE_M)
        if not is_known.any():
            continue
        volumes = np.einsum("ti,ti->t", np.cross(lateral, up), front)[is_known] / lengths.prod(0)[is_known]
        found.append(float(np.mean(volumes)))
    return found


def split_subjects_off(labels: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the subject of each label, "" without one, and the label without it.

    If no label has a colon, a subject ends at another separator if its labels then name two heights of a body, and more parts and
    pairs of left and right than the whole labels do: "Jim" of "Jim_LFHD", but not "L" of "L_ANKLE".
    """
    subjects, names = [list(each) for each in zip(*(label.rpartition(":")[::2] for label in labels), strict=True)] or ([], [])
    readings: dict[str, dict[int, str]] = {}
    for m, label in enumerate(labels if not any(subjects) else ()):
        for separator in SUBJECT_SEPARATORS.finditer(label):
            readings.setdefault(label[: separator.start()], {})[m] = label[separator.end() :]
    for subject, bare in readings.items():
        heights = {classify_label_height(name) for name in bare.values()} - {None}
        if len(heights) > 1 and _count_known_labels(list(bare.values())) > _count_known_labels([labels[m] for m in bare]):
            for m, name in bare.items():
                subjects[m], names[m] = subject, name
    return subjects, names


def _count_known_labels(labels: Sequence[str]) -> int:
    """Return how many labels name a part of the body, and how many a side."""
    return sum(classify_label_height(label) is not None for label in labels) + 2 * len(find_pairs(labels))


def classify_label_height(label: str) -> int | None:
    """Return 2 for a label of the head or shoulders, 1 for the pelvis, 0 for the feet, None for any other."""
    names = list_label_names(label)
    heights = [height for height, known in ((2, HEAD_NAMES), (1, PELVIS_NAMES), (0, FOOT_NAMES)) if names & known]
    return heights[-1] if heights else None


def list_label_names(label: str) -> set[str]:
    """Return the names that a label may be meant as: its words, and the whole of it without subject and side."""
    words = [word.upper() for word in WORD_PATTERN.findall(label.rsplit(":", 1)[-1])]
    name = "".join(words)
    names = {
        name,
        *(name.removeprefix(side) for pair in LABEL_SIDES for side in pair),
        *(name.removesuffix(side) for side in LABEL_SIDES[1]),
    }
    return names | {word for word in words if len(word) > 2}


def find_pairs(labels: Sequence[str]) -> list[tuple[int, int]]:
    """Return the left and the right marker of each pair whose labels differ in the letter or word for the side."""
    index = {label.upper(): m for m, label in enumerate(labels)}
    pairs: list[tuple[int, int]] = []
    for name, m in index.items():
        subject, _, bare = name.rpartition(":")
        prefix = f"{subject}:" if subject else ""
        for left_word, right_word in LABEL_SIDES:
            other = index.get(f"{prefix}{right_word}{bare.removeprefix(left_word)}")
            if bare.startswith(left_word) and other is not None:
                pairs.append((m, other))
                break
    return pairs


def compute_means(positions: Float[np.ndarray, "T K 3"]) -> Float[np.ndarray, "T 3"]:
    count = (~np.isnan(positions[..., :1])).sum(1)
    return np.nansum(positions, axis=1) / np.where(count > 0, count, np.nan)
