"""Coordinates in files: units of length, codes for missing points, and which axis points up, from what a body does.

What the labelled markers show of a person is how tall it is, how it stands, and whether it is mirrored. Labels are recognised by
their words in any marker set (see `classify_label_height`). Positions are in file axes, in metres or in a unit that is still to
be found.

The up direction is the one of the six with the most evidence. Each kind of evidence adds to or subtracts from its score, as a
logarithm of odds: a head above the feet is likely for an upright person and unlikely for one who lies, and the lowest markers of
most captures are on a floor at the height 0.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.io.points import PointConverter, PointTypes
from mocapfix.model.take import SUBJECT_SEPARATORS, UpAxis
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


METRES_PER_UNIT = {"mm": 0.001, "cm": 0.01, "m": 1.0, "in": 0.0254, "ft": 0.3048}
# Names of units, of which a file may have the first letters only: the field for POINT:UNITS often has four characters.
LONG_NAMES = "millimeters millimetres", "centimeters centimetres", "meters metres mtrs", "inches", "foot feet"
UNIT_NAMES = {name: unit for unit, names in zip(METRES_PER_UNIT, LONG_NAMES, strict=True) for name in names.split()}
MIN_UNIT_LETTERS = 3  # of a name that was cut off

INVALID_COORDINATE_LIMIT = 9_000_000  # file units; a coordinate from here on is missing: Cortex writes 9999999
MISSING_CODE_LIMIT = 9999  # file units; three equal coordinates from here on are missing, such as -9999.99

# Rotations of file axes to Y-up axes, by the up axis. All are proper. Z up: (x, y, z) -> (y, z, x), as in CMU's releases.
# Y down: (x, y, z) -> (x, -y, -z), which makes a camera's axes those of an image whose Y points up.
ROTATIONS_TO_Y_UP = {
    "X": np.eye(3)[[2, 0, 1]],
    "-X": np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
    "Y": np.eye(3),
    "-Y": np.diag([1.0, -1, -1]),
    "Z": np.eye(3)[[1, 2, 0]],
    "-Z": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
}


def get_metres_per_unit(name: str) -> float | None:
    """Return the metres in a unit, given by its abbreviation or its name, which may be cut off, in any case; None if unknown."""
    text = name.strip().lower().rstrip(".")
    found = {unit for full, unit in UNIT_NAMES.items() if len(text) >= MIN_UNIT_LETTERS and full.startswith(text)}
    return METRES_PER_UNIT.get(found.pop() if len(found) == 1 else text)


def format_length(length_m: float) -> str:
    """Return a length with three significant digits, a large one without an exponent."""
    return f"{float(f'{length_m:.3g}'):,.15g} m"


def find_valid_points(points_file: Float[np.ndarray, "T P 3"]) -> Bool[np.ndarray, "T P"]:
    """Return which points, in file units, are positions: not NaN, not all 0, and not a code for a missing point."""
    x, y, z = np.moveaxis(points_file, -1, 0)
    equal = (x == y) & (y == z)
    in_range = (
        (np.abs(x) < INVALID_COORDINATE_LIMIT) & (np.abs(y) < INVALID_COORDINATE_LIMIT) & (np.abs(z) < INVALID_COORDINATE_LIMIT)
    )
    return in_range & ~(equal & ((x == 0) | (np.abs(x) >= MISSING_CODE_LIMIT)))


AXIS_NAMES = ("X", "Y", "Z", "-X", "-Y", "-Z")

# Scores by kind of evidence. The first is that of the vertical on a person who is upright in all frames.
UPRIGHT_SCORE = 3.0
TALL_SCORE = 3.0
LATERAL_SCORE = -4.0
FLOOR_AT_ZERO_SCORE = 3.0
NO_FLOOR_AT_ZERO_SCORE = -2.0
CONSTANT_FLOOR_SCORE = 1.5
CHANGING_FLOOR_SCORE = -3.0
LONG_TRAVEL_SCORE = -6.0
FREE_FALL_SCORE = 4.0
OTHER_AXIS_SCORE = -1.0
X_AXIS_SCORE = -2.0
DOWN_SCORE = -2.0
STANDING_SCORE = 6.0
MAYBE_STANDING_SCORE = 1.5
# Weight of the evidence of the floor where no label names a part of the body: there may be no body that stands on it.
UNKNOWN_MARKERS_FACTOR = 0.5
UPRIGHT_BASIS = "head, pelvis and feet"
MAX_FALLING_MARKERS = 12  # markers whose fall is measured
MIN_CERTAIN_SCORE = 2.0  # least difference of two scores at which the better one is certain

# A person stands if the cosine of the body's axis is at least this in most frames, the squared cosine of its sides at most this,
# and its standing feet are flat and in one plane while it walks some way, or on a floor at the height 0. Of the full-body
# captures that these were measured on, the medians are 0.96 to 1.00 and at most 0.1.
MIN_UPRIGHT_COSINE = 0.85
MIN_UPRIGHT_SHARE = 0.75  # of the frames
MAX_LATERAL_COSINE_2 = 0.25
MAX_FOOT_TILT_M = 0.08  # difference of the heights of toe and heel of a standing foot
MAX_STANDING_RANGE_M = 0.08  # of the heights of standing feet in one plane
MIN_STANDING_SAMPLES = 5
# Distance that someone travels across the own axis, and length of the mean direction of the sides, who cannot roll on the floor.
MIN_TRAVEL_ACROSS_M = 2.0
MIN_STEADY_LATERAL = 0.7
MIN_WALKED_M = 0.5  # distance between the places of standing feet of someone who walks
CLEAR_EXTENT_RATIO = 1.5  # ratio of the largest to the second largest extent of a body that is clearly tall along one axis
MIN_BODY_EXTENT_M = 0.5  # smallest extent in metres of a body; a smaller set of markers shows no floor
MIN_FLOOR_MARKERS = 6  # number of markers below which their lowest is no evidence of a floor
MIN_VISIBLE_FRACTION = 0.8  # of the largest number of markers, in a frame from whose lowest marker the floor is estimated
FLOOR_RANGE_M = (-0.05, 0.12)  # range in metres of the height of the lowest markers, on a floor at the height 0
# Distance in metres along any axis that a person travels who shows whether the lowest height changes, and by how much it does.
MIN_TRAVEL_FOR_FLOOR_M = 0.3
MAX_CONSTANT_FLOOR_M = 0.06
MIN_CHANGING_FLOOR_M = 0.4
MAX_HEIGHT_M = 3.0  # extent in metres of a take along an axis that is more than a person climbs or falls
# Acceleration of free fall, its tolerance, and that of the other axes, in m/s2; the time between the compared positions and
# the shortest flight, both in seconds.
GRAVITY_M_PER_S2 = 9.81
GRAVITY_TOLERANCE_M_PER_S2 = 1.0
FALL_STEP_S = 0.05
MIN_FALL_S = 0.1


class UpAxisEvidence(NamedTuple):
    """Scores (6,) of the directions in `AXIS_NAMES` by one kind of evidence, and what it is, in a few words."""

    description: str
    scores: Float[np.ndarray, "6"]


class PointSample(NamedTuple):
    """Positions (m) in file axes, NaN where missing."""

    frames: Float[np.ndarray, "t M 3"]  # evenly spread frames of all M markers
    falling: Float[np.ndarray, "T m 3"]  # all frames of a few markers
    rate: float  # frames per second


def sample_points(points: InspectedPoints) -> PointSample:
    """Return what the unit and the up axis are estimated from."""
    frames = sample_evenly(points.frame_count, MAX_INSPECTED_FRAMES)
    falling = points.columns[sample_evenly(len(points.columns), MAX_FALLING_MARKERS)]
    return PointSample(points.convert(points.columns, frames), points.convert(falling), points.rate)


def estimate_up_axis(body: BodyEvidence, points: PointSample, default_axis: str = "Z") -> UpAxis:
    """Estimate the up axis of a file.

    Args:
        body: What the labelled markers show.
        default_axis: The up axis of most files of the format.
    """
    default = UpAxisEvidence("the usual axis of the format", _score_default(default_axis))
    evidence, is_known = _collect_evidence(body, points)
    if not evidence:
        return UpAxis(default_axis, default.description, is_certain=False)
    evidence = [default, *evidence]
    total = np.sum([each.scores for each in evidence], axis=0)
    second, best = (int(axis) for axis in np.argsort(total, kind="stable")[-2:])
    is_certain = bool(total[best] - total[second] >= MIN_CERTAIN_SCORE)
    if not is_certain and body.body_axis is None:
        return UpAxis(default_axis, default.description, is_certain=False)
    margins = [(each.scores[best] - each.scores[second], each.description) for each in evidence]
    reasons = [description for margin, description in sorted(margins, reverse=True) if margin > 0]
    return UpAxis(AXIS_NAMES[best], ", ".join(reasons), is_certain and is_known)


def estimate_sign(axis: str, body: BodyEvidence, points: PointSample) -> str:
    """Return the axis "X", "Y" or "Z" with a minus sign before it if the evidence is that it points down."""
    evidence, _ = _collect_evidence(body, points)
    total = np.sum([_score_default(axis), *(each.scores for each in evidence)], axis=0)
    up, down = (total[AXIS_NAMES.index(each)] for each in (axis, f"-{axis}"))
    return f"-{axis}" if down - up >= MIN_CERTAIN_SCORE else axis


class Standing(NamedTuple):
    """The axis along which a person seems to stand, and whether it cannot lie instead."""

    axis: str
    is_certain: bool


def find_standing_axis(body: BodyEvidence) -> Standing | None:
    """Return the axis along which a person stands or walks, None if its head is not above its feet, or its sides are not level.

    That it does not lie is certain if it moves far across its own axis without turning, or if its standing feet are flat and all
    at the same height: at 0, or at places farther apart than the feet of one pose.
    """
    axis = body.body_axis
    if axis is None:
        return None
    cosines, lateral = (_drop_unknown(_normalise(each)) for each in (axis, body.lateral))
    for index in range(3 if len(cosines) else 0):
        along = cosines[:, index]
        sign = 1.0 if np.median(along) > 0 else -1.0
        if np.mean(sign * along > MIN_UPRIGHT_COSINE) < MIN_UPRIGHT_SHARE:
            continue
        if not len(lateral) or np.mean(lateral[:, index] ** 2) > MAX_LATERAL_COSINE_2:
            return None
        name = AXIS_NAMES[index if sign > 0 else index + 3]
        centre = np.delete(body.compute_centre(np.ones(len(body.labels), bool)), index, axis=1)
        distance = np.ptp(np.nanquantile(centre, [0.05, 0.95], axis=0), axis=0).max()
        if distance > MIN_TRAVEL_ACROSS_M and np.linalg.norm(lateral.mean(0)) > MIN_STEADY_LATERAL:
            return Standing(name, is_certain=True)
        feet = _find_standing_feet(body, index, sign)
        return None if feet is None else Standing(name, feet)
    return None


def _find_standing_feet(body: BodyEvidence, axis: int, sign: float) -> bool | None:
    """Return whether standing feet are all in one plane that is a floor, None if they are not flat."""
    toes, heels = body.select_names(TOE_NAMES), body.select_names(HEEL_NAMES)
    heights: list[np.ndarray] = []
    places: list[np.ndarray] = []
    for side in body.sides:
        feet = side & body.select_height(0)
        if not feet.any():
            return False
        centre = body.compute_centre(feet)
        later = compute_means(body.later_positions[:, feet])
        is_standing = np.linalg.norm(later - centre, axis=-1) < MAX_STANDING_SPEED_M_PER_S * body.step_s
        if (side & toes).any() and (side & heels).any():
            tilt = np.abs(body.compute_direction(side & toes, side & heels)[is_standing, axis])
            if np.isfinite(tilt).any() and np.nanmedian(tilt) > MAX_FOOT_TILT_M:
                return None
        heights.append(np.fmin.reduce(sign * body.positions[:, feet, axis], axis=1)[is_standing])
        places.append(centre[is_standing])
    height, place = np.concatenate(heights), np.delete(np.concatenate(places), axis, axis=1)
    if len(height) < MIN_STANDING_SAMPLES:
        return False
    low, middle, high = np.nanquantile(height, [0.1, 0.5, 0.9])
    walked = np.ptp(np.nanquantile(place, [0.05, 0.95], axis=0), axis=0).max()
    is_on_floor = low > FLOOR_RANGE_M[0] and middle < FLOOR_RANGE_M[1]
    return bool(high - low < MAX_STANDING_RANGE_M and (is_on_floor or walked > MIN_WALKED_M))


def is_on_floor_along(axis: str, points: PointSample) -> bool:
    """Return whether the lowest markers along an axis are on a floor at the height 0, as those of one who lies are."""
    sign, index = (-1.0 if axis.startswith("-") else 1.0), AXIS_NAMES.index(axis) % 3
    heights = sign * points.frames[..., index]
    lowest = np.nanmin(heights[np.isfinite(heights).any(1)], axis=1)
    return bool(len(lowest) and FLOOR_RANGE_M[0] < np.median(lowest) < FLOOR_RANGE_M[1])


def _normalise(vectors: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3"]:
    """Return unit vectors, NaN for those shorter than the distance between parts of a body."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > MIN_PART_DISTANCE_M, length, np.nan)


