"""Running a compiled loop over frames on every core.

The kernels release the interpreter's lock; each thread takes a block of frames and writes only there, so the result does
not depend on their number. (Numba's own parallel loops do the same but take several times as long to compile.)
"""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from typing import Any


def count_cores() -> int:
    """-> how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_over_frames(kernel: Callable[..., None], frames: int, *arguments: object) -> None:
    """Call kernel(*arguments, first, stop) on blocks that together make up 0..frames."""
    workers = count_cores()
    size = max(1, -(-frames // (4 * workers)))
    run_in_parallel(lambda a: kernel(*arguments, a, min(a + size, frames)), range(0, frames, size))


def run_in_parallel(function: Callable[[Any], None], parts: Iterable[Any]) -> None:
    """Call a function that mostly works without the interpreter's lock on each part, as many at once as there are cores."""
    running = [get_thread_pool(count_cores()).submit(function, part) for part in parts]
    wait(running)  # all of them, before an error in one is told
    for each in running:
        each.result()


@cache
def get_thread_pool(workers: int) -> ThreadPoolExecutor:
    """-> the threads, kept: to start them takes as long as a window of frames."""
    return ThreadPoolExecutor(workers)
