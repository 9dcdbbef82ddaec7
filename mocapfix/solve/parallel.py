"""Run compiled loops over frames in parallel threads, in an order that keeps dependent frames together, and whole functions.

The kernels release the interpreter's lock. Each thread takes a block of frames and writes only there, so the result does not
depend on the number of threads. (Numba's own parallel loops do the same but take several times as long to compile.)

Work that holds the lock is shared with a second process, if the command has started one: `start_second_process` starts it,
`compute_beside` gives it work. Without it, or when it has ended, the same work is done in this process.
"""

import gc
import os
import pickle
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from contextvars import ContextVar, copy_context
from functools import cache, partial
from importlib import import_module
from multiprocessing import get_context, parent_process
from typing import Any, Generic, NamedTuple, ParamSpec, TypeVar

import numpy as np
from jaxtyping import Bool, Int

from mocapfix.model.system import count_cores


class SolveOrder(NamedTuple):
    """Chains of frames; the frames of a chain are solved one after the other, the chains in parallel."""

    frames: Int[np.ndarray, " N"]  # chain after chain
    start_frame: Int[np.ndarray, " N"]  # the frame whose pose each starts from; -1 for its own
    copied_joints: Bool[np.ndarray, "one_or_T J"]  # joints copied from there; the root with its position
    chain_starts: Int[np.ndarray, " starts"]  # index of each chain's first entry in `frames`, and the end


def order_independently(frames: Int[np.ndarray, " N"], joints: int) -> SolveOrder:
    """Return the order in which each of some frames starts from its own pose."""
    return SolveOrder(frames, np.full(len(frames), -1), np.zeros((1, joints), bool), np.arange(len(frames) + 1))


def order_from_gap_ends(gaps: list[tuple[int, int]], uncertain_joints: Bool[np.ndarray, "T J"]) -> SolveOrder:
    """Return the order that solves `gaps` (first, last) from both ends to the middle, each frame from its outer neighbour.

    The halves of a gap are two chains: they start from frames beside the gap, and need nothing of one another.

    Joints that are uncertain start from the neighbour's rotations; the others, and the root, from their own. So where markers
    leave two poses possible, as for a thigh without its knee, the continuous one is found. A gap at the take's beginning or end
    has one end only. If a gap covers all frames, the first frame is its end, and is not solved again.
    """
    frames: list[int] = []
    start_frame: list[int] = []
    chain_starts, last_frame = [0], len(uncertain_joints) - 1
    for first, last in gaps:
        count = last - first + 1 if last == last_frame else 0 if first == 0 else (last - first + 2) // 2  # from the first end
        forward = range(max(first, 1), first + count)
        for chain, step in ((forward, -1), (range(last, first + count - 1, -1), 1)):
            if chain:
                frames += chain
                start_frame += [t + step for t in chain]
                chain_starts.append(len(frames))
    copied_joints = uncertain_joints.copy()
    copied_joints[:, 0] = False
    return SolveOrder(np.array(frames, int), np.array(start_frame, int), copied_joints, np.array(chain_starts))


Part = TypeVar("Part")

BLOCKS_PER_CORE = 4  # so that cores that finish early take over blocks from others


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


Value = TypeVar("Value")
second_process: ContextVar[Executor | None] = ContextVar("second_process", default=None)


