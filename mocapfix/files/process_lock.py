"""Locks that end with the process that holds them, however it ends."""

import os
import socket
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

from mocapfix.errors import WriteError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

LOCK_TEXT_ENCODING = "utf-8"


@contextmanager
def hold_process_lock(path: Path, describe_refusal: Callable[[str], str]) -> Generator[None]:
    """Hold the lock at `path`, a file that stays there.

    describe_refusal  returns the sentence of the error if another process holds it, given its computer, process and start

    Raises WriteError then, and if the file cannot be written.
    """
    try:
        number = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise WriteError(describe_lock_failure(path, error)) from error
    try:
        try:
            lock_open_file(number, wait=False)
            text = f"computer {socket.gethostname()}, process {os.getpid()}, since {time.strftime('%Y-%m-%d %H:%M')}"
            os.ftruncate(number, 0)
            os.write(number, text.encode(LOCK_TEXT_ENCODING))
        except BlockingIOError:
            holder = path.read_text(encoding=LOCK_TEXT_ENCODING).strip() or "unknown process"
            raise WriteError(describe_refusal(holder)) from None
        except OSError as error:
            raise WriteError(describe_lock_failure(path, error)) from error
        yield
    finally:
        os.close(number)


def lock_open_file(number: int, *, wait: bool) -> None:
    """Lock an open file for this process; raise BlockingIOError if another has it and `wait` is false."""
    if fcntl is not None:
        fcntl.flock(number, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))


def describe_lock_failure(path: Path, error: OSError) -> str:
    """Return the sentence on a lock file that cannot be written or locked."""
    return f"{path}: cannot be written ({error.strerror or error}); choose another folder."
