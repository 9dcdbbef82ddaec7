"""mocapfix as a process of Blender: its stages, its errors as one sentence, and cancelling."""

import os
import stat
import sys
import time
from pathlib import Path

import pytest

from tests.addon.addon_modules import load_addon_module

process = load_addon_module("process")
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="the programs are shell scripts")
DEADLINE_S = 10.0


@pytest.fixture
def start(tmp_path):
    """Return a function that starts a shell script in the place of mocapfix."""

    def start_script(script: str, **options):
        path = tmp_path / "mocapfix"
        path.write_text(f"#!/bin/sh\n{script}\n", encoding="utf-8")
        path.chmod(path.stat().st_mode | stat.S_IEXEC)
        temporary = process.make_temporary_folder()
        return process.CleaningProcess(str(path), ["take.c3d"], temporary, **options), temporary

    return start_script


def wait_for(condition) -> None:
    end = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_stages_are_shown_in_words_and_progress_never_falls(start):
    running, _ = start("for each in read solve detect; do echo stage: $each >&2; done")
    running.wait()
    assert running.stage_text == "detecting faults"
    assert running.fraction == process.STAGES["solve"][0]
    running.check_result()


def test_environment_asks_for_stages_and_has_no_variables_of_blenders_python(start, monkeypatch):
    monkeypatch.setenv("PYTHONHOME", "/blender")
    running, temporary = start("env")
    running.wait()
    variables = (temporary / "output.txt").read_text(encoding="utf-8").splitlines()
    assert "MOCAPFIX_STAGE_LINES=1" in variables
    assert not [each for each in variables if each.startswith("PYTHONHOME")]


def test_error_of_mocapfix_is_passed_on(start):
    running, _ = start("echo stage: read >&2; echo 'take.c3d: is cut off; copy it again.' >&2; exit 1")
    running.wait()
    with pytest.raises(process.ProcessError, match=r"^take.c3d: is cut off; copy it again.$"):
        running.check_result()


def test_unknown_option_is_named_with_what_to_do(start):
    running, _ = start("echo '│ Unrecognized options: --character, x.yaml │' >&2; exit 2")
    running.wait()
    with pytest.raises(process.ProcessError, match="does not know the option --character: update it"):
        running.check_result()


def test_traceback_becomes_one_sentence(start):
    running, _ = start("printf 'Traceback (most recent call last):\\n  File\\nKeyError: 3\\n' >&2; exit 1")
    running.wait()
    with pytest.raises(process.ProcessError, match=r"^mocapfix failed unexpectedly \(KeyError: 3\); update it") as raised:
        running.check_result()
    assert "\n" not in str(raised.value)


def test_failure_without_a_word_names_the_status(start):
    running, _ = start("exit 7")
    running.wait()
    with pytest.raises(process.ProcessError, match="stopped with status 7; check the path"):
        running.check_result()


def test_cancelling_stops_the_process_and_what_it_has_started(start, tmp_path):
    running, temporary = start(f"sleep 60 & echo $! > {tmp_path}/child; wait")
    wait_for(lambda: (tmp_path / "child").exists() and (tmp_path / "child").read_text(encoding="utf-8").strip())
    child = int((tmp_path / "child").read_text(encoding="utf-8"))
    started = time.monotonic()
    running.cancel()
    assert time.monotonic() - started < process.STOP_S
    assert running.poll()
    assert not temporary.exists()
    wait_for(lambda: not is_running(child))


def test_process_that_ignores_the_request_to_stop_is_killed(start, monkeypatch, tmp_path):
    monkeypatch.setattr(process, "STOP_S", 0.2)
    running, _ = start(f"trap '' TERM; touch {tmp_path}/ready; while :; do sleep 0.05; done")
    wait_for((tmp_path / "ready").exists)
    running.cancel()
    assert running.poll()


def test_wrong_path_and_missing_program_are_one_sentence_each(monkeypatch, tmp_path):
    with pytest.raises(process.ProcessError, match=r"/nowhere/mocapfix is not a program that can be started; correct the path"):
        process.find_executable("/nowhere/mocapfix")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(process.ProcessError, match="mocapfix was not found; install it"):
        process.find_executable("")


def test_file_that_is_no_program_is_refused(tmp_path):
    path = tmp_path / "mocapfix"
    path.write_bytes(b"\x7fELF")
    path.chmod(0o755)
    with pytest.raises(process.ProcessError, match="cannot be started"):
        process.CleaningProcess(str(path), [], process.make_temporary_folder())


def is_running(number: int) -> bool:
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    status = Path(f"/proc/{number}/stat")
    return not (status.exists() and status.read_text(encoding="utf-8").rpartition(")")[2].split()[0] == "Z")
