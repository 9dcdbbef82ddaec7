"""The parts of a cleaning job as its YAML says them, key by key."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    FiniteFloat,
    NonNegativeInt,
    PositiveFloat,
    model_validator,
)

from mocapfix import synthetic
from mocapfix.errors import MocapfixError, SceneError
from mocapfix.faults import REPAIRABLE_KINDS
from mocapfix.files.output_files import check_outputs_absent, make_output_folder
from mocapfix.files.shipped import DEFAULT_INIT_METHOD, DEFAULT_PRIOR_NAME, INIT_METHODS
from mocapfix.files.yaml_models import StrictModel, read_yaml_model
from mocapfix.fill.gap_filling import FillOptions
from mocapfix.write.output_options import OutputOptions


# MERGED: mocapfix.job_form
def _build_choice_validator(choices: tuple[str, ...]):
    def check(value: str) -> str:
        if value not in choices:
            raise ValueError(f"must be one of {', '.join(choices)}, not {value!r}")
        return value

    return AfterValidator(check)


def _check_c3d_name(value: str) -> str:
    if Path(value).name != value or not value.lower().endswith(".c3d"):
        raise ValueError(f"must be the name of a C3D file, without a folder, not {value!r}")
    return value


def _wrap_file_name(value: object) -> object:
    """A text alone is a file's name."""
    return {"file": value} if isinstance(value, str) else value


class JobTake(StrictModel):
    """A file or a wildcard, as text alone; or a take that mocapfix composes itself, damage and all: `compose` is what its file
    shall be called, `seed` tells which person, skin and damage are drawn."""

    file: str | None = None
    compose: Annotated[str | None, AfterValidator(lambda value: value and _check_c3d_name(value))] = None
    seed: NonNegativeInt = 0

    @model_validator(mode="after")
    def _check_exactly_one(self) -> Self:
        if (self.file is None) == (self.compose is None):
            raise ValueError("must be a file, or say compose")
        return self


class JobSubject(StrictModel):
    """A subject file, as text alone; or takes to calibrate one from."""

    file: str | None = None
    calibrate: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _check_exactly_one(self) -> Self:
        if (self.file is None) == (not self.calibrate):
            raise ValueError("must be a subject file, or say calibrate")
        return self


class JobVolume(StrictModel):
    """up: the files' axis that points to the sky; floor: metres, how high it lies along that axis."""

    up: Literal["X", "Y", "Z"] | None = None
    floor: FiniteFloat = 0.0


class JobPrior(StrictModel):
    name: str = DEFAULT_PRIOR_NAME
    scale: PositiveFloat = 1.0


class JobFill(StrictModel):
    """What may be touched; as `mocapfix clean --help` says of each."""

    max_gap: PositiveFloat = FillOptions.max_gap
    limit_mm: PositiveFloat = FillOptions.limit * 1e3
    keep: tuple[str, ...] = ()
    frames: tuple[int, int] | None = None
    refill: bool = False
    only: tuple[Annotated[str, _build_choice_validator(REPAIRABLE_KINDS)], ...] = ()


class JobWrite(StrictModel):
    """What is written beside the usual files."""

    bvh_for: tuple[str, ...] = ()
    also: tuple[str, ...] = ()
    fps: PositiveFloat | None = None


JobTakeField = Annotated[JobTake, BeforeValidator(_wrap_file_name)]
JobSubjectField = Annotated[JobSubject, BeforeValidator(_wrap_file_name)]
InitMethodField = Annotated[str, _build_choice_validator(INIT_METHODS)]


# MERGED: mocapfix.job
# A cleaning job written down: which takes, whose, in which volume, under which prior, and what is to be written.
#
# A scene of the kind "clean", as `mocapfix run` does it. Paths are from the scene's own folder, and may have wildcards.
WILDCARD_CHARACTERS = set("*?[")


