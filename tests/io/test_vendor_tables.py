from pathlib import Path

import numpy as np
import pytest

from mocapfix.errors import ReadError
from mocapfix.io import capture
from mocapfix.io.text_tables import EXPECTED_MARKERS_NOTE
from tests.text_files import LABELS, STANDING, assert_refused, motive, motive_rows, nexus, qualisys, workstation

Y_UP = STANDING[..., [1, 2, 0]] / 1000


def write_and_read(folder: Path, text: str):
    path = folder / "walk.csv"
    path.write_bytes(text.encode())
    return capture.read_take(path)


@pytest.mark.parametrize("labelled_rows", [True, False])
def test_only_marker_columns_are_read(tmp_path, labelled_rows):
    take = write_and_read(tmp_path, motive(labelled_rows=labelled_rows))
    np.testing.assert_allclose(take.markers, Y_UP, atol=1e-6)
    assert (take.labels, take.rate, take.first_frame, take.notes) == (LABELS, 120, 0, ())


@pytest.mark.parametrize(("units", "metres"), [("Meters", 1.0), ("Millimeters", 0.001), ("Inches", 0.0254)])
def test_units_are_read_from_the_header(tmp_path, units, metres):
    take = write_and_read(tmp_path, motive(Y_UP / metres, units=units))
    np.testing.assert_allclose(take.markers, Y_UP, atol=1e-6)


def test_blanks_are_missing(tmp_path):
    xyz = Y_UP.copy()
    xyz[1, 0] = xyz[2:, 2] = np.nan
    np.testing.assert_array_equal(write_and_read(tmp_path, motive(xyz)).visible, ~np.isnan(xyz[..., 0]))


def test_measured_markers_are_preferred_to_expected_ones(tmp_path):
    xyz = np.concatenate([Y_UP + 1, Y_UP], axis=1)
    kinds = ["Rigid Body Marker", "Bone Marker", "Rigid Body Marker", "Marker", "Marker", "Marker"]
    take = write_and_read(tmp_path, motive(xyz, LABELS * 2, kinds))
    np.testing.assert_allclose(take.markers, Y_UP, atol=1e-6)
    assert take.notes == ()


def test_expected_markers_are_read_and_noted_if_there_are_no_others(tmp_path):
    take = write_and_read(tmp_path, motive(kinds=["Rigid Body Marker"] * 3))
    np.testing.assert_allclose(take.markers, Y_UP, atol=1e-6)
    assert take.notes == (EXPECTED_MARKERS_NOTE,)


def test_unlabelled_markers_are_read_as_a_separate_take(tmp_path):
    take = write_and_read(tmp_path, motive(np.concatenate([Y_UP, Y_UP[:, :1]], 1), [*LABELS, "Unlabeled 1013"]))
    assert take.labels == LABELS
    assert take.unlabelled is not None
    assert take.unlabelled.labels == ("Unlabeled 1013",)


def test_y_is_up_unless_the_body_stands_along_another_axis(tmp_path):
    wide = np.array([[[0, 0.5, 0], [0.1, 1.4, 0], [1.2, 1, 0.1]]])  # wider than tall, without labels of head or feet
    np.testing.assert_allclose(write_and_read(tmp_path, motive(wide, "ABC")).markers, wide)
    np.testing.assert_allclose(write_and_read(tmp_path, motive(STANDING / 1000)).markers, Y_UP, atol=1e-6)  # exported with Z up


ROWS = motive().split("\r\n")
INVALID_FILES = {
    "rigid bodies alone": (motive(Y_UP[:, :0], ()), "line 7: the columns have rigid body and no markers; export it with Markers"),
    "local": (motive(space="Local"), "line 1: the coordinates are local"),
    "a unit": (motive(units="Parsecs"), "line 1: the unit is 'Parsecs'"),
    "only the first line": (motive().split("\r\n")[0], "line 1: the file ends before its columns are named"),
    "a word": (motive().replace("1.701000", "oops"), "line 9: field 12 is 'oops' and not a number"),
    "cut off": (motive()[:-20], "line 11: the file is cut off"),
    "without its rows of names": ("\r\n".join([ROWS[0], *ROWS[6:]]), "line 2: there are no rows with the types"),
}


@pytest.mark.parametrize("case", INVALID_FILES)
def test_invalid_files_are_refused_with_the_line(tmp_path, case):
    assert_refused(write_and_read, tmp_path, *INVALID_FILES[case])


NAMES = ("Body-Head", "Body-LeftFoot", "Marker-42")


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
MOTIVE_ROWS_INVALID_FILES = {
    "cut off": (TEXT[:-75], "line 11: does not have the rigid bodies and markers that it declares"),
    "a word": (TEXT.replace("1.70100000", "one"), "line 7: does not have"),
    "a count beyond reason": (TEXT.replace(",3,0.0", f",{10**20},0.0", 1), "line 5: does not have"),
    "a count below nothing": (TEXT.replace("0.00000000,1,1", "0.00000000,-1,1", 1), "line 5: does not have"),
    "two of a name": (TEXT.replace("Body-LeftFoot", "Body-Head"), "line 5: has two markers of the same name"),
    "no frames": ("\r\n".join(TEXT.split("\r\n")[:4]), "has no frames"),
}


