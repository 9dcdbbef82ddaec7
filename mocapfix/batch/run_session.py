"""A batch: the stages of a session, each as jobs on a cluster, and what is resumed.

Before takes are cleaned it is found out who is who, the takes of each person are surveyed, and each person is calibrated. What
these stages write is in DIR/people: a subject file for each person, and one for each take in which markers lie elsewhere; in
`.records` the measurements of the bodies in each take, and the calibration frames of takes whose person is in others too. All
of it is used again while takes, options and version are the same. If people are remembered, their takes are solved besides, and
DIR/people has a memory of each person, from which lost limbs are inferred. DIR/people.yaml names the people, their takes, and the
markers that moved. Records are the state: whatever ends the batch, the next one goes on with the takes that have no current
record.
"""

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, nullcontext, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Literal, cast

from mocapfix.batch.child_process import JobLimits
from mocapfix.batch.cluster import BatchProgress, ClusterOptions, Task, has_dashboard, open_client, run_tasks
from mocapfix.batch.job_files import BatchTake
from mocapfix.batch.jobs import CLEAN_FUNCTION, CleanRequest, clean_take, find_current_record, run_with_retries, try_to_hash
from mocapfix.batch.records import (
    PersonEntry,
    SessionPeople,
    TakeRecord,
    get_record_path,
    hash_options,
    lock_batch_folder,
    read_record,
    resolve_option_files,
    write_people_file,
    write_record,
)
from mocapfix.errors import MocapfixError, WriteError
from mocapfix.io.files import make_output_folder, replace_atomically
from mocapfix.io.shipped import get_version
from mocapfix.options import CleanOptions

if TYPE_CHECKING:
    from distributed import Client

    from mocapfix.subject.people import Person
    from mocapfix.surveys import BodyToCalibrate


PEOPLE_FOLDER = "people"
RECORDS_FOLDER = ".records"  # in that folder: hidden, so that no outputs of a take are there, whatever its name
COMPARE_FUNCTION = "mocapfix.batch.run_session:measure_recorded_take"
SURVEY_FUNCTION = "mocapfix.batch.run_session:survey_recorded_take"
CALIBRATE_FUNCTION = "mocapfix.batch.run_session:calibrate_recorded_person"
REMEMBER_FUNCTION = "mocapfix.batch.run_session:remember_recorded_take"


