"""Run compiled loops over frames in parallel threads, in an order that keeps dependent frames together, and whole functions in
parallel processes.

The kernels release the interpreter's lock. Each thread takes a block of frames and writes only there, so the result does not
depend on the number of threads. (Numba's own parallel loops do the same but take several times as long to compile.)
"""

import io
import os
import pickle
import signal
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from functools import cache
from typing import Any, BinaryIO, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Bool, Int

from mocapfix.errors import MocapfixError
from mocapfix.kernels.compilation import THREADS_VARIABLE, count_cores


class SolveOrder(NamedTuple):
    """Chains of frames; the frames of a chain are solved one after the other, the chains in parallel."""

    frames: Int[np.ndarray, " N"]  # chain after chain
    start_frame: Int[np.ndarray, " N"]  # the frame whose pose each starts from; -1 for its own
    copied_joints: Bool[np.ndarray, "one_or_T J"]  # joints copied from there; the root with its position
    chain_starts: Int[np.ndarray, " starts"]  # index of each chain's first entry in `frames`, and the end


def order_independently(frames: Int[np.ndarray, " N"], joints: int) -> SolveOrder:
    """Return the order in which each of some frames starts from its own pose."""
    return SolveOrder(frames, np.full(len(frames), -1), np.zeros((1, joints), bool), np.arange(len(frames) + 1))


def order_sequentially(has_own_pose: Bool[np.ndarray, " T"], joints: int) -> SolveOrder:
    """Return the order in which a frame with a pose of its own starts from that, and any other from the frame before.

    The first frame must have a pose of its own.
    """
    frames = np.arange(len(has_own_pose))
    start_frame = np.where(has_own_pose, -1, frames - 1)
    chain_starts = np.r_[np.flatnonzero(has_own_pose), len(has_own_pose)]
    return SolveOrder(frames, start_frame, np.ones((1, joints), bool), chain_starts)


def order_from_gap_ends(gaps: list[tuple[int, int]], uncertain_joints: Bool[np.ndarray, "T J"]) -> SolveOrder:
    """Return the order that solves `gaps` (first, last) from both ends to the middle, each frame from its outer neighbour.

    Joints that are uncertain start from the neighbour's rotations; the others, and the root, from their own. So where markers
    leave two poses possible, as for a thigh without its knee, the continuous one is found. A gap at the take's beginning or end
    has one end only. If a gap covers all frames, the first frame is its end, and is not solved again.
    """
    frames: list[int] = []
    start_frame: list[int] = []
    chain_starts, last_frame = [0], len(uncertain_joints) - 1
    for first, last in gaps:
        gap = range(first, last + 1)
        if first == 0 and last == last_frame:
            steps = [(t, t - 1) for t in gap[1:]]
        elif first == 0:
            steps = [(t, t + 1) for t in gap[::-1]]
        elif last == last_frame:
            steps = [(t, t - 1) for t in gap]
        else:
            half = (len(gap) + 1) // 2
            forward, backward = [(t, t - 1) for t in gap[:half]], [(t, t + 1) for t in gap[half:][::-1]]
            pairs = zip(forward, [*backward, None], strict=False)
            steps = [step for pair in pairs for step in pair if step is not None]
        frames += [t for t, _ in steps]
        start_frame += [s for _, s in steps]
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


def map_in_processes(
    function: Callable[[Part], Value], parts: Iterable[Part], shared: Sequence[object] = ()
) -> Generator[Value, None, None]:
    """Yield function(part) of each part in order, computed in as many processes at a time as there are cores.

    A process is a copy of this one, in which compiled loops have one thread; only its result is sent. So the function can use
    whatever is in memory, and what it changes there is lost. Processes that are not needed because the caller stops are ended.
    On one core, of one part, in a thread, and where a system has no safe copies, the function is called here for one part after
    the other.

    Args:
        function: What to compute.
        parts: Its arguments.
        shared: Objects that a result may contain, which are not sent.

    Raises:
        MocapfixError: If a process was ended by the system.
        Exception: Whatever the function raises.
    """
    remaining, workers = list(parts), count_cores()
    if min(workers, len(remaining)) < 2 or sys.platform != "linux" or threading.current_thread() is not threading.main_thread():
        yield from map(function, remaining)
        return
    remaining.reverse()
    running = deque[_Child]()
    try:
        while remaining or running:
            while remaining and len(running) < workers:
                running.append(_Child.start(function, remaining.pop(), shared))
            yield running[0].receive(shared)
            running.popleft().end()
    finally:
        for each in running:
            each.end()


class _Child(NamedTuple):
    """A process that computes one value, and the pipe from it."""

    process: int
    replies: BinaryIO

    @classmethod
    def start(cls, function: Callable[[Part], object], part: Part, shared: Sequence[object]) -> "_Child":
        """Copy this process; the copy computes the value, sends it and ends."""
        source, target = os.pipe()
        process = os.fork()
        if process:
            os.close(target)
            return cls(process, os.fdopen(source, "rb"))
        try:
            os.close(source)
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # this process ends its copies
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            os.environ[THREADS_VARIABLE] = "1"
            get_thread_pool.cache_clear()  # a copy has no threads
            try:
                reply = _dump((True, function(part)), shared)
            except BaseException as error:
                error.add_note(traceback.format_exc())
                try:
                    reply = pickle.dumps((False, error))
                    pickle.loads(reply)
                except Exception:  # the error cannot be sent
                    reply = pickle.dumps((False, RuntimeError(repr(error))))
            with os.fdopen(target, "wb") as stream:
                stream.write(reply)
        finally:
            os._exit(0)

    def receive(self, shared: Sequence[object]) -> Any:
        """Return the value, or raise what was raised."""
        try:
            is_value, value = _load(self.replies, shared)
        except (EOFError, pickle.UnpicklingError):
            problem = "A process of this take was ended by the system; there may be too little memory"
            raise MocapfixError(f"{problem}. Set {THREADS_VARIABLE}=1 to use one process.") from None
        if not is_value:
            raise value
        return value

    def end(self) -> None:
        """End the process if it still runs."""
        self.replies.close()
        with suppress(ProcessLookupError):
            os.kill(self.process, signal.SIGKILL)
        with suppress(ChildProcessError):
            os.waitpid(self.process, 0)


def _dump(value: object, shared: Sequence[object]) -> memoryview:
    """Return a pickle in which shared objects are numbers."""
    number = {id(each): n for n, each in enumerate(shared)}

    class Pickler(pickle.Pickler):
        def persistent_id(self, obj: Any) -> int | None:
            return number.get(id(obj))

    stream = io.BytesIO()
    Pickler(stream, pickle.HIGHEST_PROTOCOL).dump(value)
    return stream.getbuffer()


def _load(stream: BinaryIO, shared: Sequence[object]) -> Any:
    class Unpickler(pickle.Unpickler):
        def persistent_load(self, pid: int) -> object:
            return shared[pid]

    return Unpickler(stream).load()
