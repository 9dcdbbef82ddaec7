"""One job in a child process, with limits of time and memory.

Each thread that runs jobs has a fork server, a process that has imported mocapfix and loaded its compiled kernels, once for all
jobs. It has one thread, so that a fork copies everything. For each `ForkRequest` on its standard input it replies with the number
of the child that runs the job, and at the job's end with a `JobEnd`. The thread watches the child, and kills it at its limits.

A child runs one job after the other: the memory that it has used is faster to use than new memory. It is replaced after an error,
or when it holds much memory. When the server's standard input ends, because the worker has ended, the server kills the child and
ends. A message is its length in four bytes, and a pickle.
"""

import atexit
import ctypes
import gc
import os
import pickle
import resource
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib import import_module
from typing import BinaryIO, Literal, cast

import psutil

from mocapfix.errors import MocapfixError, describe_error
from mocapfix.io.files import return_free_memory

LENGTH_FORMAT = ">I"


@dataclass(frozen=True)
class ForkRequest:
    """A job for a child."""

    function: str  # "module:name" of a function
    arguments: bytes  # its arguments by name, pickled
    memory_mb: float  # limit of its resident memory
    new_child: bool = False  # whether a child that has run other jobs is not used: the last one was killed


@dataclass(frozen=True)
class JobEnd:
    """How a job ended."""

    wait_status: int  # of os.waitpid, if its process ended with it; 0 otherwise
    peak_memory_mb: float  # greatest resident memory, if its process ended with it
    reply: bytes  # what the child wrote: a pickled ChildReply; empty if it was killed


@dataclass(frozen=True)
class ChildReply:
    """What a child reports."""

    value: object = None  # the function's result
    error: str = ""  # the sentence of an error; "" if there was none
    is_memory: bool = False  # whether the error is that no memory was left
    # greatest resident memory during the job, with that of the libraries which the child shares with the server
    peak_memory_mb: float = 0.0


def write_message(stream: BinaryIO, message: object) -> None:
    data = pickle.dumps(message)
    stream.write(struct.pack(LENGTH_FORMAT, len(data)) + data)
    stream.flush()


def read_message(stream: BinaryIO) -> object:
    """Read one message. Raises EOFError if the stream has ended."""
    return pickle.loads(read_message_bytes(stream))


def read_message_bytes(stream: BinaryIO) -> bytes:
    """Read the pickle of one message. Raises EOFError if the stream has ended."""
    (length,) = struct.unpack(LENGTH_FORMAT, _read_exactly(stream, struct.calcsize(LENGTH_FORMAT)))
    return _read_exactly(stream, length)


def _read_exactly(stream: BinaryIO, count: int) -> bytes:
    data = bytearray()
    while len(data) < count:
        part = stream.read(count - len(data))
        if not part:
            raise EOFError
        data += part
    return bytes(data)


MAXRSS_UNIT_MB = 1e-6 if sys.platform == "darwin" else 1.024e-3  # bytes; kibibytes
PR_SET_PDEATHSIG = 1  # of Linux: a signal to the child when its parent ends
MEMORY_BACKSTOP_FACTOR = 2  # data that a child may reserve beyond that of the server, relative to its limit of resident memory
PEAK_RESET_FILE, PEAK_RESET_COMMAND = "/proc/self/clear_refs", b"5"
MAX_CHILD_JOBS = 20  # rerun keeps 2 to 3 MB of each recording
MAX_KEPT_MEMORY_SHARE = 0.1  # of the memory limit: what a child may hold beyond the server's memory and run another job


@dataclass(frozen=True)
class _Child:
    """A child process, and the ends of the pipes to it and from it."""

    process: int
    requests: BinaryIO
    replies: BinaryIO

    def end(self) -> tuple[int, float]:
        """Kill the process with all that it started, if it runs; return its wait status and peak memory in MB."""
        kill_group(self.process)
        return self.wait()

    def wait(self) -> tuple[int, float]:
        """Wait until the process has ended; return its wait status and peak memory in MB."""
        with suppress(BrokenPipeError):
            self.requests.close()
        self.replies.close()
        _, wait_status, usage = os.wait4(self.process, 0)
        return wait_status, usage.ru_maxrss * MAXRSS_UNIT_MB


def kill_group(process: int) -> None:
    """Kill a child with all processes that it started."""
    for kill in (os.killpg, os.kill):  # its group exists a moment later than itself
        with suppress(ProcessLookupError, PermissionError):
            kill(process, signal.SIGKILL)


def serve_forks() -> None:
    """Fork a child for each request on standard input until that ends."""
    requests, replies = os.fdopen(os.dup(0), "rb", buffering=0), os.fdopen(os.dup(1), "wb")
    for number, flags in ((0, os.O_RDONLY), (1, os.O_WRONLY), (2, os.O_WRONLY)):  # what a library prints is not shown
        os.dup2(os.open(os.devnull, flags), number)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the worker decides when to end
    if len(sys.argv) > 1 and sys.argv[1]:
        module, _, name = sys.argv[1].partition(":")
        getattr(import_module(module), name)()
    gc.disable()
    gc.freeze()  # the children share these objects' memory
    write_message(replies, os.getpid())
    child: _Child | None = None
    with suppress(EOFError, BrokenPipeError):
        while True:
            request = read_message(requests)
            assert isinstance(request, ForkRequest)
            child = _serve_one(request, child, requests, replies)
    if child:
        child.end()
    os._exit(0)


