"""Cleaning jobs and sessions: YAML files that name takes, their subjects, and the options with which they are cleaned; and the
takes that a command names.

A job is a scene of the kind "clean", which `mocapfix run` runs; `mocapfix batch` runs a session. Their keys are those of
`mocapfix.options`, and a header. Paths are relative to the folder of the file and may have wildcards. `find_takes` finds takes in
folders and by patterns, and gives them ids.
"""

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BeforeValidator, Field, FiniteFloat, NonNegativeInt, create_model, model_validator

from mocapfix.batch.records import ATTEMPTS_SUFFIX, RECORD_SUFFIX, get_take_folder
from mocapfix.errors import MocapfixError, OptionError, ReadError, SceneError
from mocapfix.io.file_content import check_path_encoding
from mocapfix.io.files import (
    JSON_REPORT_SUFFIX,
    OUTPUT_FOLDER_SUFFIX,
    check_outputs_absent,
    find_common_folder,
    make_output_folder,
)
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


TAKE_SUFFIXES = (".c3d", ".trc", ".tsv", ".csv", ".bvh", ".amc")
"""suffixes of captures; of files in a folder that differ only by them, the first of this order is the take"""


@dataclass(frozen=True)
class BatchTake:
    """One take: its path, and its id, which is its path relative to the common folder of the batch, with "/"."""

    id: str
    path: Path


@dataclass(frozen=True)
class FoundTakes:
    """The takes of a batch."""

    takes: tuple[BatchTake, ...]
    skipped: tuple[Path, ...] = ()  # files beside them that are no takes of their own
    unreadable: tuple[Path, ...] = ()  # folders that cannot be read


def find_takes(sources: Sequence[str], output_folder: Path) -> FoundTakes:
    """Return the takes in folders, of files and patterns, in the order of their ids.

    A folder stands for all captures in it and in its folders, outside the output folder, hidden folders and those that `clean`
    wrote. Outputs of mocapfix are no takes, wherever they are.

    Raises:
        ReadError: If a source has no take, or two takes would have the same output folder.
    """
    paths: list[Path] = []
    skipped: list[Path] = []
    unreadable: list[Path] = []
    for source in sources:
        if Path(source).is_dir():
            found = find_folder_takes(Path(source), output_folder)
            paths += [take.path for take in found.takes]
            skipped += found.skipped
            unreadable += found.unreadable
        elif Path(source).is_file():
            paths.append(Path(source))
        else:
            anchor = Path(source).anchor
            matching = Path(anchor or ".").glob(source.removeprefix(anchor)) if has_wildcards(source) else ()
            matched = select_matched_takes(matching, Path(source))
            if not matched:
                raise ReadError(f"{source}: no such take; name a folder, a file, a pattern or a session file (.yaml).")
            paths += matched
    root = Path(sources[0]) if len(sources) == 1 and Path(sources[0]).is_dir() else None
    return FoundTakes(build_take_list(paths, root), tuple(skipped), tuple(unreadable))


def find_folder_takes(folder: Path, output_folder: Path) -> FoundTakes:
    """Return the captures in a folder and its folders, also behind links to folders. Raises ReadError if there is none."""
    by_stem: dict[Path, list[Path]] = {}
    unreadable: list[Path] = []
    visited = {folder.resolve(), output_folder.resolve()}
    for place, folders, names in os.walk(folder, followlinks=True, onerror=lambda error: unreadable.append(Path(error.filename))):
        folders[:] = [each for each in sorted(folders) if not is_set_aside(each) and add_folder(visited, Path(place) / each)]
        files = (Path(place) / name for name in names if not name.startswith("."))
        for path in remove_outputs(path for path in files if path.suffix.lower() in TAKE_SUFFIXES):
            by_stem.setdefault(path.with_suffix(""), []).append(path)
    for paths in by_stem.values():
        paths.sort(key=lambda path: (TAKE_SUFFIXES.index(path.suffix.lower()), path.suffix))
    if not by_stem:
        raise ReadError(f"{folder}: holds no take ({', '.join(TAKE_SUFFIXES)}); name the folder with the captures.")
    takes = build_take_list((paths[0] for paths in by_stem.values()), folder)
    return FoundTakes(takes, tuple(path for paths in by_stem.values() for path in paths[1:]), tuple(unreadable))


def add_folder(visited: set[Path], folder: Path) -> bool:
    """Add a folder to those that were visited; return whether it is new. A link may lead to a folder that is visited anyway."""
    place = folder.resolve()
    is_new = place not in visited
    visited.add(place)
    return is_new


