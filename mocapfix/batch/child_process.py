"""One job in a child process, with limits of time and memory.

Each thread that runs jobs has a fork server (`fork_server.py`), which is started on first use and kept. The thread watches the
child: it is killed at its limits.
"""

import atexit
import os
import pickle
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import BinaryIO, Literal, cast

from mocapfix.batch.fork_server import ChildReply, ForkRequest, JobEnd, kill_group, read_message, write_message
from mocapfix.errors import MocapfixError

WATCH_INTERVAL_S = 0.1
PAGE_MB = os.sysconf("SC_PAGE_SIZE") / 1e6 if hasattr(os, "sysconf") else 0.004
DEFAULT_WARM_UP = "mocapfix.batch.jobs:load_everything"
CLOSE_LIMIT_S = 2.0
START_LIMIT_S = 600.0  # for a server: the first on a machine compiles the kernels
SINGLE_THREAD_ENVIRONMENT = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "MOCAPFIX_NUM_THREADS"), "1"
)

KEPT_MEMORY_ENVIRONMENT = {
    "MALLOC_MMAP_THRESHOLD_": str(1 << 28),
    "MALLOC_TRIM_THRESHOLD_": str(1 << 29),
    "MALLOC_TOP_PAD_": str(1 << 26),
}
"""Lets glibc use the memory of arrays again instead of returning it to the system: a new page is expensive in a virtual machine,
and with two workers took a quarter of the processor time."""


@dataclass(frozen=True)
class JobLimits:
    """Limits of one job.

    timeout_s  wall-clock time
    memory_mb  resident memory of its process, MB of 10^6 bytes
    retries    how often a job whose process crashed is repeated
    """

    timeout_s: float = 3600.0
    memory_mb: float = 4000.0
    retries: int = 1


@dataclass(frozen=True)
class JobOutcome:
    """How a job ended; `value` is its function's result, `error` a sentence if it is not done."""

    status: Literal["done", "error", "timeout", "memory", "crash"]
    value: object = None
    error: str = ""
    seconds: float = 0.0
    peak_memory_mb: float = 0.0


