"""Command-line arguments: those that several commands share, and those that are built from `mocapfix.options`.

Every stage of `CleanOptions` becomes a group of arguments, every option of it a flag.
"""

from collections.abc import Iterable, Mapping
from dataclasses import Field, field, fields, make_dataclass
from pathlib import Path
from typing import Annotated, Any, cast, get_args

import tyro

from mocapfix.errors import OptionError
from mocapfix.options import PURPOSE_OPTIONS, UP_AXES, CleanOptions, Option, StageOptions, build_clean_options, list_stages

UP_FLAG = "--up"
FRAME_LIMIT = 2**62
"""beyond the number of any frame: the end of a range that is left open"""

FlagOption = tyro.conf.FlagCreatePairsOff[bool]
JsonOption = Annotated[FlagOption, tyro.conf.arg(name="json", help="print JSON instead of a table")]
OverwriteOption = Annotated[FlagOption, tyro.conf.arg(help="replace existing files")]
TakeArgument = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TAKE", help="motion capture file")]
TakesArgument = Annotated[
    tuple[Path, ...],
    tyro.conf.Positional,
    tyro.conf.arg(metavar="TAKE...", help="motion capture files", help_behavior_hint="(at least one)"),
]


def describe_option(metavar: str, help: str, default: str, **details: Any) -> Any:
    """Return how help shows an argument whose default value does not explain itself; `default` is the text that does."""
    return tyro.conf.arg(metavar=metavar, help=help, help_behavior_hint=f"(default: {default})", **details)


def build_options_argument(
    stages: Iterable[str], *, without: Iterable[str] = (), default_texts: Mapping[str, str] | None = None
) -> Any:
    """Return the annotation of the parameter of a command that holds options, which `parse_options` reads.

    stages         the names of the stages in `CleanOptions` whose options the command has
    without        the names of options that it does not have
    default_texts  by name of an option, the default that help shows instead of the usual text
    """
    groups: list[tuple[str, Any, Any]] = []
    for name, stage in list_stages():
        if name in stages:
            group = _build_group(stage, frozenset(without), default_texts or {})
            groups.append((name, tyro.conf.OmitArgPrefixes[group], field(default_factory=group)))
    return Annotated[tyro.conf.OmitArgPrefixes[make_dataclass("OptionArguments", groups)], tyro.conf.arg(name="")]


def join_axis_arguments(arguments: Iterable[str]) -> list[str]:
    """Return arguments in which a negative up axis is no flag: ["--up=-y"] for ["--up", "-y"]."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] == UP_FLAG and argument.upper() in UP_AXES:
            joined[-1] = f"{UP_FLAG}={argument}"
        else:
            joined.append(argument)
    return joined


def parse_options(arguments: object) -> CleanOptions:
    """Return the options in the value of a parameter of `build_options_argument`. Raises OptionError."""
    given: dict[str, object] = {}
    for name, stage in list_stages():
        group = getattr(arguments, name, None)
        for each in _list_fields(stage):
            value = getattr(group, each.name, None)
            if value is not None and value != _build_argument(each)[1]:
                given[each.name] = _parse_value(each, value)
    return build_clean_options(**given)


ARGUMENT_FORMS = {"frames": "FIRST:LAST, as in 100:250", "subject": "FILE, or NAME=FILE,... with a name only once"}


def parse_frames(text: str) -> tuple[int, int] | None:
    """Return the first and the last frame that FIRST:LAST names, None for all frames. Raises ValueError."""
    first, colon, last = text.partition(":")
    if not colon:
        raise ValueError(text)
    return None if text == ":" else (int(first) if first else -FRAME_LIMIT, int(last) if last else FRAME_LIMIT)


def parse_subject_files(text: str) -> str | tuple[tuple[str, Path], ...]:
    """Return the subject file that a text names, or the files of several subjects: NAME=FILE,NAME=FILE. Raises ValueError."""
    if "=" not in text or Path(text).is_file():
        return text
    pairs = [(name.strip(), file.strip()) for name, _, file in (part.partition("=") for part in text.split(","))]
    if not all(name and file for name, file in pairs) or len({name.casefold() for name, _ in pairs}) < len(pairs):
        raise ValueError(text)
    return tuple((name.removesuffix(":"), Path(file)) for name, file in pairs)


def split_names(texts: Iterable[str]) -> tuple[str, ...]:
    """Return the names in texts, in which commas may separate several."""
    return tuple(name.strip() for text in texts for name in text.split(",") if name.strip())


def _list_fields(stage: type[StageOptions]) -> tuple[Field[Any], ...]:
    return tuple(each for each in fields(cast(Any, stage)) if "option" in each.metadata)


def _build_group(stage: type[StageOptions], without: frozenset[str], default_texts: Mapping[str, str]) -> type[Any]:
    """Return the dataclass that holds the arguments of a stage's options."""
    arguments = [
        (each.name, *_build_argument(each, default_texts.get(each.name, "")))
        for each in _list_fields(stage)
        if each.name not in without
    ]
    group = make_dataclass(stage.__name__.removesuffix("Options"), arguments)
    group.__doc__ = stage.__doc__
    return group


def _build_argument(each: Field[Any], default_text: str = "") -> tuple[Any, Any]:
    """Return the annotation and the default value of the argument for an option."""
    option: Option = each.metadata["option"]
    details: dict[str, Any] = {"name": option.flag.removeprefix("--"), "help": option.help, "aliases": option.aliases or None}
    if each.name in PURPOSE_OPTIONS:  # None if it is not given
        lab = "" if option.lab_default is None else f"; with --purpose lab: {option.to_display(option.lab_default)}"
        details["help_behavior_hint"] = f"(default: {option.to_display(each.default)}{lab})"
        return Annotated[type(each.default) | None, tyro.conf.arg(metavar=option.metavar, **details)], None
    if default_text := default_text or option.default_text:
        details["help_behavior_hint"] = f"(default: {default_text})"
    if isinstance(each.default, bool):
        return Annotated[FlagOption, tyro.conf.arg(**details)], each.default
    argument = tyro.conf.arg(metavar=option.metavar, **details)
    if each.type == tuple[float, ...]:
        return Annotated[str, argument], ",".join(f"{number:g}" for number in option.to_display(each.default))
    if isinstance(each.default, tuple):
        element = Path if Path in get_args(get_args(each.type)[0]) else str
        return Annotated[tyro.conf.UseAppendAction[tuple[element, ...]], argument], ()
    if isinstance(each.default, float):
        return Annotated[float, argument], option.to_display(each.default)
    if isinstance(each.default, int | str):
        return Annotated[type(each.default), argument], each.default
    return Annotated[float | None if each.type == float | None else str | None, argument], None


def _parse_value(each: Field[Any], value: Any) -> Any:
    """Return the value of an option from that of its argument. Raises OptionError."""
    option: Option = each.metadata["option"]
    try:
        if each.type == tuple[int, int] | None:
            return parse_frames(value)
        if each.type == tuple[str, ...]:
            return split_names(value)
        if each.name == "subject":
            return parse_subject_files(value)
        if each.type == tuple[float, ...]:
            value = tuple(float(number) for number in split_names([value]))
    except ValueError:
        form = ARGUMENT_FORMS.get(each.name, "numbers with commas between them")
        raise OptionError(each.name, option.flag, option.job_key, f"must be {form}, not {value!r}") from None
    return option.from_display(value)
