"""The Dask cluster of a batch: of this machine, an existing one, one that Slurm starts, or one over SSH."""

import logging
import os
import signal
import warnings
from collections.abc import Generator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING, Any, cast

from mocapfix.errors import MocapfixError, format_name_list
from mocapfix.kernels.precompilation import count_cores

if TYPE_CHECKING:
    from distributed import Client

CONNECT_TIMEOUT_S = 10.0
MAX_WORKER_LOSSES = 1000  # of the worker of a task, before Dask gives the task up: it is rarely the task's fault
LOOPBACK = "127.0.0.1"
SILENT_LOGGERS = ("distributed", "distributed.nanny", "distributed.worker", "distributed.scheduler", "tornado.application")


@dataclass(frozen=True)
class ClusterOptions:
    """Where a batch is computed; by default on this machine.

    workers    worker processes of one thread; None for one a core of this machine
    scheduler  address of a scheduler that is running
    use_slurm  whether to start the workers as Slurm jobs, by the profile "jobqueue.slurm" of Dask's configuration
    ssh_hosts  computers on which workers are started over SSH
    """

    workers: int | None = None
    scheduler: str | None = None
    use_slurm: bool = False
    ssh_hosts: tuple[str, ...] = ()


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

    Raises MocapfixError if it cannot be started or reached.
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
