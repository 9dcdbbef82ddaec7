"""The records of a batch: for each take what was cleaned, with what, and how it ended, in a JSON file beside the outputs; and who
is in which take, in people.yaml.

The records are the whole state of a batch. A take whose record agrees with its input, the options and the version, and whose
outputs exist, is not cleaned again: `hash_file` and `hash_options` tell. `lock_batch_folder` and `hold_take` lock the folder of a
batch and the outputs of a take; the locks end with the process that holds them, however it ends.
"""

import hashlib
import json
import os
from collections.abc import Generator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path, PurePosixPath
from typing import Any, Literal, cast

from pydantic import Field, NonNegativeFloat, NonNegativeInt, ValidationError

from mocapfix.io.files import LOCK_TEXT_ENCODING, build_lock, hold_process_lock, make_output_folder, replace_atomically
from mocapfix.io.shipped import dump_yaml
from mocapfix.io.yaml_files import StrictModel, read_yaml_model
from mocapfix.model.system import avoid_reserved_name
from mocapfix.options import CleanOptions

RECORD_SUFFIX = ".record.json"

FailureReason = Literal["error", "timeout", "memory", "crash"]


class SubjectFigures(StrictModel):
    """What a cleaning found and did on one subject of a take."""

    subject: str = ""  # name of the subject; "" if the file has only one
    marker_set: str | None = None  # name of the marker set; None without a body
    frame_count: NonNegativeInt = 0
    rate_hz: NonNegativeFloat = 0.0
    duration_s: NonNegativeFloat = 0.0
    sample_count: NonNegativeInt = 0  # samples of all markers in all frames
    missing_before: NonNegativeInt = 0
    filled: NonNegativeInt = 0
    left_empty: NonNegativeInt = 0
    replaced: NonNegativeInt = 0
    relabelled: NonNegativeInt = 0
    fault_counts: dict[str, NonNegativeInt] = Field(default_factory=dict)  # number of faults by kind
    # that of the change that is predicted worst, as in the report; None without any
    worst_predicted_error_mm: NonNegativeFloat | None = None
    # frame of its least certain sample, else the one with the most empty or corrected ones; the file's frame number
    worst_frame: int | None = None
    residual_mm: NonNegativeFloat | None = None  # mean distance of the markers from the body; None without a body
    picture_svg: str = ""  # small drawing of that frame for the session page
    laboratory: str = ""  # what suggests that the take is that of a laboratory; "" if nothing does
    notes: tuple[str, ...] = ()  # sentences of the report on what else needs attention


class TakeRecord(StrictModel):
    """How the last attempt to clean a take ended."""

    take: str  # id of the take: its path relative to the common folder of all takes, with "/"
    input: str  # path of the input file
    input_sha256: str = ""  # hash of the input's bytes; "" if it could not be read
    options_sha256: str = ""  # hash of the options, and of the subject files among them
    version: str = ""  # version of mocapfix
    status: Literal["done", "failed"]
    reason: FailureReason | None = None  # why it failed: an error that mocapfix explains, a limit, or a crash of the process
    error: str = ""  # one sentence; "" if done
    attempts: NonNegativeInt = 1  # how often the cleaning was begun with this input, these options and this version
    seconds: NonNegativeFloat = 0.0  # time of the last attempt
    peak_memory_mb: NonNegativeFloat = 0.0  # greatest resident memory of the process that cleaned, MB of 10^6 bytes
    # paths of the outputs by suffix, relative to the batch's folder, with "/"; those of the last that was done with this input
    outputs: dict[str, str] = Field(default_factory=dict)
    subjects: tuple[SubjectFigures, ...] = ()
    # paths of the subject files with which the take was cleaned, by subject, relative to the batch's folder
    subject_files: dict[str, str] = Field(default_factory=dict)
    started: str = ""  # time in ISO 8601 with time zone
    finished: str = ""


def get_take_folder(output_folder: Path, take: str) -> Path:
    """Return the folder for the outputs of a take, given its id: its path without the suffix."""
    path = output_folder / PurePosixPath(take)
    return path.with_name(avoid_reserved_name(path.stem))


def get_record_path(output_folder: Path, take: str) -> Path:
    return get_take_folder(output_folder, take) / f"{PurePosixPath(take).stem}{RECORD_SUFFIX}"


def write_record(output_folder: Path, record: TakeRecord) -> Path:
    """Write a record beside the outputs of its take, replacing an earlier one. Raises WriteError."""
    path = get_record_path(output_folder, record.take)
    make_output_folder(path.parent)
    with replace_atomically(path) as part:
        part.write_text(record.model_dump_json(indent=1) + "\n", encoding="utf-8")
    return path


def read_record(path: Path) -> TakeRecord | None:
    """Return the record in a file; None if there is none, or if it was written by another version and cannot be read."""
    try:
        return TakeRecord.model_validate_json(path.read_bytes())
    except (OSError, ValidationError):
        return None


def read_records(output_folder: Path) -> list[TakeRecord]:
    """Return all records in the folder of a batch, by the ids of their takes."""
    found = (read_record(path) for path in list_record_paths(output_folder))
    return sorted((record for record in found if record), key=lambda record: record.take)


