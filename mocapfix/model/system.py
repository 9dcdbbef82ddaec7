"""What the operating system is and has, and the names that files may have on every system.

`get_system` is the only place that asks; tests replace it to run the code for another system.
"""

import os
import re
import signal
import sys
from pathlib import Path
from typing import NamedTuple

# Names that Windows gives to devices, whatever follows the first dot.
DEVICE_NAMES = {"con", "prn", "aux", "nul", *(f"{port}{number}" for port in ("com", "lpt") for number in range(1, 10))}

THREADS_VARIABLE = "MOCAPFIX_NUM_THREADS"  # of the environment


class System(NamedTuple):
    """An operating system."""

    name: str  # "linux", "darwin" or "win32", as Python names it
    cache_folder: Path  # where programs of this user keep what they can compute again
    max_path_length: int  # characters of a path that all programs can open
    keeps_open_files: bool  # whether a file that a program has open cannot be replaced or removed
    has_signal_masks: bool  # whether a thread can block signals, and processes that it starts inherit this
    stop_signals: tuple[int, ...]  # the signals besides the interrupt by which the system asks a command to end


def get_system() -> System:
    """Return what this operating system is and has. Raises RuntimeError if the user has no home folder."""
    environment = os.environ
    if sys.platform == "win32":
        cache_folder = Path(environment.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
        stop_signals = (signal.SIGTERM, signal.SIGBREAK)  # the second when the window of the console is closed
        return System("win32", cache_folder, 259, True, False, stop_signals)
    if sys.platform == "darwin":
        return System("darwin", Path.home() / "Library" / "Caches", 1023, False, True, (signal.SIGTERM,))
    cache_folder = Path(environment.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return System("linux", cache_folder, 4095, False, True, (signal.SIGTERM,))


def count_cores() -> int:
    """Return the number of cores that this process may use, at most as many as the variable MOCAPFIX_NUM_THREADS says."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = os.environ.get(THREADS_VARIABLE, "")
    return max(1, min(cores, int(limit))) if limit.isdecimal() else cores


def make_file_name(text: str) -> str:
    """Return a text as a part of a file name: other characters than letters, digits, "_", "-", " " and "." become "_"."""
    return avoid_reserved_name(re.sub(r"[^\w. -]", "_", text))


def avoid_reserved_name(name: str) -> str:
    """Return the name of a file or folder such that Windows accepts it: not that of a device, no dot or space at its end."""
    name = re.sub(r"[. ]+$", lambda end: "_" * len(end[0]), name)
    return f"{name}_" if name.partition(".")[0].rstrip().casefold() in DEVICE_NAMES else name
