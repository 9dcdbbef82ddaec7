from pathlib import Path

import numpy as np
import pytest

from mocapfix.io import capture
from tests.text_files import LABELS, STANDING, assert_refused, trc

Y_UP = STANDING[..., [1, 2, 0]] / 1000


def write_and_read(folder: Path, text: str, encoding: str = "utf-8"):
    path = folder / "walk.trc"
    path.write_bytes(text.encode(encoding))
    return capture.read_take(path)


@pytest.mark.parametrize("end", ["\r\n", "\n", "\r"])
@pytest.mark.parametrize("blank", [True, False])
@pytest.mark.parametrize("between", ["\t", ","])
def test_metres_with_y_up(tmp_path, end, blank, between):
    take = write_and_read(tmp_path, trc(end=end, blank=blank, between=between))
    np.testing.assert_allclose(take.markers, Y_UP, atol=1e-12)
    assert (take.labels, take.rate, take.first_frame, take.other_labels, take.unlabelled) == (LABELS, 100, 1, (), None)
    assert take.notes == ()


@pytest.mark.parametrize(("units", "metres"), [("mm", 0.001), ("cm", 0.01), ("Meters", 1.0), ("MM", 0.001)])
def test_units(tmp_path, units, metres):
    take = write_and_read(tmp_path, trc(STANDING * 0.001 / metres, units=units))
    np.testing.assert_allclose(take.markers, Y_UP, atol=0.5e-3 * metres)


def test_a_missing_unit_is_noted(tmp_path):
    take = write_and_read(tmp_path, trc(units=""))
    np.testing.assert_allclose(take.markers, Y_UP, atol=1e-12)
    assert take.notes == ("The header names no unit; mm, the usual one, is assumed.",)


@pytest.mark.parametrize(
    "missing", ["", " ", "NaN", "nan", "-nan", "-nan(ind)", "9999999.00000", "-9999.99", "0.000", "1.#QNAN", "null"]
)
def test_spellings_of_missing_coordinates_are_nan(tmp_path, missing):
    xyz = STANDING.copy()
    xyz[1, 2] = xyz[3, 0] = np.nan
    take = write_and_read(tmp_path, trc(xyz, missing=missing))
    np.testing.assert_array_equal(take.visible, ~np.isnan(xyz[..., 0]))


def test_markers_after_the_end_of_a_line_are_missing(tmp_path):
    lines = trc().split("\r\n")
    lines[7] = "\t".join(lines[7].split("\t")[:5])  # a spreadsheet omits trailing blanks
    take = write_and_read(tmp_path, "\r\n".join(lines))
    np.testing.assert_array_equal(take.visible[1], [True, False, False])
    assert take.visible[[0, 2, 3]].all()


def test_exponents_decimal_commas_and_trailing_tabs(tmp_path):
    text = trc().replace("1700.000", "1.7E+03").replace(".", ",").replace("\r\n", "\t\t\r\n").replace("walk,trc", "walk.trc")
    np.testing.assert_allclose(write_and_read(tmp_path, text).markers, Y_UP, atol=1e-12)


def test_frame_numbers_are_read_from_the_lines(tmp_path):
    take = write_and_read(tmp_path, trc(first=185, OrigDataStartFrame=7))
    assert (take.first_frame, take.get_frame_number(3)) == (185, 188)


def test_wrong_counts_are_noted(tmp_path):
    assert write_and_read(tmp_path, trc(NumFrames=900)).notes == ("The header declares 900 frames; the file has 4.",)
    assert write_and_read(tmp_path, trc(NumFrames=2, NumMarkers=1)).notes == (
        "The header declares 1 markers; 3 are named.",
        "The header declares 2 frames; the file has 4.",
    )
    assert write_and_read(tmp_path, trc(NumFrames="", NumMarkers="?")).notes == ()


def test_frame_numbers_in_steps_of_two_are_noted(tmp_path):
    lines = trc(np.repeat(STANDING, 2, axis=0), first=11).split("\r\n")
    take = write_and_read(tmp_path, "\r\n".join(lines[:6] + lines[6:-1:2]) + "\r\n")
    assert (take.first_frame, take.frame_count) == (11, 4)
    assert any("Frame numbers in the file increase by 2" in note for note in take.notes)


def test_a_missing_rate_is_computed_from_the_times(tmp_path):
    assert write_and_read(tmp_path, trc(rate=60, DataRate=0)).rate == 60
    assert write_and_read(tmp_path, trc(rate=60, DataRate="")).rate == 60


def test_columns_after_the_named_ones_are_unlabelled(tmp_path):
    xyz = np.concatenate([STANDING, STANDING[:, :2] + 7], axis=1)
    xyz[1, 4] = np.nan
    lines = trc(xyz, [*LABELS, "", ""]).split("\r\n")
    take = write_and_read(tmp_path, "\r\n".join(lines))
    assert take.labels == LABELS
    assert take.unlabelled is not None
    np.testing.assert_allclose(take.unlabelled.markers[:, 0], xyz[:, 3][:, [1, 2, 0]] / 1000)
    np.testing.assert_array_equal(take.unlabelled.point_columns, [3, 4])


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "latin-1"])
def test_byte_order_marks_and_old_encodings(tmp_path, encoding):
    take = write_and_read(tmp_path, trc(labels=("Tête", "Cheville", "Doigt")), encoding)
    assert take.labels == ("Tête", "Cheville", "Doigt")


LINES = trc().split("\r\n")
INVALID_FILES = {
    "no names": ("\r\n".join(LINES[:2]), "line 2: the file ends before its markers are named"),
    "no header": ("\r\n".join([LINES[0], *LINES[3:]]), "line 2: there is no header"),
    "no frames": ("\r\n".join(LINES[:6]), "has no frames"),
    "empty names": (trc(labels=("", "", "")), "line 4: names no markers"),
    "a word": (trc().replace("1701.000", "moved"), "line 8: field 5 is 'moved' and not a number"),
    "a unit": (trc(units="furlong"), "line 3: the unit is 'furlong'; give it with --unit, one of mm, cm, m"),
    "no rate": (trc(STANDING[:1], DataRate="?"), "line 3: the frame rate is '?'"),
    "a frame twice": ("\r\n".join([*LINES[:8], LINES[7], *LINES[8:]]), "line 9: frame 2 follows frame 2"),
    "no frame numbers": (trc().replace("2\t0.01000", "\t0.01000"), "line 8: does not begin with a frame number"),
    "cut off in a line": (trc()[:-30], "line 10: the file is cut off"),
    "cut off after its last line": (trc(NumFrames=9)[:-2], "line 10: the file is cut off: 9 frames are declared and 4 are there"),
}


@pytest.mark.parametrize("case", INVALID_FILES)
def test_invalid_files_are_refused_with_the_line(tmp_path, case):
    assert_refused(write_and_read, tmp_path, *INVALID_FILES[case])
