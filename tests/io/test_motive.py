from pathlib import Path

import numpy as np
import pytest

from mocapfix.io import capture
from mocapfix.io.vendor_tables import EXPECTED_MARKERS_NOTE
from tests.text_files import LABELS, STANDING, assert_refused, motive

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
