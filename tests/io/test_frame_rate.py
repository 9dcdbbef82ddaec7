"""Rates and missing frames, of times with known answers and of files of every format."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from mocapfix.errors import ReadError
from mocapfix.io import capture
from mocapfix.io.frame_rate import (
    FrameTimes,
    _count_omitted_frames,
    choose_rate,
    find_frames,
    infer_rate,
    parse_time,
    read_frame_time,
)
from mocapfix.io.patches import patch_animation, patch_table
from mocapfix.model.animation import Animation
from mocapfix.options import ReadOptions
from tests.asf_files import AMC, ASF
from tests.bvh_files import TEXT
from tests.c3d_files import c3d_bytes
from tests.text_files import LABELS, STANDING, motive, nexus, qualisys, trc

NO_OPTIONS = ReadOptions()


def find(times=None, numbers=None, stated="", unit_s=None, options=NO_OPTIONS, rows=None):
    """Return the frames of a table with these columns."""
    return find_frames(
        lambda row, sentence: ReadError(f"row {row}: {sentence}"),
        lambda sentence: ReadError(f"rate: {sentence}"),
        rows or len(times if times is not None else numbers if numbers is not None else ()),
        stated_rate=stated,
        times=None if times is None else FrameTimes(np.array(times, float), unit_s),
        frame_numbers=None if numbers is None else np.array(numbers, float),
        options=options,
    )


@pytest.mark.parametrize(
    ("spelled", "rate", "is_noted"),
    [
        (".0083", 120, True), ("0.0083333", 120, False), ("0.00833333", 120, False), ("0.033", 30, True), ("0.033333", 30, False),
        ("0.016666", 60, True), ("0.0166", 60, True), ("0.041667", 24, False), ("0.0333667", 30000 / 1001, False),
        ("0.04", 25, False), ("0.01", 100, False), ("8.3333e-3", 120, False), ("0.0101", 1 / 0.0101, False),
        ("0.2", 5, False),
    ],
)  # fmt: skip
def test_rounded_frame_times_give_the_common_rate(spelled, rate, is_noted):
    inferred, notes = infer_rate(spelled)
    assert inferred == pytest.approx(rate, rel=1e-12)
    assert bool(notes) == is_noted
    assert all(spelled in note for note in notes)


@st.composite
def clocks(draw):
    """Return a rate, the frames present of some, and their times in a unit, rounded as files round them, from any start."""
    rate = draw(st.sampled_from([24, 25, 30000 / 1001, 50, 59.94, 60, 100, 120, 200, 240, 500, 1000]))
    count = draw(st.integers(30, 300))
    missing = draw(st.sets(st.integers(1, count - 2), max_size=count // 4))
    present = np.setdiff1d(np.arange(count), list(missing))
    unit_s, decimals = draw(st.sampled_from([(1.0, 4), (1.0, 6), (1e-3, 1), (1e-3, 3), (1e-6, 0), (1e-9, 0)]))
    start_s = draw(st.sampled_from([0.0, 12.5, 1.7e9 if unit_s * 10.0**-decimals > 1e-6 else 3e5]))
    return rate, present, np.round((start_s + present / rate) / unit_s, decimals), unit_s


@settings(max_examples=150)
@given(clocks(), st.booleans(), st.booleans())
def test_rate_and_missing_frames_follow_from_times(clock, has_numbers, has_unit):
    rate, present, times, unit_s = clock
    assume(has_unit or (rate, unit_s) != (1000, 1e-3))  # such times could count frames
    found = find(times, 7 + present if has_numbers else None, unit_s=unit_s if has_unit else None)
    assert found.rate == pytest.approx(rate, rel=2e-4)
    np.testing.assert_array_equal(found.row_frames, present)
    assert found.first_frame == (7 if has_numbers else 1)
    missing = present[-1] + 1 - len(present)
    assert any("missing from the file" in note for note in found.notes) == (missing > 0)
    name = {1e-3: "milliseconds", 1e-6: "microseconds", 1e-9: "nanoseconds"}.get(unit_s)
    assert any(f"taken as {name}" in note for note in found.notes) == (name is not None and not has_unit)


@settings(max_examples=60)
@given(st.integers(0, 10_000), st.sampled_from([25, 30, 60, 120]), st.sampled_from([0.05, 0.1, 0.15]))
def test_times_of_cameras_that_jitter_give_their_rate_without_gaps(seed, rate, jitter):
    times = np.cumsum(np.full(300, 1 / rate)) + np.random.default_rng(seed).normal(0, jitter / rate, 300)
    found = find(np.maximum.accumulate(times))
    assert found.rate == pytest.approx(rate, rel=0.005)
    assert found.frame_count == 300
    assert (jitter < 0.1) or any("irregular" in note for note in found.notes)


@pytest.mark.parametrize("rate", [59.94, 75, 96, 120, 240, 1000])
def test_times_with_two_decimals_omit_no_frames(rate):
    found = find(np.round(np.arange(300) / rate, 2))
    assert found.rate == pytest.approx(rate, rel=0.04)
    assert found.frame_count == 300


@settings(max_examples=200)
@given(
    st.sampled_from([24, 25, 29.97, 30, 50, 59.94, 60, 75, 100, 120, 150, 200, 240, 250, 300, 500, 1000]),
    st.integers(1, 400),
    st.integers(1, 6),
    st.sampled_from([0.0, 0.37, 12.3456]),
    st.booleans(),
    st.booleans(),
)
def test_rounded_or_cut_off_times_agree_with_their_header(rate, count, decimals, start, is_cut_off, has_numbers):
    times = (start + np.arange(count) / rate) * 10**decimals
    times = np.floor(times + 1e-9 if is_cut_off else times + 0.5) / 10**decimals
    found = find(times, np.arange(count) + 3 if has_numbers else None, stated=str(rate), unit_s=1.0)
    assert (found.rate, found.frame_count, found.notes) == (rate, count, ())


def test_the_time_column_wins_over_the_header():
    times = np.arange(100) / 120
    assert find(times, stated="59.94").notes == ("The header says 59.94 Hz and the time column 120 Hz; the time column is used.",)
    assert find(times, stated="59.94").rate == 120
    assert (find(times, stated="120.0").rate, find(times, stated="120.0").notes) == (120, ())
    assert find(np.arange(100) / 60, stated="59.94").rate == 59.94  # programs write times of the nominal rate
    assert find(1e3 * times, stated="120", unit_s=1.0).rate == 120
    assert find(times, stated="0.12").rate == 120
    assert find([0.0, 0.01, 0.02], stated="120").rate == 120  # 0.0167 s, rounded


@pytest.mark.parametrize("times", [np.zeros(50), np.full(50, np.nan), np.arange(50.0), np.arange(50.0)[::-1]])
def test_a_column_that_is_no_time_is_not_used(times):
    found = find(times, np.arange(50), stated="100")
    assert (found.rate, found.frame_count, found.notes) == (100, 50, ())
    with pytest.raises(ReadError, match=r"rate: the file does not give its frame rate; give it with --rate HZ\."):
        find(times, np.arange(50))
    assert find(times, np.arange(50), options=ReadOptions(rate_hz=50)).rate == 50


def test_rate_of_the_option_wins_with_a_note():
    option = ReadOptions(rate_hz=60)
    assert find(np.arange(100) / 120, stated="120", options=option).rate == 60
    assert find(np.arange(100) / 120, options=option).notes == ("The file says 120 Hz; the 60 Hz of --rate are used.",)
    assert find(np.arange(100) / 60, options=option).notes == ()
    assert choose_rate(ReadError, 59.94, option) == (60, ())


@pytest.mark.parametrize("stated", ["0", "0.12", "4.9", "2001", "10000", "nan", "?"])
def test_impossible_rates_are_refused_with_the_option(stated):
    with pytest.raises(ReadError, match=r"give it with --rate HZ"):
        find(numbers=[1, 2, 3], stated=stated)
    assert find(numbers=[1, 2, 3], stated=stated, options=ReadOptions(rate_hz=120)).rate == 120


def test_frame_numbers_may_omit_frames():
    found = find(numbers=[5, 6, 9, 10], stated="100")
    assert (found.first_frame, found.row_frames.tolist()) == (5, [0, 1, 4, 5])
    remark = "the motion is filled there, and the copy of the file keeps its rows."
    assert found.notes == (f"2 frames, first 7 to 8, are missing from the file; {remark}",)
    found = find(numbers=[0, 4, 8, 16, 20], stated="100")
    assert found.row_frames.tolist() == [0, 1, 2, 4, 5]


def test_times_count_where_frame_numbers_go_on():
    found = find(np.delete(np.arange(50), [20, 21]) / 100, np.arange(5, 53))
    assert (found.first_frame, found.frame_count) == (5, 50)
    assert found.notes[0] == "Times omit frames after number 24, where numbers go on; frames are counted by the times."


@pytest.mark.parametrize("numbers", [[1, 2, 2, 3], [3, 2, 1], [1, 2, 50], [1, 3, 5, 6]])
def test_other_frame_numbers_are_refused(numbers):
    with pytest.raises(ReadError, match=r"row \d: frame \d+ follows frame \d; export the complete trial"):
        find(numbers=numbers, stated="100")


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("1.5", 1.5), ("1,5", 1.5), ("00:01:02.5", 62.5), ("2024-03-01T12:00:00.250+00:00", 1709294400.25), ("x", np.nan)],
)
def test_times_are_numbers_clock_times_or_dates(text, seconds):
    np.testing.assert_equal(parse_time(text), seconds)


@pytest.mark.parametrize(
    ("text", "rate", "word"),
    [
        ("8.3333", 120, "milliseconds"), ("16.6667", 60, "milliseconds"), ("33", 30, "milliseconds"), ("10", 100, "milliseconds"),
        ("40", 25, "milliseconds"), ("8.4", 1000 / 8.4, "milliseconds"), ("8333.33", 120, "microseconds"),
        ("120", 120, "rate"), ("60.0", 60, "rate"), ("30", 30, "rate"), ("59.94", 60000 / 1001, "rate"), ("25", 25, "rate"),
        ("0.0083333", 120, ""), ("0.2", 5, ""),
    ],
)  # fmt: skip
def test_frame_times_in_other_units(text, rate, word):
    found = read_frame_time(text)
    assert found
    assert found[0] == pytest.approx(rate)
    assert bool(word) == bool(found[1])
    assert all(word in note for note in found[1])


@pytest.mark.parametrize("text", ["0", "-1", "1", "35", "0.0001", "1e300", "1e-320", "inf", "nan"])
def test_frame_times_without_a_possible_rate(text):
    assert read_frame_time(text) is None


WIDE = "Time,A_X,A_Y,A_Z,B_X,B_Y,B_Z\n"
IMPOSSIBLE_RATES: dict[str, bytes] = {
    "walk.trc": trc(rate=3).encode(),
    "walk.csv": motive(rate=3).encode(),
    "nexus.csv": nexus(rate="0").encode(),
    "walk.tsv": qualisys(columns=()).replace("FREQUENCY\t100", "FREQUENCY\t0").encode(),
    "wide.csv": (WIDE + "".join(f"{t},0.1,1.2,0.3,0.4,0.{t}5,0.6\n" for t in range(6))).encode(),
    "points.json": b'{"rate": 0.12, "unit": "m", "labels": ["a"], "frames": [[[0, 1, 2]], [[0, 1, 3]]]}',
    "walk.bvh": TEXT.replace(".0083333", "1").encode(),
    "09_01.amc": b"# 0.12 fps\n" + AMC.encode(),
    "walk.c3d": c3d_bytes(STANDING, LABELS, extra={"POINT:RATE": 0.12}),
}


@pytest.mark.parametrize("name", IMPOSSIBLE_RATES)
def test_impossible_rates_of_files_are_refused_and_the_option_corrects_them(tmp_path, name):
    (tmp_path / "09.asf").write_text(ASF, encoding="utf-8")
    (tmp_path / name).write_bytes(IMPOSSIBLE_RATES[name])
    with pytest.raises(ReadError, match=r"--rate HZ") as refused:
        capture.read_capture(tmp_path / name)
    assert len(str(refused.value).removeprefix(str(tmp_path))) < 220
    found = capture.read_capture(tmp_path / name, ReadOptions(rate_hz=120.0))
    assert found.rate == 120


@pytest.mark.parametrize("rows", [[2], [2, 3, 4], [1, 7]])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_rows_that_are_missing_are_gaps_and_stay_missing_in_the_copy(tmp_path: Path, rows, encoding):
    markers = np.concatenate([STANDING, STANDING + 4, STANDING + 8])
    lines = trc(markers).split("\r\n")
    (tmp_path / "walk.trc").write_bytes("\r\n".join(line for i, line in enumerate(lines) if i - 6 not in rows).encode(encoding))
    take = capture.read_take(tmp_path / "walk.trc")
    assert (take.frame_count, take.rate) == (len(markers), 100)
    np.testing.assert_allclose(take.markers[~np.isin(np.arange(12), rows)], np.delete(markers, rows, 0)[..., [1, 2, 0]] / 1000)
    assert np.isnan(take.markers[rows]).all()
    filled = take.replace_markers(np.where(take.visible[..., None], take.markers, 0.5))
    moved = filled.markers.copy()
    moved[8, 1] += 0.25
    assert patch_table(tmp_path / "same.trc", take, filled) == []
    assert (tmp_path / "same.trc").read_bytes() == (tmp_path / "walk.trc").read_bytes()
    patch_table(tmp_path / "moved.trc", take, filled.replace_markers(moved))
    texts = [(tmp_path / name).read_bytes().decode(encoding).split("\t") for name in ("walk.trc", "moved.trc")]
    assert sum(a != b for a, b in zip(*texts, strict=True)) == 3
    np.testing.assert_allclose(capture.read_take(tmp_path / "moved.trc").markers[8, 1], moved[8, 1], atol=1e-6)


@pytest.mark.parametrize("present", [[1, 2, 5, 6], [3, 4, 5, 7]])
def test_frames_that_an_amc_omits_are_gaps(tmp_path, present):
    (tmp_path / "09.asf").write_text(ASF, encoding="utf-8")
    header, _, frame = AMC.partition("7\n")
    frame = frame[: frame.index("\n8\n") + 1]
    (tmp_path / "09_01.amc").write_text(header + "".join(f"{number}\n{frame}" for number in present), encoding="utf-8")
    found = capture.read_capture(tmp_path / "09_01.amc")
    assert isinstance(found, Animation)
    is_present = np.isin(np.arange(present[0], present[-1] + 1), present)
    assert (found.first_frame, found.frame_count) == (present[0], len(is_present))
    assert np.isfinite(found.values[is_present]).all()
    assert np.isnan(found.values[~is_present]).all()
    assert any("missing from the file" in note for note in found.notes)
    values = np.nan_to_num(found.values, nan=1.0)
    patch_animation(tmp_path / "out.amc", found, values)
    assert (tmp_path / "out.amc").read_bytes() == (tmp_path / "09_01.amc").read_bytes()


@pytest.mark.parametrize(
    "column", ["Time", "timestamp", "Timestamp (ms)", "t", "t_ms", "time_s", "unix_timestamp", "elapsed_s", "seconds"]
)
def test_time_columns_of_plain_tables(tmp_path, column):
    scale = 1000 if "ms" in column else 1
    rows = [f"{scale * (1.7e9 * ('stamp' in column) + t / 50):.3f},0.1,1.2,0.3,0.4,0.{t:02}5,0.6\n" for t in range(20)]
    (tmp_path / "a.csv").write_text("# exported\n\n" + WIDE.replace("Time", column) + "".join(rows), encoding="utf-8")
    found = capture.read_take(tmp_path / "a.csv")
    assert (found.rate, found.frame_count, found.labels) == (50, 20, ("A", "B"))


@pytest.mark.parametrize("rate", [30.0, 120.0])
def test_a_table_without_times_has_the_rate_of_the_option(tmp_path, rate):
    text = "body_nose_x,body_nose_y,body_nose_z\n" + "".join(f"{t},1600,{10 * t}\n" for t in range(20))
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    with pytest.raises(ReadError, match=r"line 1: there is no column for the time.*give it with --rate HZ"):
        capture.read_take(tmp_path / "a.csv")
    found = capture.read_take(tmp_path / "a.csv", ReadOptions(rate_hz=rate))
    assert (found.rate, found.frame_count, found.labels) == (rate, 20, ("body_nose",))


def test_decimal_commas_between_commas_are_named(tmp_path):
    (tmp_path / "a.csv").write_text(WIDE + "".join(f"0,0{t},1,5,1,6,1,7,1,8,1,9,2,0\n" for t in range(9)), encoding="utf-8")
    with pytest.raises(ReadError, match=r"line 2: has 14 fields for 7 columns.*export it with semicolons"):
        capture.read_take(tmp_path / "a.csv")
    text = WIDE.replace(",", ";") + "".join(f"0,0{t};1,5;1,6;1,7;1,8;1,9;2,0\n" for t in range(9))
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    assert capture.read_take(tmp_path / "a.csv").rate == 100


@pytest.mark.parametrize("excess", [1e300, np.inf, np.nan])
def test_damaged_times_omit_no_frames(excess):
    assert not _count_omitted_frames(np.array([0.0, 0.0, excess, 0.0]), 0.0).any()
    assert _count_omitted_frames(np.array([0.0, 0.0, 7.0, 0.0]), 0.0).tolist() == [0, 0, 7, 0]
