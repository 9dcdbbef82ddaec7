"""Jobs in child processes: results, errors, limits and crashes, and children that end with their server."""

import threading
import time
from collections.abc import Generator
from contextlib import suppress
from math import inf

import psutil
import pytest

from mocapfix.batch.child_process import ForkServer, JobLimits, describe_crash

FAULTS = "mocapfix.lab.batches"
LIMITS = JobLimits(timeout_s=60.0, memory_mb=4000.0)


@pytest.fixture(scope="module")
def server() -> Generator[ForkServer]:
    server = ForkServer(warm_up="")
    yield server
    server.close()


def test_result_of_a_job_is_returned(server: ForkServer) -> None:
    outcome = server.run(f"{FAULTS}:give_number", {}, LIMITS)
    assert (outcome.status, outcome.value, outcome.error) == ("done", 42, "")


def test_limits_may_be_infinite(server: ForkServer) -> None:
    assert server.run("builtins:dict", {"a": 1}, JobLimits(inf, inf)).value == {"a": 1}


def test_unexplained_error_is_one_sentence_with_its_place(server: ForkServer) -> None:
    outcome = server.run(f"{FAULTS}:fail", {}, LIMITS)
    assert outcome.status == "error"
    assert f"{FAULTS.rpartition('.')[2]}.py" in outcome.error
    assert "ValueError: a value" in outcome.error


def test_job_that_hangs_is_ended(server: ForkServer) -> None:
    start = time.monotonic()
    outcome = server.run(f"{FAULTS}:hang", {}, JobLimits(timeout_s=0.5))
    assert outcome.status == "timeout"
    assert time.monotonic() - start < 2.5
    assert "--timeout" in outcome.error


def test_job_that_grows_is_ended(server: ForkServer) -> None:
    outcome = server.run(f"{FAULTS}:grow", {}, JobLimits(memory_mb=300.0))
    assert outcome.status == "memory"
    assert outcome.peak_memory_mb < 2000


def test_job_that_crashes_is_explained_and_the_server_goes_on(server: ForkServer) -> None:
    outcome = server.run(f"{FAULTS}:crash", {}, LIMITS)
    assert outcome.status == "crash"
    assert "segmentation fault" in outcome.error
    assert server.run(f"{FAULTS}:give_number", {}, LIMITS).value == 42


def test_child_runs_one_job_after_the_other(server: ForkServer) -> None:
    children = [server.run("os:getpid", {}, LIMITS).value for _ in range(3)]
    assert len(set(children)) == 1


@pytest.mark.parametrize(
    ("function", "limits", "status"),
    [
        ("fail", LIMITS, "error"),
        ("crash", LIMITS, "crash"),
        ("hang", JobLimits(timeout_s=0.2), "timeout"),
        ("hold_memory", LIMITS, "done"),
    ],
)
def test_child_is_replaced_after_an_error_or_with_much_memory(
    server: ForkServer, function: str, limits: JobLimits, status: str
) -> None:
    before = server.run("os:getpid", {}, LIMITS).value
    assert server.run(f"{FAULTS}:{function}", {}, limits).status == status
    after = server.run("os:getpid", {}, LIMITS)
    assert after.status == "done"
    assert after.value != before


def test_peak_memory_is_that_of_the_job_alone(server: ForkServer) -> None:
    large = server.run(f"{FAULTS}:use_memory", {}, LIMITS).peak_memory_mb
    small = server.run(f"{FAULTS}:give_number", {}, LIMITS).peak_memory_mb
    assert large - small > 250


def run_until_killed(server: ForkServer) -> None:
    with suppress(EOFError, BrokenPipeError):
        server.run(f"{FAULTS}:hang", {}, LIMITS)


def test_children_end_with_their_server() -> None:
    server = ForkServer(warm_up="")
    process = psutil.Process(server.process_id)
    thread = threading.Thread(target=run_until_killed, args=(server,))
    thread.start()
    deadline = time.monotonic() + 10
    while not process.children() and time.monotonic() < deadline:
        time.sleep(0.02)
    children = process.children()
    assert children
    process.kill()
    _, alive = psutil.wait_procs(children, timeout=2)
    thread.join()
    server.close()
    assert not alive


@pytest.mark.parametrize(("status", "words"), [(9, "SIGKILL"), (11, "segmentation fault"), (256, "exit status 1")])
def test_ends_without_a_reply_are_named(status: int, words: str) -> None:
    assert words in describe_crash(status)
