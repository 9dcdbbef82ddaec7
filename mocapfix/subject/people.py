"""People across the takes of a session: who is who, their calibration, and their subject files.

Takes show the same person if they agree in the name: that in the session file, else the prefix of the labels, else the folder
of the take. Names are checked by the body: distances of markers on one segment or on neighbouring ones, which do not depend on
the pose. Subjects of one take are never the same person. A person has one subject file for all takes, and one for each take in
which markers lie elsewhere.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float, Int
from threadpoolctl import threadpool_limits

from mocapfix.io.files import find_common_folder
from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.system import make_file_name
from mocapfix.model.take import Take
from mocapfix.options import CleanOptions
from mocapfix.stats.sequences import sample_evenly
from mocapfix.subject.average_body import find_near_pairs
from mocapfix.subject.calibration import CalibrationFrames
from mocapfix.subject.library import write_subject
from mocapfix.subject.person_calibration import PersonCalibration, calibrate_person

MAX_MEASURED_FRAMES = 200
MIN_COMPARED_PAIRS = 8  # marker pairs that two takes must have in common to compare their bodies
MIN_PAIR_LENGTH_M = 0.10  # median distance of a marker pair that is compared


@dataclass(frozen=True)
class BodyMeasurements:
    """Distances between markers of one subject in a take."""

    take: str  # id of the take
    subject_name: str  # name of the subject among several in the take; "" if it is the only one
    label_name: str  # name of the person in the labels; "" if they have none
    marker_set: str  # name of the marker set
    # Median distance of markers on one segment or on neighbouring ones, by their labels joined with a space.
    distances_m: dict[str, float]


def measure_body(take_id: str, take: Take, marker_set: MarkerSet) -> BodyMeasurements:
    """Return the measurements of the subject of a take. A few faulty samples do not change them, since they are medians."""
    columns = marker_set.find_columns(take.labels)
    seen = np.flatnonzero(columns >= 0)
    markers = take.markers[sample_evenly(len(take.markers), MAX_MEASURED_FRAMES)][:, columns[seen]]
    labels = [marker_set.labels[k] for k in seen]
    distances_m = measure_marker_distances(markers, labels, marker_set.joints[seen])
    return BodyMeasurements(take_id, take.subject_name, take.main_subject, marker_set.name, distances_m)


def measure_marker_distances(
    markers: Float[np.ndarray, "N K 3"], labels: Sequence[str], joints: Int[np.ndarray, " K"]
) -> dict[str, float]:
    """Return the median distances in metres of marker pairs whose joints are the same or neighbours."""
    second, first = find_near_pairs(joints)
    distance = np.linalg.norm(markers[:, second] - markers[:, first], axis=2)
    known = (~np.isnan(distance)).any(0)
    median = np.nanmedian(distance[:, known], axis=0)
    kept = median > MIN_PAIR_LENGTH_M
    pairs = zip(first[known][kept], second[known][kept], median[kept], strict=True)
    return {f"{labels[a]} {labels[b]}": round(float(length), 6) for a, b, length in pairs}


def compute_body_difference(first: BodyMeasurements, second: BodyMeasurements) -> float | None:
    """Return the median relative difference of the distances that two subjects have in common; None if they are too few."""
    common = sorted(first.distances_m.keys() & second.distances_m.keys())
    if len(common) < MIN_COMPARED_PAIRS:
        return None
    lengths = np.array([[each.distances_m[pair] for pair in common] for each in (first, second)])
    return float(np.median(np.abs(np.log(lengths[0] / lengths[1]))))


# Median relative difference of marker distances above which two bodies are clearly different, whatever their names. Markers that
# were attached again differ by half of it.
MAX_BODY_DIFFERENCE = 0.06
# The same for takes that share only a folder. Two takes of one person with the markers left on differ by 0.003 to 0.017, the
# bodies of different people by 0.048 and more.
MAX_UNNAMED_DIFFERENCE = 0.03
MAX_COMPARED_TAKES = 20  # takes of a person with which another take is compared
FOLDER_REASON = "folder of the takes"
UNNAMED_PERSON = "person"


@dataclass(frozen=True)
class Person:
    """A person of a session."""

    name: str  # unique in the session, and a file name
    takes: tuple[BodyMeasurements, ...]  # the measurements of the person in each take
    reason: str  # how the takes were recognised
    notes: tuple[str, ...] = ()  # sentences on names that the bodies contradict


def group_people(bodies: Sequence[BodyMeasurements], names: Mapping[str, Sequence[str]] | None = None) -> list[Person]:
    """Return the people of a session; `names` are the takes of each known one, alone or among others by prefix."""
    of_take = {take: name for name, takes in (names or {}).items() for take in takes}
    subject_counts: dict[str, int] = {}
    for body in bodies:
        subject_counts[body.take] = subject_counts.get(body.take, 0) + 1
    groups: list[tuple[str, str, list[BodyMeasurements]]] = []
    notes: dict[int, list[str]] = {}
    for body in bodies:
        folder = PurePosixPath(body.take).parent.as_posix()
        name, reason = (UNNAMED_PERSON if folder == "." else folder.replace("/", "-")), FOLDER_REASON
        if body.take in of_take and subject_counts[body.take] == 1:
            name, reason = of_take[body.take], "session file"
        elif body.label_name:
            name, reason = body.label_name, "prefix of the labels"
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


def can_be_same(body: BodyMeasurements, others: Sequence[BodyMeasurements], limit: float) -> bool:
    """Return whether a subject can be the person of other takes: in another take, with the same marker set and a similar body.

    Args:
        limit: Greatest median relative difference of marker distances.
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
        safe = make_file_name(name.replace(".", "_")) or UNNAMED_PERSON
        number, unique = 2, safe
        while any(each.name.casefold() == unique.casefold() for each in people):
            unique, number = f"{safe}-{number}", number + 1
        people.append(Person(unique, tuple(takes), reason, tuple(notes.get(g, ()))))
    return people


