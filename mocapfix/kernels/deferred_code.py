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

from numba.core.codegen import JITCodeLibrary
from numba.core.compiler_lock import global_compiler_lock
from numba.core.environment import lookup_environment
from numba.core.registry import cpu_target

ENVIRONMENT_PREFIX = "_ZN08NumbaEnv"  # of the names of Numba's variables that refer to a function's environment


class DeferredCodeLibrary(JITCodeLibrary):
    """The code of a compiled function and of those that it calls; machine code once an address is asked for."""

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
        return super().serialize_using_object_code() if self._is_loaded else self.serialize_using_bitcode()

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
