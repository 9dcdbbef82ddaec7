import re
import struct
import time
import tracemalloc
from pathlib import Path

import ezc3d
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.errors import ReadError
from mocapfix.io import c3d, capture
from mocapfix.model.take import C3dLayout
from tests.c3d_files import ENCODINGS, c3d_bytes
from tests.captures import CAPTURES, needs_captures

UNREADABLE = {"bad_parameter_section.c3d", "empty.c3d"}
READABLE = sorted(path for folder in ("c3d", "cmu") for path in (CAPTURES / folder).glob("*.c3d") if path.name not in UNREADABLE)

LABELS = ("Jim:LFHD", "Jim:LANK", "Jim:LFIN")
NOISE = np.random.default_rng(0).normal(size=(4, 3, 3))
# One person standing in mm, Z up: head, ankle, hand over four frames; every number is a whole count of 0.1.
STANDING = np.array([[[10, 20, 1700], [0, 30, 80], [400, 20.5, 1000]]], float) + np.arange(4)[:, None, None]


def write_and_read(folder: Path, *args, **options):
    path = folder / "take.c3d"
    path.write_bytes(c3d_bytes(*args, **options))
    return capture.read_take(path)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_all_six_encodings_give_the_same_metres_with_y_up(tmp_path, encoding):
    take = write_and_read(tmp_path, STANDING, LABELS, encoding=encoding)
    np.testing.assert_allclose(take.markers, STANDING[..., [1, 2, 0]] / 1000, atol=1e-7)
    assert take.labels == LABELS
    assert take.rate == 120
    assert take.other_labels == ()
    np.testing.assert_array_equal(take.point_columns, [0, 1, 2])


@pytest.mark.parametrize(
    ("units", "metres"),
    [("mm", 0.001), ("cm ", 0.01), ("M", 1.0), ("Meters", 1.0), ("in", 0.0254), (None, 0.001), (["mm", "mm"], 0.001)],
)
def test_units(tmp_path, units, metres):
    take = write_and_read(tmp_path, STANDING, LABELS, extra={"POINT:UNITS": units, "POINT:Y_SCREEN": "+Y"})
    np.testing.assert_allclose(take.markers, STANDING * metres, rtol=1e-6)


@pytest.mark.parametrize(("vertical", "order"), [("+Y", [0, 1, 2]), ("+Z", [1, 2, 0]), ("-Z", [1, 2, 0]), ("+X", [2, 0, 1])])
def test_the_up_axis_is_read_from_y_screen(tmp_path, vertical, order):
    take = write_and_read(tmp_path, STANDING, LABELS, extra={"POINT:X_SCREEN": "+X", "POINT:Y_SCREEN": vertical})
    np.testing.assert_allclose(take.markers, STANDING[..., order] / 1000, atol=1e-7)
    assert isinstance(take.layout, C3dLayout)
    assert np.linalg.det(take.layout.rotation_y_up_file) == 1


@pytest.mark.parametrize("up", [0, 1, 2])
def test_the_up_axis_is_estimated_from_head_and_feet(tmp_path, up):
    file = np.roll(STANDING, up - 2, axis=-1)
    take = write_and_read(tmp_path, file, LABELS)
    np.testing.assert_allclose(take.markers, STANDING[..., [1, 2, 0]] / 1000, atol=1e-7)


