"""Jobs in child processes: results, errors, limits and crashes, and children that end with their worker."""

import subprocess
import sys
import time
from collections.abc import Generator
from math import inf

import psutil
import pytest

from mocapfix.batch import child_process
from mocapfix.batch.child_process import ACCESS_VIOLATION, ChildProcess, JobLimits, JobOutcome, describe_crash
from mocapfix.errors import MocapfixError

FAULTS = "mocapfix.lab.batches"
LIMITS = JobLimits(timeout_s=60.0, memory_mb=4000.0)


@pytest.fixture(scope="module")
def child() -> Generator[ChildProcess]:
    """Return a child for jobs after which it can run another."""
    child = ChildProcess("builtins:dict")
    yield child
    child.close()


def run_in_new_child(function: str, limits: JobLimits = LIMITS) -> tuple[ChildProcess, JobOutcome]:
    child = ChildProcess("builtins:dict")
    outcome = child.run(f"{FAULTS}:{function}", {}, limits)
    child.close()
    return child, outcome


def test_result_of_a_job_is_returned(child: ChildProcess) -> None:
    outcome = child.run(f"{FAULTS}:give_number", {}, LIMITS)
    assert (outcome.status, outcome.value, outcome.error) == ("done", 42, "")


def test_limits_may_be_infinite(child: ChildProcess) -> None:
    assert child.run("builtins:dict", {"a": 1}, JobLimits(inf, inf)).value == {"a": 1}


def test_what_a_job_prints_does_not_disturb_its_result(child: ChildProcess) -> None:
    assert child.run("builtins:print", {}, LIMITS).status == "done"
    assert child.run("subprocess:call", {"args": [sys.executable, "-c", "print(1)"]}, LIMITS).value == 0
    assert child.run("os:getpid", {}, LIMITS).value == child.process_id


def test_unexplained_error_is_one_sentence_with_its_place_and_the_child_goes_on(child: ChildProcess) -> None:
    outcome = child.run(f"{FAULTS}:fail", {}, LIMITS)
    assert outcome.status == "error"
    assert f"{FAULTS.rpartition('.')[2]}.py" in outcome.error
    assert "ValueError: a value" in outcome.error
    assert child.is_usable
    assert child.run("os:getpid", {}, LIMITS).value == child.process_id


def test_result_that_cannot_be_sent_is_an_error(child: ChildProcess) -> None:
    assert child.run("threading:Lock", {}, LIMITS).status == "error"


def test_job_that_hangs_is_ended() -> None:
    child, outcome = run_in_new_child("hang", JobLimits(timeout_s=0.5))
    assert (outcome.status, child.is_usable) == ("timeout", False)
    assert outcome.seconds < 2.5
    assert "--timeout" in outcome.error


def test_job_that_grows_is_ended() -> None:
    child, outcome = run_in_new_child("grow", JobLimits(memory_mb=300.0))
    assert (outcome.status, child.is_usable) == ("memory", False)
    assert 300 < outcome.peak_memory_mb < 2000


def test_job_that_crashes_is_explained() -> None:
    child, outcome = run_in_new_child("crash")
    assert (outcome.status, child.is_usable) == ("crash", False)
    assert ("access violation" if sys.platform == "win32" else "segmentation fault") in outcome.error


def test_child_that_holds_much_memory_is_not_used_again() -> None:
    child = ChildProcess("builtins:dict")
    child.run(f"{FAULTS}:give_number", {}, LIMITS)
    assert child.is_usable
    assert child.run(f"{FAULTS}:hold_memory", {}, LIMITS).status == "done"
    assert not child.is_usable
    child.close()


def test_another_child_takes_the_place_of_one_that_was_killed() -> None:
    def run(function: str) -> JobOutcome:
        return child_process.run_in_child(function, {}, LIMITS, "builtins:dict")

    first = run("os:getpid").value
    assert isinstance(first, int)
    assert run("os:getpid").value == first
    psutil.Process(first).kill()
    outcomes = [run("os:getpid") for _ in range(2)]
    assert [each.status for each in outcomes] == ["crash", "done"]
    assert outcomes[1].value != first
    assert run(f"{FAULTS}:crash").status == "crash"


def test_peak_memory_is_that_of_the_job_alone(child: ChildProcess) -> None:
    large = child.run(f"{FAULTS}:use_memory", {}, LIMITS).peak_memory_mb
    small = child.run(f"{FAULTS}:give_number", {}, LIMITS).peak_memory_mb
    assert large - small > 250


WORKER = f"""
from mocapfix.batch.child_process import ChildProcess, JobLimits
child = ChildProcess("builtins:dict")
print(child.process_id, flush=True)
child.run("subprocess:call", {{"args": [{sys.executable!r}, "-c", "import time; time.sleep(60)"]}}, JobLimits())
"""


def test_child_ends_with_its_worker_and_ends_what_it_started() -> None:
    worker = subprocess.Popen([sys.executable, "-c", WORKER], stdout=subprocess.PIPE)
    assert worker.stdout
    child = psutil.Process(int(worker.stdout.readline()))
    deadline = time.monotonic() + 20
    while not child.children() and time.monotonic() < deadline:
        time.sleep(0.02)
    started = [child, *child.children()]
    assert len(started) > 1
    worker.kill()
    worker.wait()
    _, alive = psutil.wait_procs(started, timeout=5)
    assert not alive


def test_child_that_cannot_start_is_one_sentence() -> None:
    with pytest.raises(MocapfixError, match=r"could not be started on .*; check that mocapfix is installed there"):
        ChildProcess("os:abort")


@pytest.mark.parametrize(
    ("status", "words"),
    [
        (-9, "SIGKILL"),
        (-11, "segmentation fault"),
        (-99, "signal 99"),
        (1, "status 1"),
        (ACCESS_VIOLATION, "access violation"),
    ],
)
def test_ends_without_a_reply_are_named(status: int, words: str) -> None:
    assert words in describe_crash(status)
