"""Strict models of the YAML files that users write and edit, their types, and the one YAML writer."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, FiniteFloat, ValidationError
from yaml.representer import SafeRepresenter

from mocapfix.errors import SceneError, format_name_list
from mocapfix.io.shipped import is_existing_file, read_yaml
from mocapfix.model.skeleton import load_cmu31_body

YamlModel = TypeVar("YamlModel", bound=BaseModel)
NamedItem = TypeVar("NamedItem")

# Replacements, by pydantic's error type, of messages that are written for programmers.
PYDANTIC_MESSAGES = {
    "extra_forbidden": "there is no such key; check its spelling",
    "missing": "is missing",
    "tuple_type": "must be a list",
    "model_type": "must be key: value pairs",
    "dict_type": "must be key: value pairs",
    "string_type": "must be text",
    "literal_error": "must be {expected}",
    "union_tag_not_found": "is missing",
    "union_tag_invalid": "must be one of {expected_tags}, not {tag!r}",
}
MAX_LINE_LENGTH = 130  # characters in a line of a written file


class StrictModel(BaseModel):
    """A model that accepts no unknown keys and only finite numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def read_yaml_model(model: type[YamlModel], path: Path) -> YamlModel:
    """Read a YAML file and validate it by a model. Raise SceneError as `read_validated_yaml` does."""
    return read_validated_yaml(model.model_validate, path)


def read_validated_yaml(validate: Callable[[Any], YamlModel], path: Path) -> YamlModel:
    """Read a YAML file and validate it.

    Args:
        validate: Converts the content of the file, or raises pydantic's ValidationError.

    Returns:
        The converted content.

    Raises:
        SceneError: If the file is invalid. The message names the file and the first invalid key, and says what is wrong.
    """
    data = read_yaml(path)
    try:
        return validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        context: dict[str, Any] = first.get("ctx", {})
        key = ".".join(str(part) for part in first["loc"]) or str(context.get("discriminator", "the file")).strip("'")
        template = PYDANTIC_MESSAGES.get(first["type"])
        message = template.format(**context) if template else first["msg"].removeprefix("Value error, ")
        raise SceneError(f"{path}: {key}: {message}.") from error


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


def _represent_inline(dumper: SafeRepresenter, mapping: InlineMapping) -> yaml.MappingNode:
    return dumper.represent_mapping("tag:yaml.org,2002:map", mapping, flow_style=True)


def _represent_inline_sequence(dumper: SafeRepresenter, sequence: InlineSequence) -> yaml.SequenceNode:
    return dumper.represent_sequence("tag:yaml.org,2002:seq", sequence, flow_style=True)


_YamlDumper.add_representer(InlineMapping, _represent_inline)
_YamlDumper.add_representer(InlineSequence, _represent_inline_sequence)


def _validate_joint_name(name: str) -> str:
    names = load_cmu31_body().skeleton.names
    if name not in names:
        raise ValueError(f"there is no joint {name!r}; the joints are {format_name_list(names)}")
    return name


Vector3 = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
JointName = Annotated[str, AfterValidator(_validate_joint_name)]
