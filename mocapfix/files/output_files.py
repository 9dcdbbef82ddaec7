"""Writing output files safely: atomic replacement, overwrite checks and output folders."""

import os
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from pathlib import Path
from tempfile import mkstemp

from mocapfix.errors import WriteError


@contextmanager
def replace_atomically(target: Path) -> Generator[Path]:
    """Yield a temporary file beside `target` to write into.

    The temporary file replaces `target` if the block ends without an exception, and is deleted otherwise.

    Raises:
        WriteError: If the folder of `target` is not writable. The message names the target.
    """
    target = Path(target)
    try:
        handle, name = mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=".part")
    except OSError as error:
        raise WriteError(f"{target}: cannot be written ({error.strerror}); choose another folder.") from error
    os.close(handle)
    part = Path(name)
    try:
        yield part
        part.chmod(0o666 & ~_get_umask())
        part.replace(target)
    except OSError as error:
        raise WriteError(f"{target}: could not be written ({error.strerror or error}).") from error
    finally:
        part.unlink(missing_ok=True)


def check_outputs_absent(outputs: Iterable[Path], overwrite: bool) -> None:
    """Raise WriteError for the first output that exists, unless `overwrite` is true."""
    existing = [path for path in outputs if path.exists()]
    if existing and not overwrite:
        raise WriteError(f"{existing[0]}: already exists; give --overwrite to replace it, or choose another name or folder.")


def make_output_folder(folder: Path) -> None:
    """Create an output folder and its parents. Raise WriteError if that fails."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WriteError(f"{folder}: the folder cannot be created ({error.strerror}); choose another with --out.") from error


def _get_umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