@pytest.mark.parametrize("case", MOTIVE_ROWS_INVALID_FILES)
def test_invalid_files_are_refused_with_the_line_of_motive_rows(tmp_path, case):
    assert_refused(write_and_read, tmp_path, *MOTIVE_ROWS_INVALID_FILES[case])


OUTPUTS = "Model Outputs\n120\n,,Jim:LKneeAngles,,\nFrame,Sub Frame,X,Y,Z\n,,deg,deg,deg\n695,0,1,2,3\n696,0,1,2,3\n\n"
DEVICES = "\nDevices\n1200\n,,Force\nFrame,Sub Frame,Fx\n,,N\n695,0,0.1\n695,1,0.1\n"


@pytest.mark.parametrize("before", ["", OUTPUTS])
@pytest.mark.parametrize("after", ["", DEVICES])
@pytest.mark.parametrize("rate", ["120", "120,Hz", "120,,,,,", "120.0"])
def test_the_section_of_trajectories_is_found(tmp_path, before, after, rate):
    take = write_and_read(tmp_path, nexus(before=before, after=after, rate=rate))
    np.testing.assert_allclose(take.markers, Y_UP, atol=1e-9)
    assert (take.labels, take.rate, take.first_frame, take.frame_count, take.other_labels) == (LABELS, 120, 695, 4, ())


def test_section_names_as_a_spreadsheet_saves_them(tmp_path):
    text = nexus().replace("Trajectories\n", "Trajectories,,,,,,,,,,\n").replace("\n", ",,\r\n")
    np.testing.assert_allclose(write_and_read(tmp_path, text).markers, Y_UP, atol=1e-9)
    np.testing.assert_allclose(write_and_read(tmp_path, nexus().replace(",", ";").replace(".", ",")).markers, Y_UP, atol=1e-9)


def test_velocities_are_ignored(tmp_path):
    np.testing.assert_allclose(write_and_read(tmp_path, nexus(velocities=True)).markers, Y_UP, atol=1e-9)


def test_units_and_blanks(tmp_path):
    xyz = STANDING / 1000
    xyz[1, 0] = np.nan
    take = write_and_read(tmp_path, nexus(xyz, units="m"))
    np.testing.assert_allclose(take.markers, xyz[..., [1, 2, 0]], atol=0.6e-3)
    assert not take.visible[1, 0]


def test_workstations_export(tmp_path):
    labels = [*LABELS, "Jim:LHipAngles", "*12"]
    take = write_and_read(tmp_path, workstation(np.concatenate([STANDING, STANDING[:, :2]], 1), labels))
    np.testing.assert_allclose(take.markers, Y_UP, atol=1e-9)
    assert (take.labels, take.rate, take.first_frame) == (LABELS, 100, 1)
    assert take.other_labels == ("Jim:LHipAngles", "*12")


NEXUS_INVALID_FILES = {
    "model outputs alone": (OUTPUTS, "has model outputs and no trajectories; export the trajectories as well"),
    "no names": (nexus(labels=("", "", "")), "line 3: names no markers"),
    "no axes": ("Trajectories\n120\n", "line 1: no line that begins with Frame and names the axes follows"),
    "no frames": ("\n".join(nexus().split("\n")[:5]), "line 4: no frames follow"),
    "a unit": (nexus(units="ells"), "line 5: the unit is 'ells'"),
    "a word": (nexus().replace("1701.000", "oops"), "line 7: field 5 is 'oops'"),
    "cut off": (nexus()[:-20], "line 9: the file is cut off"),
    "rate": (nexus(rate="0"), "line 2: the frame rate is '0'"),
}


@pytest.mark.parametrize("case", NEXUS_INVALID_FILES)
def test_invalid_files_are_refused_with_the_line_of_nexus(tmp_path, case):
    assert_refused(write_and_read, tmp_path, *NEXUS_INVALID_FILES[case])


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


QUALISYS_INVALID_FILES = {
    "rigid bodies": ("NO_OF_FRAMES\t2\r\nNO_OF_BODIES\t1\r\nBODY_NAMES\tBox\r\n1\t2\t3\r\n", r"rigid bodies \(6D\)"),
    "analog": ("NO_OF_SAMPLES\t2\r\nFREQUENCY\t100\r\nCHANNEL_NAMES\tEMG\r\n1\r\n", "has analog signals"),
    "no names": (qualisys(labels=()), "line 8: names no markers"),
    "cut off": (qualisys()[:-20], "line 13: the file is cut off"),
    "a word": (qualisys().replace("1701.000", "oops"), "line 11: field 5 is 'oops'"),
}


@pytest.mark.parametrize("case", QUALISYS_INVALID_FILES)
def test_invalid_files_are_refused_with_the_line_of_qualisys(tmp_path, case):
    text, words = QUALISYS_INVALID_FILES[case]
    with pytest.raises(ReadError, match=words) as error:
        write_and_read(tmp_path, text)
    assert str(error.value).startswith(str(tmp_path / "walk.csv"))


def test_a_first_field_of_thousands_of_digits_is_no_frame_number(tmp_path):
    text = qualisys(columns=("Frame",), named=False).replace("\r\n1\t", f"\r\n{'9' * 5000}\t", 1)
    assert "9" * 5000 in text
    (tmp_path / "a.tsv").write_text(text, newline="", encoding="utf-8")
    found = capture.read_capture(tmp_path / "a.tsv")
    assert (found.first_frame, found.frame_count) == (1, len(STANDING))
