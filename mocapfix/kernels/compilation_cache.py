"""The files in which compiled kernels are kept from one run to the next.

Numba's own cache compares the source of a compiled function with that of the cached one, but not the sources of the functions
that it calls, and keeps what is out of date. Here the kernels of a module are in a folder whose name contains a digest of the
sources of the module and of all that it imports, and of Numba's version. A folder of another digest is removed once this one
is needed.

Machine code for the kernels that Python calls, and for no others.

Numba optimises each function that it compiles, turns it into machine code, copies it into the code of every function that calls
it, and optimises it there again. Of a kernel that only other kernels call, the machine code is never run. Here a function is
optimised and turned into machine code when its address is asked for, that is, if Python calls it; what it calls is copied into
it as Numba first wrote it. This halves the time of compilation.

It holds for the kernels and for what of Numba's own they call; other compiled functions of the process are not affected.
"""

import hashlib
import os
import pickle
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import numba
from llvmlite.binding import parse_bitcode
from numba import njit
from numba.core import config
from numba.core.caching import CompileResultCacheImpl, FunctionCache, _CacheLocator
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler_lock import global_compiler_lock
from numba.core.environment import lookup_environment
from numba.core.registry import cpu_target

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

jit: Any = njit  # without its types, which do not have all options

PACKAGE_FOLDER = Path(__file__).parent.parent
KERNELS_FOLDER = Path(__file__).parent
IMPORT_PATTERN = re.compile(r"^ *(?:from|import) +(mocapfix[\w.]*)(?: +import +(\([^)]*\)|[^\n]*))?", re.MULTILINE)
DIGEST_LENGTH = 12  # hexadecimal digits in a folder's name


def compile_kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Compile a function as `numba.njit` does, and cache it in the folder of its module. A decorator.

    options  of `numba.njit`
    """
    if function is None:
        return lambda function: compile_kernel(function, **options)
    dispatcher: Any = jit(no_cfunc_wrapper=True, **options)(function)  # nothing calls kernels by their address
    dispatcher._cache = KernelCache(function)
    compile_at_once = dispatcher.compile

    def compile_deferred(signature):

        with defer_machine_code():
            return compile_at_once(signature)

    dispatcher.compile = compile_deferred
    return dispatcher


def compile_inner_kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Compile a function that only other kernels call. A decorator, as `compile_kernel`.

    The code with which Python would call the function is left out: it takes about as long to compile as the function itself. A
    call from Python, as in a test, works all the same, but compiles the function another time and does not cache that.
    """
    if function is None:
        return lambda function: compile_inner_kernel(function, **options)
    dispatcher = compile_kernel(function, no_cpython_wrapper=True, **options)
    build_callable_dispatcher = cache(lambda: jit(**options)(function))
    dispatcher._insert = lambda *arguments, **named: None  # the table of what Python may call stays empty
    dispatcher._compile_for_args = lambda *values, **named: build_callable_dispatcher()._compile_for_args(*values, **named)
    return dispatcher


class KernelCacheLocator(_CacheLocator):
    """Where the kernels of one module are cached."""

    def __init__(self, function):
        self._py_file = function.__code__.co_filename  # for Numba's warnings
        self._line = function.__code__.co_firstlineno
        self._folder = find_module_folder(function.__module__)

    @classmethod
    def from_function(cls, py_func, py_file):
        """Return the locator of a function."""
        return cls(py_func)

    def ensure_cache_path(self):
        """Create the folder, and remove those of other versions of the module."""
        if not self._folder.is_dir():
            self._folder.mkdir(parents=True, exist_ok=True)
            remove_outdated_folders(self._folder.parent)

    def get_cache_path(self) -> Any:
        """Return the folder."""
        return str(self._folder)

    def get_source_stamp(self) -> Any:
        """Return what changes with the sources: the folder's name."""
        return self._folder.name

    def get_disambiguator(self) -> Any:
        """Return the line of the function, by which functions of one name differ."""
        return str(self._line)