@dataclass(frozen=True)
class TakeRequest:
    """A take to be surveyed; or with the subjects of its people, of whom it is to be remembered how they move in it."""

    take: CleanRequest
    kind: Literal["survey", "memory"]


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

    The crash of a take, or a limit that it reached, is recorded: the job is repeated with other limits only.
    """
    outcome = run_with_retries(function, request, limits)
    if isinstance(outcome.value, dict):
        return cast("dict[str, Any]", outcome.value)
    if function != CALIBRATE_FUNCTION and outcome.status in ("timeout", "memory", "crash"):
        path, key = locate_record(request)
        nothing: dict[str, Any] = {"files": [], "bodies": [], "subjects": {}}
        _write_record(path, {"key": key, **nothing, "error": outcome.error, "limits": asdict(limits)})
    return outcome.error


def measure_recorded_take(request: CleanRequest) -> dict[str, Any]:
    """Measure the bodies in a take, unless they are known; return them. Run in a child.

    A take without a body has none, and the sentence on it. A take that has to be labelled, or whose marker set has to be learned,
    is surveyed at once, since that is most of the work.
    """
    from mocapfix import surveys
    from mocapfix.subject.people import measure_body

    def measure(key: str) -> dict[str, Any]:
        try:
            found = surveys.find_bodies_to_calibrate(request.path, request.options)
            if any(body.is_learned or body.take.labelled_file is not None for body in found):
                survey = TakeRequest(request, "survey")
                _use_record(*locate_record(survey), lambda survey_key: _write_surveys(survey, survey_key, found))
        except MocapfixError as error:
            return {"key": key, "files": [], "bodies": [], "error": str(error)}
        bodies = [asdict(measure_body(request.take, body.take, body.marker_set)) for body in found]
        return {"key": key, "files": [], "bodies": bodies, "error": ""}

    return _use_record(*locate_record(request), measure)


def survey_recorded_take(request: TakeRequest) -> dict[str, Any]:
    """Write the calibration frames of each subject in a take, unless they are there; return their files. Run in a child.

    A take whose frames do not suffice has no files, and the sentence on it.
    """
    from mocapfix import surveys

    def survey(key: str) -> dict[str, Any]:
        try:
            return _write_surveys(request, key, surveys.find_bodies_to_calibrate(request.take.path, request.take.options))
        except MocapfixError as error:
            return {"key": key, "files": [], "subjects": {}, "error": str(error)}

    return _use_record(*locate_record(request), survey)


def _write_surveys(request: TakeRequest, key: str, bodies: "Sequence[BodyToCalibrate]") -> dict[str, Any]:
    """Write the calibration frames of the subjects of a take; return the record. Raises MocapfixError."""
    from mocapfix import surveys
    from mocapfix.subject.calibration import write_calibration_frames

    path, take = locate_record(request)[0], request.take
    found = [surveys.survey_subject(body, take.options, take.take) for body in bodies]
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


def remember_recorded_take(request: TakeRequest) -> dict[str, Any]:
    """Write the memory of each subject in a take, unless it is there; return their files. Run in a child."""
    from mocapfix import pipeline
    from mocapfix.solve.person_memory import write_memory

    def remember(key: str) -> dict[str, Any]:
        path, take = locate_record(request)[0], request.take
        try:
            memories = pipeline.remember_take(take.path, PurePosixPath(take.take).with_suffix("").as_posix(), take.options)
        except MocapfixError as error:
            return {"key": key, "files": [], "subjects": {}, "error": str(error)}
        files = {name: str(path.with_suffix(f".{number}.safetensors")) for number, name in enumerate(memories)}
        for name, memory in memories.items():
            write_memory(Path(files[name]), memory)
        return {"key": key, "files": list(files.values()), "subjects": files, "error": ""}

    return _use_record(*locate_record(request), remember)


def locate_record(request: CleanRequest | TakeRequest | PersonRequest) -> tuple[Path, str]:
    """Return the file with the result of a job, and the key of what the result depends on."""
    if isinstance(request, PersonRequest):
        return locate_records(request.output_folder) / f"{request.name}.json", f"{request.key} {request.basis}"
    take, kind = (request, "bodies") if isinstance(request, CleanRequest) else (request.take, request.kind)
    key = f"{try_to_hash(take.path)} {hash_options(take.options)} {get_version()}"
    return locate_records(take.output_folder) / "takes" / f"{take.take}.{kind}.json", key


def locate_records(output_folder: Path) -> Path:
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


COMPARE_STAGE, SURVEY_STAGE, CALIBRATE_STAGE, REMEMBER_STAGE = "compare", "survey", "calibrate", "remember"
MIN_PERSON_TAKES = 2  # takes of a person from which a subject is calibrated; a single take is calibrated while it is cleaned


def assign_subjects(
    connect: "Callable[[], Client]",
    requests: Sequence[CleanRequest],
    names: Mapping[str, Sequence[str]],
    limits: JobLimits,
    progress: BatchProgress,
    *,
    remembers_people: bool,
) -> list[CleanRequest]:
    """Return the requests with the subjects calibrated from all takes of each person, and write people.yaml.

    Takes that cannot be surveyed, and people with one take, keep their options.

    Args:
        connect: Opens the cluster, which is not needed where all was done before.
        names: By name of a person, the ids of takes.
        remembers_people: Whether the requests also have a memory of each person.
    """
    from mocapfix.subject.people import BodyMeasurements, group_people

    by_id = {request.take: request for request in requests}
    measured = _run_stage(connect, COMPARE_STAGE, COMPARE_FUNCTION, by_id, limits, progress)
    people = group_people([BodyMeasurements(**body) for found in measured.values() for body in found["bodies"]], names)
    shared = {body.take for person in people if len(person.takes) >= MIN_PERSON_TAKES for body in person.takes}
    to_survey = {take: TakeRequest(request, "survey") for take, request in by_id.items() if take in shared}
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
    with_subjects = [_add_subjects(request, subjects.get(request.take, {})) for request in requests]
    return _add_memories(connect, with_subjects, entries, limits, progress) if remembers_people else with_subjects


def build_person_request(person: "Person", surveyed: Mapping[str, dict[str, Any]], folder: Path) -> PersonRequest | None:
    """Return the request to calibrate a person from the takes that were surveyed; None if they are too few.

    Args:
        surveyed: By id of a take, the record of its survey.
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
    subject = _name_files({name: request.output_folder / path for name, path in files.items()})
    return replace(request, options=request.options.change(subject=subject), subject_files=tuple(files.items()))


