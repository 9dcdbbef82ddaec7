"""The stages of a session before its takes are cleaned: find out who is who, survey the takes of each person, and calibrate it.

What the stages write is in DIR/people: a subject file for each person, and one for each take in which markers lie elsewhere; in
`.records` the measurements of the bodies in each take, and the calibration frames of takes whose person is in others too. All of
it is used again while takes, options and version are the same.
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, cast

from mocapfix.batch.child_process import JobLimits
from mocapfix.batch.jobs import CleanRequest
from mocapfix.batch.people_jobs import (
    CALIBRATE_FUNCTION,
    COMPARE_FUNCTION,
    SURVEY_FUNCTION,
    PersonEntry,
    PersonRequest,
    SessionPeople,
    SurveyRequest,
    locate_record,
    locate_records,
    read_people_record,
    run_people_job,
    write_people_file,
)
from mocapfix.batch.task_window import BatchProgress, Task, run_tasks

if TYPE_CHECKING:
    from distributed import Client

    from mocapfix.subject.people import Person


COMPARE_STAGE, SURVEY_STAGE, CALIBRATE_STAGE = "compare", "survey", "calibrate"
MIN_PERSON_TAKES = 2
"""Takes of a person from which a subject is calibrated; a single take is calibrated while it is cleaned."""


def assign_subjects(
    connect: "Callable[[], Client]",
    requests: Sequence[CleanRequest],
    names: Mapping[str, Sequence[str]],
    limits: JobLimits,
    progress: BatchProgress,
) -> list[CleanRequest]:
    """Return the requests with the subjects calibrated from all takes of each person, and write people.yaml.

    connect  opens the cluster, which is not needed where all was done before
    names    by name of a person, the ids of takes

    Takes that cannot be surveyed, and people with one take, keep their options.
    """
    from mocapfix.subject.body_size import BodyMeasurements
    from mocapfix.subject.people import group_people

    by_id = {request.take: request for request in requests}
    measured = _run_stage(connect, COMPARE_STAGE, COMPARE_FUNCTION, by_id, limits, progress)
    bodies = [BodyMeasurements(**body) for found in measured.values() for body in found["bodies"]]
    people = group_people(bodies, names)
    shared = {body.take for person in people if len(person.takes) >= MIN_PERSON_TAKES for body in person.takes}
    to_survey = {take: SurveyRequest(request) for take, request in by_id.items() if take in shared}
    surveyed = _run_stage(connect, SURVEY_STAGE, SURVEY_FUNCTION, to_survey, limits, progress)
    to_calibrate = {
        request.name: request
        for person in people
        if (request := build_person_request(person, surveyed, requests[0].output_folder))
    }
    calibrated = _run_stage(connect, CALIBRATE_STAGE, CALIBRATE_FUNCTION, to_calibrate, limits, progress)
    entries = [PersonEntry.model_validate(calibrated[name]["entry"]) for name in to_calibrate if name in calibrated]
    single = [
        PersonEntry(name=each.name, basis=each.reason, takes={take.take: take.subject_name for take in each.takes})
        for each in people
        if each.name not in calibrated
    ]
    notes = tuple(note for person in people for note in person.notes)
    write_people_file(requests[0].output_folder, SessionPeople(people=(*entries, *single), notes=notes))
    subjects: dict[str, dict[str, str]] = {}
    for entry in entries:
        for take, subject_name in entry.takes.items():
            subjects.setdefault(take, {})[subject_name] = entry.take_files.get(take, entry.subject_file)
    return [_add_subjects(request, subjects.get(request.take, {})) for request in requests]


def build_person_request(person: "Person", surveyed: Mapping[str, dict[str, Any]], folder: Path) -> PersonRequest | None:
    """Return the request to calibrate a person from the takes that were surveyed; None if they are too few.

    surveyed  by id of a take, the record of its survey
    folder    of the batch
    """
    paths = {
        body.take: Path(surveyed[body.take]["subjects"][body.subject_name])
        for body in person.takes
        if body.take in surveyed and body.subject_name in surveyed[body.take]["subjects"]
    }
    if len(paths) < MIN_PERSON_TAKES:
        return None
    sessions = tuple(PurePosixPath(take).parent.as_posix() for take in paths)
    key = hashlib.sha256("".join(surveyed[take]["key"] for take in paths).encode()).hexdigest()
    return PersonRequest(person.name, person.reason, tuple(paths.values()), sessions, folder, key)


def forget_results(folder: Path, *, failed_only: bool) -> None:
    """Let the next batch survey the takes and calibrate the people of a folder again, or survey those whose survey failed."""
    for path in locate_records(folder).rglob("*.json"):
        if not failed_only or b'"limits"' in path.read_bytes():
            path.unlink()


def _add_subjects(request: CleanRequest, files: Mapping[str, str]) -> CleanRequest:
    """Return the request with the subject files of a take, by the names of its subjects."""
    if not files:
        return request
    paths = {name: request.output_folder / path for name, path in files.items()}
    subject = paths[""] if set(paths) == {""} else tuple(paths.items())
    return replace(request, options=request.options.change(subject=subject), subject_files=tuple(files.items()))


def _run_stage(
    connect: "Callable[[], Client]",
    stage: str,
    function: str,
    requests: Mapping[str, Any],
    limits: JobLimits,
    progress: BatchProgress,
) -> dict[str, dict[str, Any]]:
    """Run a function on each request in child processes and return the results of those that succeeded, by name.

    They are in the order of the requests, not in that in which the jobs end: people and their subjects depend on the order.
    """
    known = {name: read_people_record(*locate_record(request)) for name, request in requests.items()}
    results = {name: found for name, found in known.items() if found and found.get("limits", asdict(limits)) == asdict(limits)}
    waiting = {name: request for name, request in requests.items() if name not in results}
    if not waiting:
        return results
    progress.start_stage(stage, len(requests), len(results))
    tasks = (Task(name, (function, request, limits)) for name, request in waiting.items())
    for task, result in run_tasks(connect(), run_people_job, tasks, progress.start_job, progress.show_message):
        if isinstance(result, dict):
            results[task.name] = cast("dict[str, Any]", result)
        else:  # a take that can be cleaned alone has not failed
            progress.show_message(f"{task.name}: not in the {stage} ({result}) It is cleaned without the person's other takes.")
        progress.finish_job(task.name, "")
    return {name: results[name] for name in requests if name in results}
