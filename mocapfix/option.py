"""One option of cleaning: how it is presented, checked, and read and written as text.

`define_option` makes a dataclass field with an `Option` in its metadata; `StageOptions` checks the values of all its options.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from math import isfinite
from numbers import Integral
from pathlib import Path
from typing import Any, TypeVar, cast

from mocapfix.errors import OptionError

T = TypeVar("T")
FRAME_RANGE_TYPE = tuple[int, int] | None  # of an option that FIRST:LAST gives


@dataclass(frozen=True)
class Option:
    """How one option is presented and checked. Limits are in the unit of the field.

    Attributes:
        flag: The flag on the command line.
        metavar: The placeholder of its value in help texts.
        help: One line for help texts and documentation.
        job_key: The dotted key in a job file; "" if a job cannot set it.
        unit: The unit of the value on the command line and in job files.
        per_unit: How many of `unit` make one of the field's unit: 1000 for a field in metres that users give in millimetres.
        aliases: Other flags of the same meaning.
        default_text: The default in help texts where None or an empty list does not explain itself.
        choices: The allowed values, of a tuple the allowed elements; empty if any value is allowed.
        above: Lower limit, exclusive.
        at_least: Lower limit, inclusive.
        at_most: Upper limit, inclusive.
        is_finite: Whether the value must be finite.
        is_file: Whether the value names a file, or something shipped.
        for_markers: Whether the option has no use for animations, and is refused for them.
        lab_default: The default with the purpose "lab", which differs from the usual one; None if it does not.
        name, stage, type, default: Of its field, and the name of the stage in `CleanOptions`.
    """

    flag: str
    metavar: str
    help: str
    job_key: str = ""
    unit: str = ""
    per_unit: float = 1.0
    aliases: tuple[str, ...] = ()
    default_text: str = ""
    choices: tuple[str, ...] = ()
    above: float | None = None
    at_least: float | None = None
    at_most: float | None = None
    is_finite: bool = False
    is_file: bool = False
    for_markers: bool = False
    lab_default: Any = None
    name: str = ""
    stage: str = ""
    type: Any = None
    default: Any = None

    def get_value(self, options: Any) -> Any:
        return getattr(getattr(options, self.stage), self.name)

    def convert(self, value: Any) -> Any:
        """Return a value with the type of the field: a tuple for a list or the only one of several, floats for integers."""
        if isinstance(value, list):
            value = tuple(cast("list[Any]", value))
        elif isinstance(value, str) and self.type == FRAME_RANGE_TYPE:
            value = self.parse([value])
        elif isinstance(value, str | Path) and isinstance(self.default, tuple):
            value = (value,)
        if self.type == tuple[float, ...] and isinstance(value, tuple):
            return tuple(_convert_integer(each) for each in cast("tuple[Any, ...]", value))
        return _convert_integer(value) if self.type in (float, float | None) else value

    def to_display(self, value: Any) -> Any:
        """Return a value with its numbers in the unit that users see."""
        if isinstance(value, tuple):
            return tuple(self.to_display(each) for each in cast("tuple[Any, ...]", value))
        return round(value * self.per_unit, 9) if isinstance(value, float) and self.per_unit != 1.0 else value

    def from_display(self, value: Any) -> Any:
        """Return a value that a user gave with its numbers in the unit of the field."""
        if isinstance(value, tuple):
            return tuple(self.from_display(each) for each in cast("tuple[Any, ...]", value))
        return value / self.per_unit if isinstance(value, float) and self.per_unit != 1.0 else value

    def find_problem(self, value: object) -> str:
        """Return what is wrong with a value as the end of a sentence, "" if it is allowed."""
        if self.type in (FRAME_RANGE_TYPE, int | None) and value is not None:
            numbers = cast("tuple[object, ...]", value) if isinstance(value, tuple) else (value,)
            expected = 2 if self.type == FRAME_RANGE_TYPE else 1
            if len(numbers) != expected or not all(isinstance(each, Integral) for each in numbers):
                return f"must be {ARGUMENT_FORMS[self.type]}, not {value!r}"
            first, last = cast("tuple[int, ...]", (numbers[0], numbers[-1]))
            if first > last:
                return f"must be FIRST:LAST with FIRST at most LAST, not {format_frames(first, last)}"
        elements = cast("tuple[object, ...]", value) if isinstance(value, tuple) else (value,)
        return next((problem for each in elements if (problem := self._find_element_problem(each))), "")

    def _find_element_problem(self, value: object) -> str:
        if isinstance(value, str) and self.choices and value not in self.choices:
            return f"must be one of {', '.join(self.choices)}, not {value!r}"
        if not isinstance(value, int | float) or isinstance(value, bool):
            return ""
        is_allowed = (
            (self.above is None or value > self.above)
            and (self.at_least is None or value >= self.at_least)
            and (self.at_most is None or value <= self.at_most)
            and (isfinite(value) or not self.is_finite)
        )
        return "" if is_allowed else f"must be {self._describe_range()}, not {self.to_display(value):g}"

    def _describe_range(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        limits = (("greater than", self.above), ("at least", self.at_least), ("at most", self.at_most))
        parts = [f"{words} {self.to_display(limit):g}{unit}" for words, limit in limits if limit is not None]
        return " and ".join([*parts, *(["finite"] if self.is_finite else [])])

    def parse(self, texts: Sequence[str | Path]) -> Any:
        """Return the value that texts on the command line name, one for each time that the flag is given. Raises OptionError."""
        text = str(texts[-1])
        try:
            if self.type == FRAME_RANGE_TYPE:
                return parse_frames(text)
            if self.name in SUBJECT_FILE_OPTIONS:
                return parse_subject_files(text)
            if self.type == tuple[float, ...]:
                return self.from_display(tuple(float(number) for number in split_names([text])))
            if isinstance(self.default, tuple):
                return split_names(map(str, texts)) if self.type == tuple[str, ...] else tuple(texts)
            if self.type in (float, float | None):
                return self.from_display(float(text))
            return int(text) if self.type in (int, int | None) else text
        except ValueError:
            form = ARGUMENT_FORMS.get(self.type, SUBJECT_FORM if self.name in SUBJECT_FILE_OPTIONS else NUMBERS_FORM)
            raise OptionError(self.name, self.flag, self.job_key, f"must be {form}, not {text!r}") from None

    def format(self, value: Any) -> list[str]:
        """Return the arguments that `parse` reads as a value."""
        if value is True:
            return [self.flag]
        if self.type == FRAME_RANGE_TYPE:
            return [f"{self.flag}={format_frames(*value)}"]
        if self.name in SUBJECT_FILE_OPTIONS and isinstance(value, tuple):
            value = ",".join(f"{prefix}={file}" for prefix, file in cast("tuple[tuple[str, str], ...]", value))
        values = cast("tuple[Any, ...]", value) if isinstance(value, tuple) else (value,)
        if values and isinstance(values[0], float):
            return [f"{self.flag}={','.join(repr(each) for each in self.to_display(values))}"]
        if any(str(each).startswith("-") for each in values):  # as in --up=-Y: not another flag
            return [f"{self.flag}={each}" for each in values]
        return [argument for each in values for argument in (self.flag, str(each))]


def _convert_integer(value: Any) -> Any:
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value


SUBJECT_FILE_OPTIONS = ("subject", "person_memory")  # they name a file, or one for each subject
SUBJECT_FORM = "FILE, or NAME=FILE,... with a name only once"
NUMBERS_FORM = "numbers with commas between them"
ARGUMENT_FORMS: dict[Any, str] = {
    FRAME_RANGE_TYPE: "FIRST:LAST, as in 100:250",
    **dict.fromkeys((int, int | None), "a whole number"),
    **dict.fromkeys((float, float | None), "a number"),
}
FRAME_LIMIT = 2**62  # beyond the number of any frame: the end of a range that is left open


def parse_frames(text: str) -> tuple[int, int] | None:
    """Return the first and the last frame that FIRST:LAST names, None for all frames. Raises ValueError."""
    first, colon, last = text.partition(":")
    if not colon:
        raise ValueError(text)
    return None if text == ":" else (int(first) if first else -FRAME_LIMIT, int(last) if last else FRAME_LIMIT)


def format_frames(first: int, last: int) -> str:
    """Return a range of frames as `parse_frames` reads it, with an end left out that is open."""
    return f"{'' if first == -FRAME_LIMIT else first}:{'' if last == FRAME_LIMIT else last}"


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


def define_option(default: T, flag: str, metavar: str, help: str, **details: Any) -> T:
    """Return a dataclass field with its default and an `Option`, which has the same arguments, in its metadata."""
    return field(default=default, metadata={"option": Option(flag, metavar, help, **details)})


class StageOptions:
    """The options of one stage. A list, or a single text for an option that takes several, becomes a tuple.

    An integer becomes a float for an option that is one, or several: only floats are converted between units.

    Raises:
        OptionError: For the first value that is not allowed.
    """

    def __post_init__(self) -> None:
        for option in list_options(type(self)):
            value = option.convert(getattr(self, option.name))
            object.__setattr__(self, option.name, value)
            if problem := option.find_problem(value):
                raise OptionError(option.name, option.flag, option.job_key, problem)


@cache
def list_options(stage: type[StageOptions]) -> tuple[Option, ...]:
    """Return the options of a stage; they do not have its name."""
    return tuple(
        replace(cast("Option", each.metadata["option"]), name=each.name, type=each.type, default=each.default)
        for each in fields(cast(Any, stage))
        if "option" in each.metadata
    )
