"""Find and read the files that ship with mocapfix, in a wheel as well as in a checkout."""

import math
import re
import tomllib
from functools import cache
from importlib import metadata, resources
from pathlib import Path
from typing import Any, cast

import yaml

from mocapfix.errors import SceneError

MAX_YAML_DEPTH = 100  # lists and mappings that may contain each other; those of mocapfix are four deep
MAX_YAML_VALUES = 1_000_000  # values that a document with aliases may have with these written out
ALIAS_PATTERN = re.compile(r"[\s\[,:]\*\w")
BRACKET_PATTERN = re.compile(r"[\[{\]}]")
DEEP_BLOCK_PATTERN = re.compile(r"[-?]\s+[-?]\s|^ {100}", re.MULTILINE)  # many of these make a document deep
YAML_LOADER: type[yaml.SafeLoader] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""the loader of libyaml if PyYAML was built with it, which is ten times as fast"""


@cache
def get_version() -> str:
    """Return the version, which pyproject.toml states: of the installed package, or of a checkout that is not installed."""
    try:
        return metadata.version("mocapfix")
    except metadata.PackageNotFoundError:
        project = find_shipped_folder("scenes").parent / "pyproject.toml"
        return tomllib.loads(project.read_text(encoding="utf-8"))["project"]["version"]


def find_shipped_folder(name: str) -> Path:
    """Return the folder "scenes" or "priors": within the installed package, or beside it in a checkout."""
    inside = Path(str(resources.files("mocapfix"))) / name
    return inside if inside.is_dir() else inside.parent.parent / name


def read_shipped_yaml(name: str) -> dict[str, Any]:
    """Return the content of the file `name` in scenes/."""
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


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the content of a YAML file. Raises SceneError with the file and the line if it is none, or no mapping."""
    try:
        text = Path(path).read_text(encoding="utf-8")
        if measure_yaml_depth(text) > MAX_YAML_DEPTH:
            raise SceneError(f"{path}: contains lists in lists more than {MAX_YAML_DEPTH} deep; check that it is the right file.")
        data = yaml.load(text, YAML_LOADER)
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
