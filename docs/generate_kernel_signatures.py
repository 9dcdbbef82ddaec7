"""Write mocapfix/kernels/kernel_signatures.json: the kernels that the demo calls, with the types of their arguments.

    PYTHONPATH=. python docs/generate_kernel_signatures.py

Run it when kernels or their arguments have changed. The demo's take is cleaned with nothing compiled, which takes a minute or
two, and what Numba compiles is recorded. Kernels that only other kernels call are listed too if they take long, so that several
processes share the work.
"""

import gc
import json
import os
import sys
import tempfile
import time
from functools import cache
from pathlib import Path
from types import CodeType, ModuleType

os.environ["NUMBA_CACHE_DIR"] = tempfile.mkdtemp()  # before Numba is imported: an empty one

from numba.core import event

from mocapfix import pipeline, synthetic
from mocapfix.kernels.precompilation import SIGNATURES_FILE, describe_type

MIN_INNER_KERNEL_S = 0.25  # processor time of compiling a kernel that Python does not call, from which it is listed
KERNELS_MODULE = "mocapfix.kernels."


class CompilationRecorder(event.Listener):
    """Records every kernel that Numba compiles: its types, its own processor time, and what was compiled for it."""

    def __init__(self) -> None:
        self.kernels = {}  # (name, types): seconds, dispatcher, keys of the kernels that were compiled for it
        self._running = []

    def on_start(self, event) -> None:
        """Note the start of a compilation, which may be one within another."""
        dispatcher = event.data["dispatcher"]
        name = name_kernel(dispatcher)
        self._running.append([(name, event.data["args"]) if name else None, dispatcher, time.thread_time(), 0.0, set()])

    def on_end(self, event) -> None:
        """Record a finished compilation."""
        key, dispatcher, start_s, inner_s, callees = self._running.pop()
        duration_s = time.thread_time() - start_s
        if key:
            self.kernels[key] = (duration_s - inner_s, dispatcher, callees)
        if self._running:
            self._running[-1][3] += duration_s
            self._running[-1][4] |= callees | ({key} if key else set())


def name_kernel(dispatcher) -> str | None:
    """Return a kernel's name in the list, None for a compiled function that is no kernel, such as one of Numba's own."""
    function = dispatcher.py_func
    module = sys.modules.get(function.__module__)
    if not function.__module__.startswith(KERNELS_MODULE) or getattr(module, function.__name__, None) is not dispatcher:
        return None
    return f"{function.__module__}.{function.__name__}".removeprefix(KERNELS_MODULE)


def find_called_kernels(code: CodeType, scope: dict) -> set[str]:
    """Return the names of the kernels that a function calls, directly or not, by the names in its code."""
    found = set()
    values = [scope.get(name) for name in code.co_names]
    values += [getattr(value, name, None) for value in values if isinstance(value, ModuleType) for name in code.co_names]
    for value in values:
        if hasattr(value, "py_func"):
            found |= {name_kernel(value)} - {None}
            found |= find_called_kernels(value.py_func.__code__, value.py_func.__globals__)
    return found


def list_kernels(recorder: CompilationRecorder) -> dict:
    """Return the content of the file."""
    shared, described = {}, {}
    for key, (seconds, dispatcher, callees) in recorder.kernels.items():
        is_inner = dispatcher.targetoptions.get("no_cpython_wrapper", False)
        if is_inner and seconds < MIN_INNER_KERNEL_S:
            continue
        try:
            arguments = [describe_type(each, shared) for each in key[1]]
        except TypeError:  # a type that only compiled code has
            continue
        names = find_called_kernels(dispatcher.py_func.__code__, dispatcher.py_func.__globals__)
        described[key] = (arguments, seconds, {other for other in recorder.kernels if other in callees or other[0] in names})
    needed = {key: {other for other in described if other in callees} - {key} for key, (_, _, callees) in described.items()}

    @cache
    def measure_chain(key) -> float:
        """Return the time to compile a kernel and then the longest chain of kernels that call one another and it."""
        return described[key][1] + max((measure_chain(other) for other in described if key in needed[other]), default=0.0)

    ordered = sorted(described, key=measure_chain, reverse=True)
    index = {key: n for n, key in enumerate(ordered)}
    kernels = [
        {"kernel": key[0], "arguments": described[key][0], "callees": sorted(index[other] for other in needed[key])}
        for key in ordered
    ]
    return {"types": [description for _, description in sorted(shared.values(), key=lambda each: each[0])], "kernels": kernels}


def format_list(content: dict) -> str:
    """Return the content of the file as JSON with one kernel or type a line."""
    parts = []
    for name, entries in content.items():
        lines = ",\n  ".join(json.dumps(entry) for entry in entries)
        parts.append(f' "{name}": [\n  {lines}\n ]')
    return "{\n" + ",\n".join(parts) + "\n}\n"


def main() -> None:
    """Clean the demo's take and write the list."""
    gc.disable()
    recorder = CompilationRecorder()
    event.register("numba:compile", recorder)
    with tempfile.TemporaryDirectory() as folder:
        take = Path(folder) / "demo.c3d"
        synthetic.write_synthetic_take(take, synthetic.compose_take(seed=0))
        pipeline.clean(take).write(take.with_suffix(".mocapfix"))
    SIGNATURES_FILE.write_text(format_list(list_kernels(recorder)), encoding="utf-8")
    seconds = sum(each[0] for each in recorder.kernels.values())
    sys.stdout.write(f"{SIGNATURES_FILE}: {len(recorder.kernels)} kernels were compiled in {seconds:.0f} s\n")


if __name__ == "__main__":
    main()
