"""The record of one take in a batch: what was cleaned, with what, and how it ended. One JSON file beside the outputs.

The records are the whole state of a batch. A take whose record agrees with its input, the options and the version, and whose
outputs exist, is not cleaned again.
"""

import os
from pathlib import Path, PurePosixPath
from typing import Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, ValidationError

from mocapfix.batch.take_figures import SubjectFigures
from mocapfix.files.output_files import make_output_folder, replace_atomically
from mocapfix.files.yaml_models import StrictModel

RECORD_SUFFIX = ".record.json"

FailureReason = Literal["error", "timeout", "memory", "crash"]


class TakeRecord(StrictModel):
    """How the last attempt to clean a take ended.

    take             id of the take: its path relative to the common folder of all takes, with "/"
    input            path of the input file
    input_sha256     hash of the input's bytes; "" if it could not be read
    options_sha256   hash of the options, and of the subject files among them
    version          version of mocapfix
    reason           why it failed: an error that mocapfix explains, a limit, or a crash of the process
    error            one sentence; "" if done
    attempts         how often the cleaning was begun with this input, these options and this version
    seconds          time of the last attempt
    peak_memory_mb   greatest resident memory of the process that cleaned, MB of 10^6 bytes
    outputs          paths of the outputs by suffix, relative to the batch's folder, with "/"
    subject_files    paths of the subject files with which the take was cleaned, by subject, relative to the batch's folder
    started          time in ISO 8601 with time zone
    """

    take: str
    input: str
    input_sha256: str = ""
    options_sha256: str = ""
    version: str = ""
    status: Literal["done", "failed"]
    reason: FailureReason | None = None
    error: str = ""
    attempts: NonNegativeInt = 1
    seconds: NonNegativeFloat = 0.0
    peak_memory_mb: NonNegativeFloat = 0.0
    outputs: dict[str, str] = Field(default_factory=dict)
    subjects: tuple[SubjectFigures, ...] = ()
    subject_files: dict[str, str] = Field(default_factory=dict)
    started: str = ""
    finished: str = ""


def get_take_folder(output_folder: Path, take: str) -> Path:
    """Return the folder for the outputs of a take, given its id: its path without the suffix."""
    return output_folder / PurePosixPath(take).with_suffix("")


def get_record_path(output_folder: Path, take: str) -> Path:
    """Return the path of a take's record."""
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
