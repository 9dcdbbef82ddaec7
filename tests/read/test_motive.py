from pathlib import Path

import numpy as np
import pytest

from mocapfix.read import capture
from mocapfix.read.motive import EXPECTED_MARKERS_NOTE
from tests.text_files import LABELS, STANDING, assert_refused, motive

Y_UP = STANDING[..., [1, 2, 0]] / 1000


def take_of(folder: Path, text: str):
    path = folder / "walk.csv"
    path.write_bytes(text.encode())
    return capture.read_capture(path)


@pytest.mark.parametrize("labelled_rows", [True, False])
def test_markers_are_told_from_rigid_bodies_and_their_errors(tmp_path, labelled_rows):
    take = take_of(tmp_path, motive(labelled_rows=labelled_rows))
    np.testing.assert_allclose(take.markers, Y_UP, atol=1e-6)
    assert (take.labels, take.rate, take.first_frame, take.notes) == (LABELS, 120, 0, ())


@pytest.mark.parametrize(("units", "metres"), [("Meters", 1.0), ("Millimeters", 0.001), ("Inches", 0.0254)])
def test_units_are_the_headers(tmp_path, units, metres):
    take = take_of(tmp_path, motive(Y_UP / metres, units=units))
    np.testing.assert_allclose(take.markers, Y_UP, atol=1e-6)


def test_blanks_are_missing(tmp_path):
    xyz = Y_UP.copy()
    xyz[1, 0] = xyz[2:, 2] = np.nan
    np.testing.assert_array_equal(take_of(tmp_path, motive(xyz)).visible, ~np.isnan(xyz[..., 0]))


def test_measured_markers_go_before_those_that_bodies_expect(tmp_path):
    xyz = np.concatenate([Y_UP + 1, Y_UP], axis=1)
    kinds = ["Rigid Body Marker", "Bone Marker", "Rigid Body Marker", "Marker", "Marker", "Marker"]
    take = take_of(tmp_path, motive(xyz, LABELS * 2, kinds))
    np.testing.assert_allclose(take.markers, Y_UP, atol=1e-6)
    assert take.notes == ()


def test_expected_markers_alone_are_taken_and_remarked_on(tmp_path):
    take = take_of(tmp_path, motive(kinds=["Rigid Body Marker"] * 3))
    np.testing.assert_allclose(take.markers, Y_UP, atol=1e-6)
    assert take.notes == (EXPECTED_MARKERS_NOTE,)


def test_unlabelled_markers_are_a_take_of_their_own(tmp_path):
    take = take_of(tmp_path, motive(np.concatenate([Y_UP, Y_UP[:, :1]], 1), [*LABELS, "Unlabeled 1013"]))
    assert take.labels == LABELS
    assert take.unlabelled is not None
    assert take.unlabelled.labels == ("Unlabeled 1013",)


def test_y_is_up_unless_the_body_says_otherwise(tmp_path):
    wide = np.array([[[0, 0.5, 0], [0.1, 1.4, 0], [1.2, 1, 0.1]]])  # wider than tall, and the labels say nothing
    np.testing.assert_allclose(take_of(tmp_path, motive(wide, "ABC")).markers, wide)
    np.testing.assert_allclose(take_of(tmp_path, motive(STANDING / 1000)).markers, Y_UP, atol=1e-6)  # exported Z up


ROWS = motive().split("\r\n")
BAD = {
    "rigid bodies alone": (motive(Y_UP[:, :0], ()), "line 7: the columns hold rigid body and no markers; export it with Markers"),
    "local": (motive(space="Local"), "line 1: the coordinates are local"),
    "a unit": (motive(units="Parsecs"), "line 1: the unit is 'Parsecs'"),
    "the facts alone": (motive().split("\r\n")[0], "line 1: the file ends before its columns are named"),
    "a word": (motive().replace("1.701000", "oops"), "line 9: field 12 is 'oops' and not a number"),
    "cut off": (motive()[:-20], "line 11: is cut off"),
    "without its rows of names": ("\r\n".join([ROWS[0], *ROWS[6:]]), "line 2: no rows with the columns'"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_sentence_with_the_file_and_line(tmp_path, case):
    assert_refused(take_of, tmp_path, *BAD[case])