class KernelCacheImplementation(CompileResultCacheImpl):
    """Numba's files of compiled functions, in the folders of `KernelCacheLocator`."""

    _locator_classes = (KernelCacheLocator,)


class KernelCache(FunctionCache):
    """Numba's cache of a function; a cache that cannot be read or written only costs time."""

    _impl_class = KernelCacheImplementation

    def load_overload(self, sig, target_context):
        """Return the compiled function for a signature, None if it must be compiled."""
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # an incomplete file, or one that refers to what has been moved
            return None

    def save_overload(self, sig, data):
        """Save a compiled function. Another process that saves the same function with another signature waits."""
        with suppress(OSError):
            self._impl.locator.ensure_cache_path()
            with lock_folder(Path(self.cache_path)):
                try:
                    super().save_overload(sig, data)
                except (pickle.PickleError, EOFError, AttributeError, ImportError):  # the index cannot be read
                    self.flush()
                    super().save_overload(sig, data)


@contextmanager
def lock_folder(folder: Path) -> Generator[None]:
    """Hold a lock on a folder, so that one process at a time writes there."""
    if fcntl is None:
        yield
        return
    with (folder / ".lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


@cache
def find_cache_folder() -> Path:
    """Return the folder for compiled kernels: the first that is writable of several.

    They are the folder that NUMBA_CACHE_DIR names, the package's, the user's cache folder and the temporary folder. Outside the
    package its installations have different folders.
    """
    installation = f"kernels-{_compute_digest(str(PACKAGE_FOLDER).encode())}"
    candidates = [KERNELS_FOLDER / "__pycache__"]
    if named_folder := getattr(config, "CACHE_DIR", ""):
        candidates.insert(0, Path(named_folder) / "mocapfix" / installation)
    with suppress(RuntimeError):  # no home
        candidates.append(_find_user_cache_folder() / "mocapfix" / installation)
    temporary = Path(tempfile.gettempdir()) / "mocapfix" / installation
    return next((folder for folder in candidates if _is_writable(folder)), temporary)


def _find_user_cache_folder() -> Path:
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def find_module_folder(module: str) -> Path:
    """Return the folder for the compiled kernels of a module, which may not exist."""
    return find_cache_folder() / _name_module_folder(module)


@cache
def _name_module_folder(module: str) -> str:
    return f"{module}-{compute_source_digest(module)}"


@cache
def compute_source_digest(module: str) -> str:
    """Return a digest of the sources of a module and of all modules that it imports, and of Numba's version."""
    found: dict[str, bytes] = {}
    remaining = [module]
    while remaining:
        name = remaining.pop()
        if name not in found and (source := _read_source(name)):
            found[name] = source[0]
            remaining += source[1]
    return _compute_digest(b"\0".join([numba.__version__.encode(), *(found[name] for name in sorted(found))]))


@cache
def _read_source(module: str) -> tuple[bytes, list[str]] | None:
    """Return the source of a module of the package and the names of what it imports; None if it is none.

    The package itself, whose imports are deferred, is none.
    """
    path = PACKAGE_FOLDER.parent.joinpath(*module.split("."))
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    if module == PACKAGE_FOLDER.name or not path.is_file():
        return None
    source = path.read_bytes()
    imported = [module.rpartition(".")[0]]
    for origin, names in IMPORT_PATTERN.findall(source.decode("utf-8")):
        imported += [origin, *(f"{origin}.{name}" for name in re.findall(r"\w+", names))]
    return source, imported


@cache
def compute_kernels_digest() -> str:
    """Return a digest of all kernels' sources and of the list of those that are compiled first."""
    files = sorted([*KERNELS_FOLDER.rglob("*.py"), *KERNELS_FOLDER.glob("*.json")])
    return _compute_digest(b"\0".join([numba.__version__.encode(), *(file.read_bytes() for file in files)]))


def _compute_digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:DIGEST_LENGTH]