@pytest.mark.parametrize(("tall", "order"), [(1, [0, 1, 2]), (2, [1, 2, 0])])
def test_the_up_axis_is_estimated_from_the_extent_of_the_body(tmp_path, tall, order):
    file = np.roll(STANDING, tall - 2, axis=-1)
    take = write_and_read(tmp_path, file, ("A", "B", "C"))
    np.testing.assert_allclose(take.markers, file[..., order] / 1000, atol=1e-7)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_blocks_of_frames_are_read_like_the_whole_file(tmp_path, encoding, monkeypatch):
    random = np.random.default_rng(0)
    xyz = random.normal(scale=500, size=(9, 3)) + random.normal(scale=10, size=(60, 9, 3))
    xyz[:, 8] = (xyz[:, 0] + xyz[:, 1]) / 2
    xyz[random.random((60, 9)) < 0.1] = 0
    path = tmp_path / "take.c3d"
    path.write_bytes(c3d_bytes(xyz, [f"M{letter}" for letter in "ABCDEFGHI"], encoding=encoding))
    whole = capture.read_take(path)
    monkeypatch.setattr(c3d, "MAX_BLOCK_SAMPLES", 7 * 9)
    in_blocks = capture.read_take(path)
    np.testing.assert_array_equal(in_blocks.markers, whole.markers)
    assert whole.computed_points is not None
    assert in_blocks.computed_points is not None
    np.testing.assert_array_equal(in_blocks.computed_points.take.markers, whole.computed_points.take.markers)
    assert in_blocks.labels == whole.labels == tuple(f"M{letter}" for letter in "ABCDEFGH")


def test_memory_of_reading_is_that_of_the_file_and_its_markers(tmp_path):
    path = tmp_path / "take.c3d"
    xyz = np.random.default_rng(0).normal(scale=500, size=(10_000, 100, 3))
    path.write_bytes(c3d_bytes(xyz, [f"M{m}A" for m in range(100)], extra={"POINT:Y_SCREEN": "+Z"}))
    del xyz
    capture.read_take(path)  # compiles
    tracemalloc.start()
    try:
        take = capture.read_take(path)
        peak_bytes = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    # Residual words have a quarter of the file, flags of the samples an eighth.
    assert peak_bytes < 1.4 * path.stat().st_size + take.markers.nbytes + 15e6


@pytest.mark.parametrize("is_float", [False, True])
def test_only_invalid_samples_are_nan(tmp_path, is_float):
    xyz, words = STANDING.copy(), np.full((4, 3), 5)
    words[0, 0] = -1
    xyz[1, 1] = 0
    expected = np.ones((4, 3), bool)
    expected[0, 0] = expected[1, 1] = False
    if is_float:
        xyz[1, 2], xyz[2, 2], xyz[3, 0], xyz[3, 1] = -9999.99, 9999999, np.nan, np.inf
        expected[1, 2] = expected[2, 2] = expected[3, 0] = expected[3, 1] = False
    take = write_and_read(tmp_path, xyz, LABELS, words, encoding=(84, is_float))
    np.testing.assert_array_equal(take.visible, expected)
    np.testing.assert_array_equal(np.isnan(take.markers).all(-1), ~expected)


def test_a_coordinate_of_zero_alone_is_valid(tmp_path):
    xyz = STANDING.copy()
    xyz[0, 0] = (0, 0, 1700)
    assert write_and_read(tmp_path, xyz, LABELS).visible.all()


def test_first_frame_of_the_header(tmp_path):
    take = write_and_read(tmp_path, STANDING, LABELS, first=40)
    assert (take.first_frame, take.frame_count, take.get_frame_number(3)) == (40, 4, 43)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("header", [65535, 70000], ids=["saturated", "wrapped"])
def test_first_frame_beyond_65535(tmp_path, encoding, header):
    trial = {"TRIAL:ACTUAL_START_FIELD": [70000 - 65536, 1], "TRIAL:ACTUAL_END_FIELD": [70003 - 65536, 1]}
    take = write_and_read(tmp_path, STANDING, LABELS, encoding=encoding, first=header, extra=trial)
    assert (take.first_frame, take.frame_count, take.get_frame_number(3)) == (70000, 4, 70003)


@pytest.mark.parametrize("processor", [84, 85, 86])
@pytest.mark.parametrize(
    "frame_parameters",
    [
        {"POINT:LONG_FRAMES": 70000.0},
        {"POINT:FRAMES": 70000.0},
        {"TRIAL:ACTUAL_START_FIELD": [1, 0], "TRIAL:ACTUAL_END_FIELD": [70000 - 65536, 1]},
    ],
)
def test_frame_counts_beyond_the_header_word(tmp_path, frame_parameters, processor):
    xyz = np.ones((70000, 1, 3))
    xyz[-1] = 2
    take = write_and_read(tmp_path, xyz, ["A"], encoding=(processor, False), extra=frame_parameters)
    assert (take.frame_count, take.notes) == (70000, ())
    np.testing.assert_allclose(take.markers[[0, -2, -1], 0, 0], [0.001, 0.001, 0.002])


