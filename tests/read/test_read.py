"""What a file is is told by what it holds."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from mocapfix import read
from mocapfix.errors import ReadError
from tests.c3d_files import c3d_bytes

STANDING = np.array([[[10, 20, 1700], [0, 30, 80], [400, 20.5, 1000]]], float) + np.arange(4)[:, None, None]
LABELS = ("Jim:LFHD", "Jim:LANK", "Jim:LFIN")

STRANGE = {
    "empty": (b"", "is empty"),
    "text": (b"Dear all,\nthe take is attached.\n" * 200, "one of: C3D, TRC"),
    "binary": (bytes(range(256)) * 20, "one of: C3D, TRC"),
    "gzip": (gzip.compress(b"PathFileType\t4"), r"packed \(gzip\); unpack it"),
    "zip": (b"PK\x03\x04" + bytes(100), r"packed \(zip\)"),
}


@pytest.mark.parametrize("case", STRANGE)
def test_a_file_of_no_kind_is_one_sentence(tmp_path, case):
    data, words = STRANGE[case]
    path = tmp_path / "walk.c3d"
    path.write_bytes(data)
    with pytest.raises(ReadError, match=words) as error:
        read.take(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_no_such_file_and_a_folder(tmp_path):
    with pytest.raises(ReadError, match=r"none\.c3d: there is no such file"):
        read.take(tmp_path / "none.c3d")
    with pytest.raises(ReadError, match="is a folder"):
        read.take(tmp_path)


def test_content_tells_and_not_the_suffix(tmp_path):
    path = tmp_path / "walk.trc"
    path.write_bytes(c3d_bytes(STANDING, LABELS))
    assert read.take(path).labels == LABELS


def test_every_kind_is_named_once_and_recognises_no_other(tmp_path):
    names = [kind.name for kind in read.KINDS]
    assert len(set(names)) == len(names)
    assert not any(kind.recognises(b"", Path("walk.c3d")) for kind in read.KINDS)