def _drop_unknown(vectors: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "t 3"]:
    return vectors[np.isfinite(vectors).all(1)]


def _collect_evidence(body: BodyEvidence, points: PointSample) -> tuple[list[UpAxisEvidence], bool]:
    """Return the evidence, none if no marker is visible, and whether it is of a body or of gravity."""
    seen = points.frames[np.any(~np.isnan(points.frames[..., 0]), axis=1)]
    if not len(seen):
        return [], False
    floor = _collect_floor_evidence(seen)
    has_body = body.body_axis is not None
    if not has_body:
        floor = [UpAxisEvidence(each.description, UNKNOWN_MARKERS_FACTOR * each.scores) for each in floor]
    evidence = [*_collect_body_evidence(body, seen), *floor]
    if (fall := find_free_fall(points.falling, points.rate)).any():
        evidence.append(UpAxisEvidence("free fall", FREE_FALL_SCORE * fall))
    if (standing := find_standing_axis(body)) is not None:
        score = STANDING_SCORE if standing.is_certain else MAYBE_STANDING_SCORE
        evidence.append(UpAxisEvidence("standing feet", score * (np.array(AXIS_NAMES) == standing.axis)))
    return evidence, has_body or bool(fall.any())


def find_free_fall(positions_file: Float[np.ndarray, "T M 3"], rate: float) -> Bool[np.ndarray, "6"]:
    """Return along which directions of `AXIS_NAMES` as up the markers fall freely, on average, for some time."""
    step = max(1, round(FALL_STEP_S * rate))
    falls = np.zeros(6, bool)
    if len(positions_file) <= 2 * step:
        return falls
    bend = positions_file[2 * step :] - 2 * positions_file[step:-step] + positions_file[: -2 * step]
    is_known = ~np.isnan(bend[..., 0])
    is_enough = is_known.sum(1) > is_known.shape[1] / 2
    mean = np.where(is_known[..., None], bend, 0.0).sum(1) / np.maximum(is_known.sum(1), 1)[:, None]
    acceleration = mean * (rate / step) ** 2
    needed = max(2, round(MIN_FALL_S * rate))
    for axis, (index, sign) in enumerate((index, sign) for sign in (1, -1) for index in range(3)):
        others = np.delete(acceleration, index, axis=1)
        is_fall = np.abs(sign * acceleration[:, index] + GRAVITY_M_PER_S2) < GRAVITY_TOLERANCE_M_PER_S2
        is_fall &= is_enough & (np.abs(others) < GRAVITY_TOLERANCE_M_PER_S2).all(1)
        falls[axis] = len(is_fall) >= needed and bool((np.convolve(is_fall, np.ones(needed), "valid") >= needed).any())
    return falls


