"""One job in a child process, with limits of time and memory.

Each thread that runs jobs has a child, which runs one job after the other: importing mocapfix and loading its compiled kernels
takes seconds. The thread watches the child and kills it at a limit. Another child takes its place then, after a crash, and when
it holds much memory.

A worker of Dask is a daemonic process, which may not have children of `multiprocessing`, so the child is a program that reads
pickled jobs from its standard input and writes pickled replies to its standard output. When its input ends, because the worker
has ended, it kills itself and what it has started.
"""

import faulthandler
import gc
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from queue import Empty, SimpleQueue
from typing import Any, BinaryIO, Literal, NamedTuple, cast

import psutil

from mocapfix.errors import MocapfixError, describe_error
from mocapfix.io.files import return_free_memory

WATCH_INTERVAL_S = 0.05


class _Job(NamedTuple):
    """A job for the child."""

    function: str  # "module:name" of a function
    arguments: bytes  # its arguments by name, pickled
    timeout_s: float


class _Reply(NamedTuple):
    """How a job ended."""

    value: object = None  # the function's result
    error: str = ""  # the sentence of an error; "" if there was none
    is_memory: bool = False  # whether the error is that no memory was left
    peak_memory_mb: float = 0.0  # greatest resident memory during the job
    held_memory_mb: float = 0.0  # resident memory after it


def _forward(stream: BinaryIO, target: "SimpleQueue[Any]") -> None:
    """Put the messages of a stream into a queue; None at its end."""
    with suppress(EOFError, OSError, pickle.UnpicklingError):
        while True:
            target.put(pickle.load(stream))
    target.put(None)


def read_resident_mb(process: int) -> float:
    """Return the resident memory of a process in MB, 0 if it has ended."""
    try:
        return psutil.Process(process).memory_info().rss / 1e6
    except psutil.Error:
        return 0.0


def kill_with_children(process: int) -> None:
    """Kill a process and all that it started."""
    with suppress(psutil.NoSuchProcess):
        parent = psutil.Process(process)
        for each in [*parent.children(recursive=True), parent]:
            with suppress(psutil.NoSuchProcess):
                each.kill()


END_MARGIN_S = 10.0  # after the time limit, when a child ends by itself whose worker has not ended it
_peak_memory_mb = 0.0  # greatest memory of this process that was seen since its job began


def serve_jobs(prepare: str) -> None:
    """Call the function `prepare` ("module:name"), then run the jobs from standard input until that ends. Run in the child."""
    requests, replies = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    for number, flags in ((0, os.O_RDONLY), (1, os.O_WRONLY)):  # what a library prints is not shown
        os.dup2(os.open(os.devnull, flags), number)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the worker decides when to end
    gc.disable()
    jobs: SimpleQueue[_Job | None] = SimpleQueue()
    for each in (_end_with_input, _sample_memory):
        threading.Thread(target=each, args=(requests, jobs), daemon=True).start()
    job: _Job | None = _Job(prepare, pickle.dumps({}), float("inf"))
    while job:
        reply = _run_job(job)
        return_free_memory()
        if not gc.get_freeze_count():
            gc.freeze()  # the libraries and what they keep are not searched for garbage again
        pickle.dump(reply._replace(held_memory_mb=read_resident_mb(os.getpid())), replies)
        replies.flush()
        job = jobs.get()


def _end_with_input(requests: BinaryIO, jobs: "SimpleQueue[_Job | None]") -> None:
    _forward(requests, jobs)
    kill_with_children(os.getpid())


def _sample_memory(*_: object) -> None:
    global _peak_memory_mb
    while True:
        _peak_memory_mb = max(read_resident_mb(os.getpid()), _peak_memory_mb)
        time.sleep(WATCH_INTERVAL_S)


def measure_peak_memory_mb() -> float:
    """Return the greatest resident memory of this process that was seen during its job."""
    return max(_peak_memory_mb, read_resident_mb(os.getpid()))


def _run_job(job: _Job) -> _Reply:
    """Call the function of a job."""
    global _peak_memory_mb
    _peak_memory_mb = 0.0
    module, _, name = job.function.partition(":")
    if job.timeout_s < threading.TIMEOUT_MAX:  # ends this process even if the function never releases the interpreter's lock
        faulthandler.dump_traceback_later(job.timeout_s + END_MARGIN_S, exit=True)
    try:
        reply = _Reply(getattr(import_module(module), name)(**pickle.loads(job.arguments)))
        pickle.dumps(reply)
    except MemoryError:
        reply = _Reply(error="The memory limit was reached.", is_memory=True)
    except BaseException as error:  # the process goes on
        reply = _Reply(error=describe_error(error))
    faulthandler.cancel_dump_traceback_later()
    return reply._replace(peak_memory_mb=measure_peak_memory_mb())


DEFAULT_PREPARE = "mocapfix.batch.jobs:load_everything"
START_LIMIT_S = 600.0  # for a child: the first on a machine compiles the kernels
MAX_GROWTH_SHARE = 0.1  # of the memory limit: what a child may hold beyond what it held before its first job, and run another
ACCESS_VIOLATION = 0xC0000005  # exit status of a process that Windows ends for a wrong address

