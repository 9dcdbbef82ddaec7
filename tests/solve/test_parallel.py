"""Blocks of frames on every core."""

import os

import numpy as np
import pytest

from mocapfix.solve.parallel import run_over_frames


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
