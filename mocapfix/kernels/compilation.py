"""How kernels are compiled, where compiled kernels are kept from one run to the next, and which are compiled first.

Numba's cache compares the source of a compiled function's module with that of the cached one, but not the sources of the
functions that it calls. So the folder's name contains a digest of the sources of all kernels, of the named tuples that they are
called with, and of Numba's version. Folders of other digests are removed once a new one is made.

`kernel_signatures.json` lists the kernels that cleaning a take calls, with the types of their arguments. Before the first take is
cleaned, several processes compile them; `python -m mocapfix.kernels.compilation` does that without cleaning anything. A kernel or
a type that is not in the list is compiled when it is used. `docs/generate_kernel_signatures.py` writes the list.

A type is a name of Numba's (`int64`), an array's (`float64[3C]`: its type, dimensions and layout; `readonly` after it), a list
for a tuple, or an object with the name of a named tuple's class and its fields' types. Types that occur in several are written
once, under `types`, and referred to by `$` and their number.
"""

import ctypes
import gc
import hashlib
import importlib
import json
import operator
import os
import re
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import nullcontext, suppress
from functools import cache, partial
from graphlib import TopologicalSorter
from multiprocessing import get_context
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, cast

import numba
from llvmlite.binding import Linkage, ffi, parse_bitcode
from numba import njit, types
from numba.core import environment, errors
from numba.core.caching import FunctionCache
from numba.core.codegen import JITCodeLibrary, JITCPUCodegen
from numba.core.runtime.context import NRTContext
from numba.core.runtime.nrt import rtsys
from numba.core.types.functions import BaseFunction
from numba.core.typing.templates import infer_global

from mocapfix.model.system import count_cores, get_system

config: Any = numba.config  # pyright: ignore[reportPrivateImportUsage]

PACKAGE_FOLDER = Path(__file__).parent.parent
KERNELS_FOLDER = Path(__file__).parent
SIGNATURES_FILE = KERNELS_FOLDER / "kernel_signatures.json"
ARRAY_PATTERN = re.compile(r"(\w+)\[(\d+)([CFA])\](?: (readonly))?")
DIGEST_LENGTH = 12  # hexadecimal digits in a folder's name
FOLDER_PREFIX = "compiled-"
MAX_PROCESSES = 8  # more would wait for the kernel that takes longest
SHARING_MODULES = (  # their kernels call the same functions
    ("levenberg_marquardt", "schur", "covariance"),
    ("belief_propagation", "pose_transfer", "rigid_registration", "joint_registration"),
)
NUMBER_OPERATORS = {
    operator.add, operator.sub, operator.mul, operator.truediv, operator.neg, operator.lt, operator.le, operator.gt, operator.ge,
    operator.eq, operator.ne, operator.iadd, operator.isub, operator.imul, operator.itruediv,
}  # fmt: skip
MESSAGE_COLOURS = ("code", "errmsg", "filename", "indicate", "highlight", "reset")


@cache
def compute_kernels_digest() -> str:
    """Return a digest of Numba's version and of the sources of all kernels, of what they import and of their named tuples."""
    files = sorted({*KERNELS_FOLDER.rglob("*.py"), PACKAGE_FOLDER / "model" / "motion.py", *list_named_tuple_files()})
    return _compute_digest(b"\0".join([numba.__version__.encode(), *(file.read_bytes() for file in files)]))


def list_named_tuple_files() -> list[Path]:
    """Return the files of the modules whose named tuples `kernel_signatures.json` lists."""
    keys: set[str] = set()
    json.loads(SIGNATURES_FILE.read_bytes(), object_hook=keys.update)  # called with every object in it
    modules = {key.rpartition(".")[0] for key in keys}
    return sorted(PACKAGE_FOLDER.joinpath(*module.split(".")).with_suffix(".py") for module in modules if module)


def choose_cache_folder() -> Path | None:
    """Return the folder for compiled kernels, in the first of several folders that is writable; None if none is.

    They are the folder that NUMBA_CACHE_DIR names, the package's, the user's cache folder and the temporary folder. Outside the
    package its installations have different folders.
    """
    installation = Path("mocapfix", f"kernels-{_compute_digest(str(PACKAGE_FOLDER).encode())}")
    candidates = [KERNELS_FOLDER / "__pycache__"]
    if requested := os.environ.get("NUMBA_CACHE_DIR"):  # Numba's own value is this module's once it was imported
        candidates.insert(0, Path(requested) / installation)
    with suppress(RuntimeError):  # no home
        candidates.append(get_system().cache_folder / installation)
    candidates.append(Path(tempfile.gettempdir()) / installation)
    for candidate in candidates:
        folder = candidate / f"{FOLDER_PREFIX}{compute_kernels_digest()}"
        is_new = not folder.is_dir()
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
            if is_new:
                for outdated in {*candidate.glob(f"{FOLDER_PREFIX}*")} - {folder}:
                    shutil.rmtree(outdated, ignore_errors=True)
            return folder
    return None


def _compute_digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:DIGEST_LENGTH]