def remove_outputs(paths: Iterable[Path]) -> list[Path]:
    """Return the paths without outputs of mocapfix: beside an output of a batch is the record, or are the attempts, of the take,
    and beside one of `clean` is its report.
    """
    stems_of_folder: dict[Path, set[str]] = {}
    reports_of_folder: dict[Path, set[str]] = {}
    kept: list[Path] = []
    for path in paths:
        if path.parent not in stems_of_folder:
            names = [each.name for suffix in (RECORD_SUFFIX, ATTEMPTS_SUFFIX) for each in path.parent.glob(f"*{suffix}")]
            stems = {name.removesuffix(RECORD_SUFFIX).removesuffix(ATTEMPTS_SUFFIX).removeprefix(".") for name in names}
            stems_of_folder[path.parent] = stems
            reports_of_folder[path.parent] = {
                each.name.removesuffix(JSON_REPORT_SUFFIX) for each in path.parent.glob(f"*{JSON_REPORT_SUFFIX}")
            }
        is_batch_output = any(path.name.startswith(f"{stem}.") for stem in stems_of_folder[path.parent])
        if not is_batch_output and not any(is_reported(path, stem) for stem in reports_of_folder[path.parent]):
            kept.append(path)
    return kept


def is_reported(path: Path, report_stem: str) -> bool:
    """Return whether a report of `clean` beside a capture is its own: that of the take, or of one of its subjects.

    The report "walk.Jim" is that of the subject Jim in walk.c3d, unless there is a walk.Jim.c3d.
    """
    is_of_subject = report_stem.startswith(f"{path.stem}.") and not path.with_name(report_stem + path.suffix).exists()
    return path.stem == report_stem or is_of_subject


def select_matched_takes(matching: Iterable[Path], given: Path) -> list[Path]:
    """Return the takes among the files that a pattern matches: captures that are neither hidden nor outputs of mocapfix.

    Args:
        given: The pattern; folders that it names may be hidden, or hold outputs.
    """
    files = (path for path in matching if path.suffix.lower() in TAKE_SUFFIXES and path.is_file())
    shown = (path for path in files if not any(is_set_aside(part) for part in set(path.parts) - set(given.parts)))
    return sorted(remove_outputs(shown))


def is_set_aside(name: str) -> bool:
    """Return whether a file or folder of this name is hidden or an output folder of `clean`."""
    return name.startswith(".") or name.endswith(OUTPUT_FOLDER_SUFFIX)


def make_absolute(path: Path) -> Path:
    """Return the absolute path of a file or folder. Links keep their own names, by which takes are called."""
    return Path(os.path.abspath(path))  # noqa: PTH100


def build_take_list(paths: Iterable[Path], root: Path | None = None) -> tuple[BatchTake, ...]:
    """Return takes with their ids, in the order of these; a path that is named twice is one take.

    Args:
        root: The folder to which ids are relative; None for the deepest that contains all takes.

    Raises:
        ReadError: If two takes would have the same output folder, or a name is not valid UTF-8.
    """
    absolute = list(dict.fromkeys(make_absolute(path) for path in paths))
    for path in absolute:
        check_path_encoding(path)
    if not absolute:
        return ()
    base = make_absolute(root) if root else find_common_folder(absolute)
    takes = sorted((BatchTake(path.relative_to(base).as_posix(), path) for path in absolute), key=lambda take: take.id)
    by_folder: dict[str, BatchTake] = {}
    for take in takes:
        other = by_folder.setdefault(get_take_folder(base, take.id).as_posix().casefold(), take)
        if other is not take:
            raise ReadError(
                f"{take.path}: its outputs would be in the same folder as those of {other.path.name}; name one of the two only."
            )
    return tuple(takes)


class SessionHeader(StrictModel):
    """The keys of a session file that are not options. Paths are relative to its folder and may have wildcards."""

    kind: Literal["session"]
    title: str = ""  # one line
    takes: tuple[str, ...] = Field(min_length=1)
    # by name of a person, the takes that show them; other takes are grouped by their subjects and names
    people: dict[str, tuple[str, ...]] = Field(default_factory=dict)


@dataclass(frozen=True)
class Session:
    """A session that was read: its title, its takes, the ids of the takes by name of a person, and its options."""

    title: str
    takes: tuple[BatchTake, ...]
    people: dict[str, tuple[str, ...]]
    options: CleanOptions


def read_session_file(path: Path) -> Session:
    """Read a session file. Raises SceneError with the file and the first wrong key, or the pattern that matches no file."""
    header = read_yaml_model(SESSION_MODEL, path)
    options = build_job_options(path, header)
    takes = build_take_list(expand_takes(path, header.takes, "takes"))
    ids = {take.path: take.id for take in takes}
    shown = {name: expand_takes(path, patterns, f"people.{name}") for name, patterns in header.people.items()}
    people = {name: tuple(ids[each] for each in map(make_absolute, paths) if each in ids) for name, paths in shown.items()}
    return Session(header.title, takes, people, options)


def expand_takes(path: Path, names: Sequence[str], key: str) -> list[Path]:
    """Return the takes that names and patterns mean beside the session file at `path`.

    Raises SceneError, naming `key`, if a pattern matches no take.
    """
    takes: list[Path] = []
    for name in names:
        found = expand_paths(path, [name], key)
        if has_wildcards(name) and not (path.parent / name).is_file():
            found = select_matched_takes(found, path.parent / name)
            if not found:
                raise SceneError(f"{path}: {key}: {name!r} matches no take ({', '.join(TAKE_SUFFIXES)}).")
        takes += found
    return takes


SESSION_MODEL = build_job_model("SessionFile", SessionHeader)
