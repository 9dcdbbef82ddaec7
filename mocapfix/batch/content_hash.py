"""Hashes of what determines the outputs of a take: the bytes of its file, and the options with the files that they name."""

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

from mocapfix.options import STAGE_OF_OPTION, CleanOptions

FILE_OPTION_NAMES = ("marker_set", "subject", "like", "hierarchy", "review_files", "rigs", "characters", "character_map")
"""options that may name files"""


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
    values = {
        name: getattr(getattr(options, stage), name) for name, stage in STAGE_OF_OPTION.items() if name in FILE_OPTION_NAMES
    }
    return options.change(**{name: _resolve(value) for name, value in values.items() if value})


def _resolve(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(_resolve(each) for each in cast("tuple[Any, ...]", value))
    return Path(value).resolve() if isinstance(value, str | Path) and Path(value).is_file() else value