SUBJECT_SUFFIX = ".subject.yaml"


@dataclass(frozen=True)
class PersonFiles:
    """Where the subjects of a person are."""

    main: Path  # the subject file for takes in which the markers have their usual places
    by_take: dict[str, Path]  # by id of a take, the file with the places of that take


def locate_person_files(folder: Path, name: str, person: PersonCalibration) -> PersonFiles:
    """Return the paths of the subject files of a person with a name, in a folder."""
    by_take = {
        take: folder / f"{name}.{PurePosixPath(take).with_suffix('').as_posix().replace('/', '-')}{SUBJECT_SUFFIX}"
        for take in person.take_subjects
    }
    return PersonFiles(folder / f"{name}{SUBJECT_SUFFIX}", by_take)


def write_person_files(files: PersonFiles, person: PersonCalibration) -> None:
    """Write the subject files of a person, those of single takes with notes on what lies elsewhere. Raises WriteError."""
    write_subject(files.main, person.subject)
    for take, path in files.by_take.items():
        write_subject(path, replace(person.take_subjects[take], notes=person.describe_take(take)))


TakeGuard = Callable[[Path], AbstractContextManager[object]]  # in which a take is worked on


@dataclass(frozen=True)
class CalibratedPerson:
    """A person of several takes."""

    name: str  # unique among the people, and a file name; "" for the only person
    calibration: PersonCalibration  # bones and marker places
    notes: tuple[str, ...] = ()  # sentences on names that the bodies contradict

    def describe(self) -> list[str]:
        """Return what a technician must know of the calibration: moved markers, and takes that do not fit."""
        return [*self.notes, *self.calibration.describe_moves(), *self.calibration.rejected.values()]


def calibrate_one_person(
    paths: Sequence[Path], options: CleanOptions, mean_pose_prior: str, guard: TakeGuard = nullcontext
) -> list[CalibratedPerson]:
    """Calibrate the person of all takes; none if `guard` leaves no take. Raises TakeError as `calibrate_takes`."""
    from mocapfix.surveys import survey_person

    surveys: list[CalibrationFrames] = []
    for path, take in zip(paths, name_takes(paths), strict=True):
        with guard(path):
            surveys += survey_person([path], [take], options)
    return [CalibratedPerson("", calibrate_with_one_thread(surveys, mean_pose_prior))] if surveys else []


def calibrate_people(
    paths: Sequence[Path], options: CleanOptions, mean_pose_prior: str, guard: TakeGuard = nullcontext
) -> list[CalibratedPerson]:
    """Calibrate all people in takes. Who is who: by the names in the labels or the folders of the takes, checked by the body."""
    from mocapfix.surveys import BodyToCalibrate, find_bodies_to_calibrate, survey_subject

    found: dict[tuple[str, str], BodyToCalibrate] = {}
    path_of_take = dict(zip(name_takes(paths), paths, strict=True))
    for take, path in path_of_take.items():
        with guard(path):
            for body in find_bodies_to_calibrate(path, options):
                found[take, body.take.subject_name] = body
    bodies = [measure_body(take, body.take, body.marker_set) for (take, _), body in found.items()]
    people: list[CalibratedPerson] = []
    for person in group_people(bodies):
        keys = [(body.take, body.subject_name) for body in person.takes]
        surveys: list[CalibrationFrames] = []
        for key in keys:
            with guard(path_of_take[key[0]]):
                surveys.append(survey_subject(found[key], options, key[0]))
        if surveys:
            people.append(CalibratedPerson(person.name, calibrate_with_one_thread(surveys, mean_pose_prior), person.notes))
    return people


def name_takes(paths: Sequence[Path]) -> list[str]:
    """Return an id of each take: its path relative to the folder that contains all of them, with "/". Raises ReadError."""
    resolved = [path.resolve() for path in paths]
    folder = find_common_folder(resolved)
    return [path.relative_to(folder).as_posix() for path in resolved]


def calibrate_with_one_thread(surveys: Sequence[CalibrationFrames], mean_pose_prior: str) -> PersonCalibration:
    """Calibrate a person from takes whose sessions are their folders, without threads of the BLAS library."""
    sessions = [PurePosixPath(each.take).parent.as_posix() for each in surveys]
    with threadpool_limits(limits=1, user_api="blas"):
        return calibrate_person(surveys, sessions, mean_pose_prior)
