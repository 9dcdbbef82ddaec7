"""Writing output files safely: atomic replacement, overwrite checks, output folders and locks.

New files are written into a temporary folder beside the outputs. Its owner holds a lock in it for as long as it needs it. The
system releases the locks of a process that ends, however it ends, and the next run removes the folders of killed owners.
"""

import ctypes
import gc
import hashlib
import os
import shutil
import signal
import socket
import threading
import time
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager, suppress
from pathlib import Path, PurePath
from tempfile import gettempdir, mkdtemp
from types import FrameType
from typing import TYPE_CHECKING

from mocapfix.errors import ReadError, WriteError
from mocapfix.model.system import get_system

if TYPE_CHECKING:
    from filelock import FileLock

HOST_DIGEST_LENGTH = 8
TEMPORARY_PREFIX = ".mocapfix-" + hashlib.sha256(socket.gethostname().encode()).hexdigest()[:HOST_DIGEST_LENGTH] + "-"
"""of the names of temporary folders: with a digest of the machine's name"""
TEMPORARY_PATTERN = ".mocapfix-" + "?" * HOST_DIGEST_LENGTH + "-*"
LOCK_NAME = ".lock"  # the file in a temporary folder that its owner has locked
FOREIGN_AGE_S = 24 * 3600.0
"""age from which what another machine left is removed too: not every network file system knows the locks of other machines"""
OPEN_FILE_LIMIT_S, OPEN_FILE_INTERVAL_S = 3.0, 0.05
"""how long, and between which attempts, a file is waited for that a program has open, such as a virus scanner"""


@contextmanager
def open_temporary_folder(folder: Path) -> Generator[Path]:
    """Yield a new folder in a folder, with a locked file in it, and removed at the end with its content. Raises OSError.

    A folder without a lock is always empty, at the beginning and at the end, so that another process can tell whether it is used.
    """
    while True:
        path = Path(mkdtemp(dir=folder, prefix=TEMPORARY_PREFIX))
        lock = build_lock(path / LOCK_NAME)
        try:
            lock.acquire()
            break
        except (FileNotFoundError, FileExistsError):  # the latter where it is removed while filelock looks whether it is there
            if not folder.is_dir():  # otherwise another process or thread has removed it before it was locked
                raise
        except OSError:
            if (path / LOCK_NAME).exists():  # a file system without locks
                break
            path.rmdir()
            raise
    try:
        yield path
    finally:
        _remove_folder(path, lock)


def remove_abandoned_files(folder: Path) -> None:
    """Remove the temporary folders in a folder whose owners have ended. What cannot be removed is left."""
    with suppress(OSError):
        for path in folder.glob(TEMPORARY_PATTERN):
            with suppress(OSError):
                _remove_if_abandoned(path)


def _remove_if_abandoned(path: Path) -> None:
    if not path.name.startswith(TEMPORARY_PREFIX) and time.time() - path.stat().st_mtime < FOREIGN_AGE_S:
        return
    if not (path / LOCK_NAME).exists():
        path.rmdir()  # it is empty
        return
    lock = build_lock(path / LOCK_NAME)
    lock.acquire(blocking=False)  # raises OSError while the owner lives
    _remove_folder(path, lock)


def _remove_folder(path: Path, lock: "FileLock") -> None:
    """Remove a temporary folder and release its lock, whose file is removed last."""
    with suppress(OSError):
        for each in path.iterdir():
            if each.name != LOCK_NAME:
                if each.is_dir():
                    shutil.rmtree(each, ignore_errors=True)
                else:
                    each.unlink(missing_ok=True)
    with suppress(PermissionError):  # on Windows it is removed with the lock
        (path / LOCK_NAME).unlink(missing_ok=True)
    lock.release()
    with suppress(OSError):
        path.rmdir()


OUTPUT_FOLDER_SUFFIX = ".mocapfix"  # of the folder beside a take for its outputs; captures in such a folder are outputs
JSON_REPORT_SUFFIX = ".report.json"  # what follows the stem of a take, or of one of its subjects, in the name of its report


@contextmanager
def replace_atomically(target: Path) -> Generator[Path]:
    """Yield a path in a temporary folder beside `target` to write a file to.

    The new file replaces `target` if the block ends without an exception, and is deleted otherwise. What killed processes left in
    the folder is deleted too.

    Raises:
        WriteError: If the folder of `target` is not writable. The message names the target.
    """
    target, part = Path(target), None
    remove_abandoned_files(target.parent)
    try:
        with open_temporary_folder(target.parent) as temporary:
            part = temporary / target.name
            yield part
            replace_file(part, target)
    except OSError as error:
        raise WriteError(describe_write_failure(target, error, "" if part else "; choose another folder")) from error


@contextmanager
def replace_together(targets: Iterable[Path], folder: Path) -> Generator[Path]:
    """Yield a temporary folder in `folder` to write files of the names of `targets` into.

    They replace the targets if the block ends without an exception; a target of which there is no new file is removed. A signal
    to stop that arrives while they are moved takes effect afterwards.

    Raises:
        WriteError: If the folder is not writable, full or removed. The message names it.
    """
    remove_abandoned_files(folder)
    temporary = folder
    try:
        with open_temporary_folder(folder) as temporary:
            yield temporary
            with hold_signals():
                targets = list(targets)
                for target in targets:  # all can be replaced, or none is
                    if target.exists():
                        replace_file(target, target)
                for target in targets:
                    part = temporary / target.name
                    if part.exists():
                        replace_file(part, target)
                    else:  # an output of an earlier run
                        target.unlink(missing_ok=True)
    except WriteError as error:
        raise WriteError(str(error).replace(f"{temporary}{os.sep}", f"{folder}{os.sep}")) from error
    except OSError as error:
        raise WriteError(describe_write_failure(folder, error, "; choose another folder")) from error


