"""Tasks on a Dask cluster: handed over a few at a time, and repeated when their worker is lost.

What a batch reports while it runs: its stages, the jobs that begin and end, and messages.
"""

import time
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

from mocapfix.errors import MocapfixError

if TYPE_CHECKING:
    from distributed import Client


TASKS_PER_THREAD = 2  # handed over: one that runs and one that waits, so that no worker waits for the client
POLL_INTERVAL_S = 0.02
COUNT_INTERVAL_S = 1.0  # between two looks at the number of workers
MAX_CONNECTION_LOSS_S = 5.0  # after which the scheduler counts as ended
MAX_SUBMISSIONS = 3  # of a task that Dask gave up because its workers ended


@dataclass(frozen=True)
class Task:
    """A call of a function on a worker, with the name under which progress shows it."""

    name: str
    arguments: tuple[Any, ...]


@dataclass
class _Submitted:
    task: Task
    submissions: int = 1
    future: Any = field(default=None, repr=False)


def run_tasks(
    client: "Client",
    function: Callable[..., Any],
    tasks: Iterable[Task],
    report_start: Callable[[str], None],
    report_message: Callable[[str], None],
) -> Generator[tuple[Task, Any]]:
    """Yield each task with its result, in the order in which they end.

    Raises MocapfixError if the scheduler ends. An exception of the function, and the loss of several workers by one task, is
    yielded as the result.
    """
    remaining = iter(tasks)
    running: dict[str, _Submitted] = {}
    thread_count, last_found, next_count_time, last_contact_time = 1, 1, 0.0, time.monotonic()
    is_exhausted = False
    while True:
        now = time.monotonic()
        if client.status == "running":
            last_contact_time = now
        elif now - last_contact_time > MAX_CONNECTION_LOSS_S:
            raise MocapfixError("The scheduler has ended; run the same command again to go on with the takes that are left.")
        if now >= next_count_time and client.status == "running":
            found, next_count_time = count_threads(client), now + COUNT_INTERVAL_S
            if not found and last_found:
                report_message("No worker is connected to the scheduler; the batch waits for one.")
            thread_count, last_found = found or thread_count, found
        while not is_exhausted and len(running) < TASKS_PER_THREAD * thread_count and client.status == "running":
            task = next(remaining, None)
            if task is None:
                is_exhausted = True
                break
            running[task.name] = _Submitted(task, future=submit_task(client, function, task))
            report_start(task.name)
        if is_exhausted and not running:
            return
        ended = [each for each in running.values() if each.future.done()]
        for each in ended:
            result = get_result(each.future)
            if client.status != "running" and isinstance(result, Exception):
                continue  # it is unknown how the task ended
            if is_worker_loss(result) and each.submissions < MAX_SUBMISSIONS:
                each.submissions += 1
                each.future = submit_task(client, function, each.task)
                continue
            del running[each.task.name]
            yield each.task, result
        if not ended:
            time.sleep(POLL_INTERVAL_S)


def submit_task(client: "Client", function: Callable[..., Any], task: Task) -> Any:
    """Hand a task to the scheduler and return its future."""
    return client.submit(function, *task.arguments, pure=False, retries=0)


def count_threads(client: "Client") -> int:
    """Return the number of tasks that the workers can run at a time; 0 if it is unknown."""
    try:
        return sum(cast("dict[str, int]", client.nthreads()).values())
    except Exception:  # the connection to the scheduler was lost
        return 0


def get_result(future: Any) -> Any:
    """Return the result of a task that ended, or the exception with which it ended."""
    try:
        return future.result(timeout=1)
    except Exception as error:  # whatever ended the task is its result
        return error


def is_worker_loss(result: object) -> bool:
    """Return whether a task ended because its workers did."""
    return type(result).__name__ in (
        "KilledWorker",
        "CancelledError",
        "FutureCancelledError",
        "FuturesCancelledError",
        "TimeoutError",
    )


class BatchProgress:
    """Receiver of a batch's progress. This one ignores everything; the command line draws it.

    The stages follow one another, and each has jobs: takes to survey, people to calibrate, takes to clean. A job that is repeated
    on another worker may begin several times; it ends once.
    """

    def start_stage(self, stage: str, job_count: int, done_count: int = 0) -> None:
        """Begin a stage such as "clean", of which `done_count` of the `job_count` jobs were done by an earlier batch."""

    def start_job(self, name: str) -> None:
        """Report that a job was handed to a worker. `name` is the id of the take, or the name of the person."""

    def finish_job(self, name: str, error: str = "") -> None:
        """Report that a job ended, and the sentence on its failure; "" if it is done."""

    def show_dashboard(self, address: str) -> None:
        """Show the address of Dask's dashboard."""

    def show_message(self, message: str) -> None:
        """Show a sentence on the batch, for example that a worker was lost."""
