"""Compile, in several processes, the kernels that cleaning needs, before the first take is cleaned.

Numba compiles one function at a time in a process. `kernel_signatures.json` lists the kernels and the types of their arguments,
each with the kernels that it calls, so that each is compiled once, after those that it calls, by whichever process is free.
Numba's cache carries them from one process to another. A kernel or a type that is not in the list is compiled when it is used.
`python -m mocapfix.kernels.precompilation` compiles them without cleaning anything.
`docs/generate_kernel_signatures.py` writes the list.

The list of kernels that cleaning a take calls, with the types of their arguments.

A type is a name of Numba's (`int64`), an array's (`float64[3C]`: its type, dimensions and layout; `readonly` after it), a list
for a tuple, or an object with the name of a named tuple's class and its fields' types. Types that occur in several are written
once, under `types`, and referred to by `$` and their number.
"""

import gc
import importlib
import json
import os
import re
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import NamedTuple

from numba import types

from mocapfix.kernels.compilation_cache import PACKAGE_FOLDER, compute_kernels_digest, find_cache_folder

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


MAX_PROCESSES = 8  # more would wait for the longest chain of kernels that call one another
THREADS_VARIABLE = "MOCAPFIX_NUM_THREADS"  # of the environment
WORKER_CODE = "from mocapfix.kernels.precompilation import serve_compilation; serve_compilation()"


def is_precompiled() -> bool:
    """Return whether `precompile_kernels` has been run for the present sources of the kernels."""
    return _get_stamp_path().exists()


def precompile_kernels(report_progress: Callable[[int, int], None], processes: int | None = None) -> None:
    """Compile the listed kernels that are not in the cache.

    report_progress  is called with the number of kernels that are compiled and of all
    processes        including this one; by default one for each core that this process may use
    """
    signatures = read_signatures()
    schedule = CompilationSchedule(signatures, report_progress)
    if processes is None:
        processes = min(count_cores(), MAX_PROCESSES)
    helpers = [threading.Thread(target=_feed_worker, args=(schedule,), daemon=True) for _ in range(processes - 1)]
    for helper in helpers:
        helper.start()
    while (index := schedule.take()) is not None:
        with suppress(Exception):  # it is reported where the kernel is used
            compile_signature(signatures[index])
        schedule.finish(index)
    for helper in helpers:
        helper.join()
    with suppress(OSError):
        path = _get_stamp_path()
        path.parent.mkdir(parents=True, exist_ok=True)
        for outdated in path.parent.glob(f"precompiled.{sys.implementation.cache_tag}-*"):
            outdated.unlink()
        path.touch()


def count_cores() -> int:
    """Return the number of cores that this process may use, at most as many as the variable MOCAPFIX_NUM_THREADS says."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = os.environ.get(THREADS_VARIABLE, "")
    return max(1, min(cores, int(limit))) if limit.isdecimal() else cores


def _get_stamp_path() -> Path:
    """Return the path of the file that exists once the listed kernels are compiled."""
    return find_cache_folder() / f"precompiled.{sys.implementation.cache_tag}-{compute_kernels_digest()}"


class CompilationSchedule:
    """Which kernel to compile next; shared by threads.

    A kernel can be taken once those that it calls are finished. The list has the kernels with the longest chains of callers
    first.
    """

    def __init__(self, signatures: list[KernelSignature], report_progress: Callable[[int, int], None]) -> None:
        self._signatures = signatures
        self._report_progress = report_progress
        self._waiting = list(range(len(signatures)))
        self._finished: set[int] = set()
        self._changed = threading.Condition()

    def take(self) -> int | None:
        """Return the index of a kernel that can be compiled now; None if all are taken. Wait until there is one."""
        with self._changed:
            while self._waiting:
                for index in self._waiting:
                    if self._finished.issuperset(self._signatures[index].callees):
                        self._waiting.remove(index)
                        return index
                self._changed.wait()
            return None

    def finish(self, index: int) -> None:
        """Note that a kernel is compiled."""
        with self._changed:
            self._finished.add(index)
            self._report_progress(len(self._finished), len(self._signatures))
            self._changed.notify_all()


def _feed_worker(schedule: CompilationSchedule) -> None:
    """Start a process, and let it compile kernels until all are taken. If it fails, its kernel counts as finished."""
    search_path = [str(PACKAGE_FOLDER.parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(search_path), "PYTHONSAFEPATH": "1"}
    try:
        worker = subprocess.Popen(
            [sys.executable, "-c", WORKER_CODE],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
    except OSError:  # no interpreter, as inside another program
        return
    with worker:
        if worker.stdin is None or worker.stdout is None or not worker.stdout.readline():
            return
        while (index := schedule.take()) is not None:
            answer = ""
            with suppress(OSError):
                worker.stdin.write(f"{index}\n")
                worker.stdin.flush()
                answer = worker.stdout.readline()
            schedule.finish(index)
            if not answer:
                break
        with suppress(OSError):
            worker.stdin.close()


def serve_compilation() -> None:
    """Compile the kernels whose indices are read from standard input, and answer each with its index."""
    gc.disable()
    signatures, answers = read_signatures(), sys.stdout
    sys.stdout = sys.stderr
    answers.write("ready\n")
    answers.flush()
    for line in sys.stdin:
        with suppress(Exception):  # it is reported where the kernel is used
            compile_signature(signatures[int(line)])
        answers.write(line)
        answers.flush()


if __name__ == "__main__" and not is_precompiled():
    precompile_kernels(lambda done, total: None)
