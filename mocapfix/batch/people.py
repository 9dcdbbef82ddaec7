"""People across the takes of a session: who is who, by names and checked by the body.

Takes show the same person if they agree in the name: that in the session file, else the prefix of the labels, else the folder of
the take. Names are checked by the body: distances of markers on one segment or on neighbouring ones. Subjects of one take are
never the same person.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np
from jaxtyping import Float

from mocapfix.calibrate.calibration_frames import CalibrationFrames
from mocapfix.skeleton import load_cmu31_body

MIN_COMPARED_PAIRS = 8
"""Marker pairs that two takes must have in common to compare their bodies."""
MIN_PAIR_LENGTH_M = 0.10
"""Median distance of a marker pair that is compared."""
MAX_BODY_DIFFERENCE = 0.06
"""Median relative difference of marker distances above which two bodies are clearly different, whatever their names. Markers that
were attached again differ by half of it."""
MAX_UNNAMED_DIFFERENCE = 0.03
"""The same for takes that share only a folder. Two takes of one person with the markers left on differ by 0.003 to 0.017, the
bodies of different people by 0.048 and more."""
FOLDER_REASON = "folder of the takes"
UNNAMED_PERSON = "person"


@dataclass(frozen=True)
class Person:
    """A person of a session.

    Attributes:
        name: unique in the session, and a file name.
        takes: the frames of each take that shows the person.
        reason: how the takes were recognised.
        notes: sentences on names that the bodies contradict.
    """

    name: str
    takes: tuple[CalibrationFrames, ...]
    reason: str
    notes: tuple[str, ...] = ()


def group_people(surveys: Sequence[CalibrationFrames], names: Mapping[str, Sequence[str]] | None = None) -> list[Person]:
    """Return the people of a session.

    surveys  the frames of each subject in each take
    names    by name of a person, the ids of the takes that show only that person, or the person among others by prefix
    """
    of_take = {take: name for name, takes in (names or {}).items() for take in takes}
    subject_counts: dict[str, int] = {}
    for survey in surveys:
        subject_counts[survey.take] = subject_counts.get(survey.take, 0) + 1
    groups: list[tuple[str, str, list[CalibrationFrames]]] = []
    notes: dict[int, list[str]] = {}
    for survey in surveys:
        has_session_name = survey.take in of_take and subject_counts[survey.take] == 1
        name, reason = (of_take[survey.take], "session file") if has_session_name else find_name(survey)
        limit = MAX_UNNAMED_DIFFERENCE if reason == FOLDER_REASON else MAX_BODY_DIFFERENCE
        same_name = [g for g, (other, _, _) in enumerate(groups) if other.casefold() == name.casefold()]
        fitting = [g for g in same_name if can_be_same(survey, groups[g][2], limit)]
        if fitting:
            groups[fitting[0]][2].append(survey)
            continue
        groups.append((name, reason, [survey]))
        if same_name and reason != FOLDER_REASON:
            other = groups[same_name[0]][2][0].take
            notes[len(groups) - 1] = [
                f"{survey.take}: is named {name} like {other}, but in the same take or with another body: another person."
            ]
    return _name_uniquely(groups, notes)


def find_name(survey: CalibrationFrames) -> tuple[str, str]:
    """Return the name of the person in a take and where it is from: the prefix of the labels, or the folder of the take."""
    if survey.subject_name:
        return survey.subject_name, "prefix of the labels"
    folder = PurePosixPath(survey.take).parent.as_posix()
    return (UNNAMED_PERSON if folder == "." else folder.replace("/", "-")), FOLDER_REASON


def can_be_same(survey: CalibrationFrames, others: Sequence[CalibrationFrames], limit: float) -> bool:
    """Return whether a subject can be the person of other takes: in another take, with the same marker set and a similar body.

    limit  greatest median relative difference of marker distances
    """
    if any(other.take == survey.take or other.marker_set != survey.marker_set for other in others):
        return False
    differences = [compute_body_difference(survey, other) for other in others]
    known = [each for each in differences if each is not None]
    return not known or float(np.median(known)) <= limit


def compute_body_difference(first: CalibrationFrames, second: CalibrationFrames) -> float | None:
    """Return the median relative difference of the distances of markers on neighbouring segments; None if too few are common."""
    lengths = [measure_marker_distances(each) for each in (first, second)]
    common = lengths[0].keys() & lengths[1].keys()
    if len(common) < MIN_COMPARED_PAIRS:
        return None
    return float(np.median([abs(np.log(lengths[0][pair] / lengths[1][pair])) for pair in common]))


def measure_marker_distances(survey: CalibrationFrames) -> dict[tuple[str, str], float]:
    """Return the median distances in metres of marker pairs on one segment, which do not depend on the pose."""
    parents = load_cmu31_body().skeleton.parents
    distances: dict[tuple[str, str], float] = {}
    for a, label in enumerate(survey.labels):
        for b in range(a):
            i, j = survey.joints[a], survey.joints[b]
            if i == j or parents[i] == j or parents[j] == i:
                median = _compute_median_distance(survey.markers[:, a], survey.markers[:, b])
                if median > MIN_PAIR_LENGTH_M:
                    distances[survey.labels[b], label] = median
    return distances


def _compute_median_distance(first: Float[np.ndarray, "N 3"], second: Float[np.ndarray, "N 3"]) -> float:
    distance = np.linalg.norm(first - second, axis=1)
    seen = distance[~np.isnan(distance)]
    return float(np.median(seen)) if len(seen) else 0.0


def _name_uniquely(groups: Sequence[tuple[str, str, list[CalibrationFrames]]], notes: Mapping[int, list[str]]) -> list[Person]:
    """Return the groups as people with different names, by a number where names agree."""
    people: list[Person] = []
    for g, (name, reason, takes) in enumerate(groups):
        safe = "".join(character if character.isalnum() or character in "-_ " else "_" for character in name) or UNNAMED_PERSON
        number, unique = 2, safe
        while any(each.name.casefold() == unique.casefold() for each in people):
            unique, number = f"{safe}-{number}", number + 1
        people.append(Person(unique, tuple(takes), reason, tuple(notes.get(g, ()))))
    return people
