"""The takes of a batch: the files in a folder, those that patterns match, or those that a caller names."""

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from mocapfix.batch.folder_lock import BATCH_LOCK_NAME
from mocapfix.errors import ReadError
from mocapfix.read.file_content import check_path_encoding

TAKE_SUFFIXES = (".c3d", ".trc", ".tsv", ".csv", ".bvh", ".amc")
"""suffixes of captures; of files in a folder that differ only by them, the first of this order is the take"""
WILDCARDS = "*?["


@dataclass(frozen=True)
class BatchTake:
    """One take: its path, and its id, which is its path relative to the common folder of the batch, with "/"."""

    id: str
    path: Path


@dataclass(frozen=True)
class FoundTakes:
    """The takes of a batch, and the files beside them that are no takes of their own."""

    takes: tuple[BatchTake, ...]
    skipped: tuple[Path, ...] = ()


def find_takes(sources: Sequence[str], output_folder: Path) -> FoundTakes:
    """Return the takes in folders, of files and patterns, in the order of their ids.

    A folder stands for all captures in it and in its folders, outside the output folders of batches and of `clean`.

    Raises ReadError if a source has no take, or two takes would have the same output folder.
    """
    paths: list[Path] = []
    skipped: list[Path] = []
    for source in sources:
        if Path(source).is_dir():
            found = find_folder_takes(Path(source), output_folder)
            paths += [take.path for take in found.takes]
            skipped += found.skipped
        elif Path(source).is_file():
            paths.append(Path(source))
        else:
            matching = expand_pattern(source) if set(WILDCARDS) & set(source) else []
            if not matching:
                raise ReadError(f"{source}: no such take; name a folder, a file, a pattern or a session file (.yaml).")
            paths += matching
    root = Path(sources[0]) if len(sources) == 1 and Path(sources[0]).is_dir() else None
    return FoundTakes(build_take_list(paths, root), tuple(skipped))


def find_folder_takes(folder: Path, output_folder: Path) -> FoundTakes:
    """Return the captures in a folder and its folders. Raises ReadError if there is none."""
    by_stem: dict[Path, list[Path]] = {}
    for place, folders, names in os.walk(folder):
        folders[:] = sorted(each for each in folders if is_input_folder(Path(place) / each, output_folder))
        for path in (Path(place) / name for name in names if not name.startswith(".")):
            if path.suffix.lower() in TAKE_SUFFIXES:
                by_stem.setdefault(path.with_suffix(""), []).append(path)
    for paths in by_stem.values():
        paths.sort(key=lambda path: (TAKE_SUFFIXES.index(path.suffix.lower()), path.suffix))
    if not by_stem:
        raise ReadError(f"{folder}: holds no take ({', '.join(TAKE_SUFFIXES)}); name the folder with the captures.")
    takes = build_take_list((paths[0] for paths in by_stem.values()), folder)
    return FoundTakes(takes, tuple(path for paths in by_stem.values() for path in paths[1:]))


def is_input_folder(folder: Path, output_folder: Path) -> bool:
    """Return whether captures in a folder are input: not hidden, and no outputs of mocapfix."""
    is_output = folder.name.startswith(".") or folder.suffix == ".mocapfix" or (folder / BATCH_LOCK_NAME).exists()
    return not is_output and folder.resolve() != output_folder.resolve()


def expand_pattern(pattern: str) -> list[Path]:
    """Return the captures that a pattern matches; `**` stands for any folders."""
    root = Path(pattern).anchor
    matching = Path(root or ".").glob(pattern.removeprefix(root))
    return sorted(path for path in matching if path.is_file() and path.suffix.lower() in TAKE_SUFFIXES)


def build_take_list(paths: Iterable[Path], root: Path | None = None) -> tuple[BatchTake, ...]:
    """Return takes with their ids, in the order of these; a path that is named twice is one take.

    root  the folder to which ids are relative; None for the deepest that contains all takes

    Raises ReadError if two takes would have the same output folder, or a name is not valid UTF-8.
    """
    resolved = list(dict.fromkeys(path.resolve() for path in paths))
    for path in resolved:
        check_path_encoding(path)
    if not resolved:
        return ()
    base = root.resolve() if root else Path(os.path.commonpath([path.parent for path in resolved]))
    takes = sorted((BatchTake(path.relative_to(base).as_posix(), path) for path in resolved), key=lambda take: take.id)
    by_folder: dict[str, BatchTake] = {}
    for take in takes:
        other = by_folder.setdefault(PurePosixPath(take.id).with_suffix("").as_posix().casefold(), take)
        if other is not take:
            raise ReadError(
                f"{take.path}: its outputs would be in the same folder as those of {other.path.name}; name one of the two only."
            )
    return tuple(takes)
