"""People across the takes of a session: who is who, by names and checked by the body.

Takes show the same person if they agree in the name: that in the session file, else the prefix of the labels, else the folder of
the take. Names are checked by the body: distances of markers on one segment or on neighbouring ones. Subjects of one take are
never the same person.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np

from mocapfix.calibrate.body_measurements import BodyMeasurements, compute_body_difference

MAX_BODY_DIFFERENCE = 0.06
"""Median relative difference of marker distances above which two bodies are clearly different, whatever their names. Markers that
were attached again differ by half of it."""
MAX_UNNAMED_DIFFERENCE = 0.03
"""The same for takes that share only a folder. Two takes of one person with the markers left on differ by 0.003 to 0.017, the
bodies of different people by 0.048 and more."""
MAX_COMPARED_TAKES = 20
"""Takes of a person with which another take is compared."""
FOLDER_REASON = "folder of the takes"
UNNAMED_PERSON = "person"


@dataclass(frozen=True)
class Person:
    """A person of a session.

    Attributes:
        name: unique in the session, and a file name.
        takes: the measurements of the person in each take.
        reason: how the takes were recognised.
        notes: sentences on names that the bodies contradict.
    """

    name: str
    takes: tuple[BodyMeasurements, ...]
    reason: str
    notes: tuple[str, ...] = ()


def group_people(bodies: Sequence[BodyMeasurements], names: Mapping[str, Sequence[str]] | None = None) -> list[Person]:
    """Return the people of a session.

    bodies  the measurements of each subject in each take
    names   by name of a person, the ids of the takes that show only that person, or the person among others by prefix
    """
    of_take = {take: name for name, takes in (names or {}).items() for take in takes}
    subject_counts: dict[str, int] = {}
    for body in bodies:
        subject_counts[body.take] = subject_counts.get(body.take, 0) + 1
    groups: list[tuple[str, str, list[BodyMeasurements]]] = []
    notes: dict[int, list[str]] = {}
    for body in bodies:
        has_session_name = body.take in of_take and subject_counts[body.take] == 1
        name, reason = (of_take[body.take], "session file") if has_session_name else find_name(body)
        limit = MAX_UNNAMED_DIFFERENCE if reason == FOLDER_REASON else MAX_BODY_DIFFERENCE
        same_name = [g for g, (other, _, _) in enumerate(groups) if other.casefold() == name.casefold()]
        fitting = [g for g in same_name if can_be_same(body, groups[g][2], limit)]
        if fitting:
            groups[fitting[0]][2].append(body)
            continue
        groups.append((name, reason, [body]))
        if same_name and reason != FOLDER_REASON:
            other = groups[same_name[0]][2][0].take
            notes[len(groups) - 1] = [
                f"{body.take}: is named {name} like {other}, but in the same take or with another body: another person."
            ]
    return _name_uniquely(groups, notes)


def find_name(body: BodyMeasurements) -> tuple[str, str]:
    """Return the name of the person in a take and where it is from: the prefix of the labels, or the folder of the take."""
    if body.label_name:
        return body.label_name, "prefix of the labels"
    folder = PurePosixPath(body.take).parent.as_posix()
    return (UNNAMED_PERSON if folder == "." else folder.replace("/", "-")), FOLDER_REASON


def can_be_same(body: BodyMeasurements, others: Sequence[BodyMeasurements], limit: float) -> bool:
    """Return whether a subject can be the person of other takes: in another take, with the same marker set and a similar body.

    limit  greatest median relative difference of marker distances
    """
    if any(other.take == body.take or other.marker_set != body.marker_set for other in others):
        return False
    differences = [compute_body_difference(body, other) for other in others[:MAX_COMPARED_TAKES]]
    known = [each for each in differences if each is not None]
    return not known or float(np.median(known)) <= limit


def _name_uniquely(groups: Sequence[tuple[str, str, list[BodyMeasurements]]], notes: Mapping[int, list[str]]) -> list[Person]:
    """Return the groups as people with different names, by a number where names agree."""
    people: list[Person] = []
    for g, (name, reason, takes) in enumerate(groups):
        safe = "".join(character if character.isalnum() or character in "-_ " else "_" for character in name) or UNNAMED_PERSON
        number, unique = 2, safe
        while any(each.name.casefold() == unique.casefold() for each in people):
            unique, number = f"{safe}-{number}", number + 1
        people.append(Person(unique, tuple(takes), reason, tuple(notes.get(g, ()))))
    return people