def test_undeclared_frames_beyond_65535_are_read_and_noted(tmp_path):
    take = write_and_read(tmp_path, np.ones((70000, 3, 3)), LABELS, encoding=(84, False), extra={"POINT:FRAMES": 65535})
    assert take.visible[:70000].all()
    assert take.frame_count == 70000 + 256 // 30  # the rest of the last block is indistinguishable from frames
    assert take.notes == ("The header declares 65535 frames; the file has 70008.",)


def test_a_shortened_file_with_its_old_header_is_read_and_noted(tmp_path):
    path = tmp_path / "take.c3d"
    path.write_bytes(c3d_bytes(STANDING, LABELS)[: -256 - 2 * 60])  # two frames of three points and three analog words
    take = capture.read_take(path)
    np.testing.assert_allclose(take.markers, STANDING[:2][..., [1, 2, 0]] / 1000, atol=1e-7)
    assert take.notes == ("The header declares 4 frames; the file has 2.",)


@pytest.mark.parametrize("encoding", ENCODINGS)
@given(rate=st.floats(5, 2000, width=32), scale=st.floats(0.125, 2, width=32))
def test_numeric_parameters_in_every_encoding(tmp_path_factory, encoding, rate, scale):
    folder = tmp_path_factory.mktemp("numbers")
    take = write_and_read(folder, STANDING, LABELS, encoding=encoding, scale=scale, extra={"POINT:RATE": rate})
    assert isinstance(take.layout, C3dLayout)
    assert (take.rate, take.layout.scale_factor) == (rate, scale)


def test_subject_names_are_read(tmp_path):
    bare = [label.removeprefix("Jim:") for label in LABELS]
    jims = write_and_read(tmp_path, STANDING, bare, extra={"SUBJECTS:USED": 1, "SUBJECTS:NAMES": ["Jim   "]})
    assert (jims.subject_names, jims.marker_subjects) == (("Jim",), ("Jim",) * 3)
    several = write_and_read(tmp_path, STANDING, ["Jim:LFHD", "Ann:LANK", "LFIN"], extra={"SUBJECTS:NAMES": ["Jim", "Ann"]})
    assert (several.subject_names, several.marker_subjects) == (("Jim", "Ann"), ("Jim", "Ann", ""))


def test_the_header_overrules_a_larger_frame_count_parameter(tmp_path):
    assert write_and_read(tmp_path, STANDING, LABELS, extra={"POINT:FRAMES": 900}).frame_count == 4


def test_labels_beyond_255_and_their_columns(tmp_path):
    labels = [f"*{i}" for i in range(250)] + [f"M{i}" for i in range(250, 300)]
    xyz = np.arange(1, 901, dtype=float).reshape(1, 300, 3)
    take = write_and_read(tmp_path, xyz, labels, extra={"POINT:Y_SCREEN": "+Y"})
    assert take.labels == tuple(labels[250:])
    assert len(take.other_labels) == 250
    np.testing.assert_array_equal(take.point_columns, np.arange(250, 300))
    np.testing.assert_allclose(take.markers, xyz[:, 250:] / 1000, rtol=1e-6)


@pytest.mark.parametrize("processor", [84, 85, 86])
def test_label_lists_over_several_parameters(tmp_path, processor):
    """600 points. The list of scalars is longer than 255 too: every second label from 0 to 598."""
    labels = [f"M{i}" for i in range(600)]
    scalars = {"POINT:SCALARS": labels[:510:2], "POINT:SCALARS2": labels[510::2]}
    take = write_and_read(tmp_path, np.full((1, 600, 3), 50.0), labels, encoding=(processor, False), extra=scalars)
    assert take.labels == tuple(labels[1::2])
    assert take.other_labels == tuple(labels[::2])


