"""The messages between a worker, its fork server and the server's child: the length in four bytes, and a pickle."""

import pickle
import struct
from dataclasses import dataclass
from typing import BinaryIO

LENGTH_FORMAT = ">I"


@dataclass(frozen=True)
class ForkRequest:
    """A job for a child.

    function   "module:name" of a function
    arguments  its arguments by name, pickled
    memory_mb  limit of its resident memory
    new_child  whether a child that has run other jobs is not used: the last one was killed
    """

    function: str
    arguments: bytes
    memory_mb: float
    new_child: bool = False


@dataclass(frozen=True)
class JobEnd:
    """How a job ended.

    wait_status     of os.waitpid, if its process ended with it; 0 otherwise
    peak_memory_mb  greatest resident memory, if its process ended with it
    reply           what the child wrote: a pickled ChildReply; empty if it was killed
    """

    wait_status: int
    peak_memory_mb: float
    reply: bytes


@dataclass(frozen=True)
class ChildReply:
    """What a child reports.

    value           the function's result
    error           the sentence of an error; "" if there was none
    is_memory       whether the error is that no memory was left
    peak_memory_mb  greatest resident memory during the job, with that of the libraries which the child shares with the server
    """

    value: object = None
    error: str = ""
    is_memory: bool = False
    peak_memory_mb: float = 0.0


def write_message(stream: BinaryIO, message: object) -> None:
    """Write one message."""
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
