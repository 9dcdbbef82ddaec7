from pathlib import Path

import numpy as np
import pytest

from mocapfix.io import capture
from tests.text_files import STANDING, assert_refused, motive_rows

Y_UP = STANDING[..., [1, 2, 0]] / 1000
NAMES = ("Body-Head", "Body-LeftFoot", "Marker-42")


def write_and_read(folder: Path, text: str):
    path = folder / "walk.csv"
    path.write_bytes(text.encode())
    return capture.read_take(path)


@pytest.mark.parametrize("bodies", [0, 1, 3])
def test_markers_that_a_row_omits_are_missing(tmp_path, bodies):
    xyz = Y_UP.copy()
    xyz[0, 0] = xyz[2, 1] = np.nan
    take = write_and_read(tmp_path, motive_rows(xyz, NAMES, bodies=bodies))
    assert set(take.labels) == set(NAMES[:2])
    for i, name in enumerate(NAMES[:2]):
        np.testing.assert_allclose(take.markers[:, take.labels.index(name)], xyz[:, i], atol=1e-8)
    assert (take.rate, take.first_frame, take.notes) == (120, 0, ())
    assert take.unlabelled is not None
    assert take.unlabelled.labels == ("*42",)


def test_left_handed_coordinates_are_mirrored(tmp_path):
    take = write_and_read(tmp_path, motive_rows(Y_UP, NAMES, "lefthanded"))
    np.testing.assert_allclose(take.markers, (Y_UP * [1, 1, -1])[:, :2], atol=1e-8)


def test_a_wrong_frame_count_is_noted(tmp_path):
    lines = motive_rows(Y_UP, NAMES).split("\r\n")
    take = write_and_read(tmp_path, "\r\n".join(lines[:-3]) + "\r\n")
    assert take.notes == ("The header declares 4 frames; the file has 3.",)


TEXT = motive_rows(Y_UP, NAMES)
INVALID_FILES = {
    "cut off": (TEXT[:-75], "line 11: does not have the rigid bodies and markers that it declares"),
    "a word": (TEXT.replace("1.70100000", "one"), "line 7: does not have"),
    "a count beyond reason": (TEXT.replace(",3,0.0", f",{10**20},0.0", 1), "line 5: does not have"),
    "a count below nothing": (TEXT.replace("0.00000000,1,1", "0.00000000,-1,1", 1), "line 5: does not have"),
    "two of a name": (TEXT.replace("Body-LeftFoot", "Body-Head"), "line 5: has two markers of the same name"),
    "no frames": ("\r\n".join(TEXT.split("\r\n")[:4]), "has no frames"),
}


@pytest.mark.parametrize("case", INVALID_FILES)
def test_invalid_files_are_refused_with_the_line(tmp_path, case):
    assert_refused(write_and_read, tmp_path, *INVALID_FILES[case])
