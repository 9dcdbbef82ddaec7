"""The stages of a session before its takes are cleaned: survey the takes, find out who is who, and calibrate each person.

What the stages write is in DIR/people: the calibration frames of each take in `surveys`, a subject file for each person, and
one for each take in which markers lie elsewhere. All of it is used again while takes, options and version are the same.
"""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, cast

from mocapfix.batch.child_process import JobLimits, run_in_child
from mocapfix.batch.content_hash import hash_options
from mocapfix.batch.jobs import CleanRequest, get_version, try_to_hash
from mocapfix.batch.people_file import PersonEntry, SessionPeople, write_people_file
from mocapfix.batch.progress import BatchProgress
from mocapfix.batch.task_window import Task, run_tasks
from mocapfix.errors import MocapfixError
from mocapfix.files.output_files import make_output_folder, replace_atomically

if TYPE_CHECKING:
    from distributed import Client

PEOPLE_FOLDER = "people"
SURVEY_STAGE, CALIBRATE_STAGE = "survey", "calibrate"
SURVEY_FUNCTION = "mocapfix.batch.session_people:survey_recorded_take"
CALIBRATE_FUNCTION = "mocapfix.batch.session_people:calibrate_recorded_person"
MIN_PERSON_TAKES = 2
"""Takes of a person from which a subject is calibrated; a single take is calibrated while it is cleaned."""


@dataclass(frozen=True)
class PersonRequest:
    """A person to be calibrated from the frames in files, in the sessions of these names."""

    name: str
    basis: str
    frames: tuple[Path, ...]
    sessions: tuple[str, ...]
    output_folder: Path
    key: str


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
    from mocapfix.batch.people import group_people
    from mocapfix.calibrate.calibration_frames import read_calibration_frames

    by_id = {request.take: request for request in requests}
    surveyed = _run_stage(connect, SURVEY_STAGE, SURVEY_FUNCTION, by_id, limits, progress)
    files = {take: [Path(path) for path in found["files"]] for take, found in surveyed.items()}
    frames_of = {path: read_calibration_frames(path) for paths in files.values() for path in paths}
    path_of = {(frames.take, frames.subject_name): path for path, frames in frames_of.items()}
    people = group_people(list(frames_of.values()), names)
    folder = requests[0].output_folder
    to_calibrate: dict[str, PersonRequest] = {}
    for person in people:
        if len(person.takes) >= MIN_PERSON_TAKES:
            paths = tuple(path_of[take.take, take.subject_name] for take in person.takes)
            sessions = tuple(PurePosixPath(take.take).parent.as_posix() for take in person.takes)
            key = hashlib.sha256("".join(surveyed[take.take]["key"] for take in person.takes).encode()).hexdigest()
            to_calibrate[person.name] = PersonRequest(person.name, person.reason, paths, sessions, folder, key)
    calibrated = _run_stage(connect, CALIBRATE_STAGE, CALIBRATE_FUNCTION, to_calibrate, limits, progress)
    entries = [PersonEntry.model_validate(calibrated[name]["entry"]) for name in to_calibrate if name in calibrated]
    single = [
        PersonEntry(name=each.name, basis=each.reason, takes={take.take: take.subject_name for take in each.takes})
        for each in people
        if each.name not in calibrated
    ]
    notes = tuple(note for person in people for note in person.notes)
    write_people_file(folder, SessionPeople(people=(*entries, *single), notes=notes))
    subjects: dict[str, dict[str, str]] = {}
    for entry in entries:
        for take, subject_name in entry.takes.items():
            subjects.setdefault(take, {})[subject_name] = entry.take_files.get(take, entry.subject_file)
    return [_add_subjects(request, subjects.get(request.take, {})) for request in requests]


def forget_results(folder: Path, *, failed_only: bool) -> None:
    """Let the next batch survey the takes and calibrate the people of a folder again, or survey those whose survey failed."""
    for path in (folder / PEOPLE_FOLDER).rglob("*.json"):
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
    known = {name: _read_record(*_locate_record(request)) for name, request in requests.items()}
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


