"""Session files: YAML files that name the takes of a session, the people in them, and the options of cleaning."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field

from mocapfix.batch.take_list import (
    TAKE_SUFFIXES,
    BatchTake,
    build_take_list,
    make_absolute,
    select_matched_takes,
)
from mocapfix.errors import SceneError
from mocapfix.files.yaml_models import StrictModel, read_yaml_model
from mocapfix.jobs.cleaning_job import build_job_model, build_job_options, expand_paths, has_wildcards
from mocapfix.options import CleanOptions


class SessionHeader(StrictModel):
    """The keys of a session file that are not options. Paths are relative to its folder and may have wildcards.

    title   one line
    takes   the takes
    people  by name of a person, the takes that show them; other takes are grouped by their subjects and names
    """

    kind: Literal["session"]
    title: str = ""
    takes: tuple[str, ...] = Field(min_length=1)
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
