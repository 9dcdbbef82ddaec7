"""Every Python process with this folder in PYTHONPATH lacks what Windows lacks, and mocapfix gets the answers of Windows.

Python imports a module of this name when it starts, so this holds for workers and children too.
"""

import multiprocessing
import os
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from tempfile import gettempdir
from types import ModuleType

from mocapfix.model import system

MISSING_MODULES = ("fcntl", "grp", "pwd", "resource", "termios")
MISSING_FUNCTIONS = ("fork", "forkpty")


class RefusingFinder:
    """Refuses to import what Windows does not have."""

    @staticmethod
    def find_spec(name: str, _path: Sequence[str] | None = None, _target: ModuleType | None = None) -> None:
        """Raise ModuleNotFoundError for a module that Windows does not have."""
        if name in MISSING_MODULES:
            raise ModuleNotFoundError(f"No module named {name!r}: Windows has none", name=name)


def answer_as_windows() -> system.System:
    """Return what Windows is and has."""
    return system.System("win32", Path(gettempdir()), 259, True, False, (signal.SIGTERM,))


for each in ("filelock", "locket", "psutil"):  # what these libraries do on this system stands in for what they do on Windows
    with suppress(ImportError):
        import_module(each)
sys.meta_path.insert(0, RefusingFinder)
for each in MISSING_MODULES:
    sys.modules.pop(each, None)
for each in MISSING_FUNCTIONS:
    if hasattr(os, each):
        delattr(os, each)
multiprocessing.set_start_method("spawn", force=True)
system.get_system = answer_as_windows