def test_unlabelled_points_and_model_outputs_are_not_markers(tmp_path):
    others = ["*12", "", "#", "Uname*1", "C_123", "17", "Jim:*3", "Unlabeled 20", "Jim:Crank", "LKneeAngles", "Jim:LHipMoment"]
    others += ["Jim:PELO", "Jim:PELA", "Jim:PELL", "Jim:PELP", "CentreOfMass", "Jim:5", "Unlabeled:7"]
    markers = ["LFHD", "Jim:LANK", "Jim:Marker_1", "P1", "C7", "LP", "LA", "Genoux_C", "Jim:Stick 1", "Box:1", "Box:2"]
    labels = [*others, *markers]
    xyz = np.arange(1, 3 * len(labels) + 1, dtype=float).reshape(1, -1, 3)
    take = write_and_read(tmp_path, xyz, labels, extra={"POINT:SCALARS": ["Jim:Crank", "Other"]})
    assert take.labels == tuple(markers)
    assert take.other_labels == tuple(others)


def test_unlabelled_trajectories_are_read_as_a_separate_take(tmp_path):
    xyz = np.concatenate([STANDING, STANDING[:, ::-1] + 5, STANDING[:, :1] * 0], axis=1)
    labels = [*LABELS, "*12", "LKneeAngles", "Uname*1", "*99"]  # the last is never visible
    take = write_and_read(tmp_path, xyz, labels, extra={"POINT:Y_SCREEN": "+Y"})
    assert take.unlabelled is not None
    assert take.unlabelled.labels == ("*12", "Uname*1")
    np.testing.assert_array_equal(take.unlabelled.point_columns, [3, 5])
    np.testing.assert_allclose(take.unlabelled.markers, xyz[:, [3, 5]] / 1000, rtol=1e-6)
    assert take.unlabelled.rate == take.rate
    assert write_and_read(tmp_path, STANDING, LABELS).unlabelled is None


def test_points_after_the_last_captured_one_are_computed(tmp_path):
    labels = ["A", "B", "C", "D", "RHJ0", "LHJ0", "HED0"]
    xyz, words = np.full((2, 7, 3), 100.0), np.zeros((2, 7))
    words[0, [0, 3]] = 0x0305
    assert write_and_read(tmp_path, xyz, labels, words).labels == ("A", "B", "C", "D")
    assert write_and_read(tmp_path, xyz, labels).labels == tuple(labels)  # no residuals: all are measured
    assert write_and_read(tmp_path, xyz[:, :6], labels[:6], words[:, :6]).labels == tuple(labels[:6])  # two may be edited markers
    words[0, [0, 3]] = 0x0005
    assert write_and_read(tmp_path, xyz, labels, words).labels == tuple(
        labels
    )  # residuals without cameras, as Qualisys and a fill


def test_duplicate_labels_and_invisible_markers_are_kept(tmp_path):
    xyz = STANDING.copy()
    xyz[:, 2] = 0
    take = write_and_read(tmp_path, xyz, ("LFHD", "LFHD", "LANK"))
    assert take.labels == ("LFHD", "LFHD", "LANK")
    np.testing.assert_array_equal(take.visible.any(0), [True, True, False])


def test_more_or_fewer_labels_than_points(tmp_path):
    assert write_and_read(tmp_path, STANDING, [*LABELS, "Late", "Later"]).labels == LABELS
    assert write_and_read(tmp_path, STANDING, LABELS[:2]).other_labels == ("",)


