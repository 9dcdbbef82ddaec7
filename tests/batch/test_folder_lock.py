"""Locks on folders and takes: one holder at a time, and attempts that are counted until they are recorded."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from mocapfix.batch.records import hold_take, lock_batch_folder
from mocapfix.errors import WriteError


def test_second_batch_on_a_folder_is_refused_with_its_holder(tmp_path: Path) -> None:
    with lock_batch_folder(tmp_path), pytest.raises(WriteError, match=rf"process {os.getpid()}"), lock_batch_folder(tmp_path):
        pass
    with lock_batch_folder(tmp_path):
        pass


def test_errors_of_what_holds_the_lock_are_not_those_of_the_lock(tmp_path: Path) -> None:
    with pytest.raises(PermissionError), lock_batch_folder(tmp_path):
        raise PermissionError


def test_lock_of_a_dead_process_is_taken_over(tmp_path: Path) -> None:
    code = "import os, pathlib, sys; from mocapfix.batch.records import lock_batch_folder; print(os.getpid(), flush=True); "
    code += "lock_batch_folder(pathlib.Path(sys.argv[1])).__enter__(); os._exit(0)"
    process = subprocess.check_output([sys.executable, "-c", code, str(tmp_path)], encoding="utf-8").strip()
    assert f"process {process}," in (tmp_path / ".batch.lock").read_text(encoding="utf-8")
    with lock_batch_folder(tmp_path):
        assert f"process {os.getpid()}," in (tmp_path / ".batch.lock").read_text(encoding="utf-8")


def test_attempts_are_counted_until_they_are_cleared(tmp_path: Path) -> None:
    for expected in (1, 2):
        with hold_take(tmp_path, "a/walk.c3d") as attempts:
            assert attempts.begin("key") == expected
            assert attempts.count("other") == 0
    with hold_take(tmp_path, "a/walk.c3d") as attempts:
        attempts.clear()
    assert not list((tmp_path / "a" / "walk").iterdir())


def test_lock_leaves_no_file_without_attempts(tmp_path: Path) -> None:
    with hold_take(tmp_path, "walk.c3d"):
        pass
    assert not list((tmp_path / "walk").iterdir())
