import csv
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mocapfix.errors import ReadError
from mocapfix.io import capture
from mocapfix.io.text_tables import write_csv, write_trc
from mocapfix.model.take import TableLayout, Take
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


def test_what_lacks_a_coordinate_is_named(tmp_path):
    lines = trc().split("\r\n")
    lines[7] = "\t".join(lines[7].split("\t")[:4])
    take = write_and_read(tmp_path, "\r\n".join(lines))
    assert take.notes == (f"Samples without all three coordinates are read as missing: {LABELS[0]} (1 in all).",)
    columns = [f"{label}_{axis}" for label in LABELS for axis in "XYZ"]
    rows = [f"{n / 100:.2f}," + ",".join(f"{x:.3f}" for x in frame.ravel()) for n, frame in enumerate(STANDING)]
    columns[5] = "Force"  # the Z of the second marker
    (tmp_path / "walk.csv").write_text("\n".join([",".join(["time", *columns]), *rows]), encoding="utf-8")
    take = capture.read_take(tmp_path / "walk.csv")
    assert take.labels == (LABELS[0], LABELS[2])
    assert f"Not read, without X, Y and Z side by side: {LABELS[1]}." in take.notes


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


def build_text(delimiter=",", separator="_", unit="_mm", lead=("frame", "time_s"), scale=1.0, axes="XYZ"):
    names = [*lead, *(f"{label}{separator}{axis}{unit}" for label in LABELS for axis in axes)]
    begin = {"frame": "{f}", "Field": "{f}", "time_s": "{t:.4f}", "Time": "{t:.4f}"}
    rows = [
        [*(begin[each].format(f=7 + t, t=t / 50) for each in lead), *(f"{x * scale:.6f}" for x in row.ravel())]
        for t, row in enumerate(STANDING)
    ]
    return "".join(delimiter.join(row) + "\n" for row in [names, *rows])


def read_csv(folder: Path, content: str):
    path = folder / "walk.csv"
    path.write_bytes(content.encode())
    return capture.read_take(path)


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize("separator", ["_", ":", " ", "."])
@pytest.mark.parametrize(("unit", "scale"), [("_mm", 1.0), (" (mm)", 1.0), ("_m", 0.001), (" [cm]", 0.1)])
def test_columns_by_name(tmp_path, delimiter, separator, unit, scale):
    take = read_csv(tmp_path, build_text(delimiter, separator, unit, scale=scale))
    np.testing.assert_allclose(take.markers, Y_UP, atol=1e-9 + 1e-6 * (unit == "_m"))
    assert (take.labels, take.rate, take.first_frame, take.notes) == (LABELS, 50, 7, ())


@pytest.mark.parametrize(("scale", "unit"), [(1.0, "mm"), (0.001, "m")])
def test_a_missing_unit_is_inferred_from_the_span_and_noted(tmp_path, scale, unit):
    take = read_csv(tmp_path, build_text("\t", ":", "", ("Field", "Time"), scale, "xyz"))
    np.testing.assert_allclose(take.markers, Y_UP, atol=2e-6)
    assert take.notes == (f"The file names no unit; {unit} is assumed, from the span of its coordinates.",)


def test_frames_without_numbers_are_counted_from_1(tmp_path):
    assert read_csv(tmp_path, build_text(lead=("time_s",))).first_frame == 1


@pytest.mark.parametrize("header", ["Time (ms)", "time_ms", "Time [milliseconds]"])
def test_times_in_milliseconds(tmp_path, header):
    names, *rows = build_text(lead=("Time",)).replace("Time", header).splitlines(keepends=True)
    rows = [f"{t * 16.6833:.4f},{row.partition(',')[2]}" for t, row in enumerate(rows)]
    assert read_csv(tmp_path, "".join([names, *rows])).rate == pytest.approx(59.94, abs=0.001)


def test_a_table_without_times_is_refused(tmp_path):
    with pytest.raises(ReadError, match="line 1: there is no column for the time"):
        read_csv(tmp_path, build_text(lead=("frame",)))


def test_mixed_line_ends_are_refused(tmp_path):
    with pytest.raises(ReadError, match=r"walk\.csv, line 1: has another line end than the other lines"):
        read_csv(tmp_path, build_text().replace("\n", "\r", 1))


@pytest.mark.parametrize("times", [(0, 0.02, 0.04, 0.5), (0, 0.02, 0.04, 0.03)])
def test_irregular_times_without_frame_numbers_are_refused(tmp_path, times):
    names, *rows = build_text(lead=("Time",)).splitlines(keepends=True)
    rows = [f"{time},{row.partition(',')[2]}" for time, row in zip(times, rows, strict=True)]
    with pytest.raises(ReadError, match=r"walk\.csv, line 5: the time step is"):
        read_csv(tmp_path, "".join([names, *rows]))


@pytest.mark.parametrize("rate", [59.94, 75, 96, 120, 240, 1000])
def test_times_may_be_rounded_to_a_hundredth_of_a_second(tmp_path, rate):
    names, row = build_text(lead=("Time",)).splitlines(keepends=True)[:2]
    rows = [f"{t / rate:.2f},{row.partition(',')[2]}" for t in range(300)]
    assert read_csv(tmp_path, "".join([names, *rows])).rate == pytest.approx(rate, rel=0.04)


def test_names_with_unbalanced_quotes_are_refused(tmp_path):
    with pytest.raises(ReadError, match="line 1: has no columns X, Y and Z of a marker"):
        read_csv(tmp_path, '"' + build_text())


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