def _score_default(default_axis: str) -> Float[np.ndarray, "6"]:
    scores = np.array([X_AXIS_SCORE, OTHER_AXIS_SCORE, OTHER_AXIS_SCORE])
    scores[AXIS_NAMES.index(default_axis)] = 0.0
    return np.r_[scores, scores + DOWN_SCORE]


def _collect_body_evidence(body: BodyEvidence, positions: Float[np.ndarray, "T M 3"]) -> list[UpAxisEvidence]:
    """Return the evidence of the heights of body parts, or else of the extent of the markers, and that of the two sides."""
    evidence: list[UpAxisEvidence] = []
    upright = None if body.body_axis is None else _measure_direction(body.body_axis)
    if upright is not None:
        evidence.append(UpAxisEvidence(UPRIGHT_BASIS, UPRIGHT_SCORE * np.r_[upright, -upright]))
    else:
        evidence.append(UpAxisEvidence("the largest extent", np.tile(_score_extent(positions), 2)))
    lateral = _measure_direction(body.lateral, is_signed=False)
    if lateral is not None:
        evidence.append(UpAxisEvidence("left and right", LATERAL_SCORE * np.tile(lateral, 2)))
    return evidence


def _measure_direction(vectors: Float[np.ndarray, "T 3"], is_signed: bool = True) -> Float[np.ndarray, "3"] | None:
    """Return the mean squared cosines of vectors, with the signs of the cosines if wanted; None if all vectors are short."""
    cosines = _drop_unknown(_normalise(vectors))
    return np.mean(cosines * (cosines if not is_signed else np.abs(cosines)), axis=0) if len(cosines) else None


