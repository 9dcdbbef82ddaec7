"""Files in YAML that people write and mend: held against the form they must have, and written so that they can be read."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, TypeVar

import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, FiniteFloat, TypeAdapter, ValidationError

from mocapfix.errors import SceneError
from mocapfix.files.shipped import read_yaml
from mocapfix.skeleton import load_cmu31_body

YamlModel = TypeVar("Form", bound=BaseModel)
NamedItem = TypeVar("Found")
PYDANTIC_MESSAGES = {  # for what pydantic says to programmers
    "extra_forbidden": "there is no such key; look for a slip in its name",
    "missing": "is missing",
    "tuple_type": "must be a list",
    "model_type": "must be key: value pairs",
    "dict_type": "must be key: value pairs",
    "string_type": "must be text",
    "union_tag_not_found": "is missing",
    "union_tag_invalid": "must be one of {expected_tags}, not {tag!r}",
}


class StrictModel(BaseModel):
    """A form with no keys but its own, and finite numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def read_yaml_model(model: type[YamlModel] | TypeAdapter[YamlModel], path: Path) -> YamlModel:
    """-> what a YAML file says, in the form it must have; of one of several forms a TypeAdapter tells which.

    Raises SceneError with the file, the path of the first wrong key and what is wrong with it.
    """
    data = read_yaml(path)
    try:
        return model.validate_python(data) if isinstance(model, TypeAdapter) else model.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        known = first.get("ctx", {})
        key = ".".join(str(part) for part in first["loc"]) or known.get("discriminator", "the file").strip("'")
        said = (
            PYDANTIC_MESSAGES[first["type"]].format(**known)
            if first["type"] in PYDANTIC_MESSAGES
            else first["msg"].removeprefix("Value error, ")
        )
        raise SceneError(f"{path}: {key}: {said}.") from error


def find_by_name(
    name_or_path: str | Path, shipped: Mapping[str, NamedItem], item_kind: str, read: Callable[[Path], NamedItem]
) -> NamedItem:
    """-> of what travels with mocapfix, by name, the one that is meant; or what `read` makes of a YAML file of the same form.

    Raises SceneError where there is none of the name: the message says `what` it would be, and lists those there are.
    """
    if (known := shipped.get(str(name_or_path))) is not None:
        return known
    if not Path(name_or_path).is_file():
        raise SceneError(f"{name_or_path}: no such {item_kind}; name one of {', '.join(shipped)}, or give a YAML file.")
    return read(Path(name_or_path))


def _validate_joint_name(name: str) -> str:
    if name not in load_cmu31_body().skeleton.names:
        raise ValueError(f"there is no joint {name!r}; the joints are {', '.join(load_cmu31_body().skeleton.names)}")
    return name


Vector3 = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
JointName = Annotated[str, AfterValidator(_validate_joint_name)]


class InlineMapping(dict):
    """A mapping that is written on one line: a bone or a marker."""


def dump_yaml(data: dict) -> str:
    """-> the YAML of a mapping, keys in its order."""
    return yaml.dump(data, Dumper=_YamlDumper, sort_keys=False, width=130, allow_unicode=True)


class _YamlDumper(yaml.SafeDumper):
    """PyYAML's safe writer, which knows Line."""


_YamlDumper.add_representer(
    InlineMapping, lambda dumper, line: dumper.represent_mapping("tag:yaml.org,2002:map", line, flow_style=True)
)
