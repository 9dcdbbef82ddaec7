"""Cleaning that hangs, grows or crashes for takes of certain names, by which the limits of batches are tested."""

import ctypes
import time
from pathlib import PurePosixPath

import numpy as np

from mocapfix.batch.jobs import CleanRequest, clean_recorded_take
from mocapfix.batch.records import TakeRecord

FAULTY_FUNCTION = "mocapfix.bench.batch_faults:clean_with_faults"
GROWTH_STEP_MB = 20.0
GROWTH_MB = 10_000.0
HANG_S = 3600.0


def clean_with_faults(request: CleanRequest) -> TakeRecord:
    """Clean a take, unless its name begins with "hang", "grow" or "crash"."""
    name = PurePosixPath(request.take).name
    for prefix, fault in FAULTS.items():
        if name.startswith(prefix):
            fault()
    return clean_recorded_take(request)


def hang() -> None:
    """Do nothing for an hour."""
    time.sleep(HANG_S)


def grow() -> None:
    """Use 10 GB of memory."""
    blocks = [np.ones(int(GROWTH_STEP_MB * 1e6 / 8)) for _ in range(int(GROWTH_MB / GROWTH_STEP_MB))]
    time.sleep(len(blocks))


def crash() -> None:
    """End the process by a segmentation fault."""
    ctypes.string_at(0)


def fail() -> None:
    """Raise an error that mocapfix does not explain."""
    raise ValueError("a value")


def give_number() -> int:
    """Return a number."""
    return 42


def use_memory() -> None:
    """Use 350 MB for a moment."""
    np.ones(int(350e6 / 8))


def hold_memory() -> None:
    """Use 500 MB and never release it."""
    _held.append(np.ones(int(500e6 / 8)))


_held: list[np.ndarray] = []
FAULTS = {"hang": hang, "grow": grow, "crash": crash}
