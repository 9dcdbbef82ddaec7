"""What the children of a batch's workers do before takes are cleaned: measure and survey takes, and calibrate people.

Each job writes a record with its result, which is used again while its key is the same.

The people of a session, people.yaml in the folder of a batch: who they are, their takes, and the markers that moved.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from pydantic import Field

from mocapfix.batch.child_process import JobLimits, run_in_child
from mocapfix.batch.jobs import CleanRequest, get_version, try_to_hash
from mocapfix.batch.records import hash_options
from mocapfix.errors import MocapfixError
from mocapfix.io.files import make_output_folder, replace_atomically
from mocapfix.io.yaml_files import StrictModel, dump_yaml, read_yaml_model

if TYPE_CHECKING:
    from mocapfix.state import CleaningState


PEOPLE_FILE_NAME = "people.yaml"


class PersonEntry(StrictModel):
    """One person of a session. Paths are relative to the folder of the batch.

    basis          from what it is known which takes are this person's, in words such as "subject prefix" or "body"
    takes          by id of a take, the name of the subject in it; "" if it has only one
    subject_file   calibrated from all takes
    take_files     by id of a take, the subject file with which it was cleaned, where marker places differ
    moved_markers  a sentence for each marker that moved between takes
    rejected       by id of a take, why it is not this person's although the names agree
    """

    name: str
    basis: str = ""
    takes: dict[str, str] = Field(default_factory=dict)
    subject_file: str = ""
    take_files: dict[str, str] = Field(default_factory=dict)
    moved_markers: tuple[str, ...] = ()
    rejected: dict[str, str] = Field(default_factory=dict)


class SessionPeople(StrictModel):
    """All people of a session, and sentences on how takes were assigned to them."""

    people: tuple[PersonEntry, ...] = ()
    notes: tuple[str, ...] = ()


def write_people_file(output_folder: Path, people: SessionPeople) -> Path:
    """Write people.yaml into the folder of a batch and return its path. Raises WriteError."""
    path = output_folder / PEOPLE_FILE_NAME
    with replace_atomically(path) as part:
        part.write_text(dump_yaml(people.model_dump(mode="json")), encoding="utf-8")
    return path


def read_people_file(output_folder: Path) -> SessionPeople | None:
    """Return the people of a batch, None if the session has no such file. Raises SceneError if it cannot be read."""
    path = output_folder / PEOPLE_FILE_NAME
    return read_yaml_model(SessionPeople, path) if path.exists() else None


PEOPLE_FOLDER = "people"
RECORDS_FOLDER = ".records"
"""in that folder: hidden, so that no outputs of a take are there, whatever its name"""
COMPARE_FUNCTION = "mocapfix.batch.people_jobs:measure_recorded_take"
SURVEY_FUNCTION = "mocapfix.batch.people_jobs:survey_recorded_take"
CALIBRATE_FUNCTION = "mocapfix.batch.people_jobs:calibrate_recorded_person"


@dataclass(frozen=True)
class SurveyRequest:
    """A take to be surveyed."""

    take: CleanRequest


@dataclass(frozen=True)
class PersonRequest:
    """A person to be calibrated from the frames in files, in the sessions of these names."""

    name: str
    basis: str
    frames: tuple[Path, ...]
    sessions: tuple[str, ...]
    output_folder: Path
    key: str


def run_people_job(function: str, request: Any, limits: JobLimits) -> dict[str, Any] | str:
    """Run a job of this module in a child process; return its result, or why there is none. Run by a worker.

    A process that crashes is repeated `limits.retries` times. The crash of a take, or a limit that it reached, is recorded: the
    job is repeated with other limits only.
    """
    outcome = run_in_child(function, {"request": request}, limits)
    for _ in range(limits.retries):
        if outcome.status == "crash":
            outcome = run_in_child(function, {"request": request}, limits)
    if isinstance(outcome.value, dict):
        return cast("dict[str, Any]", outcome.value)
    if function != CALIBRATE_FUNCTION and outcome.status in ("timeout", "memory", "crash"):
        path, key = locate_record(request)
        _write_record(
            path, {"key": key, "files": [], "bodies": [], "subjects": {}, "error": outcome.error, "limits": asdict(limits)}
        )
    return outcome.error


def measure_recorded_take(request: CleanRequest) -> dict[str, Any]:
    """Measure the bodies in a take, unless they are known; return them. Run in a child.

    A take without a body has none, and the sentence on it. A take that has to be labelled, or whose marker set has to be learned,
    is surveyed at once, since that is most of the work.
    """
    from mocapfix import pipeline
    from mocapfix.subject.body_size import measure_body

    def measure(key: str) -> dict[str, Any]:
        try:
            states = pipeline.find_bodies_to_calibrate(request.path, request.options)
            if any(state.has_learned_set or state.original_take.labelled_file is not None for state in states):
                survey = SurveyRequest(request)
                _use_record(*locate_record(survey), lambda survey_key: _write_surveys(survey, survey_key, states))
        except MocapfixError as error:
            return {"key": key, "files": [], "bodies": [], "error": str(error)}
        sets = [(state.original_take, state.marker_set) for state in states]
        bodies = [asdict(measure_body(request.take, take, marker_set)) for take, marker_set in sets if marker_set]
        return {"key": key, "files": [], "bodies": bodies, "error": ""}

    return _use_record(*locate_record(request), measure)


def survey_recorded_take(request: SurveyRequest) -> dict[str, Any]:
    """Write the calibration frames of each subject in a take, unless they are there; return their files. Run in a child.

    A take whose frames do not suffice has no files, and the sentence on it.
    """
    from mocapfix import pipeline

    def survey(key: str) -> dict[str, Any]:
        try:
            return _write_surveys(request, key, pipeline.find_bodies_to_calibrate(request.take.path, request.take.options))
        except MocapfixError as error:
            return {"key": key, "files": [], "subjects": {}, "error": str(error)}

    return _use_record(*locate_record(request), survey)


def _write_surveys(request: SurveyRequest, key: str, states: "Sequence[CleaningState]") -> dict[str, Any]:
    """Write the calibration frames of the subjects of a take; return the record. Raises MocapfixError."""
    from mocapfix import pipeline
    from mocapfix.subject.calibration import write_calibration_frames

    path, take = locate_record(request)[0], request.take
    found = [pipeline.survey_subject(state, take.options, take.take) for state in states]
    files = {frames.subject_name: str(path.with_suffix(f".{number}.npz")) for number, frames in enumerate(found)}
    make_output_folder(path.parent)
    for frames in found:
        write_calibration_frames(Path(files[frames.subject_name]), frames)
    return {"key": key, "files": list(files.values()), "subjects": files, "error": ""}


def calibrate_recorded_person(request: PersonRequest) -> dict[str, Any]:
    """Write the subject files of a person, unless they are there, and return the person's entry. Run in a child."""
    from mocapfix.subject.calibration import read_calibration_frames
    from mocapfix.subject.people import locate_person_files, write_person_files
    from mocapfix.subject.person_calibration import calibrate_person

    folder = request.output_folder / PEOPLE_FOLDER

    def calibrate(key: str) -> dict[str, Any]:
        frames = [read_calibration_frames(path) for path in request.frames]
        person = calibrate_person(frames, request.sessions)
        subject_name = {each.take: each.subject_name for each in frames}
        files = locate_person_files(folder, request.name, person)
        write_person_files(files, person)
        entry = PersonEntry(
            name=request.name,
            basis=request.basis,
            takes={take: subject_name[take] for take in sorted(person.takes)},
            subject_file=files.main.relative_to(request.output_folder).as_posix(),
            take_files={take: path.relative_to(request.output_folder).as_posix() for take, path in files.by_take.items()},
            moved_markers=tuple(person.describe_moves()),
            rejected=person.rejected,
        )
        return {"key": key, "files": [str(files.main)], "entry": entry.model_dump(mode="json")}

    return _use_record(*locate_record(request), calibrate)


