"""The arguments of `mocapfix clean` with which a take was cleaned, so that it can be cleaned again in the same way."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

from mocapfix.options import CleanOptions, Option, ReadOptions, list_options, list_stages


def build_clean_arguments(path: Path, options: CleanOptions, folder: Path, stem: str) -> list[str]:
    """Return the input and the options that differ from the defaults, without changes files.

    Files are named relative to the output folder. A subject without a file is the one that was written there.

    stem  of the outputs
    """
    arguments = [_name_file(path, folder)]
    for stage_name, stage in list_stages():
        values = getattr(options, stage_name)
        for name, option in list_options(stage):
            value = getattr(values, name)
            if name != "review_files" and value != options.get_default(name):
                arguments += _format_option(option, name, value, folder, stem)
    return arguments


def _format_option(option: Option, name: str, value: Any, folder: Path, stem: str) -> list[str]:
    """Return the flag of an option and its value."""
    if value is True:
        return [option.flag]
    if name == "frames":
        return [f"{option.flag}={value[0]}:{value[1]}"]
    if name == "subject" and isinstance(value, tuple):
        pairs = cast("tuple[tuple[str, Path], ...]", value)
        return [option.flag, ",".join(f"{prefix}={_name_file(Path(path), folder)}" for prefix, path in pairs)]
    if name == "subject" and not isinstance(value, str | Path):
        return [option.flag, f"{stem}.subject.yaml"]
    values = cast("tuple[Any, ...]", value) if isinstance(value, tuple) else (value,)
    if values and isinstance(values[0], float):
        return [f"{option.flag}={','.join(repr(each) for each in option.to_display(values))}"]
    if values and str(values[0]).startswith("-"):  # as in --up=-Y: not another flag
        return [f"{option.flag}={each}" for each in values]
    return [argument for each in values for argument in (option.flag, _format_value(each, folder))]


def _format_value(value: object, folder: Path) -> str:
    is_file = isinstance(value, str | Path) and Path(value).is_file()
    return _name_file(Path(cast("str | Path", value)), folder) if is_file else str(value)


def _name_file(path: Path, folder: Path) -> str:
    """Return the path of a file relative to a folder, with "/"."""
    try:
        return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
    except ValueError:  # on another drive
        return path.resolve().as_posix()


def find_argument(arguments: Sequence[str], flag: str) -> str | None:
    """Return the value of a flag in the arguments, None if it is not there."""
    for argument, following in zip(arguments, [*arguments, ""][1:], strict=True):
        if argument == flag:
            return following
        if argument.startswith(f"{flag}="):
            return argument.removeprefix(f"{flag}=")
    return None


def parse_read_options(arguments: Sequence[str]) -> ReadOptions:
    """Return the options of reading in the arguments."""
    values: dict[str, Any] = {}
    for name, option in list_options(ReadOptions):
        if isinstance(getattr(ReadOptions, name), bool):
            values[name] = option.flag in arguments
        elif (text := find_argument(arguments, option.flag)) is not None:
            values[name] = text if option.choices else float(text)
    return ReadOptions(**values)
