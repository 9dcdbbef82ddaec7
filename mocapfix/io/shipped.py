"""Find the files that ship with mocapfix, in a wheel as well as in a checkout; read and write YAML."""

import hashlib
import math
import pickle
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar, cast

import yaml

from mocapfix.errors import SceneError, WriteError, format_name_list
from mocapfix.io.files import replace_atomically

MAX_YAML_DEPTH = 100  # lists and mappings that may contain each other; those of mocapfix are four deep
MAX_YAML_VALUES = 1_000_000  # values that a document with aliases may have with these written out
ALIAS_PATTERN = re.compile(r"[\s\[,:]\*\w")
BRACKET_PATTERN = re.compile(r"[\[{\]}]")
DEEP_BLOCK_PATTERN = re.compile(r"[-?]\s+[-?]\s|^ {100}", re.MULTILINE)  # many of these make a document deep
YAML_LOADER: type[yaml.SafeLoader] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""the loader of libyaml if PyYAML was built with it, which is ten times as fast"""
load_yaml: Callable[[str], Any] = partial(yaml.load, Loader=YAML_LOADER)


@cache
def get_version() -> str:
    """Return the version, which pyproject.toml states: of the installed package, or of a checkout that is not installed."""
    import tomllib
    from importlib import metadata

    try:
        return metadata.version("mocapfix")
    except metadata.PackageNotFoundError:
        project = find_shipped_folder("scenes").parent / "pyproject.toml"
        return tomllib.loads(project.read_text(encoding="utf-8"))["project"]["version"]


def find_shipped_folder(name: str) -> Path:
    """Return the folder "scenes" or "priors": within the installed package, or beside it in a checkout."""
    inside = Path(__file__).parent.parent / name
    return inside if inside.is_dir() else inside.parent.parent / name


@cache
def read_shipped_yaml(name: str) -> dict[str, Any]:
    """Return the content of the file `name` in scenes/, which is not changed."""
    return read_yaml(find_shipped_folder("scenes") / name)


def measure_yaml_depth(text: str) -> int:
    """Return how deeply lists and mappings contain each other, at most; 0 where few signs of it are in the text.

    libyaml composes them recursively and ends the process where its stack is too small.
    """
    depth = deepest = 0
    for bracket in BRACKET_PATTERN.findall(text):
        depth += 1 if bracket in "[{" else -1
        deepest = max(deepest, depth)
    if deepest <= MAX_YAML_DEPTH and len(DEEP_BLOCK_PATTERN.findall(text)) <= MAX_YAML_DEPTH:
        return 0
    depth = deepest = 0
    for event in yaml.parse(text, YAML_LOADER):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            deepest = max(deepest, depth)
            if deepest > MAX_YAML_DEPTH:
                break
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
    return deepest


Parsed = TypeVar("Parsed")
NamedItem = TypeVar("NamedItem")


def keep_parsed(name: str, files: Sequence[Path], parse: Callable[[], Parsed]) -> Parsed:
    """Return what is parsed from files. It is kept beside the compiled kernels under a name, until one of the files changes.

    Args:
        files: All files that the result depends on, with the modules that define its types.
        parse: Returns something that can be pickled.
    """
    from mocapfix.kernels.compilation import CACHE_FOLDER

    if CACHE_FOLDER is None:
        return parse()
    kept, digest = CACHE_FOLDER / f"{name}.pickle", hashlib.sha256(b"\0".join(file.read_bytes() for file in files)).digest()
    with suppress(Exception):  # there is none, or one that cannot be read
        if (content := kept.read_bytes()).startswith(digest):
            return pickle.loads(content[len(digest) :])
    parsed = parse()
    with suppress(WriteError), replace_atomically(kept) as part:
        part.write_bytes(digest + pickle.dumps(parsed))
    return parsed


def find_by_name(
    name_or_path: str | Path, shipped: Mapping[str, NamedItem], item_kind: str, read: Callable[[Path], NamedItem]
) -> NamedItem:
    """Return a shipped item by its name, or read it from a YAML file.

    Args:
        name_or_path: Name of a shipped item, or path of a YAML file.
        item_kind: What an item is, for the error message.
        read: Reads an item from a file.

    Raises:
        SceneError: If there is neither a shipped item nor a file of that name. The message lists the shipped items.
    """
    if (item := shipped.get(str(name_or_path))) is not None:
        return item
    if not is_existing_file(name_or_path):
        raise SceneError(
            f"{name_or_path}: no such {item_kind}; name one of {format_name_list(list(shipped))}, or give a YAML file."
        )
    return read(Path(name_or_path))


def is_existing_file(path: str | Path) -> bool:
    """Return whether there is a file of this name; a name that no file can have is none."""
    try:
        return Path(path).is_file()
    except (OSError, ValueError):
        return False


def _count_values(data: object, counts: dict[int, float]) -> float:
    """Return how many values a document has with its aliases written out, infinitely many if it contains itself."""
    if not isinstance(data, dict | list):
        return 1
    if id(data) not in counts:
        counts[id(data)] = math.inf  # while it is counted
        content = cast("list[object]", data) if isinstance(data, list) else cast("dict[object, object]", data).values()
        counts[id(data)] = 1 + sum(_count_values(each, counts) for each in content)
    return counts[id(data)]


def read_yaml(path: Path, load: Callable[[str], Any] = load_yaml) -> dict[str, Any]:
    """Return the content of a YAML file. Raises SceneError with the file and the line if it is none, or no mapping."""
    try:
        text = Path(path).read_text(encoding="utf-8")
        if measure_yaml_depth(text) > MAX_YAML_DEPTH:
            raise SceneError(f"{path}: contains lists in lists more than {MAX_YAML_DEPTH} deep; check that it is the right file.")
        data = load(text)
        if ALIAS_PATTERN.search(text) and not _count_values(data, {}) <= MAX_YAML_VALUES:
            raise SceneError(f"{path}: its aliases (*name) stand for too many values; write them out.")
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error}).") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or getattr(error, "reason", error)
        raise SceneError(f"{path}{where}: not valid YAML ({problem}).") from error
    except (ValueError, AttributeError, TypeError, RecursionError) as error:  # PyYAML raises these for values such as 2024-13-45
        raise SceneError(f"{path}: not valid YAML ({' '.join(str(error).split())}).") from error
    if not isinstance(data, dict):
        raise SceneError(f"{path}: contains no key: value pairs; check that it is the right file.")
    return cast("dict[str, Any]", data)


YAML_TAG = "tag:yaml.org,2002:"
MAX_LINE_LENGTH = 130  # characters in a line of a written file


class InlineMapping(dict[str, Any]):
    """A mapping that is written on one line, such as that of a bone or a marker."""


class InlineSequence(list[Any]):
    """A list that is written on one line, such as the labels of a change."""


def dump_yaml(data: Mapping[str, Any], max_line_length: int = MAX_LINE_LENGTH) -> str:
    """Return the YAML text of a mapping, with the keys in its order."""
    return yaml.dump(data, Dumper=_YamlDumper, sort_keys=False, width=max_line_length, allow_unicode=True)


# The compiled writer, which gives the same text several times faster, where PyYAML was built with it.
_SafeDumper: type[yaml.SafeDumper] = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


class _YamlDumper(_SafeDumper):
    """PyYAML's safe writer, extended by InlineMapping and InlineSequence."""


_YamlDumper.add_representer(InlineMapping, lambda dumper, each: dumper.represent_mapping(YAML_TAG + "map", each, True))
_YamlDumper.add_representer(InlineSequence, lambda dumper, each: dumper.represent_sequence(YAML_TAG + "seq", each, True))
