"""The takes of a batch: files in folders, files that patterns match or that a caller names, and those of a session file.

`find_takes` finds takes and gives them ids. `read_session_file` reads a YAML file that names the takes of a session, the people
in them, and the options of cleaning.
"""

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field

from mocapfix.batch.job_files import build_job_model, build_job_options, expand_paths, has_wildcards
from mocapfix.batch.records import ATTEMPTS_SUFFIX, RECORD_SUFFIX, get_take_folder
from mocapfix.errors import ReadError, SceneError
from mocapfix.io.file_content import check_path_encoding
from mocapfix.io.files import JSON_REPORT_SUFFIX, OUTPUT_FOLDER_SUFFIX, find_common_folder
from mocapfix.io.yaml_files import StrictModel, read_yaml_model
from mocapfix.options import CleanOptions

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
            matching = expand_pattern(source) if has_wildcards(source) else []
            if not matching:
                raise ReadError(f"{source}: no such take; name a folder, a file, a pattern or a session file (.yaml).")
            paths += matching
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


def expand_pattern(pattern: str) -> list[Path]:
    """Return the takes that a pattern matches; `**` stands for any folders."""
    root = Path(pattern).anchor
    return select_matched_takes(Path(root or ".").glob(pattern.removeprefix(root)), Path(pattern))


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
