import os
import shutil
import signal

import pytest

from mocapfix.errors import WriteError
from mocapfix.io import files
from mocapfix.io.files import hold_signals, make_scratch_folder, replace_atomically, replace_together


def test_the_target_is_replaced_at_the_end(tmp_path):
    target = tmp_path / "walk.bvh"
    target.write_text("old", encoding="utf-8")
    with replace_atomically(target) as part:
        part.write_text("new", encoding="utf-8")
        assert target.read_text(encoding="utf-8") == "old"
    assert target.read_text(encoding="utf-8") == "new"
    assert list(tmp_path.iterdir()) == [target]


def write_half(target):
    with replace_atomically(target) as part:
        part.write_text("half", encoding="utf-8")
        raise RuntimeError("in the middle")


def test_a_failure_keeps_the_target(tmp_path):
    target = tmp_path / "walk.bvh"
    target.write_text("old", encoding="utf-8")
    with pytest.raises(RuntimeError, match="in the middle"):
        write_half(target)
    assert target.read_text(encoding="utf-8") == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_a_missing_folder_is_refused_with_a_remedy(tmp_path):
    target = tmp_path / "nowhere" / "walk.bvh"
    with pytest.raises(WriteError) as error, replace_atomically(target):
        pass
    assert str(target) in str(error.value)
    assert "choose another folder" in str(error.value)


def test_a_full_disk_is_a_write_error(tmp_path):
    target = tmp_path / "walk.bvh"
    with pytest.raises(WriteError, match=r"walk\.bvh.*No space left"), replace_atomically(target):
        raise OSError(28, "No space left on device")
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(os.name == "nt", reason="Windows has no umask")
def test_a_new_file_has_the_usual_permissions(tmp_path):
    usual, target = tmp_path / "usual", tmp_path / "target"
    usual.touch()
    with replace_atomically(target) as part:
        part.touch()
    assert target.stat().st_mode == usual.stat().st_mode


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_takes_effect_after_the_block(number):
    class Stopped(Exception):
        pass

    def stop(*_):
        raise Stopped

    before = signal.signal(number, stop)
    done = []
    try:
        with pytest.raises(Stopped), hold_signals():  # noqa: PT012
            signal.raise_signal(number)
            done.append(1)
        assert done == [1]
        assert signal.getsignal(number) is stop
    finally:
        signal.signal(number, before)


def test_files_are_replaced_together_or_not_at_all(tmp_path):
    targets = [tmp_path / name for name in ("a", "b", "c")]
    for target in targets:
        target.write_text("old", encoding="utf-8")
    with pytest.raises(WriteError, match=f"{tmp_path}.*No space left"), replace_together(targets, tmp_path) as folder:  # noqa: PT012
        (folder / "a").write_text("new", encoding="utf-8")
        raise OSError(28, "No space left on device")
    assert [target.read_text(encoding="utf-8") for target in targets] == ["old"] * 3
    with replace_together(targets, tmp_path) as folder:
        (folder / "a").write_text("new", encoding="utf-8")
        (folder / "b").write_text("new", encoding="utf-8")
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["a", "b"]
    assert targets[0].read_text(encoding="utf-8") == targets[1].read_text(encoding="utf-8") == "new"


def test_folder_that_is_removed_midway_is_an_error(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    with pytest.raises(WriteError, match="out"), replace_together([out / "a"], out) as folder:  # noqa: PT012
        (folder / "a").write_text("new", encoding="utf-8")
        shutil.rmtree(out)
        (folder / "b").write_text("new", encoding="utf-8")
    assert not out.exists()


def test_no_room_for_temporary_files_is_an_error(monkeypatch):
    def refuse():
        raise FileNotFoundError(2, "No usable temporary directory found")

    monkeypatch.setattr(files, "gettempdir", refuse)
    with pytest.raises(WriteError, match="TMPDIR"), make_scratch_folder():
        pass
