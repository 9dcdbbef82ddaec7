"""Cleaning jobs: YAML files that name takes, their subject, and the options with which they are cleaned.

A job is a scene of the kind "clean", which `mocapfix run` runs. Its keys are those of `mocapfix.options`, and the header below.
Paths are relative to the folder of the job file and may have wildcards.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BeforeValidator, Field, FiniteFloat, NonNegativeInt, create_model, model_validator

from mocapfix.errors import MocapfixError, OptionError, SceneError
from mocapfix.io.files import check_outputs_absent, make_output_folder
from mocapfix.io.shipped import is_existing_file
from mocapfix.io.yaml_files import StrictModel, read_yaml_model
from mocapfix.option import Option
from mocapfix.options import OPTIONS, PURPOSE_DEFAULTS, CleanOptions, build_clean_options
from mocapfix.output_formats import list_output_formats
from mocapfix.synthetic import compose_take, write_synthetic_take

HeaderModel = TypeVar("HeaderModel", bound=StrictModel)
WILDCARD_CHARACTERS = set("*?[")
COMPOSED_FOLDER = "composed"  # the folder for composed takes, within the output folder


def _check_c3d_name(value: str) -> str:
    if Path(value).name != value or not value.lower().endswith(".c3d"):
        raise ValueError(f"must be the name of a C3D file, without a folder, not {value!r}")
    return value


def _wrap_file_name(value: object) -> object:
    """Return the mapping for a plain text, which is the name of a file."""
    return {"file": value} if isinstance(value, str) else value


class JobTake(StrictModel):
    """A take to be cleaned."""

    file: str | None = None  # a file or a wildcard; in YAML also as plain text
    # instead: the name of a C3D file for a synthetic take with damage
    compose: Annotated[str, AfterValidator(_check_c3d_name)] | None = None
    seed: NonNegativeInt = 0  # the seed of the synthetic take

    @model_validator(mode="after")
    def _check_exactly_one(self) -> "JobTake":
        if (self.file is None) == (self.compose is None):
            raise ValueError("must have either file or compose")
        return self


class JobSubject(StrictModel):
    """The subject of a job: a subject file, in YAML also as plain text, or takes from which the subject is calibrated."""

    file: str | None = None
    calibrate: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _check_exactly_one(self) -> "JobSubject":
        if (self.file is None) == (not self.calibrate):
            raise ValueError("must have either file or calibrate")
        return self


class JobHeader(StrictModel):
    """The keys of a job that are not options."""

    kind: Literal["clean"]
    title: str  # one line
    takes: tuple[Annotated[JobTake, BeforeValidator(_wrap_file_name)], ...] = Field(min_length=1)  # the takes, in this order
    # the subject of all takes; null calibrates one from each take
    subject: Annotated[JobSubject, BeforeValidator(_wrap_file_name)] | None = None


@dataclass(frozen=True)
class CleaningJob:
    """A cleaning job that was read from `path`; its options have no subject yet."""

    path: Path
    header: JobHeader
    options: CleanOptions

    def list_takes(self, output_folder: Path) -> list[Path]:
        """Return the paths of the takes in their order, each once. Raises SceneError if a wildcard matches no file."""
        takes: list[Path] = []
        for index, take in enumerate(self.header.takes):
            if take.compose:
                takes.append(output_folder / COMPOSED_FOLDER / take.compose)
            elif take.file:
                takes += expand_paths(self.path, [take.file], f"takes.{index}")
        return list(dict.fromkeys(takes))

    def write_composed_takes(self, output_folder: Path, overwrite: bool) -> None:
        """Write the synthetic takes. Raises WriteError if one of the files exists and may not be replaced."""
        for take in self.header.takes:
            if take.compose:
                target = output_folder / COMPOSED_FOLDER / take.compose
                check_outputs_absent([target], overwrite)
                make_output_folder(target.parent)
                write_synthetic_take(target, compose_take(seed=take.seed))

    def get_subject_file(self) -> Path | None:
        """Return the path of the subject file, None if the job names none."""
        subject = self.header.subject
        return self.path.parent / subject.file if subject and subject.file else None

    def list_calibration_takes(self) -> list[Path]:
        """Return the takes from which the subject is calibrated; empty if there are none. Raises SceneError as `list_takes`."""
        subject = self.header.subject
        return expand_paths(self.path, subject.calibrate, "subject.calibrate") if subject else []


def read_cleaning_job(path: str | Path) -> CleaningJob:
    """Return the job in a YAML file. Raises SceneError with the file and the dotted path of the first wrong key."""
    path = Path(path)
    header = read_yaml_model(JOB_MODEL, path)
    return CleaningJob(path, header, build_job_options(path, header))


def build_job_options(path: Path, header: StrictModel) -> CleanOptions:
    """Return the options in a model of `build_job_model` that was read from `path`. Raises SceneError."""
    given: dict[str, object] = {}
    for option in JOB_OPTIONS:
        section, _, key = option.job_key.rpartition(".")
        model = getattr(header, section) if section else header
        value = getattr(model, key)
        if key in model.model_fields_set and not (value is None and option.name in PURPOSE_DEFAULTS):
            given[option.name] = option.from_display(value)
    try:
        beside = path.parent  # what is not the name of a file there is that of something shipped
        options = build_clean_options(**given).map_files(lambda name: beside / name if is_existing_file(beside / name) else name)
        list_output_formats(options.output)
    except OptionError as error:
        raise SceneError(f"{path}: {error.job_key}: {error.problem}.") from error
    except MocapfixError as error:
        raise SceneError(f"{path}: write: {error}") from error
    return options


def has_wildcards(name: str) -> bool:
    """Return whether a name can stand for several files."""
    return bool(set(name) & WILDCARD_CHARACTERS)


def expand_paths(path: Path, names: Iterable[str], key: str) -> list[Path]:
    """Return the files that names and wildcards mean beside the job at `path`, in their order, each once.

    Raises SceneError, naming `key`, if a wildcard matches no file. A plain name may be that of a file that does not exist. The
    name of a file that exists is no wildcard, whatever its characters.
    """
    found: dict[Path, None] = {}
    for name in names:
        root = Path(name).anchor
        folder, pattern = path.parent / root, name.removeprefix(root)
        is_pattern = has_wildcards(pattern) and not (folder / pattern).is_file()
        matching = sorted(folder.glob(pattern)) if is_pattern else [folder / pattern]
        if not matching:
            raise SceneError(f"{path}: {key}: no file in {folder} matches {name!r}.")
        found |= dict.fromkeys(matching)
    return list(found)


JOB_OPTIONS = [option for option in OPTIONS if option.job_key]  # the options that a job file can set


def _get_yaml_type(option: Option) -> Any:
    """Return the type of an option's value in a job file; null stands for a default that depends on the purpose."""
    finite: Any = FiniteFloat
    special: dict[Any, Any] = {float: finite, float | None: finite | None, str | Path | None: str | None}
    special[tuple[str | Path, ...]] = tuple[str, ...]
    found: Any = next((yaml_type for python_type, yaml_type in special.items() if python_type == option.type), option.type)
    return found | None if option.name in PURPOSE_DEFAULTS else found


def build_job_model(name: str, header: type[HeaderModel]) -> type[HeaderModel]:
    """Return the model of a job file: the header and a key for every option."""
    keys: dict[str, dict[str, Any]] = {"": {}}
    for option in JOB_OPTIONS:
        section, _, key = option.job_key.rpartition(".")
        default = None if option.name in PURPOSE_DEFAULTS else option.to_display(option.default)
        keys.setdefault(section, {})[key] = (_get_yaml_type(option), default)
    top = keys.pop("")
    for section, section_keys in keys.items():
        model = create_model(f"Job{section.capitalize()}", __base__=StrictModel, **section_keys)
        top[section] = (model, model())
    return create_model(name, __base__=header, **top)


JOB_MODEL = build_job_model("JobFile", JobHeader)
