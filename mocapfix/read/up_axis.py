"""Estimate which axis of a file points up, from what a body does: where its head, its feet and the floor are, and how it falls.

The axis is the one with the most evidence. Each kind of evidence adds to or subtracts from the score of an axis, as a logarithm
of odds: a head above the feet is likely for an upright person and unlikely for one who lies, and the lowest markers of most
captures are on a floor at the height 0.
"""

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.stats.sequences import sample_evenly
from mocapfix.take import UpAxis

AXIS_NAMES = "XYZ"
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
LABEL_SIDES = (("LEFT", "RIGHT"), ("L", "R"))
WORD_PATTERN = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")

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
# Weight of the evidence of the floor where no label names a part of the body: there may be no body that stands on it.
UNKNOWN_MARKERS_FACTOR = 0.5
UPRIGHT_BASIS = "head, pelvis and feet"
# Number of frames, evenly spread, in which a body and the floor are looked for, and of markers whose fall is measured.
MAX_INSPECTED_FRAMES = 300
MAX_FALLING_MARKERS = 12
# Least difference of two scores at which the better one is certain.
MIN_CERTAIN_SCORE = 2.0

# Least distance in metres between body parts of different height.
MIN_PART_DISTANCE_M = 0.2
# Ratio of the largest to the second largest extent of a body that is clearly tall along one axis.
CLEAR_EXTENT_RATIO = 1.5
# Smallest extent in metres of a body; a smaller set of markers shows no floor.
MIN_BODY_EXTENT_M = 0.5
# Number of markers below which their lowest is no evidence of a floor.
MIN_FLOOR_MARKERS = 6
# Number of visible markers, as a fraction of the largest, in a frame from whose lowest marker the floor is estimated.
MIN_VISIBLE_FRACTION = 0.8
# Range in metres of the height of the lowest markers, on a floor at the height 0.
FLOOR_RANGE_M = (-0.05, 0.12)
# Distance in metres along any axis that a person travels who shows whether the lowest height changes, and by how much it does.
MIN_TRAVEL_FOR_FLOOR_M = 0.3
MAX_CONSTANT_FLOOR_M = 0.06
MIN_CHANGING_FLOOR_M = 0.4
# Extent in metres of a take along an axis that is more than a person climbs or falls.
MAX_HEIGHT_M = 3.0
# Acceleration of free fall, its tolerance, and that of the other axes, in m/s2; the time between the compared positions and
# the shortest flight, both in seconds.
GRAVITY_M_PER_S2 = 9.81
GRAVITY_TOLERANCE_M_PER_S2 = 1.0
FALL_STEP_S = 0.05
MIN_FALL_S = 0.1


class UpAxisEvidence(NamedTuple):
    """Scores (3,) of the axes by one kind of evidence, and what it is, in a few words."""

    description: str
    scores: Float[np.ndarray, "3"]


def estimate_up_axis(
    labels: Sequence[str], positions_file: Float[np.ndarray, "T M 3"], rate: float, default_axis: str = "Z"
) -> UpAxis:
    """Estimate the up axis of a file.

    Args:
        labels: Marker labels.
        positions_file: Positions (m) in file axes, NaN where missing.
        rate: Frames per second.
        default_axis: The up axis of most files of the format.
    """
    inspected = positions_file[sample_evenly(len(positions_file), MAX_INSPECTED_FRAMES)]
    seen = inspected[np.any(~np.isnan(inspected[..., 0]), axis=1)]
    default = UpAxisEvidence("the usual axis of the format", _score_default(default_axis))
    if not len(seen):
        return UpAxis(default_axis, default.description, is_certain=False)
    body, floor = _collect_body_evidence(labels, seen), _collect_floor_evidence(seen)
    has_body = any(each.description == UPRIGHT_BASIS for each in body)
    if not has_body:
        floor = [UpAxisEvidence(each.description, UNKNOWN_MARKERS_FACTOR * each.scores) for each in floor]
    evidence = [default, *body, *floor]
    if (fall := find_free_fall(positions_file, rate)).any():
        evidence.append(UpAxisEvidence("free fall", FREE_FALL_SCORE * fall))
    total = np.sum([each.scores for each in evidence], axis=0)
    second, best = (int(axis) for axis in np.argsort(total)[-2:])
    is_certain = bool(total[best] - total[second] >= MIN_CERTAIN_SCORE)
    if not is_certain and not has_body:
        return UpAxis(default_axis, default.description, is_certain=False)
    margins = [(each.scores[best] - each.scores[second], each.description) for each in evidence]
    reasons = [description for margin, description in sorted(margins, reverse=True) if margin > 0]
    return UpAxis(AXIS_NAMES[best], ", ".join(reasons), is_certain and (has_body or bool(fall.any())))


