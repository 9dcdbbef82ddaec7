"""Run the command line as a process: `python -m mocapfix`, or `mocapfix`."""

import ctypes
import gc
import os
import sys
from importlib.machinery import ModuleSpec
from types import ModuleType

ALLOCATOR_PARAMETERS = {-8: 1, -3: 4 << 20, -1: 256 << 20}  # of glibc: heaps, bytes of a large array, of memory that a heap keeps


class UncheckedShapes(ModuleType):
    """Stands for jaxtyping: only tests and type checkers read shapes, and the library takes a tenth of the start to import."""

    def __getattr__(self, name: str) -> "UncheckedShapes":
        if name.startswith("__"):  # what libraries ask of every module, such as its file
            raise AttributeError(name)
        return self

    def __getitem__(self, annotation: tuple[type, str]) -> type:
        return annotation[0]


if "jaxtyping" not in sys.modules:  # in the second process too, which runs this module first
    sys.modules["jaxtyping"] = UncheckedShapes("jaxtyping")
    sys.modules["jaxtyping"].__spec__ = ModuleSpec("jaxtyping", None)


def main() -> None:
    """Run the command line with BLAS on one thread, one heap and without garbage collection.

    The matrices are small, and the kernels distribute frames over the cores: threads of BLAS would only wait for each other. BLAS
    reads the environment when it is loaded, hence before any import. The garbage collector would take half a second to search the
    objects of the libraries for reference cycles, of which there are none worth freeing in a short process. What one thread has
    released is used again by the others if all have one heap: with one heap each, a minute of motion takes 100 MB more. Arrays
    of 4 MB or more, such as the positions of its markers, are outside of it and leave no holes in it: these were 100 MB more.
    """
    for library in ("OPENBLAS", "OMP", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")  # Numba words many errors that it never shows
    # rerun logs that it cannot write a file; the command says so in a sentence of its own
    os.environ.setdefault("RUST_LOG", "warn,re_log_encoding=off,re_sdk=off")
    gc.disable()
    if set_parameter := getattr(ctypes.pythonapi, "mallopt", None):  # glibc has it
        for parameter, value in ALLOCATOR_PARAMETERS.items():
            set_parameter(parameter, value)
    from mocapfix.cli import app

    try:
        app.run_command_line()
    finally:
        gc.freeze()


if __name__ == "__main__":
    main()