BAD = {
    "the first bytes of a C3D": (b"\x02\x50" + bytes(100), "first 102 bytes"),
    "noise with the magic byte": (b"\x02\x50" + np.random.default_rng(1).bytes(5000), "damaged"),
    "no points": (c3d_bytes(np.zeros((4, 0, 3)), ["x"]), "no points"),
    "no frames": (c3d_bytes(np.zeros((0, 3, 3)), LABELS), "no frames"),
    "strange units": (
        c3d_bytes(STANDING, LABELS, extra={"POINT:UNITS": "furlong"}),
        "'furlong'; give the unit with --unit",
    ),
    "no rate": (
        c3d_bytes(STANDING, LABELS, extra={"POINT:RATE": 0.0}),
        "POINT:RATE: a frame rate of 0 Hz is not possible (5 to 2000); give it with --rate HZ",
    ),
    "no scale": (c3d_bytes(STANDING, LABELS, extra={"POINT:SCALE": 0.0}), "POINT:SCALE is 0"),
    "two numbers of points": (c3d_bytes(NOISE, LABELS, extra={"POINT:USED": 5}), "3 points or 5 points"),
    "cut off": (c3d_bytes(STANDING, LABELS)[: -256 - 2 * 60 - 1], "4 frames are declared and 1 are there"),
    "only its header": (c3d_bytes(STANDING, LABELS)[: -256 - 4 * 60], "4 frames are declared and 0 are there"),
}


@pytest.mark.parametrize("case", BAD)
def test_invalid_files_are_refused_with_their_name(tmp_path, case):
    data, words = BAD[case]
    path = tmp_path / "walk.c3d"
    path.write_bytes(data)
    with pytest.raises(ReadError) as error:
        capture.read_take(path)
    assert str(error.value).startswith(str(path))
    assert words in str(error.value)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("processor", "order"), [(84, "<"), (86, ">")])
def test_a_signalling_nan_is_missing_without_a_warning(tmp_path, processor, order):
    data = c3d_bytes(STANDING, LABELS, encoding=(processor, True))
    path = tmp_path / "take.c3d"
    path.write_bytes(data.replace(struct.pack(f"{order}f", 1700), struct.pack(f"{order}I", 0x7F800001)))
    assert np.argwhere(~capture.read_take(path).visible).tolist() == [[0, 0]]


@given(place=st.integers(0, 1023), byte=st.integers(0, 255), keep=st.integers(0, 2000))
def test_damaged_files_are_read_or_refused(tmp_path_factory, place, byte, keep):
    data = bytearray(c3d_bytes(STANDING, LABELS))
    data[place] = byte
    path = tmp_path_factory.mktemp("damaged") / "take.c3d"
    path.write_bytes(data[: 600 + keep])
    try:
        take = capture.read_take(path)
    except ReadError:
        return
    assert take.markers.shape == (take.frame_count, len(take.labels), 3)


MARKERS = {  # counted by hand from the labels
    "05_13.c3d": 41,
    "HDM_bd_05-01_01_120.c3d": 41,
    "FunctionalWalk.c3d": 65,
    "JA1Gait35.c3d": 51,
    "Movement_trial.c3d": 39,
    "PiG_Calibration-FlatFoot-Hole.c3d": 35,
    "PiG_Motion-FlatFoot-Hole.c3d": 35,
    "Qualisys.c3d": 55,
    "hockey_whole_body.c3d": 46,
    "sub_labels.c3d": 50,
}


@needs_captures
@pytest.mark.parametrize("path", READABLE, ids=lambda path: path.name)
def test_captures_are_upright_and_have_the_expected_markers(path):
    take = capture.read_take(path)
    assert len(take.labels) == MARKERS.get(path.name, len(take.labels))
    assert isinstance(take.layout, C3dLayout)
    assert len(take.labels) + len(take.other_labels) == take.layout.point_count
    if path.name == "Optotrak.c3d":
        return  # its origin is the camera and not the floor
    # What a laboratory captures lies above its floor and within a few metres.
    assert -0.1 < np.nanmin(np.nanpercentile(take.markers[..., 1], 5)) < np.nanpercentile(take.markers[..., 1], 95) < 2.5


