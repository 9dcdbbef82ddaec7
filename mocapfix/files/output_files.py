"""Where outputs go: into place whole or not at all, over nothing that is there unless it may be, into a folder that is made."""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import mkstemp

from mocapfix.errors import WriteError


@contextmanager
def replace_atomically(target: Path) -> Iterator[Path]:
    """Yield a new file beside `target` to write into; it becomes `target` if the block ends well, and goes otherwise.

    Raises WriteError, naming the target, where the folder cannot be written.
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
    """Raise WriteError naming the first output that is there already, unless it may be replaced."""
    there = [path for path in outputs if path.exists()]
    if there and not overwrite:
        raise WriteError(f"{there[0]}: is there already; give --overwrite to replace it, or choose another place.")


def make_output_folder(folder: Path) -> None:
    """Make an output folder. Raises WriteError naming it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WriteError(f"{folder}: cannot be made a folder ({error.strerror}); choose another with --out.") from error


def _get_umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
