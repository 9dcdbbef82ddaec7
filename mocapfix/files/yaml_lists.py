"""Long lists of mappings as YAML: thousands of changes are written in a fraction of a second.

PyYAML examines every scalar. Most of them are plain words and numbers that need neither quotes nor a line break, and items that
consist of such scalars are written directly, in the same text. All other items are left to PyYAML.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from mocapfix.files.yaml_models import MAX_LINE_LENGTH, InlineSequence, dump_yaml

# Text that is a string without quotes, unless it is one of the words below.
PLAIN_TEXT = re.compile(r"[A-Za-z](?:[A-Za-z0-9 ,;()/%+_.-]|:(?=[A-Za-z0-9]))*(?<! )")
# The same for an item of a list on one line.
PLAIN_INLINE_TEXT = re.compile(r"[A-Za-z][A-Za-z0-9_.-]*")
# Words that YAML does not read as strings.
RESERVED_WORDS = frozenset(("y", "n", "yes", "no", "on", "off", "true", "false", "null"))


def dump_yaml_list(key: str, items: Sequence[Mapping[str, Any]], max_line_length: int = MAX_LINE_LENGTH) -> str:
    """Return the YAML text of a mapping with one key, whose value is a list: the same text as that of `dump_yaml`."""
    if not items:
        return dump_yaml({key: []}, max_line_length)
    parts = [_format_mapping(item, "  ", max_line_length) or _dump_item(item, max_line_length) for item in items]
    return f"{key}:\n" + "".join(f"- {part[2:]}" for part in parts)


def _dump_item(item: Mapping[str, Any], max_line_length: int) -> str:
    """Return the lines of an item, written by PyYAML and indented by two spaces."""
    text = dump_yaml({"items": [item]}, max_line_length)
    return "  " + text.removeprefix("items:\n- ")


def _format_mapping(mapping: Mapping[str, Any], indent: str, max_line_length: int) -> str | None:
    """Return the lines of a mapping, or None if a value has to be quoted or a line to be broken."""
    lines: list[str] = []
    for key, value in mapping.items():
        if isinstance(value, dict):
            nested = _format_mapping(value, indent + "  ", max_line_length) if value else None
            text = None if nested is None else f"\n{nested}"
        else:
            scalar = _format_scalar(value)
            text = None if scalar is None or len(indent) + len(key) + 2 + len(scalar) > max_line_length else f" {scalar}\n"
        if text is None:
            return None
        lines.append(f"{indent}{key}:{text}")
    return "".join(lines)


def _format_scalar(value: object) -> str | None:
    """Return the text of a number, a string or a list of strings; None if it has to be quoted or is of another type."""
    match value:
        case None:
            return "null"
        case bool():
            return "true" if value else "false"
        case int():
            return str(value)
        case float():
            text = repr(value)
            return text if text.lstrip("-")[0].isdigit() and "e" not in text else None
        case str():
            return value if PLAIN_TEXT.fullmatch(value) and value.lower() not in RESERVED_WORDS else None
        case InlineSequence():
            labels = [each for each in value if isinstance(each, str) and PLAIN_INLINE_TEXT.fullmatch(each)]
            is_plain = len(labels) == len(value) and not any(each.lower() in RESERVED_WORDS for each in labels)
            return f"[{', '.join(labels)}]" if is_plain else None
        case _:
            return None