def find_free_fall(positions_file: Float[np.ndarray, "T M 3"], rate: float) -> Bool[np.ndarray, "3"]:
    """Return along which axes the markers fall freely, on average, for some time."""
    step = max(1, round(FALL_STEP_S * rate))
    falls = np.zeros(3, bool)
    positions_file = positions_file[:, sample_evenly(positions_file.shape[1], MAX_FALLING_MARKERS)]
    if len(positions_file) <= 2 * step:
        return falls
    bend = positions_file[2 * step :] - 2 * positions_file[step:-step] + positions_file[: -2 * step]
    is_known = ~np.isnan(bend[..., 0])
    is_enough = is_known.sum(1) > is_known.shape[1] / 2
    mean = np.where(is_known[..., None], bend, 0.0).sum(1) / np.maximum(is_known.sum(1), 1)[:, None]
    acceleration = mean * (rate / step) ** 2
    needed = max(2, round(MIN_FALL_S * rate))
    for axis in range(3):
        others = np.delete(acceleration, axis, axis=1)
        is_fall = np.abs(acceleration[:, axis] + GRAVITY_M_PER_S2) < GRAVITY_TOLERANCE_M_PER_S2
        is_fall &= is_enough & (np.abs(others) < GRAVITY_TOLERANCE_M_PER_S2).all(1)
        falls[axis] = len(is_fall) >= needed and bool((np.convolve(is_fall, np.ones(needed), "valid") >= needed).any())
    return falls


def classify_label_height(label: str) -> int | None:
    """Return 2 for a label of the head or shoulders, 1 for the pelvis, 0 for the feet, None for any other."""
    words = [word.upper() for word in WORD_PATTERN.findall(label.rsplit(":", 1)[-1])]
    name = "".join(words)
    names = {
        name,
        *(name.removeprefix(side) for pair in LABEL_SIDES for side in pair),
        *(name.removesuffix(side) for side in LABEL_SIDES[1]),
    }
    names |= {word for word in words if len(word) > 2}
    heights = [height for height, known in ((2, HEAD_NAMES), (1, PELVIS_NAMES), (0, FOOT_NAMES)) if names & known]
    return heights[-1] if heights else None


def _score_default(default_axis: str) -> Float[np.ndarray, "3"]:
    scores = np.array([X_AXIS_SCORE, OTHER_AXIS_SCORE, OTHER_AXIS_SCORE])
    scores[AXIS_NAMES.index(default_axis)] = 0.0
    return scores


def _collect_body_evidence(labels: Sequence[str], positions: Float[np.ndarray, "T M 3"]) -> list[UpAxisEvidence]:
    """Return the evidence of the heights of body parts, or else of the extent of the markers, and that of the two sides."""
    evidence: list[UpAxisEvidence] = []
    heights = np.array([-1 if (height := classify_label_height(label)) is None else height for label in labels])
    upright = next(
        (
            found
            for pair in ((2, 0), (1, 0), (2, 1))
            if (found := _measure_direction(positions, *(heights == each for each in pair))) is not None
        ),
        None,
    )
    if upright is not None:
        evidence.append(UpAxisEvidence(UPRIGHT_BASIS, UPRIGHT_SCORE * upright))
    else:
        evidence.append(UpAxisEvidence("the largest extent", _score_extent(positions)))
    left, right = _find_sides(labels)
    lateral = _measure_direction(positions, left, right)
    if lateral is not None:
        evidence.append(UpAxisEvidence("left and right", LATERAL_SCORE * lateral))
    return evidence


def _measure_direction(
    positions: Float[np.ndarray, "T M 3"], end: Bool[np.ndarray, " M"], start: Bool[np.ndarray, " M"]
) -> Float[np.ndarray, "3"] | None:
    """Return the mean squared cosines of the direction between two groups of markers; None if they are rarely apart."""
    means: list[np.ndarray] = []
    for group in (end, start):
        own = positions[:, group]
        count = (~np.isnan(own[..., :1])).sum(1)
        with np.errstate(invalid="ignore", divide="ignore"):
            means.append(np.nansum(own, axis=1) / np.where(count > 0, count, np.nan))
    difference = means[0] - means[1]
    length = np.linalg.norm(difference, axis=-1)
    is_apart = length > MIN_PART_DISTANCE_M
    return np.mean((difference[is_apart] / length[is_apart, None]) ** 2, axis=0) if is_apart.any() else None


def _find_sides(labels: Sequence[str]) -> tuple[Bool[np.ndarray, " M"], Bool[np.ndarray, " M"]]:
    """Return which markers are the left and which the right ones of pairs whose labels differ in one letter or word."""
    index = {label.upper(): m for m, label in enumerate(labels)}
    left, right = np.zeros(len(labels), bool), np.zeros(len(labels), bool)
    for name, m in index.items():
        subject, _, bare = name.rpartition(":")
        prefix = f"{subject}:" if subject else ""
        for left_word, right_word in LABEL_SIDES:
            other = f"{prefix}{right_word}{bare.removeprefix(left_word)}"
            if bare.startswith(left_word) and other in index:
                left[m] = right[index[other]] = True
                break
    return left, right


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
    lowest = np.nanmin(positions, axis=1)
    extent = np.median(np.nanmax(positions, axis=1) - lowest, axis=0)
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
    evidence.append(UpAxisEvidence("the distance travelled", np.where(span > MAX_HEIGHT_M, LONG_TRAVEL_SCORE, 0.0)))
    return evidence