CACHE_FOLDER = choose_cache_folder()  # where compiled kernels are kept; None if nothing can be written
if CACHE_FOLDER:
    config.CACHE_DIR = str(CACHE_FOLDER)


class KernelCache(FunctionCache):
    """Numba's cache of a kernel, which loads it without what only compiling needs (of Numba's 0.3 s for the first one, 0.2 s)."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the cached kernel for these types, None if there is none; see `numba.core.caching.Cache`."""
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)


class KernelLibrary(JITCodeLibrary):
    """The code of a kernel, or of a function that is compiled as part of one.

    The form of a cached kernel for the linker is parsed when another kernel is linked with it. Numba generates code for each
    function that a kernel calls, and uses it nowhere; here only for kernels. That saves a third of the time that compiling takes.
    """

    _unparsed: bytes | None = None  # bitcode of a library from the cache; None once it is parsed

    @classmethod
    def _unserialize(cls, codegen: Any, state: tuple[str, str, Any]) -> Any:
        name, kind, data = state
        if kind != "object":
            return super()._unserialize(codegen, state)
        library = codegen.create_library(name)
        object_code, library._unparsed = data
        library.enable_object_caching()
        library._set_compiled_object(object_code)
        library._finalize_final_module()
        return library

    def _get_module_for_linking(self) -> Any:
        if self._unparsed is not None:
            self._shared_module, self._unparsed = parse_bitcode(self._unparsed), None
            self._codegen._engine._load_defined_symbols(self._shared_module)
        elif not self._finalized and self._shared_module is None:
            self._shared_module = self._final_module.clone()
            for each in self._shared_module.functions:
                if not each.is_declaration and each.linkage == Linkage.external:
                    each.linkage = Linkage.linkonce_odr
        return self._shared_module or super()._get_module_for_linking()

    def add_linking_library(self, library: Any) -> None:
        """Add a library that this one calls; see `numba.core.codegen.CPUCodeLibrary`."""
        self._linking_libraries.append(library)

    def finalize(self) -> None:
        """Link with the libraries that this one calls, directly or not, and generate code; see `JITCodeLibrary`."""
        called: dict[Any, list[Any]] = {}
        waiting: list[Any] = [self]
        while waiting:
            if (each := waiting.pop()) not in called:
                called[each] = [] if each._finalized else each._linking_libraries
                waiting += called[each]
        order = [*TopologicalSorter(called).static_order()]
        self._linking_libraries = order[-2::-1]  # callers first: the linker takes only what is called by what it has
        super().finalize()
        for each in self._final_module.global_variables:
            if known := environment.lookup_environment(each.name):
                set_environment(self._codegen, each.name, known)

    def get_pointer_to_function(self, name: str) -> int:
        """Return the address of a function of this library; see `numba.core.codegen.JITCodeLibrary`."""
        if self._unparsed is not None:
            return self._codegen._engine.get_function_address(name)
        if not self._finalized and name not in {each.name for each in self._final_module.functions}:
            return 0  # not a kernel
        return super().get_pointer_to_function(name)


def set_environment(codegen: Any, name: str, value: Any) -> None:
    """Set the environment that a function's code refers to, if code was generated; see `JITCPUCodegen.set_env`."""
    if address := codegen._engine.get_global_value_address(name):
        ctypes.c_void_p.from_address(address).value = id(value)


cast(Any, JITCPUCodegen)._library_class, cast(Any, JITCPUCodegen).set_env = KernelLibrary, set_environment


# A kernel from the cache names the modules of Numba that it was compiled with. It needs nothing of them, but they take as long to
# import as all kernels to load. Empty modules stand for those that are not loaded.
cast(Any, environment).importlib = SimpleNamespace(import_module=lambda name: sys.modules.get(name) or ModuleType(name))


def compile_kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Compile a function that Python calls, as `numba.njit` does with these options, cached. A decorator.

    A division by zero is infinite or NaN, as in NumPy; an error for each division would take time to compile.
    """
    if function is None:
        return partial(compile_kernel, **options)
    jit: Any = njit  # without its types, which do not have all options
    kernel = jit(no_cfunc_wrapper=True, error_model="numpy", **options)(function)  # nothing needs kernels' addresses
    if CACHE_FOLDER:
        kernel._cache = KernelCache(function)
    return kernel


def compile_inner_kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Compile a function as part of each kernel that calls it; a call from Python is not compiled. A decorator.

    `numba.extending.register_jitable` does the same, but compiles it again for each combination of the callers' options.
    """
    if function is None:
        return partial(compile_inner_kernel, **options)
    jit, options = cast(Any, njit), {"no_cpython_wrapper": True, "no_cfunc_wrapper": True, "fastmath": False, **options}
    cast(Any, function).compiled = compiled = jit(error_model="numpy", **options)(function)
    infer_global(function, types.Dispatcher(compiled))  # it does not keep what was compiled
    return function


@cache
def read_kernel_list() -> dict[str, list[tuple[Any, ...]]]:
    """Return the types of the arguments of the listed kernels, several times if it is called with several.

    Kernels are named by module and function, after `mocapfix.kernels.`. Those that take longest come first.
    """
    data = json.loads(SIGNATURES_FILE.read_text(encoding="utf-8"))
    shared, kernels = [], {}
    for each in data["types"]:
        shared.append(parse_type(each, shared))
    for each in data["kernels"]:
        kernels.setdefault(each["kernel"], []).append(tuple(parse_type(argument, shared) for argument in each["arguments"]))
    return kernels