def _name_files(paths: Mapping[str, Path]) -> Path | tuple[tuple[str, Path], ...]:
    """Return files by the names of the subjects of a take as an option has them."""
    return paths[""] if set(paths) == {""} else tuple(paths.items())


def _add_memories(
    connect: "Callable[[], Client]",
    requests: Sequence[CleanRequest],
    people: Sequence[PersonEntry],
    limits: JobLimits,
    progress: BatchProgress,
) -> list[CleanRequest]:
    """Return the requests with memories of people in several takes, which are written."""
    from mocapfix.model.skeleton import load_cmu31_body
    from mocapfix.solve.person_memory import join_memories, read_memory, write_memory

    skeleton, shared = load_cmu31_body().skeleton, {take for person in people for take in person.takes}
    to_remember = {request.take: TakeRequest(request, "memory") for request in requests if request.take in shared}
    found = _run_stage(connect, REMEMBER_STAGE, REMEMBER_FUNCTION, to_remember, limits, progress)
    files: dict[str, dict[str, Path]] = {}
    for person in people:
        parts = [found[take]["subjects"].get(name) for take, name in person.takes.items() if take in found]
        memories = [read_memory(Path(part), skeleton) for part in parts if part]
        if len(memories) >= MIN_PERSON_TAKES:
            path = requests[0].output_folder / PEOPLE_FOLDER / f"{person.name}.memory.safetensors"
            write_memory(path, join_memories(memories))
            for take, name in person.takes.items():
                files.setdefault(take, {})[name] = path
    return [
        replace(request, options=request.options.change(person_memory=_name_files(files[request.take])))
        if request.take in files and request.options.prior.person_memory is None
        else request
        for request in requests
    ]


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


CLEAN_STAGE = "clean"
DEFAULT_LIMITS = JobLimits()
THIS_MACHINE = ClusterOptions()


@dataclass(frozen=True)
class BatchSettings:
    """How a batch is run."""

    output_folder: Path  # folder for outputs, records and the page
    options: CleanOptions  # of cleaning, for all takes
    limits: JobLimits = DEFAULT_LIMITS  # of each take
    cluster: ClusterOptions = THIS_MACHINE  # where it is computed
    resume: bool = True  # whether to skip takes whose record is current
    repeat_failed: bool = False  # whether takes that failed are cleaned again although nothing has changed
    clean_function: str = CLEAN_FUNCTION  # "module:name" of what the children run, which tests replace
    each_take_alone: bool = True  # whether each take is calibrated alone, not with the other takes of the person
    remembers_people: bool = False  # whether lost limbs are inferred from the other takes of the person, too
    # by name of a person, the ids of the takes that show the person, from a session file
    people: Mapping[str, Sequence[str]] = field(default_factory=dict[str, Sequence[str]])


PageWriter = Callable[[Path, Sequence[TakeRecord], int], object]  # the last: how many takes are still to be cleaned
MAX_PAGE_SHARE = 0.05  # of the time in which takes are cleaned is spent on pages: that of thousands of takes takes seconds