class ForkServer:
    """The connection to a process that forks a child for each job. It runs one job at a time.

    warm_up  "module:name" of a function that the process calls when it starts
    """

    def __init__(self, warm_up: str = DEFAULT_WARM_UP) -> None:
        self._process: subprocess.Popen[bytes] = subprocess.Popen(
            [sys.executable, "-m", "mocapfix.batch.fork_server", warm_up],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**KEPT_MEMORY_ENVIRONMENT, **os.environ, **SINGLE_THREAD_ENVIRONMENT},
            bufsize=0,
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._requests = cast("BinaryIO", self._process.stdin)
        self._replies = cast("BinaryIO", self._process.stdout)
        self._has_killed_child = False
        self._receive(START_LIMIT_S)

    def run(self, function: str, arguments: Mapping[str, object], limits: JobLimits) -> JobOutcome:
        """Run a function ("module:name") in a child, and return how it ended."""
        start, reason, peak_mb = time.monotonic(), "", 0.0
        request = ForkRequest(function, pickle.dumps(dict(arguments)), limits.memory_mb, self._has_killed_child)
        write_message(self._requests, request)
        self._has_killed_child = False
        child = self._receive()
        assert isinstance(child, int)
        while not self._wait(WATCH_INTERVAL_S):
            resident_mb = read_resident_mb(child)
            peak_mb = max(peak_mb, resident_mb)
            if reason:  # it has been killed
                continue
            if time.monotonic() - start > limits.timeout_s:
                reason = "timeout"
            elif resident_mb > limits.memory_mb:
                reason = "memory"
            if reason:
                kill_group(child)
                self._has_killed_child = True
        end = self._receive()
        assert isinstance(end, JobEnd)
        seconds, peak_mb = time.monotonic() - start, max(peak_mb, end.peak_memory_mb)
        if reason == "timeout":
            return JobOutcome("timeout", None, f"It was ended after {limits.timeout_s:g} s (--timeout).", seconds, peak_mb)
        if reason == "memory":
            return JobOutcome("memory", None, describe_memory_limit(limits), seconds, peak_mb)
        if not end.reply:
            return JobOutcome("crash", None, describe_crash(end.wait_status), seconds, peak_mb)
        reply = pickle.loads(end.reply)
        assert isinstance(reply, ChildReply)
        peak_mb = max(peak_mb, reply.peak_memory_mb)
        if reply.is_memory:
            return JobOutcome("memory", None, describe_memory_limit(limits), seconds, peak_mb)
        return JobOutcome("error" if reply.error else "done", reply.value, reply.error, seconds, peak_mb)

    def close(self) -> None:
        """End the server and its child."""
        self._requests.close()
        try:
            self._process.wait(CLOSE_LIMIT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._replies.close()

    @property
    def process_id(self) -> int:
        """The server's process number."""
        return self._process.pid

    def _wait(self, timeout_s: float) -> bool:
        """Return whether a message, or the end of the server, is there within some time."""
        return bool(select.select([self._replies], [], [], timeout_s)[0])

    def _receive(self, timeout_s: float | None = None) -> object:
        if timeout_s is not None and not self._wait(timeout_s):
            self.close()
            raise MocapfixError(f"The process that cleans the takes did not start within {timeout_s:g} s.")
        return read_message(self._replies)


_servers = threading.local()


def run_in_child(function: str, arguments: Mapping[str, object], limits: JobLimits, warm_up: str = DEFAULT_WARM_UP) -> JobOutcome:
    """Run a function ("module:name") in a child of this thread's fork server, which is started if there is none."""
    try:
        return _get_server(warm_up).run(function, arguments, limits)
    except (EOFError, BrokenPipeError):  # the server has ended: killed by the system, for want of memory perhaps
        _drop_server(warm_up)
        return JobOutcome("crash", None, "The process that starts the jobs was killed; there may be too little memory.")


def _get_server(warm_up: str) -> ForkServer:
    servers: dict[str, ForkServer] = _servers.__dict__.setdefault("by_warm_up", {})
    if warm_up not in servers:
        try:
            servers[warm_up] = ForkServer(warm_up)
        except EOFError:
            raise MocapfixError(
                f"The process that cleans the takes could not be started on {socket.gethostname()}; check that mocapfix is "
                "installed there and that memory is left."
            ) from None
        atexit.register(_drop_server, warm_up, servers)
    return servers[warm_up]


def _drop_server(warm_up: str, servers: dict[str, ForkServer] | None = None) -> None:
    kept: dict[str, ForkServer] = _servers.__dict__.get("by_warm_up", {}) if servers is None else servers
    if server := kept.pop(warm_up, None):
        server.close()


def read_resident_mb(process: int) -> float:
    """Return the resident memory of a process in MB, 0 if it has ended."""
    try:
        with open(f"/proc/{process}/statm") as file:  # noqa: PTH123
            return int(file.read().split()[1]) * PAGE_MB
    except FileNotFoundError:
        if sys.platform == "linux":
            return 0.0
    except (OSError, IndexError):
        return 0.0
    import psutil

    try:
        return psutil.Process(process).memory_info().rss / 1e6
    except psutil.Error:
        return 0.0


def describe_memory_limit(limits: JobLimits) -> str:
    """Return the sentence on a job that reached its limit of memory."""
    return f"It needed more than {limits.memory_mb:g} MB of memory (--memory)."


def describe_crash(wait_status: int) -> str:
    """Return the sentence on a process that ended without a reply."""
    if not os.WIFSIGNALED(wait_status):
        return f"Its process ended without a result (exit status {os.waitstatus_to_exitcode(wait_status)})."
    number = os.WTERMSIG(wait_status)
    name = signal.Signals(number).name if number in set(signal.Signals) else f"signal {number}"
    words = {"SIGSEGV": " (a segmentation fault)", "SIGKILL": " (killed; the machine may have run out of memory)"}
    return f"Its process crashed by {name}{words.get(name, '')}."