@needs_captures
@pytest.mark.parametrize("path", [path for path in READABLE if path.name != "sgi_real.c3d"], ids=lambda path: path.name)
def test_captures_agree_with_ezc3d(path):
    take = capture.read_take(path)
    oracle = ezc3d.c3d(str(path))
    expected_positions = oracle["data"]["points"][:3, take.point_columns].transpose(2, 1, 0)
    assert isinstance(take.layout, C3dLayout)
    ours = take.markers @ take.layout.rotation_y_up_file / take.layout.unit_m
    np.testing.assert_allclose(ours[take.visible], expected_positions[take.visible], rtol=1e-6, atol=1e-4)
    assert (~np.isfinite(expected_positions[~take.visible]) | (expected_positions[~take.visible] == 0)).all()
    assert take.rate == pytest.approx(oracle["parameters"]["POINT"]["RATE"]["value"][0])
    # ezc3d counts from 0 and reads a first frame 0 as 1.
    assert max(take.first_frame, 1) == oracle["header"]["points"]["first_frame"] + 1


ROW = re.compile(r"\| (?:c3d|cmu)/(\S+\.c3d) \|.*?\| (\d+) points, (\d+) frames, ([\d.]+) Hz, unit (\w+),")
SOURCES = (CAPTURES / "SOURCES.md").read_text(encoding="utf-8") if CAPTURES.is_dir() else ""


@needs_captures
@pytest.mark.parametrize("row", ROW.findall(SOURCES), ids=lambda row: row[0])
def test_captures_have_the_points_frames_and_rate_of_their_source(row):
    name, points, frames, rate, unit = row
    take = capture.read_take(next(CAPTURES.rglob(name)))
    assert isinstance(take.layout, C3dLayout)
    assert (take.layout.point_count, take.frame_count, take.rate) == (int(points), int(frames), float(rate))
    assert take.layout.unit_m == {"mm": 0.001, "m": 1.0}[unit]


@needs_captures
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_real_trial_is_equal_in_all_six_encodings(tmp_path, encoding):
    trial = capture.read_take(CAPTURES / "c3d" / "pc_int.c3d")
    layout = trial.layout
    assert isinstance(layout, C3dLayout)
    assert trial.path is not None
    words = layout.view_words(trial.path.read_bytes())
    xyz, extra = words[..., :3] * layout.scale_factor, {"POINT:RATE": 50.0, "POINT:Y_SCREEN": "+Z"}
    made = c3d_bytes(xyz, trial.labels, words[..., 3], encoding, layout.scale_factor, extra=extra)
    (tmp_path / "again.c3d").write_bytes(made)
    again = capture.read_take(tmp_path / "again.c3d")
    np.testing.assert_array_equal(again.visible, trial.visible)
    assert trial.computed is not None
    np.testing.assert_array_equal(again.computed, trial.computed)
    np.testing.assert_array_equal(again.uncaptured, trial.uncaptured)
    np.testing.assert_allclose(again.markers, trial.markers, rtol=1e-7)
    assert (again.labels, again.rate) == (trial.labels, trial.rate)


@needs_captures
def test_one_trial_in_three_encodings():
    intel, dec, sgi = (capture.read_take(CAPTURES / "c3d" / f"{name}.c3d") for name in ("pc_int", "dec_real", "sgi_real"))
    np.testing.assert_array_equal(dec.markers, sgi.markers)
    np.testing.assert_array_equal(intel.visible, dec.visible)
    np.testing.assert_allclose(intel.markers, dec.markers, atol=0.0005)  # half a count of 0.28 mm plus rounding


@needs_captures
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("bad_parameter_section.c3d", "damaged"),
        ("empty.c3d", "empty"),
    ],
)
def test_invalid_captures_are_refused_quickly(name, words):
    start = time.perf_counter()
    with pytest.raises(ReadError, match=words):
        capture.read_take(CAPTURES / "c3d" / name)
    assert time.perf_counter() - start < 1


def test_file_without_labels_is_read_with_its_unlabelled_points_only(tmp_path):
    path = tmp_path / "unlabelled.c3d"
    path.write_bytes(c3d_bytes(STANDING, ["*1", "*2", ""]))
    take = capture.read_take(path)
    assert take.labels == ()
    assert take.markers.shape == (len(STANDING), 0, 3)
    assert take.unlabelled is not None
    assert take.unlabelled.markers.shape == STANDING.shape
