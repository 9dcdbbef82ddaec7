import csv

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mocapfix.io import capture
from mocapfix.io.trc_csv import write_csv, write_trc
from mocapfix.model.take import TableLayout, Take
from tests.text_files import LABELS, STANDING

Y_UP = STANDING[..., [1, 2, 0]] / 1000
TALL = np.array([[0, 1.7, 0], [0, 0.05, 0], [0, 1, 0]])  # head, ankle, hand, which give the up axis


@pytest.mark.parametrize("writer", [write_trc, write_csv])
@given(
    markers=arrays(float, (6, 3, 3), elements=st.floats(-0.3, 0.3)),
    missing=arrays(bool, (6, 3)),
    frame=st.sampled_from([(0.001, np.eye(3)[[1, 2, 0]]), (0.01, np.eye(3)), (1.0, np.eye(3))]),
    first=st.integers(0, 100_000),
    rate=st.sampled_from([30.0, 59.94, 120.0, 1000.0]),
)
def test_a_take_reads_back(tmp_path_factory, writer, markers, missing, frame, first, rate):
    path = tmp_path_factory.mktemp("new") / "take"
    missing[0] = False
    expected = np.where(missing[..., None], np.nan, markers + TALL)
    layout = TableLayout("utf-8", "\n", "\t", ".", frame[0], rotation_y_up_file=frame[1])
    writer(path, Take(expected, LABELS, rate, first, layout=layout))
    copy = capture.read_take(path)
    assert (copy.labels, copy.first_frame, copy.notes) == (LABELS, first, ())
    assert copy.rate == pytest.approx(rate, rel=1e-3)
    np.testing.assert_allclose(copy.markers, expected, atol=0.51e-8)
    assert isinstance(copy.layout, TableLayout)
    assert copy.layout.unit_m == frame[0]


def test_the_layout_of_a_trc(tmp_path):
    take = Take(Y_UP.copy(), ("LFHD", "LANK", "Left\tFinger"), 59.94, 185)
    take.markers[1, 1] = np.nan
    write_trc(tmp_path / "walk.trc", take)
    lines = (tmp_path / "walk.trc").read_bytes().decode().split("\r\n")
    assert lines[0] == "PathFileType\t4\t(X/Y/Z)\twalk.trc"
    assert lines[2] == "59.94\t59.94\t4\t3\tmm\t59.94\t185\t4"
    assert lines[3] == "Frame#\tTime\tLFHD\t\t\tLANK\t\t\tLeft Finger\t\t"
    assert lines[4] == "\t\tX1\tY1\tZ1\tX2\tY2\tZ2\tX3\tY3\tZ3"
    assert lines[5] == ""
    assert lines[7] == f"186\t{185 / 59.94:.6f}\t11.00000\t21.00000\t1701.00000\t\t\t\t401.00000\t21.50000\t1001.00000"
    assert lines[10:] == [""]


def test_the_layout_of_a_csv(tmp_path):
    take = Take(Y_UP.copy(), ("LFHD", "Jim:LANK", "hand, left"), 50, 7)
    take.markers[1, 1] = np.nan
    write_csv(tmp_path / "walk.csv", take)
    with (tmp_path / "walk.csv").open(newline="") as file:
        names, *rows = csv.reader(file)
    assert names[:5] == ["frame", "time_s", "LFHD_X_mm", "LFHD_Y_mm", "LFHD_Z_mm"]
    assert names[-1] == "hand, left_Z_mm"
    assert rows[1] == ["8", "0.020000", "11.00000", "21.00000", "1701.00000", "", "", "", "401.00000", "21.50000", "1001.00000"]
    assert len(rows) == 4
    assert capture.read_take(tmp_path / "walk.csv").labels == take.labels


def test_line_ends_in_labels_are_removed(tmp_path):
    path = tmp_path / "walk.csv"
    write_csv(path, Take(np.arange(18.0).reshape(3, 2, 3), ("left\nheel", "LTOE"), 100.0))
    assert capture.read_take(path).labels == ("left heel", "LTOE")
