from pathlib import Path

import numpy as np
import pytest

from mocapfix.read import capture
from tests.text_files import STANDING, assert_refused, motive_rows

Y_UP = STANDING[..., [1, 2, 0]] / 1000
NAMES = ("Body-Head", "Body-LeftFoot", "Marker-42")


def take_of(folder: Path, text: str):
    path = folder / "walk.csv"
    path.write_bytes(text.encode())
    return capture.read_capture(path)


@pytest.mark.parametrize("bodies", [0, 1, 3])
def test_what_a_row_does_not_list_is_missing(tmp_path, bodies):
    xyz = Y_UP.copy()
    xyz[0, 0] = xyz[2, 1] = np.nan
    take = take_of(tmp_path, motive_rows(xyz, NAMES, bodies=bodies))
    assert set(take.labels) == set(NAMES[:2])
    for i, name in enumerate(NAMES[:2]):
        np.testing.assert_allclose(take.markers[:, take.labels.index(name)], xyz[:, i], atol=1e-8)
    assert (take.rate, take.first_frame, take.notes) == (120, 0, ())
    assert take.unlabelled is not None
    assert take.unlabelled.labels == ("*42",)


def test_left_handed_coordinates_are_mirrored(tmp_path):
    take = take_of(tmp_path, motive_rows(Y_UP, NAMES, "lefthanded"))
    np.testing.assert_allclose(take.markers, (Y_UP * [1, 1, -1])[:, :2], atol=1e-8)


def test_frames_that_the_header_promises_and_that_are_not_there_are_remarked_on(tmp_path):
    lines = motive_rows(Y_UP, NAMES).split("\r\n")
    take = take_of(tmp_path, "\r\n".join(lines[:-3]) + "\r\n")
    assert take.notes == ("The header promises 4 frames and 3 are there.",)


TEXT = motive_rows(Y_UP, NAMES)
BAD = {
    "cut off": (TEXT[:-75], "line 11: does not hold the rigid bodies and markers that it counts"),
    "a word": (TEXT.replace("1.70100000", "one"), "line 7: does not hold"),
    "a count beyond reason": (TEXT.replace(",3,0.0", f",{10**20},0.0", 1), "line 5: does not hold"),
    "a count below nothing": (TEXT.replace("0.00000000,1,1", "0.00000000,-1,1", 1), "line 5: does not hold"),
    "two of a name": (TEXT.replace("Body-LeftFoot", "Body-Head"), "line 5: names two markers alike"),
    "no frames": ("\r\n".join(TEXT.split("\r\n")[:4]), "holds no frames"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_sentence_with_the_file_and_line(tmp_path, case):
    assert_refused(take_of, tmp_path, *BAD[case])
