"""Running compiled loops over frames on every core.

The kernels release the interpreter's lock. Each thread takes a block of frames and writes only there, so the result does not
depend on the number of threads. (Numba's own parallel loops do the same but take several times as long to compile.)
"""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from typing import TypeVar

Part = TypeVar("Part")

BLOCKS_PER_CORE = 4  # so that cores that finish early take over blocks from others


def count_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_over_frames(kernel: Callable[..., None], frames: int, *arguments: object) -> None:
    """Call kernel(*arguments, first, stop) on blocks that together cover the frames 0..frames - 1."""
    block = max(1, -(-frames // (BLOCKS_PER_CORE * count_cores())))
    run_in_parallel(lambda first: kernel(*arguments, first, min(first + block, frames)), range(0, frames, block))


def run_in_parallel(function: Callable[[Part], None], parts: Iterable[Part]) -> None:
    """Call a function that mostly runs without the interpreter's lock on each part, on as many threads as there are cores."""
    pool = get_thread_pool(count_cores())
    running = [pool.submit(function, part) for part in parts]
    wait(running)  # for all, before an error in one is raised
    for each in running:
        each.result()


@cache
def get_thread_pool(workers: int) -> ThreadPoolExecutor:
    """Return the threads, which are kept: starting them takes as long as solving a window of frames."""
    return ThreadPoolExecutor(workers)
