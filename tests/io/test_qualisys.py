from pathlib import Path

import numpy as np
import pytest

from mocapfix.errors import ReadError
from mocapfix.io import capture
from tests.text_files import LABELS, STANDING, qualisys

Y_UP = STANDING[..., [1, 2, 0]] / 1000


def write_and_read(folder: Path, text: str):
    path = folder / "walk.tsv"
    path.write_bytes(text.encode())
    return capture.read_take(path)


@pytest.mark.parametrize("columns", [(), ("Frame",), ("Frame", "Time")])
@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("trailing", ["", "\t"])
def test_columns_of_frame_numbers_and_times_are_optional(tmp_path, columns, named, trailing):
    take = write_and_read(tmp_path, qualisys(columns=columns, named=named, trailing=trailing, first=5))
    np.testing.assert_allclose(take.markers, Y_UP, atol=1e-9)
    assert (take.labels, take.rate, take.first_frame, take.notes) == (LABELS, 100, 5 if columns else 1, ())


@pytest.mark.parametrize("missing", ["0.000", "", "NULL"])
def test_spellings_of_missing_samples(tmp_path, missing):
    xyz = STANDING.copy()
    xyz[1, 2] = np.nan
    take = write_and_read(tmp_path, qualisys(xyz, missing=missing))
    np.testing.assert_array_equal(take.visible, ~np.isnan(xyz[..., 0]))


@pytest.mark.parametrize("missing", ["0.000", "", "NULL"])
@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("columns", [(), ("Frame", "Time")])
def test_frames_without_visible_markers_are_kept(tmp_path, missing, named, columns):
    xyz = STANDING.copy()
    xyz[:2, 0], xyz[2] = np.nan, np.nan
    take = write_and_read(tmp_path, qualisys(xyz, missing=missing, named=named, columns=columns))
    np.testing.assert_array_equal(take.visible, ~np.isnan(xyz[..., 0]))
    assert take.notes == ()


def test_default_names_are_markers_if_no_marker_is_named(tmp_path):
    take = write_and_read(tmp_path, qualisys(labels=("New 0000", "New 0002", "New 0003")))
    assert take.labels == ("New 0000", "New 0002", "New 0003")
    assert take.unlabelled is None
    take = write_and_read(tmp_path, qualisys(labels=("LFHD", "LANK", "New 0003")))
    assert take.labels == ("LFHD", "LANK")
    assert take.unlabelled is not None


INVALID_FILES = {
    "rigid bodies": ("NO_OF_FRAMES\t2\r\nNO_OF_BODIES\t1\r\nBODY_NAMES\tBox\r\n1\t2\t3\r\n", r"rigid bodies \(6D\)"),
    "analog": ("NO_OF_SAMPLES\t2\r\nFREQUENCY\t100\r\nCHANNEL_NAMES\tEMG\r\n1\r\n", "has analog signals"),
    "no names": (qualisys(labels=()), "line 8: names no markers"),
    "cut off": (qualisys()[:-20], "line 13: the file is cut off"),
    "a word": (qualisys().replace("1701.000", "oops"), "line 11: field 5 is 'oops'"),
}


@pytest.mark.parametrize("case", INVALID_FILES)
def test_invalid_files_are_refused_with_the_line(tmp_path, case):
    text, words = INVALID_FILES[case]
    with pytest.raises(ReadError, match=words) as error:
        write_and_read(tmp_path, text)
    assert str(error.value).startswith(str(tmp_path / "walk.tsv"))


def test_a_first_field_of_thousands_of_digits_is_no_frame_number(tmp_path):
    text = qualisys(columns=("Frame",), named=False).replace("\r\n1\t", f"\r\n{'9' * 5000}\t", 1)
    assert "9" * 5000 in text
    (tmp_path / "a.tsv").write_text(text, newline="")
    found = capture.read_capture(tmp_path / "a.tsv")
    assert (found.first_frame, found.frame_count) == (1, len(STANDING))
