"""The process that forks a child for each job: it has imported mocapfix and loaded its compiled kernels, once for all jobs.

`python -m mocapfix.batch.fork_server` reads requests from standard input and writes replies to standard output. A message is its
length in four bytes and a pickle. It has one thread, so that a fork copies everything. For each `ForkRequest` it replies with the
child's process number, and at the end of the child with a `ChildEnd`. When its standard input ends, because its worker has
ended or was killed, it kills the running child and ends.
"""

import ctypes
import gc
import os
import pickle
import resource
import select
import signal
import struct
import sys
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from typing import BinaryIO

LENGTH_FORMAT = ">I"
READ_SIZE = 1 << 16  # bytes
PR_SET_PDEATHSIG = 1  # of Linux: a signal to the child when its parent ends
MEMORY_BACKSTOP_FACTOR = 2  # data that a child may reserve beyond that of the server, relative to its limit of resident memory
STATUS_FILE = "/proc/self/statm"
DATA_PAGES_COLUMN = 5


@dataclass(frozen=True)
class ForkRequest:
    """A job for a child.

    function   "module:name" of a function
    arguments  its arguments by name, pickled
    memory_mb  limit of its resident memory
    """

    function: str
    arguments: bytes
    memory_mb: float


@dataclass(frozen=True)
class ChildEnd:
    """How a child ended.

    wait_status     of os.waitpid
    peak_memory_mb  greatest resident memory, with that of the libraries which it shares with the server
    reply           what the child wrote: a pickled ChildReply; empty if it was killed
    """

    wait_status: int
    peak_memory_mb: float
    reply: bytes


@dataclass(frozen=True)
class ChildReply:
    """What a child reports.

    value      the function's result
    error      the sentence of an error; "" if there was none
    is_memory  whether the error is that no memory was left
    """

    value: object = None
    error: str = ""
    is_memory: bool = False


def write_message(stream: BinaryIO, message: object) -> None:
    """Write one message."""
    data = pickle.dumps(message)
    stream.write(struct.pack(LENGTH_FORMAT, len(data)) + data)
    stream.flush()


def read_message(stream: BinaryIO) -> object:
    """Read one message. Raises EOFError if the stream has ended."""
    header = stream.read(struct.calcsize(LENGTH_FORMAT))
    if len(header) < struct.calcsize(LENGTH_FORMAT):
        raise EOFError
    (length,) = struct.unpack(LENGTH_FORMAT, header)
    data = stream.read(length)
    if len(data) < length:
        raise EOFError
    return pickle.loads(data)


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
    with suppress(EOFError, BrokenPipeError):
        while True:
            request = read_message(requests)
            assert isinstance(request, ForkRequest)
            _serve_one(request, requests, replies)
    os._exit(0)


def _serve_one(request: ForkRequest, requests: BinaryIO, replies: BinaryIO) -> None:
    """Fork a child and reply with its end. Raises EOFError if the worker has ended."""
    read_end, write_end = os.pipe()
    server = os.getpid()
    child = os.fork()
    if not child:
        os.close(read_end)
        _run_child(request, server, write_end)
    os.close(write_end)
    write_message(replies, child)
    reply = bytearray()
    while True:
        ready, _, _ = select.select([read_end, requests], [], [])
        if requests in ready:  # no request comes before the reply: the stream has ended
            with suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)
            with suppress(ProcessLookupError):
                os.kill(child, signal.SIGKILL)
            raise EOFError
        data = os.read(read_end, READ_SIZE)
        if not data:
            break
        reply += data
    os.close(read_end)
    _, wait_status, usage = os.wait4(child, 0)
    unit = 1e6 if sys.platform == "darwin" else 1e3 / 1.024  # bytes; kibibytes
    write_message(replies, ChildEnd(wait_status, usage.ru_maxrss / unit, bytes(reply)))


def _run_child(request: ForkRequest, server: int, write_end: int) -> None:
    """Run the job in the child and end the process."""
    os.setsid()  # with all processes that it starts it can be killed as a group
    _end_with_parent(server)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    with suppress(OSError, ValueError, OverflowError):
        _limit_data(request.memory_mb)
    module, _, name = request.function.partition(":")
    try:
        arguments = pickle.loads(request.arguments)
        reply = ChildReply(getattr(import_module(module), name)(**arguments))
    except MemoryError:
        reply = ChildReply(error="The memory limit was reached.", is_memory=True)
    except BaseException as error:  # the server goes on
        reply = ChildReply(error=describe_error(error))
    try:
        data = memoryview(pickle.dumps(reply))
        while data:
            data = data[os.write(write_end, data) :]
    finally:
        os._exit(0)


def describe_error(error: BaseException) -> str:
    """Return the sentence of an error; for one that mocapfix does not explain, its kind and where it was raised."""
    from mocapfix.errors import MocapfixError

    if isinstance(error, MocapfixError):
        return str(error)
    traceback, place = error.__traceback__, ""
    while traceback is not None:
        code = traceback.tb_frame.f_code
        place = f" in {os.path.basename(code.co_filename)}, line {traceback.tb_lineno}"  # noqa: PTH119
        traceback = traceback.tb_next
    return f"An error in mocapfix{place} ({type(error).__name__}: {error}); please report it, with the file if possible."


def _end_with_parent(server: int) -> None:
    """Let the kernel kill this process when the server ends, however it ends."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != server:
            os._exit(1)


def _limit_data(memory_mb: float) -> None:
    """Limit the memory that this process can reserve, in case it grows faster than it is watched."""
    with open(STATUS_FILE) as file:  # noqa: PTH123
        pages = int(file.read().split()[DATA_PAGES_COLUMN])
    limit = pages * resource.getpagesize() + int(MEMORY_BACKSTOP_FACTOR * memory_mb * 1e6)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))


if __name__ == "__main__":
    # This module a second time, under its own name, so that the classes of pickled messages are the same in both processes.
    from mocapfix.batch import fork_server

    fork_server.serve_forks()
