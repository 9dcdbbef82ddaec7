import os

import pytest

from mocapfix.errors import WriteError
from mocapfix.files.output_files import replace_atomically


def test_the_target_is_replaced_at_the_end(tmp_path):
    target = tmp_path / "walk.bvh"
    target.write_text("old")
    with replace_atomically(target) as part:
        part.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new"
    assert list(tmp_path.iterdir()) == [target]


def write_half(target):
    with replace_atomically(target) as part:
        part.write_text("half")
        raise RuntimeError("in the middle")


def test_a_failure_keeps_the_target(tmp_path):
    target = tmp_path / "walk.bvh"
    target.write_text("old")
    with pytest.raises(RuntimeError, match="in the middle"):
        write_half(target)
    assert target.read_text() == "old"
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
    with replace_atomically(target):
        pass
    assert target.stat().st_mode == usual.stat().st_mode
