"""Temporary files and folders beside outputs, which the next run removes if their owner was killed.

The owner holds a lock on each for as long as it needs it. The system releases the locks of a process that ends, however it ends.
"""

import hashlib
import os
import shutil
import socket
import time
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import mkdtemp, mkstemp

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

HOST_DIGEST_LENGTH = 8
TEMPORARY_PREFIX = ".mocapfix-" + hashlib.sha256(socket.gethostname().encode()).hexdigest()[:HOST_DIGEST_LENGTH] + "-"
"""of the names of temporary files and folders: with a digest of the machine's name"""
TEMPORARY_PATTERN = ".mocapfix-" + "?" * HOST_DIGEST_LENGTH + "-*"
LOCK_NAME = ".lock"
"""the file in a temporary folder that its owner has locked"""
FOREIGN_AGE_S = 24 * 3600.0
"""age from which what another machine left is removed too: not every network file system knows the locks of other machines"""


@contextmanager
def open_temporary_file(folder: Path) -> Generator[Path]:
    """Yield a new empty file in a folder, which is locked, and removed at the end if it is still there. Raises OSError."""
    while True:
        handle, name = mkstemp(dir=folder, prefix=TEMPORARY_PREFIX, suffix=".part")
        _lock(handle)
        if os.fstat(handle).st_nlink:  # another process has not removed it before it was locked
            break
        os.close(handle)
    try:
        yield Path(name)
    finally:
        with suppress(OSError):
            Path(name).unlink(missing_ok=True)
        os.close(handle)


@contextmanager
def open_temporary_folder(folder: Path) -> Generator[Path]:
    """Yield a new folder in a folder, with a locked file in it, and removed at the end with its content. Raises OSError.

    A folder without a lock is always empty, at the beginning and at the end, so that another process can tell whether it is used.
    """
    while True:
        path = Path(mkdtemp(dir=folder, prefix=TEMPORARY_PREFIX))
        try:
            handle = os.open(path / LOCK_NAME, os.O_CREAT | os.O_RDWR, 0o600)
        except FileNotFoundError:
            if folder.is_dir():  # another process has removed it before it was locked
                continue
            raise
        except OSError:
            path.rmdir()
            raise
        _lock(handle)
        if os.fstat(handle).st_nlink:
            break
        os.close(handle)
    try:
        yield path
    finally:
        _remove_folder(path)
        os.close(handle)


def remove_abandoned_files(folder: Path) -> None:
    """Remove the temporary files and folders in a folder whose owners have ended. What cannot be removed is left."""
    with suppress(OSError):
        for path in folder.glob(TEMPORARY_PATTERN):
            with suppress(OSError):
                _remove_if_abandoned(path)


def _remove_if_abandoned(path: Path) -> None:
    if fcntl is None:
        return
    if not path.name.startswith(TEMPORARY_PREFIX) and time.time() - path.stat().st_mtime < FOREIGN_AGE_S:
        return
    is_folder = path.is_dir()
    lock_path = path / LOCK_NAME if is_folder else path
    if is_folder and not lock_path.exists():
        path.rmdir()  # it is empty
        return
    handle = os.open(lock_path, os.O_RDWR)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises OSError while the owner lives
        if is_folder:
            _remove_folder(path)
        else:
            path.unlink(missing_ok=True)
    finally:
        os.close(handle)


def _remove_folder(path: Path) -> None:
    """Remove a temporary folder, its lock last."""
    with suppress(OSError):
        for each in path.iterdir():
            if each.name != LOCK_NAME:
                if each.is_dir():
                    shutil.rmtree(each, ignore_errors=True)
                else:
                    each.unlink(missing_ok=True)
        (path / LOCK_NAME).unlink(missing_ok=True)
        path.rmdir()


def _lock(handle: int) -> None:
    """Lock an open file, where its file system has locks."""
    if fcntl is not None:
        with suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