class CleaningJob(StrictModel):
    """What the scene says.

    title       one line
    takes       files, wildcards, or takes to be composed
    subject     a subject file; takes to calibrate one from; null: each take its own
    subject_prefix  the one to be cleaned of several subjects in a file; null: all of them
    marker_set  a shipped set's name or a YAML file; null chooses by the labels
    hierarchy   of animations, how their joints are called: a shipped style or a YAML file; null: as their names tell
    """

    kind: Literal["clean"]
    title: str
    takes: tuple[JobTakeField, ...] = Field(min_length=1)
    subject: JobSubjectField | None = None
    subject_prefix: str | None = None
    marker_set: str | None = None
    hierarchy: str | None = None
    volume: JobVolume = JobVolume()
    prior: JobPrior = JobPrior()
    start: InitMethodField = DEFAULT_INIT_METHOD
    fill: JobFill = JobFill()
    write: JobWrite = JobWrite()

    @property
    def fill_options(self) -> FillOptions:
        said = self.fill
        return FillOptions(said.max_gap, said.keep, said.frames, said.limit_mm / 1e3, said.refill)

    @property
    def output_options(self) -> OutputOptions:
        return OutputOptions(self.write.also, self.write.bvh_for, self.write.fps, self.volume.floor)

    def list_takes(self, path: Path, folder: Path) -> list[Path]:
        """-> the takes of the scene at `path`, in its order; those that are composed will be in `folder`."""
        takes: list[Path] = []
        for index, each in enumerate(self.takes):
            if each.compose:
                takes.append(get_composed_path(folder, each.compose))
            elif each.file:
                takes += expand_paths(path, [each.file], f"takes.{index}")
        return list(dict.fromkeys(takes))

    def write_composed_takes(self, folder: Path, overwrite: bool) -> None:
        """Write the takes that are to be composed. Raises WriteError where one is there and may not be replaced."""
        for each in self.takes:
            if each.compose:
                target = get_composed_path(folder, each.compose)
                check_outputs_absent([target], overwrite)
                make_output_folder(target.parent)
                synthetic.write_synthetic_take(target, synthetic.compose_take(seed=each.seed))

    def resolve_marker_set(self, path: Path) -> str | Path | None:
        """-> the marker set: a file beside the scene at `path` goes before a shipped set's name."""
        return _prefer_file_beside(path, self.marker_set)

    def resolve_hierarchy(self, path: Path) -> str | Path | None:
        """-> how joints are called: a file beside the scene at `path` goes before a shipped style's name."""
        return _prefer_file_beside(path, self.hierarchy)

    def find_subject_source(self, path: Path) -> Path | list[Path] | None:
        """-> the subject's file, or the takes to calibrate the subject from; None: each take its own."""
        if self.subject is None:
            return None
        if self.subject.file:
            return path.parent / self.subject.file
        return expand_paths(path, self.subject.calibrate, "subject.calibrate")


def _prefer_file_beside(path: Path, name: str | None) -> str | Path | None:
    beside = name and path.parent / name
    return beside if beside and beside.is_file() else name


def read_cleaning_job(path: str | Path) -> CleaningJob:
    """-> what a scene of the kind "clean" says. Raises SceneError with the file and the path of the wrong key."""
    said = read_yaml_model(CleaningJob, Path(path))
    try:
        _ = said.output_options
    except MocapfixError as error:
        raise SceneError(f"{path}: write: {error}") from error
    return said


def get_composed_path(folder: Path, name: str) -> Path:
    """-> where a composed take goes: beside what cleaning it gives, which has its name."""
    return folder / "composed" / name


def expand_paths(path: Path, names: Iterable[str], key: str) -> list[Path]:
    """-> the files beside the scene at `path` that names and wildcards under `key` say, in their order, each once.

    Raises SceneError where a wildcard finds none; what a plain name says is found missing when it is read.
    """
    found: dict[Path, None] = {}
    for name in names:
        root = Path(name).anchor
        folder, pattern = path.parent / root, name.removeprefix(root)
        matching = sorted(folder.glob(pattern)) if set(pattern) & WILDCARD_CHARACTERS else [folder / pattern]
        if not matching:
            raise SceneError(f"{path}: {key}: no file in {folder} is called {name!r}.")
        found |= dict.fromkeys(matching)
    return list(found)