def find_kernel(name: str) -> Any:
    """Return the kernel of a name such as `viterbi.find_cheapest_chain`."""
    module, _, function = name.rpartition(".")
    return getattr(importlib.import_module(f"mocapfix.kernels.{module}"), function)


def parse_type(description: Any, shared: list) -> Any:
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


def is_precompiled() -> bool:
    """Return whether `precompile_kernels` has been run for the present sources of the kernels, or cannot keep anything."""
    return CACHE_FOLDER is None or _get_stamp_path(CACHE_FOLDER).exists()


def _get_stamp_path(folder: Path) -> Path:
    return folder / f"precompiled.{sys.implementation.cache_tag}-{_compute_digest(SIGNATURES_FILE.read_bytes())}"


def precompile_kernels(report_progress: Callable[[int, int], None], processes: int | None = None) -> None:
    """Compile the listed kernels; wait while another process does so.

    Args:
        report_progress: Is called with the number of kernels that are compiled and of all.
        processes: How many compile; by default one for each core that this process may use.
    """
    from filelock import FileLock  # slow to import

    kernels, folder = read_kernel_list(), CACHE_FOLDER
    with FileLock(folder / ".lock", fallback_to_soft=False) if folder else nullcontext():
        if is_precompiled():
            return
        try:
            _compile_in_processes(kernels, processes or min(count_cores(), MAX_PROCESSES), report_progress)
        except (OSError, BrokenProcessPool):  # no interpreter, as inside another program
            compile_listed_kernels(list(kernels))
        if folder:
            _get_stamp_path(folder).touch()


def _compile_in_processes(kernels: Iterable[str], processes: int, report_progress: Callable[[int, int], None]) -> None:
    groups = group_kernels(kernels, processes)
    with ProcessPoolExecutor(processes, get_context("spawn"), initializer=_begin_compiling) as pool:
        running = {pool.submit(compile_listed_kernels, names): len(names) for names in groups}
        compiled = 0
        try:
            for each in as_completed(running):
                each.result()
                compiled += running[each]
                report_progress(compiled, sum(running.values()))
        except BaseException:  # an interrupt; without this it would take effect after the last kernel
            for each in pool._processes.values():  # pyright: ignore[reportPrivateUsage]  # public from Python 3.14 on
                each.kill()
            raise


def group_kernels(kernels: Iterable[str], processes: int) -> list[list[str]]:
    """Return the names of the kernels in groups, those of each to be compiled by one process, which compiles what they call once.

    With more than two processes the largest group would be ready last, so each kernel is a group.
    """
    groups: dict[str, list[str]] = {}
    for name in kernels:
        module = name.partition(".")[0]
        shared = next((modules[0] for modules in SHARING_MODULES if module in modules), module)
        groups.setdefault(shared if processes <= 2 else name, []).append(name)
    return list(groups.values())


def _begin_compiling() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that waits for this one answers the keyboard
    gc.disable()
    save_compilation_time()


def save_compilation_time() -> None:
    """Make Numba compile the same code in less time: by a tenth."""
    cast(Any, errors)._termcolor_inst = SimpleNamespace(**dict.fromkeys(MESSAGE_COLOURS, str))  # the messages are not shown
    cast(Any, ffi).lib._lock._cblist.clear()  # 300,000 events without a listener
    cast(Any, NRTContext).get_meminfos = list_references
    resolve = BaseFunction.get_call_type
    resolve_once = cache(lambda function, context, arguments: resolve(function, context, arguments, {}))

    def resolve_operator(function: Any, context: Any, arguments: tuple[Any, ...], named: dict[str, Any]) -> Any:
        if named or function.typing_key not in NUMBER_OPERATORS or not all(isinstance(each, types.Number) for each in arguments):
            return resolve(function, context, arguments, named)
        return resolve_once(function, context, arguments)

    cast(Any, BaseFunction).get_call_type = resolve_operator


def list_references(runtime: Any, builder: Any, described: Any, value: Any) -> list[tuple[Any, Any]]:
    """Return what is counted of a value, as `NRTContext.get_meminfos` does, without code for shapes and the like."""
    models = runtime._context.data_model_manager
    model = models[described]
    found = [(described, model.get_nrt_meminfo(builder, value))] if model.has_nrt_meminfo() else []
    for member, extract in model.traverse(builder):
        if models[member].contains_nrt_meminfo():
            found += list_references(runtime, builder, member, extract(value))
    return found


def compile_listed_kernels(names: list[str]) -> None:
    """Compile kernels for their listed types, or load them from the cache. What fails is reported where the kernel is used.

    One process compiles a kernel for all types: the index of its files in Numba's cache is for one writer at a time.
    """
    for name in names:
        with suppress(Exception):
            for each in read_kernel_list()[name]:
                find_kernel(name).compile(each)


if __name__ == "__main__":
    precompile_kernels(lambda done, total: None)
