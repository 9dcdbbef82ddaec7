"""Find and read the files that ship with mocapfix, in a wheel as well as in a checkout."""

from importlib import resources
from pathlib import Path
from typing import Any, cast

import yaml

from mocapfix.errors import SceneError

YAML_LOADER: type[yaml.SafeLoader] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""the loader of libyaml if PyYAML was built with it, which is ten times as fast"""


def find_shipped_folder(name: str) -> Path:
    """Return the folder "scenes" or "priors": within the installed package, or beside it in a checkout."""
    inside = Path(str(resources.files("mocapfix"))) / name
    return inside if inside.is_dir() else inside.parent.parent / name


def read_shipped_yaml(name: str) -> dict[str, Any]:
    """Return the content of the file `name` in scenes/."""
    return read_yaml(find_shipped_folder("scenes") / name)


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the content of a YAML file.

    Raises SceneError with the file and the line if the file cannot be read or does not contain a mapping.
    """
    try:
        data = yaml.load(Path(path).read_text(encoding="utf-8"), YAML_LOADER)
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error}).") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or getattr(error, "reason", error)
        raise SceneError(f"{path}{where}: not valid YAML ({problem}).") from error
    if not isinstance(data, dict):
        raise SceneError(f"{path}: contains no key: value pairs; check that it is the right file.")
    return cast("dict[str, Any]", data)