def _score_extent(positions: Float[np.ndarray, "T M 3"]) -> Float[np.ndarray, "3"]:
    extent = np.median(np.nanmax(positions, axis=1) - np.nanmin(positions, axis=1), axis=0)
    second, largest = np.sort(extent)[-2:]
    if largest < MIN_BODY_EXTENT_M or second <= 0:
        return np.zeros(3)
    clearness = min(1.0, float(np.log(largest / second) / np.log(CLEAR_EXTENT_RATIO)))
    return TALL_SCORE * clearness * (extent == largest)


def _collect_floor_evidence(positions: Float[np.ndarray, "T M 3"]) -> list[UpAxisEvidence]:
    """Return the evidence of a floor: at the coordinate 0, at a constant coordinate, and of the height of a room."""
    count = (~np.isnan(positions[..., 0])).sum(1)
    if count.max() < MIN_FLOOR_MARKERS:
        return []
    positions = positions[count >= MIN_VISIBLE_FRACTION * count.max()]
    smallest, largest = np.nanmin(positions, axis=1), np.nanmax(positions, axis=1)
    extent = np.median(largest - smallest, axis=0)
    lowest = np.c_[smallest, -largest]
    if extent.max() < MIN_BODY_EXTENT_M:
        return []
    low, middle, high = np.quantile(lowest, [0.05, 0.5, 0.95], axis=0)
    is_at_zero = (low > FLOOR_RANGE_M[0]) & (middle < FLOOR_RANGE_M[1])
    evidence = [UpAxisEvidence("a floor at the height 0", np.where(is_at_zero, FLOOR_AT_ZERO_SCORE, NO_FLOOR_AT_ZERO_SCORE))]
    centre = np.nanmedian(positions, axis=1)
    travel = np.ptp(np.quantile(centre, [0.05, 0.95], axis=0), axis=0)
    if travel.max() > MIN_TRAVEL_FOR_FLOOR_M:
        change = high - low
        scores = np.where(change < MAX_CONSTANT_FLOOR_M, CONSTANT_FLOOR_SCORE, 0.0)
        scores = np.where(change > MIN_CHANGING_FLOOR_M, CHANGING_FLOOR_SCORE, scores)
        evidence.append(UpAxisEvidence("a constant height of the lowest markers", scores))
    flat = positions.reshape(-1, 3)
    span = np.ptp(np.nanquantile(flat, [0.01, 0.99], axis=0), axis=0)
    evidence.append(UpAxisEvidence("the distance travelled", np.tile(np.where(span > MAX_HEIGHT_M, LONG_TRAVEL_SCORE, 0.0), 2)))
    return evidence