def replace_file(part: Path, target: Path) -> None:
    """Rename a file to `target`, in place of the file of that name; wait for a program that has that one open. Raises OSError."""
    deadline = time.monotonic() + (OPEN_FILE_LIMIT_S if get_system().keeps_open_files else 0.0)
    while True:
        try:
            part.replace(target)
            return
        except PermissionError:
            if time.monotonic() >= deadline:
                raise
        time.sleep(OPEN_FILE_INTERVAL_S)


def describe_write_failure(path: Path, error: OSError, advice: str) -> str:
    """Return the sentence on a file or folder that cannot be written; `advice` is its end, without a full stop."""
    system, file = get_system(), str(error.filename2 or error.filename or path)
    if len(file) > system.max_path_length:
        return (
            f"{path}: cannot be written: the path of an output has {len(file)} characters, of which this system opens "
            f"{system.max_path_length}; choose a folder with a shorter path."
        )
    if isinstance(error, PermissionError) and system.keeps_open_files and Path(file).is_file():
        return f"{file}: cannot be replaced while another program has it open; close it there, and repeat the command."
    if isinstance(error, FileExistsError | NotADirectoryError):
        return f"{path}: the folder cannot be created (it or one above it is a file){advice}."
    return f"{path}: cannot be written ({error.strerror or error}){advice}."


@contextmanager
def hold_signals() -> Generator[None]:
    """Let SIGINT and SIGTERM take effect only at the end of the block, in the main thread of Python."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    arrived: list[int] = []

    def note_signal(number: int, _: FrameType | None) -> None:
        arrived.append(number)

    numbers = (signal.SIGINT, signal.SIGTERM)
    handlers = {number: signal.getsignal(number) for number in numbers}
    try:
        for number in numbers:
            signal.signal(number, note_signal)
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        for number in arrived[:1]:
            signal.raise_signal(number)


@contextmanager
def make_scratch_folder() -> Generator[Path]:
    """Yield a folder for temporary files, which is removed at the end. Raises WriteError if there is no room for it."""
    try:
        folder = Path(gettempdir())
        remove_abandoned_files(folder)
        with open_temporary_folder(folder) as temporary:
            yield temporary
    except OSError as error:
        problem = error.strerror or error
        raise WriteError(f"The folder for temporary files cannot be used ({problem}); free space, or set TMPDIR.") from error


def check_outputs_absent(outputs: Iterable[Path], overwrite: bool) -> None:
    """Raise WriteError for the first output that exists, unless `overwrite` is true."""
    existing = [path for path in outputs if path.exists()]
    if existing and not overwrite:
        raise WriteError(f"{existing[0]}: already exists; give --overwrite to replace it, or choose another name or folder.")


def make_output_folder(folder: Path) -> None:
    """Create an output folder and its parents, and remove what killed processes left in it. Raise WriteError if that fails."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WriteError(describe_write_failure(folder, error, "; choose another folder with --out")) from error
    remove_abandoned_files(folder)


def find_common_folder(paths: Iterable[PurePath]) -> Path:
    """Return the deepest folder that contains files, given by absolute paths. Raises ReadError if they are on several drives."""
    folders = [path.parent for path in paths]
    try:
        return Path(os.path.commonpath(folders))
    except ValueError:
        others = [each for each in folders if each.drive != folders[0].drive]
        raise ReadError(f"{others[0]}: is on another drive than {folders[0]}; name takes of one drive at a time.") from None


def get_source_suffixes(source_path: Path | None) -> tuple[str, ...]:
    """Return the suffixes of the cleaned copy: that of the input, for AMC that of its skeleton too, for JSON that of a table."""
    suffix = (source_path.suffix[1:].lower() if source_path else "") or "c3d"
    return {"amc": ("amc", "asf"), "json": ("csv",)}.get(suffix, (suffix,))


LOCK_TEXT_ENCODING = "utf-8"


@contextmanager
def hold_process_lock(path: Path, describe_refusal: Callable[[str], str]) -> Generator[None]:
    """Hold the lock at `path`, a file that stays there.

    Raises WriteError then, and if the file cannot be written.

    Args:
        describe_refusal: Returns the sentence of the error if another process holds it, given its computer, process and start.
    """
    from filelock import Timeout  # slow to import

    lock = build_lock(path)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        holder = ""
        with suppress(OSError):  # on Windows a locked file cannot be read
            holder = path.read_text(encoding=LOCK_TEXT_ENCODING).strip()
        raise WriteError(describe_refusal(holder or "unknown process")) from None
    except OSError as error:
        raise WriteError(describe_write_failure(path, error, "; choose another folder")) from error
    try:
        text = f"computer {socket.gethostname()}, process {os.getpid()}, since {time.strftime('%Y-%m-%d %H:%M')}"
        with suppress(PermissionError):  # Windows
            path.write_text(text, encoding=LOCK_TEXT_ENCODING)
        yield
    finally:
        lock.release()


def build_lock(path: Path) -> "FileLock":
    """Return the lock of a file, which ends with its process; acquiring it raises OSError where the file system has no locks."""
    from filelock import FileLock  # slow to import

    return FileLock(path, fallback_to_soft=False)


def return_free_memory() -> None:
    """Collect garbage, and return freed memory to the system where the C library can do so (glibc)."""
    gc.collect()
    if get_system().name == "linux" and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)):
        trim(0)
