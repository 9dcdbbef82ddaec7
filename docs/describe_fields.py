"""Show every field of a class in its table of attributes on the site: an extension of Griffe, which mkdocs.yml names.

Griffe reads the section `Attributes`. Other fields are described by the comment behind or above them, by the string below them,
by the option that they are, or by the class that groups the options of their stage.
"""

import ast
import re
from dataclasses import fields
from importlib import import_module
from typing import Any

import griffe

from mocapfix import options
from mocapfix.option import Option, StageOptions


def describe_option(option: Option) -> str:
    """Return the help of an option with its flag, in whose unit users give it on the command line."""
    value = f" {option.metavar}" if option.metavar else ""
    return f"{option.help}: `{option.flag}{value}`"


def describe_default(name: str, cls: griffe.Class) -> str:
    """Return what the default of a field says of it: an option, or the options of a stage; "" for other fields."""
    loaded: Any = getattr(import_module(cls.module.path), cls.name)
    field = next(field for field in fields(loaded) if field.name == name)
    if "option" in field.metadata:
        return describe_option(field.metadata["option"])
    return (type(field.default).__doc__ or "").partition("\n")[0] if isinstance(field.default, StageOptions) else ""


class DescribeFields(griffe.Extension):
    """Adds the fields that are not described in the section `Attributes` to it."""

    def on_class_members(self, *, node: ast.AST | griffe.ObjectNode, cls: griffe.Class, **_: Any) -> None:
        if isinstance(node, griffe.ObjectNode) or not cls.docstring:
            return
        text, _, section = cls.docstring.value.partition("\n\nAttributes:\n")
        table, blank, rest = section.partition("\n\n")
        known = {line.partition(":")[0].strip() for line in table.splitlines() if not line.startswith("     ")}
        rows = table.splitlines()
        for name, member in cls.attributes.items():
            if "property" in member.labels or name in known or name.startswith("_"):
                continue
            description = self.describe(name, member, cls).rstrip(".")
            first = description[:1] if re.match(r"m\b", description) else description[:1].upper()  # m: metres
            rows.append(f"    {name}: {first}{description[1:]}{'.' if description else ''}")
            member.docstring = None
        if rows:
            cls.docstring.value = "\n".join([f"{text}\n\nAttributes:", *rows]) + blank + rest

    def describe(self, name: str, member: griffe.Attribute, cls: griffe.Class) -> str:
        """Return the description of a field, "" if it has none."""
        if member.docstring:
            return " ".join(member.docstring.value.split())
        lines, above = cls.lines_collection[cls.filepath], (member.lineno or 0) - 1
        last = lines[(member.endlineno or 0) - 1]
        while lines[above - 1].lstrip().startswith("# "):
            above -= 1
        comments = [line.strip("# ") for line in lines[above : (member.lineno or 0) - 1]]
        if "  # " in last and "fmt:" not in last:
            comments.append(last.rpartition("  # ")[2])
        if not comments and cls.module.path == options.__name__:
            return describe_default(name, cls)
        return " ".join(comments)
