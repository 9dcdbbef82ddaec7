"""Write mocapfix/kernels/kernel_signatures.json: the kernels that cleaning calls, with the types of arguments.

    PYTHONPATH=. python docs/generate_kernel_signatures.py

Run it when kernels or their arguments have changed. The demo's take is cleaned with nothing compiled, which takes a minute or
two, once more as a preview, and then a take with finger markers; the compiled kernels are listed, but for those that others call.
"""

import json
import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

os.environ["NUMBA_CACHE_DIR"] = tempfile.mkdtemp()  # before Numba is imported: an empty one

from numba import types

from mocapfix import pipeline
from mocapfix.io.c3d import write_c3d
from mocapfix.kernels.compilation import SIGNATURES_FILE
from mocapfix.lab.hands import compose_hands
from mocapfix.synthetic import compose_take, write_synthetic_take

KERNELS_MODULE = "mocapfix.kernels."


def list_kernels() -> dict[str, Any]:
    """Return the loaded kernels by module and function, after `mocapfix.kernels.`."""
    return {
        f"{name.removeprefix(KERNELS_MODULE)}.{kernel.py_func.__name__}": kernel
        for name, module in list(sys.modules.items())
        if name.startswith(KERNELS_MODULE)
        for kernel in vars(module).values()
        if hasattr(kernel, "py_func") and kernel.py_func.__module__ == name
    }


def find_called_functions(code: CodeType, scope: dict[str, Any]) -> Iterator[Any]:
    """Yield the functions of the kernels' modules that a function calls, directly or not, by the names in its code."""
    values = [scope.get(name) for name in code.co_names]
    values += [getattr(value, name, None) for value in values if isinstance(value, ModuleType) for name in code.co_names]
    for value in values:
        function: Any = getattr(value, "py_func", value)
        if str(getattr(function, "__module__", "")).startswith(KERNELS_MODULE) and hasattr(function, "__code__"):
            yield value
            yield from find_called_functions(function.__code__, function.__globals__)


def describe_type(described: Any, shared: dict[types.Type, tuple[int, object]]) -> Any:
    """Return the description of a type, and add the named tuples in it to `shared`, with a number and their description."""
    if isinstance(described, types.Array):
        readonly = "" if described.mutable else " readonly"
        return f"{describe_type(described.dtype, shared)}[{described.ndim}{described.layout}]{readonly}"
    if isinstance(described, types.BaseTuple):
        content: Any = described
        fields = [describe_type(each, shared) for each in content.types]
        if not hasattr(described, "instance_class"):
            return fields
        name = f"{content.instance_class.__module__.removeprefix('mocapfix.')}.{content.instance_class.__qualname__}"
        if described not in shared:
            shared[described] = (len(shared), {name: fields})
        return f"${shared[described][0]}"
    return {"bool": "boolean"}.get(str(described), str(described))


def describe_kernels(kernels: dict[str, Any]) -> dict[str, list[Any]]:
    """Return the content of the file: those first that call most, and none that only others call, which are parts of them."""
    called = {
        name: list(find_called_functions(kernel.py_func.__code__, kernel.py_func.__globals__)) for name, kernel in kernels.items()
    }
    outside = [
        vars(each) for name, each in sys.modules.items() if name.startswith("mocapfix.") and KERNELS_MODULE not in f"{name}."
    ]
    inner = {id(each) for found in called.values() for each in found} - {id(each) for own in outside for each in own.values()}
    shared: dict[types.Type, tuple[int, object]] = {}
    entries = [
        {"kernel": name, "arguments": [describe_type(each, shared) for each in arguments]}
        for name in sorted(kernels, key=lambda name: (-len(called[name]), name))
        if id(kernels[name]) not in inner
        for arguments in dict.fromkeys(tuple(map(types.unliteral, each)) for each in kernels[name].signatures)
    ]
    return {"types": [description for _, description in sorted(shared.values(), key=lambda each: each[0])], "kernels": entries}


def main() -> None:
    """Clean the demo's take, also as a preview, and one with fingers, and write the list with one kernel or type a line."""
    with tempfile.TemporaryDirectory() as folder:
        take, fingers = Path(folder) / "demo.c3d", Path(folder) / "fingers.c3d"
        write_synthetic_take(take, compose_take(seed=0))
        for is_fast in (False, True):
            pipeline.clean(take, is_fast=is_fast).write(take.with_suffix(".mocapfix"), overwrite=is_fast)
        write_c3d(fingers, compose_hands(seed=0).take)
        pipeline.clean(fingers).write(fingers.with_suffix(".mocapfix"))
    content = describe_kernels(list_kernels())
    lines = {name: ",\n  ".join(json.dumps(entry) for entry in entries) for name, entries in content.items()}
    text = ",\n".join(f' "{name}": [\n  {entries}\n ]' for name, entries in lines.items())
    SIGNATURES_FILE.write_text(f"{{\n{text}\n}}\n", encoding="utf-8")
    sys.stdout.write(f"{SIGNATURES_FILE}: {len(content['kernels'])} signatures\n")


if __name__ == "__main__":
    main()
