"""Locks on the folder of a batch and on the outputs of a take, which end with the process that holds them, however it ends."""

import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from mocapfix.batch.records import get_take_folder
from mocapfix.files.output_files import make_output_folder
from mocapfix.files.process_lock import LOCK_TEXT_ENCODING, hold_process_lock, lock_open_file

BATCH_LOCK_NAME = ".batch.lock"
ATTEMPTS_SUFFIX = ".attempts"


@contextmanager
def lock_batch_folder(folder: Path) -> Generator[None]:
    """Hold the lock of a batch's output folder, so that no other batch writes there.

    Raises WriteError, with the computer and the process that hold it, if another batch does.
    """
    make_output_folder(folder)

    def describe_refusal(holder: str) -> str:
        return f"{folder}: another batch is writing there ({holder}); wait for it, or choose another folder with --out."

    with hold_process_lock(folder / BATCH_LOCK_NAME, describe_refusal):
        yield


class TakeAttempts:
    """The attempts at a take, one line for each, in a file that only the process holds which cleans the take."""

    def __init__(self, path: Path, lines: list[str]) -> None:
        self._path, self._lines = path, lines

    def count_all(self) -> int:
        """Return the number of attempts with any key."""
        return len(self._lines)

    def count(self, key: str) -> int:
        """Return how many attempts with this key were begun since the take was last done or failed."""
        return self._lines.count(key)

    def begin(self, key: str) -> int:
        """Note that an attempt begins; return how many with this key have begun."""
        self._lines.append(key)
        self._path.write_text("".join(f"{line}\n" for line in self._lines), encoding=LOCK_TEXT_ENCODING)
        return self.count(key)

    def clear(self) -> None:
        """Forget the attempts, after their number was written into the record."""
        self._lines.clear()
        self._path.unlink(missing_ok=True)


@contextmanager
def hold_take(output_folder: Path, take: str) -> Generator[TakeAttempts]:
    """Hold the lock on a take's outputs; wait until no other process does."""
    folder = get_take_folder(output_folder, take)
    make_output_folder(folder)
    path = folder / f".{PurePosixPath(take).stem}{ATTEMPTS_SUFFIX}"
    while True:
        number = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            lock_open_file(number, wait=True)
            try:
                is_current = os.fstat(number).st_ino == path.stat().st_ino
            except FileNotFoundError:  # the process that held the lock before has removed the file
                is_current = False
            if is_current:
                attempts = TakeAttempts(path, path.read_text(encoding=LOCK_TEXT_ENCODING).splitlines())
                yield attempts
                if not attempts.count_all():
                    attempts.clear()
                return
        finally:
            os.close(number)