def _serve_one(request: ForkRequest, child: _Child | None, requests: BinaryIO, replies: BinaryIO) -> _Child | None:
    """Run a job in a child and reply with its end; return the child if it can run another. End with the worker."""
    if child and (request.new_child or not _send(child, request)):
        child.end()
        child = None
    if child is None:
        child = _fork_child()
        _send(child, request)
    write_message(replies, child.process)
    ready, _, _ = select.select([child.replies, requests], [], [])
    if requests in ready:  # no request comes before the reply: the stream has ended
        child.end()
        os._exit(0)
    try:
        reply = read_message_bytes(child.replies)
    except EOFError:
        write_message(replies, JobEnd(*child.end(), b""))
        return None
    write_message(replies, JobEnd(0, 0.0, reply))
    with suppress(EOFError):
        if read_message(child.replies):
            return child
    child.wait()
    return None


def _send(child: _Child, request: ForkRequest) -> bool:
    """Send a request to a child; return whether it has not ended."""
    try:
        write_message(child.requests, request)
    except BrokenPipeError:
        return False
    return True


def _fork_child() -> _Child:
    """Fork a child that waits for requests."""
    request_end, request_source = os.pipe()
    reply_source, reply_end = os.pipe()
    server = os.getpid()
    process = os.fork()
    if not process:
        os.close(request_source)
        os.close(reply_source)
        _run_child(server, os.fdopen(request_end, "rb", buffering=0), os.fdopen(reply_end, "wb"))
    os.close(request_end)
    os.close(reply_end)
    return _Child(process, os.fdopen(request_source, "wb"), os.fdopen(reply_source, "rb", buffering=0))


def _run_child(server: int, requests: BinaryIO, replies: BinaryIO) -> None:
    """Run jobs in the child until it is not used any more, and end the process."""
    try:
        os.setsid()  # with all processes that it starts it can be killed as a group
        _end_with_parent(server)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        memory = psutil.Process().memory_info  # `data`, what the process has reserved, is known on Linux alone
        first_memory = memory()
        for count in range(1, MAX_CHILD_JOBS + 1):
            request = read_message(requests)
            assert isinstance(request, ForkRequest)
            with suppress(OSError, ValueError, OverflowError):
                _limit_data(getattr(first_memory, "data", 0) + int(MEMORY_BACKSTOP_FACTOR * request.memory_mb * 1e6))
            reply = _run_job(request)
            write_message(replies, replace(reply, peak_memory_mb=measure_peak_memory_mb()))
            return_free_memory()
            held_bytes = memory().rss - first_memory.rss
            is_small = held_bytes < MAX_KEPT_MEMORY_SHARE * request.memory_mb * 1e6
            is_kept = is_small and not reply.error and count < MAX_CHILD_JOBS and _reset_peak_memory()
            write_message(replies, is_kept)
            if not is_kept:
                break
    finally:
        os._exit(0)


def _run_job(request: ForkRequest) -> ChildReply:
    """Call the function of a request."""
    module, _, name = request.function.partition(":")
    try:
        reply = ChildReply(getattr(import_module(module), name)(**pickle.loads(request.arguments)))
        pickle.dumps(reply)
    except MemoryError:
        return ChildReply(error="The memory limit was reached.", is_memory=True)
    except BaseException as error:  # the server goes on
        return ChildReply(error=describe_error(error))
    return reply


def measure_peak_memory_mb() -> float:
    """Return the greatest resident memory of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * MAXRSS_UNIT_MB


def _end_with_parent(server: int) -> None:
    """Let the kernel kill this process when the server ends, however it ends."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != server:
            os._exit(1)


def _reset_peak_memory() -> bool:
    """Let the peak memory of this process count from now; return whether the system can do so."""
    try:
        with open(PEAK_RESET_FILE, "wb") as file:  # noqa: PTH123
            file.write(PEAK_RESET_COMMAND)
    except OSError:
        return False
    return True


def _limit_data(limit_bytes: int) -> None:
    """Limit the memory that this process can reserve, in case it grows faster than it is watched."""
    _, hard_limit = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (limit_bytes, hard_limit))


WATCH_INTERVAL_S = 0.1
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


class ForkServer:
    """The connection to a process that forks a child for each job. It runs one job at a time.

    warm_up  "module:name" of a function that the process calls when it starts
    """

    def __init__(self, warm_up: str = DEFAULT_WARM_UP) -> None:
        self._process: subprocess.Popen[bytes] = subprocess.Popen(
            [sys.executable, "-c", f"from {__name__} import serve_forks; serve_forks()", warm_up],
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