def list_record_paths(output_folder: Path) -> list[Path]:
    """Return the paths of all records in the folder of a batch. Folders that appear or vanish at this moment do no harm."""
    walk = os.walk(output_folder, followlinks=True)
    return sorted(Path(folder, name) for folder, _, names in walk for name in names if name.endswith(RECORD_SUFFIX))


PEOPLE_FILE_NAME = "people.yaml"


class PersonEntry(StrictModel):
    """One person of a session. Paths are relative to the folder of the batch."""

    name: str
    basis: str = ""  # from what it is known which takes are this person's, in words such as "subject prefix" or "body"
    takes: dict[str, str] = Field(default_factory=dict)  # by id of a take, the name of the subject in it; "" if it has only one
    subject_file: str = ""  # calibrated from all takes
    # by id of a take, the subject file with which it was cleaned, where marker places differ
    take_files: dict[str, str] = Field(default_factory=dict)
    moved_markers: tuple[str, ...] = ()  # a sentence for each marker that moved between takes
    # by id of a take, why it is not this person's although the names agree
    rejected: dict[str, str] = Field(default_factory=dict)


class SessionPeople(StrictModel):
    """All people of a session, and sentences on how takes were assigned to them."""

    people: tuple[PersonEntry, ...] = ()
    notes: tuple[str, ...] = ()


def write_people_file(output_folder: Path, people: SessionPeople) -> Path:
    """Write people.yaml into the folder of a batch and return its path. Raises WriteError."""
    path = output_folder / PEOPLE_FILE_NAME
    with replace_atomically(path) as part:
        part.write_text(dump_yaml(people.model_dump(mode="json")), encoding="utf-8")
    return path


def read_people_file(output_folder: Path) -> SessionPeople | None:
    """Return the people of a batch, None if the session has no such file. Raises SceneError if it cannot be read."""
    path = output_folder / PEOPLE_FILE_NAME
    return read_yaml_model(SessionPeople, path) if path.exists() else None


BATCH_LOCK_NAME = ".batch.lock"
ATTEMPTS_SUFFIX = ".attempts"
ATTEMPTS_LOCK_SUFFIX = ".lock"


@contextmanager
def lock_batch_folder(folder: Path) -> Generator[None]:
    """Hold the lock of a batch's output folder, so that no other batch writes there.

    Raises WriteError, with the computer and the process that hold it, if another batch does.
    """
    make_output_folder(folder)
    begin, end = f"{folder}: another batch is writing there", "wait for it, or choose another folder with --out."
    with hold_process_lock(folder / BATCH_LOCK_NAME, lambda holder: f"{begin} ({holder}); {end}"):
        yield


class TakeAttempts:
    """The attempts at a take, one line for each, in a file that only the process holds which cleans the take."""

    def __init__(self, path: Path, lines: list[str]) -> None:
        self._path, self.lines = path, lines

    def count(self, key: str) -> int:
        """Return how many attempts with this key were begun since the take was last done or failed."""
        return self.lines.count(key)

    def begin(self, key: str) -> int:
        """Note that an attempt begins; return how many with this key have begun."""
        self.lines.append(key)
        self._path.write_text("".join(f"{line}\n" for line in self.lines), encoding=LOCK_TEXT_ENCODING)
        return self.count(key)

    def clear(self) -> None:
        """Forget the attempts, after their number was written into the record."""
        self.lines.clear()
        self._path.unlink(missing_ok=True)


@contextmanager
def hold_take(output_folder: Path, take: str) -> Generator[TakeAttempts]:
    """Hold the lock on a take's outputs; wait until no other process does."""
    folder = get_take_folder(output_folder, take)
    make_output_folder(folder)
    path = folder / f".{PurePosixPath(take).stem}{ATTEMPTS_SUFFIX}"
    with build_lock(path.with_suffix(ATTEMPTS_LOCK_SUFFIX)) as lock:
        lines = path.read_text(encoding=LOCK_TEXT_ENCODING).splitlines() if path.exists() else []
        attempts = TakeAttempts(path, lines)
        yield attempts
        if not attempts.lines:
            attempts.clear()
            with suppress(PermissionError):  # on Windows its file is removed with the lock
                Path(lock.lock_file).unlink(missing_ok=True)


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a file's bytes in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def hash_options(options: CleanOptions) -> str:
    """Return a hash of all options and of the contents of the files that they name."""
    values = asdict(options)
    del values["purpose"]["given"]  # who set a value does not matter
    return hashlib.sha256(json.dumps(_describe(values), sort_keys=True).encode()).hexdigest()


def _describe(value: Any) -> Any:
    """Return a value of an option as JSON has it, a file by its content: it may have another name for another worker."""
    if isinstance(value, dict):
        return {str(key): _describe(each) for key, each in cast("dict[Any, Any]", value).items()}
    if isinstance(value, list | tuple):
        return [_describe(each) for each in cast("list[Any]", value)]
    if isinstance(value, Path) and value.is_file():
        return {"sha256": hash_file(value)}
    return value if isinstance(value, int | float | str | bool | None) else str(value)


def resolve_option_files(options: CleanOptions) -> CleanOptions:
    """Return the options with absolute paths of the files that they name: workers have another current folder."""
    return options.map_files(lambda name: Path(name).resolve() if Path(name).is_file() else name)