def run_session(
    takes: Sequence[BatchTake], settings: BatchSettings, progress: BatchProgress, write_page: PageWriter | None = None
) -> list[TakeRecord]:
    """Clean the takes of a session and return their records, in the order of the takes.

    Raises:
        MocapfixError: If the output folder is in use, the cluster cannot be reached, or its scheduler ends.
    """
    folder = settings.output_folder.resolve()
    settings = replace(settings, output_folder=folder, options=resolve_option_files(settings.options))
    clients: list[Client] = []
    records: dict[str, TakeRecord] = {}
    next_page_s = 0.0

    def show_records(is_running: bool = True) -> list[TakeRecord]:
        nonlocal next_page_s
        in_order, start_s = [records[take.id] for take in takes if take.id in records], time.monotonic()
        if write_page is not None and not (is_running and start_s < next_page_s):
            with suppress(WriteError) if is_running else nullcontext():
                write_page(folder, in_order, (len(takes) - len(in_order)) * is_running)
            next_page_s = start_s + (time.monotonic() - start_s) / MAX_PAGE_SHARE
        return in_order

    with lock_batch_folder(folder), ExitStack() as stack:

        def connect() -> "Client":
            if not clients:
                clients.append(stack.enter_context(open_client(settings.cluster)))
                if has_dashboard() and clients[0].dashboard_link:
                    progress.show_dashboard(clients[0].dashboard_link)
            return clients[0]

        requests = [CleanRequest(take.id, take.path, settings.output_folder, settings.options) for take in takes]
        check_same_inputs(requests)
        try:
            if knows_people(settings) and len(requests) > 1:
                if settings.repeat_failed or not settings.resume:
                    forget_results(folder, failed_only=settings.resume)
                of_people = settings.people, settings.limits, progress
                requests = assign_subjects(connect, requests, *of_people, remembers_people=settings.remembers_people)
            records |= find_finished_takes(requests, settings)
            if waiting := [request for request in requests if request.take not in records]:
                clean_takes_on_cluster(connect(), waiting, records, settings, progress, show_records)
        finally:
            in_order = show_records(is_running=False)
    return in_order


def knows_people(settings: BatchSettings) -> bool:
    """Return whether people are calibrated from all of their takes: unless the options name a subject, or ask for a preview."""
    subject = settings.options.subject
    is_named = subject.subject is not None or subject.like is not None or subject.subject_prefix is not None
    return not settings.each_take_alone and not is_named and not settings.options.initialise.is_fast


def check_same_inputs(requests: Sequence[CleanRequest]) -> None:
    """Raise WriteError if the folder has the outputs of another file, of another session for instance, with a take's id."""
    for request in requests:
        record = read_record(get_record_path(request.output_folder, request.take))
        if record is None or record.input == str(request.path) or not Path(record.input).is_file():
            continue
        if record.input_sha256 != try_to_hash(request.path):  # not a copy
            raise WriteError(
                f"{request.output_folder}: has the outputs of {record.input}, which those of {request.path} would replace; "
                "choose another folder with --out."
            )


def find_finished_takes(requests: Sequence[CleanRequest], settings: BatchSettings) -> dict[str, TakeRecord]:
    """Return the current records by take. Without resuming none is current from now on, so that every take is cleaned again."""
    if not settings.resume:
        for request in requests:
            if record := read_record(get_record_path(request.output_folder, request.take)):
                write_record(request.output_folder, record.model_copy(update={"version": ""}))
        return {}
    found = ((each.take, find_current_record(each, repeat_failed=settings.repeat_failed)) for each in requests)
    return {take: record for take, record in found if record is not None}


def clean_takes_on_cluster(
    client: "Client",
    requests: Sequence[CleanRequest],
    records: dict[str, TakeRecord],
    settings: BatchSettings,
    progress: BatchProgress,
    show_records: Callable[[], object],
) -> None:
    """Clean takes on the workers of a cluster and add their records, each of which is shown."""
    progress.start_stage(CLEAN_STAGE, len(requests) + len(records), len(records))
    size_bytes = {each.take: each.path.stat().st_size if each.path.is_file() else 0 for each in requests}
    ordered = sorted(requests, key=lambda request: -size_bytes[request.take])  # so that the workers end together
    tasks = (Task(each.take, (each, settings.limits, settings.clean_function)) for each in ordered)
    by_take = {each.take: each for each in requests}
    for task, result in run_tasks(client, clean_take, tasks, progress.start_job, progress.show_message):
        record = result if isinstance(result, TakeRecord) else explain_lost_take(by_take[task.name], result)
        records[task.name] = record
        progress.finish_job(task.name, record.error)
        show_records()


def explain_lost_take(request: CleanRequest, error: object) -> TakeRecord:
    """Return the record of a take whose worker could not even write one; it is not written, so the take is repeated.

    Raises:
        MocapfixError: If no worker can clean at all.
    """
    if isinstance(error, MocapfixError):
        raise error
    text = f"{request.path}: the worker could not clean it ({type(error).__name__}: {error})."
    return TakeRecord(take=request.take, input=str(request.path), status="failed", reason="crash", error=text)
