"""The calibration of people from a list of takes: of one person whom all takes show, or of several."""

import os
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from threadpoolctl import threadpool_limits

from mocapfix.calibrate.body_measurements import measure_body
from mocapfix.calibrate.calibration_frames import CalibrationFrames
from mocapfix.calibrate.people import group_people
from mocapfix.calibrate.person_calibration import PersonCalibration, calibrate_person
from mocapfix.options import CleanOptions
from mocapfix.state import CleaningState

TakeGuard = Callable[[Path], AbstractContextManager[object]]
"""returns the context in which a take is worked on; it may catch what is raised, and the other takes go on"""


@dataclass(frozen=True)
class CalibratedPerson:
    """A person of several takes.

    name         unique among the people, and a file name; "" for the only person
    calibration  bones and marker places
    notes        sentences on names that the bodies contradict
    """

    name: str
    calibration: PersonCalibration
    notes: tuple[str, ...] = ()

    def describe(self) -> list[str]:
        """Return what a technician must know of the calibration: moved markers, and takes that do not fit."""
        return [*self.notes, *self.calibration.describe_moves(), *self.calibration.rejected.values()]


def calibrate_one_person(
    paths: Sequence[Path], options: CleanOptions, mean_pose_prior: str, guard: TakeGuard = nullcontext
) -> list[CalibratedPerson]:
    """Calibrate the person whom all takes show. Returns one person, none if no take is left by `guard`.

    Raises TakeError as `pipeline.calibrate_takes`.
    """
    from mocapfix import pipeline

    surveys: list[CalibrationFrames] = []
    for path, take in zip(paths, name_takes(paths), strict=True):
        with guard(path):
            surveys += pipeline.survey_person([path], [take], options)
    return [CalibratedPerson("", calibrate_with_one_thread(surveys, mean_pose_prior))] if surveys else []


def calibrate_people(
    paths: Sequence[Path], options: CleanOptions, mean_pose_prior: str, guard: TakeGuard = nullcontext
) -> list[CalibratedPerson]:
    """Calibrate all people in takes. Who is who: by the names in the labels or the folders of the takes, checked by the body.

    Raises TakeError if a take cannot be read or shows no body.
    """
    from mocapfix import pipeline

    states: dict[tuple[str, str], CleaningState] = {}
    path_of_take = dict(zip(name_takes(paths), paths, strict=True))
    for take, path in path_of_take.items():
        with guard(path):
            for state in pipeline.find_bodies_to_calibrate(path, options):
                states[take, state.original_take.subject_name] = state
    bodies = [
        measure_body(take, state.original_take, state.marker_set) for (take, _), state in states.items() if state.marker_set
    ]
    people: list[CalibratedPerson] = []
    for person in group_people(bodies):
        keys = [(body.take, body.subject_name) for body in person.takes]
        surveys: list[CalibrationFrames] = []
        for key in keys:
            with guard(path_of_take[key[0]]):
                surveys.append(pipeline.survey_subject(states[key], options, key[0]))
        if surveys:
            people.append(CalibratedPerson(person.name, calibrate_with_one_thread(surveys, mean_pose_prior), person.notes))
    return people


def name_takes(paths: Sequence[Path]) -> list[str]:
    """Return an id of each take: its path relative to the folder that contains all of them, with "/"."""
    resolved = [path.resolve() for path in paths]
    folder = os.path.commonpath([path.parent for path in resolved])
    return [path.relative_to(folder).as_posix() for path in resolved]


def calibrate_with_one_thread(surveys: Sequence[CalibrationFrames], mean_pose_prior: str) -> PersonCalibration:
    """Calibrate a person from takes whose sessions are their folders, without threads of the BLAS library."""
    sessions = [PurePosixPath(each.take).parent.as_posix() for each in surveys]
    with threadpool_limits(limits=1, user_api="blas"):
        return calibrate_person(surveys, sessions, mean_pose_prior)
