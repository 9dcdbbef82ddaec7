"""The list of kernels that cleaning a take calls, with the types of their arguments.

A type is a name of Numba's (`int64`), an array's (`float64[3C]`: its type, dimensions and layout; `readonly` after it), a list
for a tuple, or an object with the name of a named tuple's class and its fields' types. Types that occur in several are written
once, under `types`, and referred to by `$` and their number.
"""

import importlib
import json
import re
from functools import cache
from pathlib import Path
from typing import NamedTuple

from numba import types

SIGNATURES_FILE = Path(__file__).with_name("kernel_signatures.json")
ARRAY_PATTERN = re.compile(r"(\w+)\[(\d+)([CFA])\](?: (readonly))?")


class KernelSignature(NamedTuple):
    """A kernel and the types of its arguments.

    name       module and function, after `mocapfix.kernels.`
    arguments  Numba's types
    callees    indices of the kernels in the list that it calls, directly or not
    """

    name: str
    arguments: tuple
    callees: tuple[int, ...]


@cache
def read_signatures() -> list[KernelSignature]:
    """Return the listed kernels."""
    data = json.loads(SIGNATURES_FILE.read_text(encoding="utf-8"))
    shared = []
    for each in data["types"]:
        shared.append(parse_type(each, shared))
    signatures = []
    for each in data["kernels"]:
        arguments = tuple(parse_type(argument, shared) for argument in each["arguments"])
        signatures.append(KernelSignature(each["kernel"], arguments, tuple(each["callees"])))
    return signatures


def compile_signature(signature: KernelSignature) -> None:
    """Compile a kernel, or load it from the cache."""
    find_kernel(signature.name).compile(signature.arguments)


def find_kernel(name: str):
    """Return the kernel of a name such as `viterbi.find_cheapest_chain`."""
    module, _, function = name.rpartition(".")
    return getattr(importlib.import_module(f"mocapfix.kernels.{module}"), function)


def parse_type(description, shared: list):
    """Return the type of a description; `shared` are those that it may refer to."""
    if isinstance(description, list):
        return types.BaseTuple.from_types(tuple(parse_type(each, shared) for each in description))
    if isinstance(description, dict):
        ((name, fields),) = description.items()
        module, _, class_name = name.rpartition(".")
        named_tuple = getattr(importlib.import_module(f"mocapfix.{module}"), class_name)
        return types.BaseTuple.from_types(tuple(parse_type(each, shared) for each in fields), named_tuple)
    if description.startswith("$"):
        return shared[int(description[1:])]
    if array := ARRAY_PATTERN.fullmatch(description):
        return types.Array(getattr(types, array[1]), int(array[2]), array[3], readonly=bool(array[4]))
    return getattr(types, description)


def describe_type(described, shared: dict[types.Type, tuple[int, object]]):
    """Return the description of a type, and add the named tuples in it to `shared`, with a number and their description.

    Raises TypeError if the type has none.
    """
    if isinstance(described, types.Array):
        readonly = "" if described.mutable else " readonly"
        return f"{describe_type(described.dtype, shared)}[{described.ndim}{described.layout}]{readonly}"
    if isinstance(described, types.BaseTuple):
        fields = [describe_type(each, shared) for each in described.types]  # pyright: ignore[reportAttributeAccessIssue]
        if not hasattr(described, "instance_class"):
            return fields
        named_tuple = described.instance_class  # pyright: ignore[reportAttributeAccessIssue]
        description = {f"{named_tuple.__module__.removeprefix('mocapfix.')}.{named_tuple.__qualname__}": fields}
        if described not in shared:
            shared[described] = (len(shared), description)
        return f"${shared[described][0]}"
    if described == types.none:
        return "none"
    name = str(described)
    name = "boolean" if name == "bool" else name
    if getattr(types, name, None) != described:
        raise TypeError(f"{described} has no description")
    return name
