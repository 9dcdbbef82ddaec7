"""Temporary files of living and of killed owners, files that other programs have open, and paths that are too long."""

import ntpath
import os
import subprocess
import sys
import time
from pathlib import Path, PureWindowsPath

import pytest

from mocapfix.errors import ReadError, WriteError
from mocapfix.io import files
from mocapfix.io.files import (
    find_common_folder,
    make_output_folder,
    open_temporary_folder,
    remove_abandoned_files,
    replace_atomically,
    replace_together,
)
from mocapfix.model.system import get_system

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
    owner.kill()
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


@pytest.fixture
def windows(monkeypatch):
    """Let files that are open be kept as by Windows, and yield a function that opens one for a number of attempts."""
    monkeypatch.setattr(files, "get_system", lambda: get_system()._replace(keeps_open_files=True, max_path_length=200))
    monkeypatch.setattr(files, "OPEN_FILE_LIMIT_S", 0.2)
    attempts_by_file: dict[Path, int] = {}
    rename = Path.replace

    def replace(part: Path, target: Path) -> Path:
        if attempts_by_file.get(target, 0):
            attempts_by_file[target] -= 1
            raise PermissionError(13, "Access is denied", str(part), None, str(target))
        return rename(part, target)

    monkeypatch.setattr(Path, "replace", replace)
    return attempts_by_file.__setitem__


def write_two(folder: Path) -> None:
    targets = [folder / "walk.c3d", folder / "walk.bvh"]
    with replace_together(targets, folder) as temporary:
        for target in targets:
            (temporary / target.name).write_text("new", encoding="utf-8")


def test_file_that_is_open_for_a_moment_is_replaced(windows, tmp_path: Path) -> None:
    (tmp_path / "walk.bvh").write_text("old", encoding="utf-8")
    windows(tmp_path / "walk.bvh", 2)
    write_two(tmp_path)
    assert [(tmp_path / name).read_text(encoding="utf-8") for name in ("walk.bvh", "walk.c3d")] == ["new", "new"]


def test_file_that_stays_open_is_an_error_and_no_output_is_replaced(windows, tmp_path: Path) -> None:
    for name in ("walk.bvh", "walk.c3d"):
        (tmp_path / name).write_text("old", encoding="utf-8")
    windows(tmp_path / "walk.bvh", 1000)
    with pytest.raises(WriteError, match=r"walk\.bvh: cannot be replaced while another program has it open; close it there"):
        write_two(tmp_path)
    assert [(tmp_path / name).read_text(encoding="utf-8") for name in list_names(tmp_path)] == ["old", "old"]
    with pytest.raises(WriteError, match=r"walk\.bvh: cannot be replaced"), replace_atomically(tmp_path / "walk.bvh") as part:
        part.write_text("new", encoding="utf-8")


def test_path_that_is_too_long_is_an_error_with_its_length(windows, tmp_path: Path) -> None:
    folder = tmp_path / ("a" * 250)
    with pytest.raises(WriteError, match=r"has \d\d\d characters, of which this system opens 200; choose a folder"):
        make_output_folder(folder / ("b" * 300))


def test_takes_on_several_drives_have_no_common_folder(tmp_path: Path, monkeypatch) -> None:
    assert find_common_folder([tmp_path / "a" / "walk.c3d", tmp_path / "b" / "c" / "run.c3d"]) == tmp_path
    monkeypatch.setattr(os, "path", ntpath)
    paths = [PureWindowsPath(r"C:\takes\walk.c3d"), PureWindowsPath(r"D:\takes\run.c3d")]
    with pytest.raises(ReadError, match=r"^D:\\takes: is on another drive than C:\\takes;"):
        find_common_folder(paths)


@pytest.mark.parametrize("error", [FileNotFoundError, FileExistsError])
def test_a_temporary_folder_that_is_removed_before_it_is_locked_is_made_again(tmp_path, monkeypatch, error):
    removed = []
    build_lock = files.build_lock

    class Lock:
        def __init__(self, path):
            self.path = path

        def acquire(self):
            removed.append(self.path.parent)
            self.path.parent.rmdir()
            raise error(2, "as filelock raises it")

    monkeypatch.setattr(files, "build_lock", lambda path: build_lock(path) if removed else Lock(path))
    with open_temporary_folder(tmp_path) as folder:
        assert folder.is_dir()
        assert folder != removed[0]
    assert list(tmp_path.iterdir()) == []
