"""The Dask cluster of a batch (of this machine, an existing one, of Slurm, or over SSH), and the tasks on it.

Tasks are handed over a few at a time, and repeated when their worker is lost.
"""

import logging
import os
import signal
import time
import warnings
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING, Any, cast

from mocapfix.errors import MocapfixError, format_name_list
from mocapfix.model.system import get_system

if TYPE_CHECKING:
    from distributed import Client


CONNECT_TIMEOUT_S = 10.0
MAX_WORKER_LOSSES = 1000  # of the worker of a task, before Dask gives the task up: it is rarely the task's fault
LOOPBACK = "127.0.0.1"
SILENT_LOGGERS = ("distributed", "distributed.nanny", "distributed.worker", "distributed.scheduler", "tornado.application")


@dataclass(frozen=True)
class ClusterOptions:
    """Where a batch is computed; by default on this machine."""

    workers: int | None = None  # worker processes of one thread; None for one a core of this machine
    scheduler: str | None = None  # address of a scheduler that is running
    use_slurm: bool = False  # whether to start the workers as Slurm jobs, by the profile "jobqueue.slurm" of Dask's configuration
    ssh_hosts: tuple[str, ...] = ()  # computers on which workers are started over SSH


def check_dask_installed(options: ClusterOptions) -> None:
    """Raise MocapfixError if a library is missing that the cluster needs."""
    extra = "cluster" if options.use_slurm or options.ssh_hosts else "batch"
    needed = [
        "distributed",
        "psutil",
        *(["dask_jobqueue"] if options.use_slurm else []),
        *(["asyncssh"] if options.ssh_hosts else []),
    ]
    if missing := [name for name in needed if find_spec(name) is None]:
        raise MocapfixError(
            f"{', '.join(missing)} is not installed, which a batch needs; install mocapfix with "
            f'pip install -c constraints.txt -e ".[{extra}]".'
        )


@contextmanager
def open_client(options: ClusterOptions) -> Generator["Client"]:
    """Yield the client of a cluster, and end the cluster afterwards unless it was there before.

    Raises:
        MocapfixError: If it cannot be started or reached.
    """
    check_dask_installed(options)
    silence_dask()
    from distributed import Client

    cluster: Any = None
    try:
        try:
            with block_interrupts():
                cluster = None if options.scheduler else start_cluster(options)
                client = Client(options.scheduler or cluster, timeout=CONNECT_TIMEOUT_S, set_as_default=False)
        except (OSError, ValueError, RuntimeError, ImportError) as error:
            raise MocapfixError(describe_start_failure(options, error)) from error
        try:
            yield client
        finally:
            with suppress(Exception):  # a scheduler that has ended cannot be told
                client.close(timeout=2)
    finally:
        if cluster is not None:
            with suppress(Exception):
                cluster.close(timeout=5)


@contextmanager
def block_interrupts() -> Generator[None]:
    """Let the threads and processes that are started in the block never receive Ctrl-C, and this thread only afterwards.

    The batch ends its workers itself; each would report the interrupt.
    """
    if not get_system().has_signal_masks:
        yield
        return
    resource_tracker.ensure_running()  # otherwise a thread that starts the first process starts it, and receives interrupts again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def silence_dask() -> None:
    """Let Dask report nothing by itself, here and in the processes that it starts: the batch reports what matters."""
    from dask import config

    config.set(
        {
            "logging": dict.fromkeys(SILENT_LOGGERS, "critical"),
            "distributed.scheduler.allowed-failures": MAX_WORKER_LOSSES,
            "distributed.worker.memory.target": False,
            "distributed.worker.memory.spill": False,
            "distributed.worker.memory.pause": False,
            "distributed.worker.memory.terminate": False,
            "distributed.comm.timeouts.connect": f"{CONNECT_TIMEOUT_S:g}s",
            "distributed.diagnostics.nvml": False,
        }
    )
    os.environ["DASK_DISTRIBUTED__DIAGNOSTICS__NVML"] = "False"
    import distributed

    assert distributed
    for name in SILENT_LOGGERS:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)
    # Another batch on this machine has the dashboard's usual port.
    warnings.filterwarnings("ignore", message="Port .* is already in use", category=UserWarning)


def start_cluster(options: ClusterOptions) -> Any:
    """Start a cluster on this machine, with Slurm or over SSH, and return it."""
    if options.use_slurm:
        from dask_jobqueue import SLURMCluster  # pyright: ignore

        cluster: Any = SLURMCluster()
        cluster.scale(jobs=options.workers or 1)
        return cluster
    if options.ssh_hosts:
        from distributed import SSHCluster

        worker_options = {"nthreads": 1, "n_workers": options.workers or 1, "memory_limit": "0"}
        return SSHCluster([options.ssh_hosts[0], *options.ssh_hosts], worker_options=worker_options)
    from distributed import LocalCluster

    from mocapfix.model.system import count_cores

    return LocalCluster(
        n_workers=options.workers or count_cores(),
        threads_per_worker=1,
        processes=True,
        host=LOOPBACK,
        dashboard_address=cast("str", f"{LOOPBACK}:0" if has_dashboard() else None),  # None: without one
        memory_limit=0,
        silence_logs=logging.CRITICAL,
    )


def has_dashboard() -> bool:
    """Return whether Dask's dashboard can be shown, which needs bokeh."""
    return find_spec("bokeh") is not None


def describe_start_failure(options: ClusterOptions, error: Exception) -> str:
    """Return the sentence on a cluster that could not be started or reached."""
    reason = str(error).strip().split("\n")[0] or type(error).__name__
    if options.scheduler:
        return f"{options.scheduler}: no scheduler answers there ({reason}); start it, or correct --scheduler."
    if options.use_slurm:
        return f"The Slurm workers could not be started ({reason}); check jobqueue.slurm in ~/.config/dask/jobqueue.yaml."
    if options.ssh_hosts:
        hosts = format_name_list(options.ssh_hosts)
        return f"The workers could not be started on {hosts} ({reason}); check that ssh needs no password."
    return f"The workers could not be started ({reason})."


TASKS_PER_THREAD = 2  # handed over: one that runs and one that waits, so that no worker waits for the client
POLL_INTERVAL_S = 0.02
COUNT_INTERVAL_S = 1.0  # between two looks at the number of workers
MAX_CONNECTION_LOSS_S = 5.0  # after which the scheduler counts as ended
MAX_SUBMISSIONS = 3  # of a task that Dask gave up because its workers ended
WORKER_LOSSES = ("KilledWorker", "CancelledError", "FutureCancelledError", "FuturesCancelledError", "TimeoutError")
"""names of the exceptions that Dask then gives as results"""


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
            if type(result).__name__ in WORKER_LOSSES and each.submissions < MAX_SUBMISSIONS:
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
