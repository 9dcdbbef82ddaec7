"""Finding the YAML and weights that travel with mocapfix, in a wheel and in a checkout alike."""

from importlib import resources
from pathlib import Path

import yaml

from mocapfix.errors import SceneError

YAML_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # libyaml's, ten times as fast, where PyYAML was built with it


def find_shipped_folder(name: str) -> Path:
    """-> the folder "scenes" or "priors": inside the installed package, else beside it (an editable install)."""
    inside = Path(str(resources.files("mocapfix"))) / name
    return inside if inside.is_dir() else inside.parent.parent / name


def read_shipped_yaml(name: str) -> dict:
    """-> what the shipped file scenes/NAME says."""
    return read_yaml(find_shipped_folder("scenes") / name)


def read_yaml(path: Path) -> dict:
    """-> what a YAML file says.

    Raises SceneError, naming file and line, where it is not to be read or holds no mapping.
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
        raise SceneError(f"{path}: holds no key: value pairs; is it the right file?")
    return data
