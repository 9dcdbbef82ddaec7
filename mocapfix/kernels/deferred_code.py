"""Machine code for the kernels that Python calls, and for no others.

Numba optimises each function that it compiles, turns it into machine code, copies it into the code of every function that calls
it, and optimises it there again. Of a kernel that only other kernels call, the machine code is never run. Here a function is
optimised and turned into machine code when its address is asked for, that is, if Python calls it; what it calls is copied into
it as Numba first wrote it. This halves the time of compilation.

It holds for the kernels and for what of Numba's own they call; other compiled functions of the process are not affected.
"""

from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

from llvmlite.binding import parse_bitcode
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler_lock import global_compiler_lock
from numba.core.environment import lookup_environment
from numba.core.registry import cpu_target

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
