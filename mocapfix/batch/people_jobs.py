"""What the children of a batch's workers do before takes are cleaned: measure and survey takes, and calibrate people.

Each job writes a record with its result, which is used again while its key is the same.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from mocapfix.batch.child_process import JobLimits, run_in_child
from mocapfix.batch.content_hash import hash_options
from mocapfix.batch.jobs import CleanRequest, get_version, try_to_hash
from mocapfix.batch.people_file import PersonEntry
from mocapfix.errors import MocapfixError
from mocapfix.files.output_files import make_output_folder, replace_atomically

if TYPE_CHECKING:
    from mocapfix.state import CleaningState

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
    from mocapfix.calibrate.body_measurements import measure_body

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
    from mocapfix.calibrate.calibration_frames import write_calibration_frames

    path, take = locate_record(request)[0], request.take
    found = [pipeline.survey_subject(state, take.options, take.take) for state in states]
    files = {frames.subject_name: str(path.with_suffix(f".{number}.npz")) for number, frames in enumerate(found)}
    make_output_folder(path.parent)
    for frames in found:
        write_calibration_frames(Path(files[frames.subject_name]), frames)
    return {"key": key, "files": list(files.values()), "subjects": files, "error": ""}


def calibrate_recorded_person(request: PersonRequest) -> dict[str, Any]:
    """Write the subject files of a person, unless they are there, and return the person's entry. Run in a child."""
    from mocapfix.calibrate.calibration_frames import read_calibration_frames
    from mocapfix.calibrate.person_calibration import calibrate_person
    from mocapfix.calibrate.person_files import locate_person_files, write_person_files

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
