"""Blocks of frames on every core, and functions in several processes."""

import os
import signal
import sys
import threading

import numpy as np
import pytest

from mocapfix.errors import MocapfixError, OptionError, TakeError
from mocapfix.kernels.compilation import count_cores
from mocapfix.solve.parallel import map_in_processes, run_over_frames


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


needs_copies = pytest.mark.skipif(sys.platform != "linux", reason="processes are copied on Linux only")


def test_values_come_in_the_order_of_their_parts(cores):
    base = np.arange(1000.0)
    values = list(map_in_processes(lambda part: base * part, range(7)))
    assert len(values) == 7
    for part, value in enumerate(values):
        np.testing.assert_array_equal(value, base * part)
    assert list(map_in_processes(lambda part: part, [])) == []


def test_shared_objects_are_not_sent(cores):
    shared = [np.arange(5), np.arange(6)]
    values = list(map_in_processes(lambda part: {"own": shared[part], "other": shared[part].copy()}, range(2), shared))
    assert [value["own"] is shared[part] for part, value in enumerate(values)] == [True, True]
    np.testing.assert_array_equal(values[1]["other"], shared[1])


@pytest.mark.parametrize("error", [TakeError("take.c3d: has no body."), KeyError("x"), MemoryError()])
def test_errors_come_after_the_values_before_them(cores, error):
    def fail_at_two(part):
        if part == 2:
            raise error
        return part

    values = map_in_processes(fail_at_two, range(5))
    assert [next(values), next(values)] == [0, 1]
    with pytest.raises(type(error)) as raised:
        next(values)
    assert str(raised.value) == str(error)


@needs_copies
@pytest.mark.parametrize("cores", [3], indirect=True)
def test_processes_are_ended_when_the_caller_stops(cores):
    values = map_in_processes(lambda part: (part, os.getpid(), count_cores(), signal.pause() if part else None), range(9))
    part, process, threads, _ = next(values)
    assert (part, threads) == (0, 1)
    assert process != os.getpid()
    assert count_cores() == 3
    values.close()  # the others would wait for ever
    with pytest.raises(ChildProcessError):
        os.waitpid(-1, os.WNOHANG)


@needs_copies
@pytest.mark.parametrize("cores", [3], indirect=True)
def test_a_process_that_ends_and_an_error_that_cannot_be_sent_are_errors(cores):
    with pytest.raises(MocapfixError, match="MOCAPFIX_NUM_THREADS=1"):
        list(map_in_processes(lambda part: os.kill(os.getpid(), signal.SIGKILL), range(2)))

    def fail(part):
        raise OptionError("prior", "--prior", "solve.prior", "must be a name")

    with pytest.raises(RuntimeError, match="must be a name"):
        list(map_in_processes(fail, range(2)))


@pytest.mark.parametrize("cores", [3], indirect=True)
def test_threads_do_not_copy_the_process(cores):
    processes: list[int] = []
    thread = threading.Thread(target=lambda: processes.extend(map_in_processes(lambda part: os.getpid(), range(3))))
    thread.start()
    thread.join()
    assert processes == [os.getpid()] * 3