def map_in_threads(
    function: Callable[[Part], Value], parts: Iterable[Part], *, is_shared: bool = False, most: int = sys.maxsize
) -> Generator[Value]:
    """Yield function(part) of each part in order, computed in as many threads at a time as there are cores.

    Half of the time of a clean passes in kernels, beside which the other threads run. Parts that have not begun when the caller
    stops are left out. Those that have begun do not delay the end of the program.

    Args:
        most: Threads at a time, at most, also with more cores.
        is_shared: Whether the second process takes the place of one thread. Function, parts and values can be pickled then.

    Raises:
        Exception: Whatever the function raises.
    """
    remaining = deque((part, Future[Value]()) for part in parts)
    futures = [future for _, future in remaining]
    if min(count_cores(), len(remaining)) < 2:
        yield from (function(part) for part, _ in remaining)
        return

    process = second_process.get() if is_shared else None

    def compute_beside_threads(part: Part) -> Value:
        with suppress(BrokenExecutor, MemoryError):
            if process:
                return _submit(process, partial(function, part)).result()
        return function(part)

    def compute_remaining(function: Callable[[Part], Value]) -> None:
        if process:
            second_process.set(None)
        while True:
            try:
                part, future = remaining.popleft()
            except IndexError:
                return
            try:
                future.set_result(function(part))
            except BaseException as error:  # it is raised where the value is awaited
                future.set_exception(error)

    try:
        for thread in range(min(count_cores(), len(remaining), most)):
            arguments = compute_remaining, function if thread else compute_beside_threads
            threading.Thread(target=copy_context().run, args=arguments, daemon=True).start()
        for each in futures:
            yield each.result()
    finally:
        remaining.clear()


Arguments = ParamSpec("Arguments")


class Computation(NamedTuple, Generic[Value]):
    """A value that the second process computes, or this one when it is asked for."""

    compute: Callable[[], Value]
    future: "Future[Value] | None"  # None without a second process

    def finish(self) -> Value:
        """Return the value. It is computed here without a second process, or if that has ended or lacks memory.

        Raises:
            Exception: Whatever the function raises.
        """
        if self.future:
            with suppress(BrokenExecutor, MemoryError):
                return self.future.result()
        return self.compute()

    def leave(self) -> None:
        """Wait until the second process has ended work on it: it is not needed any more."""
        wait([self.future] if self.future else [])


def compute_beside(
    function: Callable[Arguments, Value], *arguments: Arguments.args, **keywords: Arguments.kwargs
) -> Computation[Value]:
    """Begin function(*arguments) in the second process, if this thread and those that have started it know one.

    Args:
        function: One that a module defines by its name, by which it is sent. It does not change its arguments.
        arguments: Values that can be pickled; a megabyte takes about two milliseconds. They are not changed before it has ended.
        keywords: More of them, for parameters by name.
    """
    compute, future, process = partial(function, *arguments, **keywords), None, second_process.get()
    with suppress(BrokenExecutor, MemoryError):
        future = process and _submit(process, compute)
    return Computation(compute, future)


def _submit(process: Executor, compute: Callable[[], Value]) -> Future[Value]:
    """Send a call, pickled here; pickling fails while another thread adds a cached property to an argument, and is repeated."""
    for _ in range(100):
        with suppress(RuntimeError):
            call = pickle.dumps(compute, pickle.HIGHEST_PROTOCOL)
            break
    else:
        raise BrokenExecutor
    return process.submit(_call_pickled, call)


def _call_pickled(call: bytes) -> Any:
    return pickle.loads(call)()


@contextmanager
def start_second_process(*modules: str) -> Generator[None]:
    """Provide a second process for `compute_beside`. It ends with this one, however that ends.

    Args:
        modules: Those that it imports while this process does other things, in the order in which they will be needed.
    """
    process = ProcessPoolExecutor(1, get_context("spawn"), initializer=begin_second_process)
    for each in modules:
        process.submit(import_module, each)
    started = list(process._processes.values())  # pyright: ignore[reportPrivateUsage]  # public from Python 3.14 on
    token = second_process.set(process)
    try:
        yield
    finally:
        second_process.reset(token)
        for each in started:
            each.kill()
        process.shutdown(cancel_futures=True)


def begin_second_process() -> None:
    """End this process when the one that has started it ends, however it does, and not at an interrupt from the keyboard."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.disable()  # as in the first one
    if parent := parent_process():
        threading.Thread(target=lambda: (parent.join(), os._exit(0)), daemon=True).start()
