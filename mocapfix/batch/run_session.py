"""A batch: the stages in which the takes of a session are cleaned, each as jobs on a cluster, and what is resumed.

Records are the state: whatever ends the batch, the next one goes on with the takes that have no current record.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from mocapfix.batch.child_process import JobLimits
from mocapfix.batch.cluster import BatchProgress, ClusterOptions, Task, has_dashboard, open_client, run_tasks
from mocapfix.batch.jobs import CLEAN_FUNCTION, CleanRequest, clean_take, find_current_record, sort_by_size, try_to_hash
from mocapfix.batch.records import TakeRecord, get_record_path, lock_batch_folder, read_record, resolve_option_files
from mocapfix.batch.session_people import assign_subjects, forget_results
from mocapfix.batch.take_list import BatchTake
from mocapfix.errors import MocapfixError, WriteError
from mocapfix.options import CleanOptions

if TYPE_CHECKING:
    from distributed import Client

CLEAN_STAGE = "clean"
DEFAULT_LIMITS = JobLimits()
THIS_MACHINE = ClusterOptions()


@dataclass(frozen=True)
class BatchSettings:
    """How a batch is run.

    each_take_alone whether each take is calibrated alone, not with the other takes of the person
    """

    output_folder: Path  # folder for outputs, records and the page
    options: CleanOptions  # of cleaning, for all takes
    limits: JobLimits = DEFAULT_LIMITS  # of each take
    cluster: ClusterOptions = THIS_MACHINE  # where it is computed
    resume: bool = True  # whether to skip takes whose record is current
    repeat_failed: bool = False  # whether takes that failed are cleaned again although nothing has changed
    clean_function: str = CLEAN_FUNCTION  # "module:name" of what the children run, which tests replace
    each_take_alone: bool = True
    # by name of a person, the ids of the takes that show the person, from a session file
    people: Mapping[str, Sequence[str]] = field(default_factory=dict[str, Sequence[str]])


PageWriter = Callable[[Path, Sequence[TakeRecord]], object]


def run_session(
    takes: Sequence[BatchTake],
    settings: BatchSettings,
    progress: BatchProgress,
    write_page: PageWriter | None = None,
) -> list[TakeRecord]:
    """Clean the takes of a session and return their records, in the order of the takes.

    write_page  writes the page and the tables of the session from the records

    Raises MocapfixError if the output folder is in use, the cluster cannot be reached, or its scheduler ends.
    """
    folder = settings.output_folder.resolve()
    settings = replace(settings, output_folder=folder, options=resolve_option_files(settings.options))
    clients: list[Client] = []
    records: dict[str, TakeRecord] = {}
    with lock_batch_folder(folder), ExitStack() as stack:

        def connect() -> "Client":
            if not clients:
                clients.append(stack.enter_context(open_client(settings.cluster)))
                if has_dashboard() and clients[0].dashboard_link:
                    progress.show_dashboard(clients[0].dashboard_link)
            return clients[0]

        requests = build_requests(takes, settings)
        check_same_inputs(requests)
        try:
            if knows_people(settings) and len(requests) > 1:
                if settings.repeat_failed or not settings.resume:
                    forget_results(folder, failed_only=settings.resume)
                requests = assign_subjects(connect, requests, settings.people, settings.limits, progress)
            records |= find_finished_takes(requests, settings)
            if waiting := [request for request in requests if request.take not in records]:
                clean_takes_on_cluster(connect(), waiting, records, settings, progress)
        finally:
            in_order = [records[take.id] for take in takes if take.id in records]
            if write_page is not None:
                write_page(folder, in_order)
    return in_order


def knows_people(settings: BatchSettings) -> bool:
    """Return whether people are calibrated from all of their takes: unless the options name a subject, or ask for a preview."""
    subject = settings.options.subject
    is_named = subject.subject is not None or subject.like is not None or subject.subject_prefix is not None
    return not settings.each_take_alone and not is_named and not settings.options.initialise.is_fast


def build_requests(takes: Sequence[BatchTake], settings: BatchSettings) -> list[CleanRequest]:
    """Return what is to be done for each take."""
    return [CleanRequest(take.id, take.path, settings.output_folder, settings.options) for take in takes]


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
    """Return the current records by take. Without resuming they are removed, so that every take is cleaned again."""
    if not settings.resume:
        for request in requests:
            get_record_path(request.output_folder, request.take).unlink(missing_ok=True)
        return {}
    found = ((each.take, find_current_record(each, repeat_failed=settings.repeat_failed)) for each in requests)
    return {take: record for take, record in found if record is not None}


def clean_takes_on_cluster(
    client: "Client",
    requests: Sequence[CleanRequest],
    records: dict[str, TakeRecord],
    settings: BatchSettings,
    progress: BatchProgress,
) -> None:
    """Clean takes on the workers of a cluster and add their records."""
    progress.start_stage(CLEAN_STAGE, len(requests) + len(records), len(records))
    tasks = (Task(each.take, (each, settings.limits, settings.clean_function)) for each in sort_by_size(requests))
    by_take = {each.take: each for each in requests}
    for task, result in run_tasks(client, clean_take, tasks, progress.start_job, progress.show_message):
        record = result if isinstance(result, TakeRecord) else explain_lost_take(by_take[task.name], result)
        records[task.name] = record
        progress.finish_job(task.name, record.error)


def explain_lost_take(request: CleanRequest, error: object) -> TakeRecord:
    """Return the record of a take whose worker could not even write one; it is not written, so the take is repeated.

    Raises MocapfixError if no worker can clean at all.
    """
    if isinstance(error, MocapfixError):
        raise error
    text = f"{request.path}: the worker could not clean it ({type(error).__name__}: {error})."
    return TakeRecord(take=request.take, input=str(request.path), status="failed", reason="crash", error=text)
