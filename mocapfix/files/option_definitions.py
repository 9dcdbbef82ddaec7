"""Define an option once: its default, unit, range and help text, and the check of its value.

`define_option` makes a dataclass field with an `Option` in its metadata; `StageOptions` checks the values of all its options.
"""

from dataclasses import dataclass, field, fields
from functools import cache
from math import isfinite
from pathlib import Path
from typing import Any, TypeVar, cast

from mocapfix.errors import OptionError

T = TypeVar("T")


@dataclass(frozen=True)
class Option:
    """How one option is presented and checked. Limits are in the unit of the field.

    flag          the flag on the command line
    metavar       the placeholder of its value in help texts
    help          one line for help texts and documentation
    job_key       the dotted key in a job file; "" if a job cannot set it
    unit          the unit of the value on the command line and in job files
    per_unit      how many of `unit` make one of the field's unit: 1000 for a field in metres that users give in millimetres
    aliases       other flags of the same meaning
    default_text  the default in help texts where None or an empty list does not explain itself
    choices       the allowed values, of a tuple the allowed elements; empty if any value is allowed
    above         lower limit, exclusive
    at_least      lower limit, inclusive
    at_most       upper limit, inclusive
    is_finite     whether the value must be finite
    is_expert     whether the option is hidden from the short help and the example job
    lab_default   the default with the purpose "lab", which differs from the usual one; None if it does not
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
    is_expert: bool = False
    lab_default: Any = None

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


def define_option(default: T, flag: str, metavar: str, help: str, **details: Any) -> T:
    """Return a dataclass field with its default and an `Option`, which has the same arguments, in its metadata."""
    return field(default=default, metadata={"option": Option(flag, metavar, help, **details)})


class StageOptions:
    """The options of one stage. A list, or a single text for an option that takes several, becomes a tuple.

    Raises OptionError for the first value that is not allowed.
    """

    def __post_init__(self) -> None:
        for name, option in list_options(type(self)):
            value = getattr(self, name)
            if isinstance(value, list):
                object.__setattr__(self, name, tuple(cast("list[object]", value)))
            elif isinstance(value, str | Path) and isinstance(getattr(type(self), name), tuple):
                object.__setattr__(self, name, (value,))
            if problem := option.find_problem(getattr(self, name)):
                raise OptionError(name, option.flag, option.job_key, problem)


@cache
def list_options(stage: type[StageOptions]) -> tuple[tuple[str, Option], ...]:
    """Return the field names of a stage's options and the options."""
    named = ((each.name, each.metadata.get("option")) for each in fields(cast(Any, stage)))
    return tuple((name, option) for name, option in named if isinstance(option, Option))
