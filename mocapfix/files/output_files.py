"""Writing output files safely: atomic replacement, overwrite checks and output folders."""

import os
import signal
import threading
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from pathlib import Path
from tempfile import gettempdir
from types import FrameType

from mocapfix.errors import WriteError
from mocapfix.files.temporary_files import open_temporary_file, open_temporary_folder, remove_abandoned_files

OUTPUT_FOLDER_SUFFIX = ".mocapfix"
"""suffix of the folder beside a take into which its outputs are written; captures in such a folder are outputs"""
JSON_REPORT_SUFFIX = ".report.json"
"""what follows the stem of a take, or of one of its subjects, in the name of its report"""


@contextmanager
def replace_atomically(target: Path) -> Generator[Path]:
    """Yield a temporary file beside `target` to write into.

    The temporary file replaces `target` if the block ends without an exception, and is deleted otherwise. Those that killed
    processes left in the folder are deleted too.

    Raises:
        WriteError: If the folder of `target` is not writable. The message names the target.
    """
    target = Path(target)
    remove_abandoned_files(target.parent)
    opened = open_temporary_file(target.parent)
    try:
        part = opened.__enter__()
    except OSError as error:
        raise WriteError(f"{target}: cannot be written ({error.strerror}); choose another folder.") from error
    try:
        yield part
        part.chmod(0o666 & ~_get_umask())
        part.replace(target)
    except OSError as error:
        raise WriteError(f"{target}: could not be written ({error.strerror or error}).") from error
    finally:
        opened.__exit__(None, None, None)


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
                for target in targets:
                    part = temporary / target.name
                    if part.exists():
                        part.replace(target)
                    else:  # an output of an earlier run
                        target.unlink(missing_ok=True)
    except WriteError as error:
        raise WriteError(str(error).replace(f"{temporary}{os.sep}", f"{folder}{os.sep}")) from error
    except OSError as error:
        raise WriteError(f"{folder}: cannot be written ({error.strerror or error}); choose another folder.") from error


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
        raise WriteError(f"{folder}: the folder cannot be created ({error.strerror}); choose another with --out.") from error
    remove_abandoned_files(folder)


def _get_umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def get_source_suffixes(source_path: Path | None) -> tuple[str, ...]:
    """Return the suffixes of the cleaned copy: that of the input, for AMC that of its skeleton too, for JSON that of a table."""
    suffix = (source_path.suffix[1:].lower() if source_path else "") or "c3d"
    return {"amc": ("amc", "asf"), "json": ("csv",)}.get(suffix, (suffix,))
