"""Temporary files of living and of killed owners."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mocapfix.io import files
from mocapfix.io.files import open_temporary_folder, remove_abandoned_files, replace_atomically

OWNER = """
import sys, time
from pathlib import Path
from mocapfix.io.files import open_temporary_folder, replace_atomically
with replace_atomically(Path(sys.argv[1]) / "a.npz") as part, open_temporary_folder(Path(sys.argv[1])) as folder:
    part.write_text("half")
    (folder / "part").write_text("half")
    print("ready", flush=True)
    time.sleep(60)
"""
pytestmark = pytest.mark.skipif(files.fcntl is None, reason="no locks on this system")


def list_names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_both_are_removed_at_the_end(tmp_path: Path) -> None:
    with replace_atomically(tmp_path / "walk.npz") as part, open_temporary_folder(tmp_path) as folder:
        (folder / "a").write_text("x", encoding="utf-8")
        part.write_text("new", encoding="utf-8")
        assert part.parent.parent == folder.parent == tmp_path
        remove_abandoned_files(tmp_path)
        assert part.exists()
        assert (folder / "a").exists()
    assert list_names(tmp_path) == ["walk.npz"]


def test_only_those_of_dead_owners_are_removed(tmp_path: Path) -> None:
    (tmp_path / "walk.bvh").write_text("an output", encoding="utf-8")
    owner = subprocess.Popen([sys.executable, "-c", OWNER, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert owner.stdout
    assert owner.stdout.readline() == "ready\n"
    remove_abandoned_files(tmp_path)
    assert len(list_names(tmp_path)) == 3
    owner.send_signal(signal.SIGKILL)
    owner.wait()
    assert len(list_names(tmp_path)) == 3
    remove_abandoned_files(tmp_path)
    assert list_names(tmp_path) == ["walk.bvh"]


def test_those_of_other_machines_are_left_for_a_day(tmp_path: Path) -> None:
    foreign = tmp_path / ".mocapfix-00000000-abc"
    foreign.mkdir()
    remove_abandoned_files(tmp_path)
    assert foreign.exists()
    old = time.time() - 2 * files.FOREIGN_AGE_S
    os.utime(foreign, (old, old))
    remove_abandoned_files(tmp_path)
    assert not foreign.exists()


def test_folder_without_a_lock_is_removed_if_it_is_empty(tmp_path: Path) -> None:
    folder = tmp_path / f"{files.TEMPORARY_PREFIX}abc"
    folder.mkdir()
    (folder / "part").touch()
    remove_abandoned_files(tmp_path)
    assert folder.exists()
    (folder / "part").unlink()
    remove_abandoned_files(tmp_path)
    assert not folder.exists()


def test_folder_that_is_missing_is_ignored(tmp_path: Path) -> None:
    remove_abandoned_files(tmp_path / "none")
    assert not (tmp_path / "none").exists()
