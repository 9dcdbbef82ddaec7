"""Duration, processor time and peak memory of a command, each with commands whose usage is known."""

import os
import sys

import pytest

from mocapfix.lab.clean_speed import run_measured

ALLOCATE = "import sys; block = b'x' * (int(sys.argv[1]) << 20)"  # MiB, all of them written


def measure(code: str, *arguments: str):
    return run_measured((sys.executable, "-I", "-S", "-c", code, *arguments), os.environ)


def test_sleep_takes_time_but_no_processor_time():
    usage = measure("import time; time.sleep(1.0)")
    assert usage.duration_s >= 1.0
    assert usage.cpu_s < 0.5


def test_processor_time_of_threads_and_children_is_counted():
    spin = "import time; end = time.process_time() + 0.5\nwhile time.process_time() < end: pass"
    usage = measure(f"import subprocess, sys; subprocess.run([sys.executable, '-I', '-S', '-c', {spin!r}])\n{spin}")
    assert usage.cpu_s >= 1.0


def test_peak_memory_is_that_of_the_command_and_not_of_the_process_that_starts_it():
    block = b"x" * (400 << 20)
    small, large = measure(ALLOCATE, "1"), measure(ALLOCATE, "201")
    assert len(block) == 400 << 20
    assert large.peak_mb - small.peak_mb == pytest.approx(200, abs=10)
    assert small.peak_mb < 100


def test_a_failed_command_is_reported_with_its_output():
    with pytest.raises(RuntimeError, match=r"(?s)status 3.*the reason"):
        measure("import sys; print('the reason'); sys.exit(3)")