CHILD_ENVIRONMENT = dict.fromkeys(
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
    """Limits of one job."""

    timeout_s: float = 3600.0  # wall-clock time
    memory_mb: float = 4000.0  # resident memory of its process, MB of 10^6 bytes
    retries: int = 1  # how often a job whose process crashed is repeated


@dataclass(frozen=True)
class JobOutcome:
    """How a job ended; `value` is its function's result, `error` a sentence if it is not done."""

    status: Literal["done", "error", "timeout", "memory", "crash"]
    value: object = None
    error: str = ""
    seconds: float = 0.0
    peak_memory_mb: float = 0.0


class ChildProcess:
    """A process that calls the function `prepare` ("module:name"), then runs one job after the other.

    Raises MocapfixError if it cannot be started.
    """

    def __init__(self, prepare: str = DEFAULT_PREPARE) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", f"import sys; from {__name__} import serve_jobs; serve_jobs(sys.argv[1])", prepare],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**KEPT_MEMORY_ENVIRONMENT, **os.environ, **CHILD_ENVIRONMENT},
        )
        self._requests = cast("BinaryIO", self._process.stdin)
        self._replies: SimpleQueue[_Reply | None] = SimpleQueue()
        threading.Thread(target=_forward, args=(self._process.stdout, self._replies), daemon=True).start()
        self.is_usable = True  # whether it can run another job
        problem = f"The process that cleans the takes could not be started on {socket.gethostname()}"
        try:
            reply = self._replies.get(timeout=START_LIMIT_S)
        except Empty:
            self.close()
            raise MocapfixError(f"{problem} within {START_LIMIT_S:g} s.") from None
        if reply is None:
            raise MocapfixError(f"{problem}; check that mocapfix is installed there and that memory is left.")
        self._first_held_mb = reply.held_memory_mb

    def run(self, function: str, arguments: Mapping[str, object], limits: JobLimits) -> JobOutcome:
        """Run a function ("module:name"), and return how it ended."""
        start, reason, peak_mb = time.monotonic(), "", 0.0
        with suppress(OSError):  # it has ended, which its replies show
            pickle.dump(_Job(function, pickle.dumps(dict(arguments)), limits.timeout_s), self._requests)
            self._requests.flush()
        while True:
            try:
                reply = self._replies.get(timeout=WATCH_INTERVAL_S)
                break
            except Empty:
                resident_mb = read_resident_mb(self.process_id)
            peak_mb = max(peak_mb, resident_mb)
            if not reason:
                is_late = time.monotonic() - start > limits.timeout_s
                reason = "timeout" if is_late else "memory" if resident_mb > limits.memory_mb else ""
                if reason:
                    kill_with_children(self.process_id)
        self.is_usable = not reason and self._is_small(reply, limits)
        seconds, peak_mb = time.monotonic() - start, max(peak_mb, reply.peak_memory_mb if reply else 0.0)
        if reason == "timeout":
            return JobOutcome("timeout", None, f"It was ended after {limits.timeout_s:g} s (--timeout).", seconds, peak_mb)
        if reason == "memory" or (reply and reply.is_memory):
            error = f"It needed more than {limits.memory_mb:g} MB of memory (--memory)."
            return JobOutcome("memory", None, error, seconds, peak_mb)
        if not reply:
            return JobOutcome("crash", None, describe_crash(self._process.wait()), seconds, peak_mb)
        return JobOutcome("error" if reply.error else "done", reply.value, reply.error, seconds, peak_mb)

    def _is_small(self, reply: _Reply | None, limits: JobLimits) -> bool:
        """Return whether the process has not ended and holds little more memory than before its first job."""
        if reply is None or reply.is_memory:
            return False
        return reply.held_memory_mb - self._first_held_mb < MAX_GROWTH_SHARE * limits.memory_mb

    def close(self) -> None:
        """End the process."""
        kill_with_children(self.process_id)
        self._process.wait()
        with suppress(OSError):
            self._requests.close()

    @property
    def process_id(self) -> int:
        return self._process.pid


_children = threading.local()


def run_in_child(function: str, arguments: Mapping[str, object], limits: JobLimits, prepare: str = DEFAULT_PREPARE) -> JobOutcome:
    """Run a function ("module:name") in this thread's child, which is started if there is none."""
    child: ChildProcess | None = getattr(_children, "child", None)
    if child is None:
        child = _children.child = ChildProcess(prepare)
    outcome = child.run(function, arguments, limits)
    if not child.is_usable:
        _children.child = None
        child.close()
    return outcome


def describe_crash(status: int) -> str:
    """Return the sentence on a process that ended without a reply; `status` is that of `subprocess`."""
    if status >= 0 and status != ACCESS_VIOLATION:
        return f"Its process ended without a result (exit status {status})."
    known = {int(each): each.name for each in signal.Signals}
    name = "an access violation" if status >= 0 else known.get(-status, f"signal {-status}")
    words = {"SIGSEGV": " (a segmentation fault)", "SIGKILL": " (killed; the machine may have run out of memory)"}
    return f"Its process crashed by {name}{words.get(name, '')}."