def remove_outdated_folders(cache_folder: Path) -> None:
    """Remove what earlier versions of this installation's kernels have left in a cache folder."""
    for folder in cache_folder.glob("mocapfix.*-*"):
        module = folder.name.rpartition("-")[0]
        if folder.name != _name_module_folder(module):
            shutil.rmtree(folder, ignore_errors=True)
    for file in KERNELS_FOLDER.rglob("*.nb[ic]"):  # Numba's own cache, which earlier versions used
        if file.parent.name != "__pycache__":
            continue
        with suppress(OSError):
            file.unlink()


ENVIRONMENT_PREFIX = "_ZN08NumbaEnv"  # of the names of Numba's variables that refer to a function's environment


class DeferredCodeLibrary(JITCodeLibrary):
    """The code of a compiled function and of those that it calls; machine code once an address is asked for."""

    _intermediate_code = b""  # if it comes from the cache, with machine code
    _is_loaded = False  # whether the execution engine has the machine code

    def get_pointer_to_function(self, name: str) -> int:
        """Return the address of a function in this library, 0 if it has none of this name."""
        self._ensure_finalized()
        if not self._is_loaded and self._defines(name):
            super()._optimize_final_module()
            self._load()
            self._set_environments()
        return super().get_pointer_to_function(name) if self._is_loaded else 0

    def serialize_using_object_code(self) -> tuple:
        """Return what is cached: without machine code if there is none."""
        self._ensure_finalized()
        if not self._is_loaded:
            return self.serialize_using_bitcode()
        name, kind, data = super().serialize_using_object_code()
        module = self._get_module_for_linking()
        symbols = [each.name for each in (*module.functions, *module.global_variables) if not each.is_declaration]
        return name, kind, (*data, symbols)

    @classmethod
    def _unserialize(cls, codegen: Any, state: tuple) -> "DeferredCodeLibrary":
        """Return the library of what is cached. The intermediate code beside machine code is read once it is needed."""
        name, kind, data = state
        if kind != "object":
            return super()._unserialize(codegen, state)
        library = codegen.create_library(name)
        machine_code, library._intermediate_code, symbols = data
        library.enable_object_caching()
        library._set_compiled_object(machine_code)
        library._finalize_final_module()
        codegen._engine._defined_symbols.update(symbols)
        return library

    def _get_module_for_linking(self) -> Any:
        """Return the intermediate code for a caller's library."""
        if self._intermediate_code:
            self._shared_module, self._intermediate_code = parse_bitcode(self._intermediate_code), b""
        return super()._get_module_for_linking()

    def _optimize_final_module(self) -> None:
        """Do nothing: `finalize` calls this too early."""

    def _finalize_final_module(self) -> None:
        """Load machine code from the cache if there is any; called when the code is complete."""
        if self._object_caching_enabled and self._compiled_object is not None:
            self._load()
        else:
            self._finalize_dynamic_globals()
            self._finalized = True

    def _load(self) -> None:
        self._dynamic_globals = []
        super()._finalize_final_module()
        self._is_loaded = True

    def _defines(self, name: str) -> bool:
        try:
            return not self._final_module.get_function(name).is_declaration
        except NameError:
            return False

    def _set_environments(self) -> None:
        """Set the environments of the functions whose code is copied into this library."""
        for variable in self._final_module.global_variables:
            if variable.name.startswith(ENVIRONMENT_PREFIX) and (environment := lookup_environment(variable.name)):
                self._codegen.set_env(variable.name, environment)  # pyright: ignore[reportAttributeAccessIssue]


@contextmanager
def defer_machine_code() -> Generator[None]:
    """Let Numba use `DeferredCodeLibrary` for what it compiles, or loads from its cache, within this context."""
    with global_compiler_lock:
        context: Any = cpu_target.target_context
        generator = context.codegen()
        outer = {name: generator.__dict__[name] for name in ("_library_class", "set_env") if name in generator.__dict__}
        set_environment = type(generator).set_env

        def set_environment_if_loaded(name, environment):
            if generator._engine.is_symbol_defined(name):
                set_environment(generator, name, environment)

        generator._library_class, generator.set_env = DeferredCodeLibrary, set_environment_if_loaded
        try:
            yield
        finally:
            del generator._library_class, generator.set_env
            generator.__dict__.update(outer)
