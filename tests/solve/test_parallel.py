"""Blocks of frames on every core, functions in several threads, and work in a second process."""

import math
import os
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor, wait

import numpy as np
import pytest

from mocapfix.errors import TakeError
from mocapfix.solve.parallel import (
    compute_beside,
    map_in_threads,
    run_over_frames,
    second_process,
    start_second_process,
)


@pytest.mark.parametrize("frames", [1, 2, 7, 8, 9, 100])
@pytest.mark.parametrize("cores", [1, 2, 3])
def test_blocks_cover_all_frames_once(monkeypatch, frames, cores):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)), raising=False)
    visits = np.zeros(frames, int)

    def visit(first, stop):
        visits[first:stop] += 1

    run_over_frames(visit, frames)
    np.testing.assert_array_equal(visits, 1)


def test_error_in_a_thread_is_raised():
    def fail(first, stop):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run_over_frames(fail, 3)


@pytest.fixture(params=[1, 3])
def cores(request, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(request.param)), raising=False)
    monkeypatch.delenv("MOCAPFIX_NUM_THREADS", raising=False)
    return request.param


def test_values_come_in_the_order_of_their_parts(cores):
    base = np.arange(1000.0)
    values = list(map_in_threads(lambda part: base * part, range(7)))
    assert len(values) == 7
    for part, value in enumerate(values):
        np.testing.assert_array_equal(value, base * part)
    assert list(map_in_threads(lambda part: part, [])) == []


@pytest.mark.parametrize("error", [TakeError("take.c3d: has no body."), KeyError("x"), MemoryError()])
def test_errors_come_after_the_values_before_them(cores, error):
    def fail_at_two(part):
        if part == 2:
            raise error
        return part

    values = map_in_threads(fail_at_two, range(5))
    assert [next(values), next(values)] == [0, 1]
    with pytest.raises(type(error)) as raised:
        next(values)
    assert raised.value is error


@pytest.mark.parametrize("cores", [3], indirect=True)
def test_as_many_parts_run_at_a_time_as_there_are_cores(cores):
    barrier = threading.Barrier(cores)
    assert list(map_in_threads(lambda part: barrier.wait(timeout=10) is not None, range(6))) == [True] * 6


@pytest.mark.parametrize("cores", [3], indirect=True)
def test_parts_that_have_not_begun_are_left_out_when_the_caller_stops(cores):
    begun, stopped = [], threading.Event()

    def begin(part):
        begun.append(part)
        return part if part == 0 else stopped.wait(10)

    values = map_in_threads(begin, range(9))
    assert next(values) == 0
    values.close()
    stopped.set()
    assert len(begun) <= cores + 1


@pytest.mark.parametrize("cores", [3], indirect=True)
def test_settings_of_the_caller_hold_in_the_threads(cores):
    with np.errstate(divide="raise"), pytest.raises(FloatingPointError):
        list(map_in_threads(lambda part: np.ones(1) / part, range(2)))


def test_work_is_done_in_the_second_process_and_here_when_that_has_ended():
    with start_second_process("mocapfix.errors"):
        here, begun = os.getpid(), compute_beside(os.getpid)
        assert begun.future
        other = begun.future.result()
        assert begun.finish() == other != here
        np.testing.assert_array_equal(compute_beside(np.diff, np.eye(4), axis=0).finish(), np.diff(np.eye(4), axis=0))
        with pytest.raises(ValueError, match="math domain"):
            compute_beside(math.sqrt, -1.0).finish()
        [future] = map_in_threads(lambda _: compute_beside(os.getpid).future, range(1))
        assert future
        wait([future])
        begun = [compute_beside(time.sleep, 0.1), compute_beside(os.getpid)]
        os.kill(other, signal.SIGTERM)
        assert [each.finish() for each in begun] == [None, here]
        assert compute_beside(os.getpid).finish() == here
    assert compute_beside(os.getpid).finish() == here


def compute_in_the_main_thread() -> str:
    if threading.current_thread() is not threading.main_thread():
        raise MemoryError
    return "here"


def test_work_is_done_here_for_which_the_second_process_lacks_memory():
    with ThreadPoolExecutor(1) as other:
        token = second_process.set(other)
        assert compute_beside(compute_in_the_main_thread).finish() == "here"
        busy, unneeded = compute_beside(time.sleep, 0.1), compute_beside(compute_in_the_main_thread)
        unneeded.leave()
        assert busy.future
        assert busy.future.done()
        second_process.reset(token)


class ChangedWhilePickled:
    """An object to which another thread adds a cached property each of the first times that it is pickled."""

    def __init__(self, times: int) -> None:
        self.times = times

    def __getstate__(self) -> dict[str, int]:
        self.times -= 1
        if self.times >= 0:
            raise RuntimeError("dictionary changed size during iteration")
        return {"times": self.times}


@pytest.mark.parametrize(("times", "is_sent"), [(0, True), (3, True), (1000, False)])
def test_an_argument_that_changes_while_it_is_pickled_is_sent_again_or_used_here(times, is_sent):
    with ThreadPoolExecutor(1) as other:
        token = second_process.set(other)
        begun = compute_beside(isinstance, ChangedWhilePickled(times), ChangedWhilePickled)
        assert (begun.future is not None, begun.finish()) == (is_sent, True)
        second_process.reset(token)
