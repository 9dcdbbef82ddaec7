"""The parts of a cleaning job as its YAML says them, key by key."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import (
    AfterValidator,
    BeforeValidator,
    FiniteFloat,
    NonNegativeInt,
    PositiveFloat,
    model_validator,
)

from mocapfix.faults import MENDED
from mocapfix.fill import FillOptions
from mocapfix.scenes import PRIOR, STARTS
from mocapfix.yaml_form import Stated


def _one_of(choices: tuple[str, ...]):
    def check(value: str) -> str:
        if value not in choices:
            raise ValueError(f"must be one of {', '.join(choices)}, not {value!r}")
        return value

    return AfterValidator(check)


def _file_name(value: str) -> str:
    if Path(value).name != value or not value.lower().endswith(".c3d"):
        raise ValueError(f"must be the name of a C3D file, without a folder, not {value!r}")
    return value


def _named(value: object) -> object:
    """A text alone is a file's name."""
    return {"file": value} if isinstance(value, str) else value


class TakeForm(Stated):
    """A file or a wildcard, as text alone; or a take that mocapfix composes itself, damage and all: `compose` is what its file
    shall be called, `seed` tells which person, skin and damage are drawn."""

    file: str | None = None
    compose: Annotated[str | None, AfterValidator(lambda value: value and _file_name(value))] = None
    seed: NonNegativeInt = 0

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        if (self.file is None) == (self.compose is None):
            raise ValueError("must be a file, or say compose")
        return self


class SubjectForm(Stated):
    """A subject file, as text alone; or takes to calibrate one from."""

    file: str | None = None
    calibrate: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        if (self.file is None) == (not self.calibrate):
            raise ValueError("must be a subject file, or say calibrate")
        return self


class VolumeForm(Stated):
    """up: the files' axis that points to the sky; floor: metres, how high it lies along that axis."""

    up: Literal["X", "Y", "Z"] | None = None
    floor: FiniteFloat = 0.0


class PriorForm(Stated):
    name: str = PRIOR
    scale: PositiveFloat = 1.0


class FillForm(Stated):
    """What may be touched; as `mocapfix clean --help` says of each."""

    max_gap: PositiveFloat = FillOptions.max_gap
    limit_mm: PositiveFloat = FillOptions.limit * 1e3
    keep: tuple[str, ...] = ()
    frames: tuple[int, int] | None = None
    refill: bool = False
    only: tuple[Annotated[str, _one_of(MENDED)], ...] = ()


class WriteForm(Stated):
    """What is written beside the usual files."""

    bvh_for: tuple[str, ...] = ()
    also: tuple[str, ...] = ()
    fps: PositiveFloat | None = None


TakeSaid = Annotated[TakeForm, BeforeValidator(_named)]
SubjectSaid = Annotated[SubjectForm, BeforeValidator(_named)]
Start = Annotated[str, _one_of(STARTS)]