def run_people_job(function: str, request: Any, limits: JobLimits) -> dict[str, Any] | str:
    """Run a job of this module in a child process; return its result, or why there is none. Run by a worker.

    A process that crashes is repeated `limits.retries` times. A survey that crashed or reached a limit is recorded, so that it is
    repeated with other limits only.
    """
    outcome = run_in_child(function, {"request": request}, limits)
    for _ in range(limits.retries):
        if outcome.status == "crash":
            outcome = run_in_child(function, {"request": request}, limits)
    if isinstance(outcome.value, dict):
        return cast("dict[str, Any]", outcome.value)
    if function == SURVEY_FUNCTION and outcome.status in ("timeout", "memory", "crash"):
        path, key = _locate_record(request)
        _write_record(path, {"key": key, "files": [], "error": outcome.error, "limits": asdict(limits)})
    return outcome.error


def survey_recorded_take(request: CleanRequest) -> dict[str, Any]:
    """Write the calibration frames of each subject in a take, unless they are there; return their files. Run in a child.

    A take without a body has no files, and the sentence on it.
    """
    from mocapfix import pipeline
    from mocapfix.calibrate.calibration_frames import write_calibration_frames

    record = _locate_record(request)[0]

    def survey(key: str) -> dict[str, Any]:
        try:
            found = pipeline.survey_take(request.path, request.options, request.take)
        except MocapfixError as error:
            return {"key": key, "files": [], "error": str(error)}
        paths = [record.with_suffix(f".{number}.npz") for number in range(len(found))]
        for path, frames in zip(paths, found, strict=True):
            write_calibration_frames(path, frames)
        return {"key": key, "files": [str(path) for path in paths], "error": ""}

    return _use_record(*_locate_record(request), survey)


def calibrate_recorded_person(request: PersonRequest) -> dict[str, Any]:
    """Write the subject files of a person, unless they are there, and return the person's entry. Run in a child."""
    from mocapfix.calibrate.calibration_frames import read_calibration_frames
    from mocapfix.calibrate.person_calibration import calibrate_person
    from mocapfix.calibrate.subject_file import write_subject

    folder = request.output_folder / PEOPLE_FOLDER

    def calibrate(key: str) -> dict[str, Any]:
        frames = [read_calibration_frames(path) for path in request.frames]
        person = calibrate_person(frames, request.sessions)
        subject_name = {each.take: each.subject_name for each in frames}
        main = folder / f"{request.name}.subject.yaml"
        write_subject(main, person.subject)
        take_files: dict[str, str] = {}
        for take, subject in person.take_subjects.items():
            path = folder / f"{request.name}.{PurePosixPath(take).with_suffix('').as_posix().replace('/', '-')}.subject.yaml"
            write_subject(path, subject)
            take_files[take] = path.relative_to(request.output_folder).as_posix()
        entry = PersonEntry(
            name=request.name,
            basis=request.basis,
            takes={take: subject_name[take] for take in sorted(person.takes)},
            subject_file=main.relative_to(request.output_folder).as_posix(),
            take_files=take_files,
            moved_markers=tuple(person.describe_moves()),
            rejected=person.rejected,
        )
        return {"key": key, "files": [str(main)], "entry": entry.model_dump(mode="json")}

    return _use_record(*_locate_record(request), calibrate)


def _locate_record(request: CleanRequest | PersonRequest) -> tuple[Path, str]:
    """Return the file with the result of a job, and the key of what the result depends on."""
    folder = request.output_folder / PEOPLE_FOLDER
    if isinstance(request, PersonRequest):
        return folder / f"{request.name}.json", f"{request.key} {request.basis}"
    key = f"{try_to_hash(request.path)} {hash_options(request.options)} {get_version()}"
    return folder / "surveys" / f"{request.take}.json", key


def _read_record(path: Path, key: str) -> dict[str, Any] | None:
    """Return what a file has under the same key and whose files exist; None without such a file."""
    try:
        record = cast("dict[str, Any]", json.loads(path.read_text(encoding="utf-8")))
        return record if record["key"] == key and all(Path(each).is_file() for each in record["files"]) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _use_record(path: Path, key: str, compute: Callable[[str], dict[str, Any]]) -> dict[str, Any]:
    """Return what a file has under the same key, else compute and write it. What another version wrote is computed again."""
    if (known := _read_record(path, key)) and "limits" not in known:
        return known
    make_output_folder(path.parent)
    record = compute(key)
    _write_record(path, record)
    return record


def _write_record(path: Path, record: dict[str, Any]) -> None:
    make_output_folder(path.parent)
    with replace_atomically(path) as part:
        part.write_text(json.dumps(record, indent=1), encoding="utf-8")
