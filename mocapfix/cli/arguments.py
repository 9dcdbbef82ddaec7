"""Command-line arguments: those that several commands share, and those that are built from `mocapfix.options`.

Every stage of `CleanOptions` becomes a group of arguments, every option of it a flag.
"""

from collections.abc import Iterable, Mapping
from dataclasses import field, fields, make_dataclass
from pathlib import Path
from typing import Annotated, Any, cast, get_args

import tyro

from mocapfix.option import Option
from mocapfix.options import OPTIONS, PURPOSE_OPTIONS, UP_AXES, CleanOptions, build_clean_options

UP_FLAG = "--up"

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
    stages: tuple[str, ...] = (), *, without: Iterable[str] = (), default_texts: Mapping[str, str] | None = None
) -> Any:
    """Return the annotation of the parameter of a command that holds options, which `parse_options` reads.

    Args:
        stages: The names of the stages in `CleanOptions` whose options the command has; none for all.
        without: The names of options that it does not have.
        default_texts: By name of an option, the default that help shows instead of the usual text.
    """
    groups: list[tuple[str, Any, Any]] = []
    left_out, texts = set(without), default_texts or {}
    for each in fields(CleanOptions):
        if not stages or each.name in stages:
            options = [option for option in OPTIONS if option.stage == each.name and option.name not in left_out]
            arguments = [(option.name, *_build_argument(option, texts.get(option.name, ""))) for option in options]
            group = make_dataclass(type(each.default).__name__.removesuffix("Options"), arguments)
            group.__doc__ = type(each.default).__doc__
            help_texts = {"help": group.__doc__}  # without it, tyro searches the source for comments, which takes long
            groups.append((each.name, tyro.conf.OmitArgPrefixes[group], field(default_factory=group, metadata=help_texts)))
    arguments = tyro.conf.OmitArgPrefixes[make_dataclass("OptionArguments", groups)]
    return tyro.conf.arg(name="", prefix_name=False, constructor=arguments)


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
    for option in OPTIONS:
        value = getattr(getattr(arguments, option.stage, None), option.name, None)
        if value is None or value == _build_argument(option)[1]:
            continue
        if isinstance(value, bool | int | float):
            given[option.name] = option.from_display(value)
        else:
            given[option.name] = option.parse(cast("tuple[Any, ...]", value) if isinstance(value, tuple) else (value,))
    return build_clean_options(**given)


def _build_argument(option: Option, default_text: str = "") -> tuple[Any, Any]:
    """Return the annotation and the default value of the argument for an option."""
    details: dict[str, Any] = {"name": option.flag.removeprefix("--"), "help": option.help, "aliases": option.aliases or None}
    if option.name in PURPOSE_OPTIONS:  # None if it is not given
        lab = "" if option.lab_default is None else f"; with --purpose lab: {option.to_display(option.lab_default)}"
        details["help_behavior_hint"] = f"(default: {option.to_display(option.default)}{lab})"
        return Annotated[type(option.default) | None, tyro.conf.arg(metavar=option.metavar, **details)], None
    if default_text := default_text or option.default_text:
        details["help_behavior_hint"] = f"(default: {default_text})"
    if isinstance(option.default, bool):
        return Annotated[FlagOption, tyro.conf.arg(**details)], option.default
    argument = tyro.conf.arg(metavar=option.metavar, **details)
    if option.type == tuple[float, ...]:
        return Annotated[str, argument], ",".join(f"{number:g}" for number in option.to_display(option.default))
    if isinstance(option.default, tuple):
        element = Path if Path in get_args(get_args(option.type)[0]) else str
        return Annotated[tyro.conf.UseAppendAction[tuple[element, ...]], argument], ()
    if isinstance(option.default, float):
        return Annotated[float, argument], option.to_display(option.default)
    if isinstance(option.default, int | str):
        return Annotated[type(option.default), argument], option.default
    return Annotated[float | None if option.type == float | None else str | None, argument], None