def locate_record(request: CleanRequest | SurveyRequest | PersonRequest) -> tuple[Path, str]:
    """Return the file with the result of a job, and the key of what the result depends on."""
    if isinstance(request, PersonRequest):
        return locate_records(request.output_folder) / f"{request.name}.json", f"{request.key} {request.basis}"
    take, suffix = (request.take, ".survey.json") if isinstance(request, SurveyRequest) else (request, ".bodies.json")
    key = f"{try_to_hash(take.path)} {hash_options(take.options)} {get_version()}"
    return locate_records(take.output_folder) / "takes" / f"{take.take}{suffix}", key


def locate_records(output_folder: Path) -> Path:
    """Return the folder with the records of the jobs in the output folder of a batch."""
    return output_folder / PEOPLE_FOLDER / RECORDS_FOLDER


def read_people_record(path: Path, key: str) -> dict[str, Any] | None:
    """Return what a file has under the same key and whose files exist; None without such a file."""
    try:
        record = cast("dict[str, Any]", json.loads(path.read_text(encoding="utf-8")))
        return record if record["key"] == key and all(Path(each).is_file() for each in record["files"]) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _use_record(path: Path, key: str, compute: Callable[[str], dict[str, Any]]) -> dict[str, Any]:
    """Return what a file has under the same key, else compute and write it. What another version wrote is computed again."""
    if (known := read_people_record(path, key)) and "limits" not in known:
        return known
    make_output_folder(path.parent)
    record = compute(key)
    _write_record(path, record)
    return record


def _write_record(path: Path, record: dict[str, Any]) -> None:
    make_output_folder(path.parent)
    with replace_atomically(path) as part:
        part.write_text(json.dumps(record, indent=1), encoding="utf-8")
