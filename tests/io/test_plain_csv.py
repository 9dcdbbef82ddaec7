from pathlib import Path

import numpy as np
import pytest

from mocapfix.errors import ReadError
from mocapfix.io import capture
from tests.text_files import STANDING

LABELS = ("Jim:LFHD", "Jim:LANK", "Jim:LFIN")
Y_UP = STANDING[..., [1, 2, 0]] / 1000


def build_text(delimiter=",", separator="_", unit="_mm", lead=("frame", "time_s"), scale=1.0, axes="XYZ"):
    names = [*lead, *(f"{label}{separator}{axis}{unit}" for label in LABELS for axis in axes)]
    begin = {"frame": "{f}", "Field": "{f}", "time_s": "{t:.4f}", "Time": "{t:.4f}"}
    rows = [
        [*(begin[each].format(f=7 + t, t=t / 50) for each in lead), *(f"{x * scale:.6f}" for x in row.ravel())]
        for t, row in enumerate(STANDING)
    ]
    return "".join(delimiter.join(row) + "\n" for row in [names, *rows])


def write_and_read(folder: Path, content: str):
    path = folder / "walk.csv"
    path.write_bytes(content.encode())
    return capture.read_take(path)


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize("separator", ["_", ":", " ", "."])
@pytest.mark.parametrize(("unit", "scale"), [("_mm", 1.0), (" (mm)", 1.0), ("_m", 0.001), (" [cm]", 0.1)])
def test_columns_by_name(tmp_path, delimiter, separator, unit, scale):
    take = write_and_read(tmp_path, build_text(delimiter, separator, unit, scale=scale))
    np.testing.assert_allclose(take.markers, Y_UP, atol=1e-9 + 1e-6 * (unit == "_m"))
    assert (take.labels, take.rate, take.first_frame, take.notes) == (LABELS, 50, 7, ())


@pytest.mark.parametrize(("scale", "unit"), [(1.0, "mm"), (0.001, "m")])
def test_a_missing_unit_is_inferred_from_the_span_and_noted(tmp_path, scale, unit):
    take = write_and_read(tmp_path, build_text("\t", ":", "", ("Field", "Time"), scale, "xyz"))
    np.testing.assert_allclose(take.markers, Y_UP, atol=2e-6)
    assert take.notes == (f"The file names no unit; {unit} is assumed, from the span of its coordinates.",)


def test_frames_without_numbers_are_counted_from_1(tmp_path):
    assert write_and_read(tmp_path, build_text(lead=("time_s",))).first_frame == 1


@pytest.mark.parametrize("header", ["Time (ms)", "time_ms", "Time [milliseconds]"])
def test_times_in_milliseconds(tmp_path, header):
    names, *rows = build_text(lead=("Time",)).replace("Time", header).splitlines(keepends=True)
    rows = [f"{t * 16.6833:.4f},{row.partition(',')[2]}" for t, row in enumerate(rows)]
    assert write_and_read(tmp_path, "".join([names, *rows])).rate == pytest.approx(59.94, abs=0.001)


def test_a_table_without_times_is_refused(tmp_path):
    with pytest.raises(ReadError, match="line 1: there is no column for the time"):
        write_and_read(tmp_path, build_text(lead=("frame",)))


def test_mixed_line_ends_are_refused(tmp_path):
    with pytest.raises(ReadError, match=r"walk\.csv, line 1: has another line end than the other lines"):
        write_and_read(tmp_path, build_text().replace("\n", "\r", 1))


@pytest.mark.parametrize("times", [(0, 0.02, 0.04, 0.5), (0, 0.02, 0.04, 0.03)])
def test_irregular_times_without_frame_numbers_are_refused(tmp_path, times):
    names, *rows = build_text(lead=("Time",)).splitlines(keepends=True)
    rows = [f"{time},{row.partition(',')[2]}" for time, row in zip(times, rows, strict=True)]
    with pytest.raises(ReadError, match=r"walk\.csv, line 5: the time step is"):
        write_and_read(tmp_path, "".join([names, *rows]))


@pytest.mark.parametrize("rate", [59.94, 75, 96, 120, 240, 1000])
def test_times_may_be_rounded_to_a_hundredth_of_a_second(tmp_path, rate):
    names, row = build_text(lead=("Time",)).splitlines(keepends=True)[:2]
    rows = [f"{t / rate:.2f},{row.partition(',')[2]}" for t in range(300)]
    assert write_and_read(tmp_path, "".join([names, *rows])).rate == pytest.approx(rate, rel=0.04)


def test_names_with_unbalanced_quotes_are_refused(tmp_path):
    with pytest.raises(ReadError, match="line 1: has no columns X, Y and Z of a marker"):
        write_and_read(tmp_path, '"' + build_text())
