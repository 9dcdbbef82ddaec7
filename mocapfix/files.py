"""Putting an output into place whole or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import mkstemp

from mocapfix.errors import WriteError


@contextmanager
def replacing(target: Path) -> Iterator[Path]:
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
        part.chmod(0o666 & ~_umask())
        part.replace(target)
    except OSError as error:
        raise WriteError(f"{target}: could not be written ({error.strerror or error}).") from error
    finally:
        part.unlink(missing_ok=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
