import warnings
from dataclasses import replace
from pathlib import Path

import c3d as c3d_library
import ezc3d
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mocapfix.errors import WriteError
from mocapfix.io import capture
from mocapfix.io.c3d import write_c3d
from mocapfix.model.take import C3dLayout, TableLayout, Take
from tests.text_files import LABELS, STANDING, trc

Y_UP = STANDING[..., [1, 2, 0]] / 1000
Z_UP = np.eye(3)[[1, 2, 0]]


def build_layout(unit: float, axes: np.ndarray) -> TableLayout:
    return TableLayout("utf-8", "\n", "\t", ".", unit, rotation_y_up_file=axes)


def read_with_c3d(path: Path) -> tuple[c3d_library.Reader, np.ndarray]:
    """Return the reader of the library and its points (T, P, 5)."""
    with path.open("rb") as file, warnings.catch_warnings(action="ignore"):
        reader = c3d_library.Reader(file)
        return reader, np.array([points for _, points, _ in reader.read_frames()])


@given(
    markers=arrays(float, (5, 3, 3), elements=st.floats(-3, 3, width=32).filter(lambda x: abs(x) > 1e-6)),
    missing=arrays(bool, (5, 3)),
    sample_sd=arrays(float, (5, 3), elements=st.floats(0, 0.05) | st.just(np.nan)),
    frame=st.sampled_from([(0.001, Z_UP), (0.01, np.eye(3)), (1.0, np.eye(3)), (0.0254, np.eye(3)[[2, 0, 1]])]),
    first=st.sampled_from([0, 1, 695, 65_533, 70_000]),
    rate=st.sampled_from([30.0, 59.94, 120.0, 1000.0]),
)
def test_a_take_reads_back(tmp_path_factory, markers, missing, sample_sd, frame, first, rate):
    path = tmp_path_factory.mktemp("new") / "take.c3d"
    labels = ("LFHD", "Jim:LANK", "Zehe_größte")
    take = Take(
        np.where(missing[..., None], np.nan, markers), labels, rate, first, layout=build_layout(*frame), sample_sd=sample_sd
    )
    write_c3d(path, take)
    copy = capture.read_take(path)
    assert (copy.labels, copy.first_frame, copy.frame_count) == (labels, first, 5)
    assert copy.rate == pytest.approx(rate, rel=1e-7)
    np.testing.assert_allclose(copy.markers, take.markers, atol=4e-7)
    assert isinstance(copy.layout, C3dLayout)
    np.testing.assert_array_equal(copy.layout.rotation_y_up_file, frame[1])
    assert copy.layout.unit_m == (frame[0] if frame[0] != 0.0254 else 0.001)
    words = copy.layout.view_words(path.read_bytes())[..., 3]
    counts = np.clip(np.rint(sample_sd / 1e-4), 1, 255)
    np.testing.assert_array_equal(words, np.where(missing, -1, np.where(np.isnan(sample_sd), 0, counts)))


def test_other_libraries_read_the_same(tmp_path):
    xyz = STANDING.copy()
    xyz[1, 2] = np.nan
    (tmp_path / "walk.trc").write_text(trc(xyz, first=185), encoding="utf-8")
    take = capture.read_take(tmp_path / "walk.trc")
    write_c3d(tmp_path / "walk.c3d", take)
    file = ezc3d.c3d(str(tmp_path / "walk.c3d"))
    np.testing.assert_allclose(file["data"]["points"][:3].transpose(2, 1, 0), xyz, rtol=1e-6)
    assert file["parameters"]["POINT"]["LABELS"]["value"] == list(LABELS)
    assert file["header"]["points"]["first_frame"] == 184  # counted from 0
    reader, points = read_with_c3d(tmp_path / "walk.c3d")
    assert (reader.first_frame, reader.last_frame, reader.point_rate) == (185, 188, 100)
    assert [label.strip() for label in reader.point_labels] == list(LABELS)
    visible = ~np.isnan(xyz[..., 0])
    np.testing.assert_allclose(points[visible][:, :3], xyz[visible], rtol=1e-6)
    assert points[1, 2, 3] == -1


def test_estimated_samples_read_back_as_computed(tmp_path):
    markers, sample_sd = np.tile(Y_UP, (10, 1, 1)), np.full((40, 3), np.nan)
    sample_sd[3:9, 1] = 0.004
    computed = np.zeros((40, 3), bool)
    computed[20, 2] = True  # computed in the source file, without a standard sample_sd
    write_c3d(tmp_path / "take.c3d", Take(markers, LABELS, 100, sample_sd=sample_sd, computed=computed))
    copy = capture.read_take(tmp_path / "take.c3d")
    np.testing.assert_array_equal(copy.computed, ~np.isnan(sample_sd) | computed)
    assert copy.uncaptured is not None
    assert not copy.uncaptured.any()


def test_unlabelled_trajectories_follow_the_markers(tmp_path):
    unlabelled = Take(Y_UP[:, :1] + 1, ("*7",), 100)
    write_c3d(tmp_path / "take.c3d", Take(Y_UP, LABELS, 100, unlabelled=unlabelled))
    copy = capture.read_take(tmp_path / "take.c3d")
    assert copy.labels == LABELS
    assert copy.unlabelled is not None
    assert copy.unlabelled.labels == ("*7",)
    np.testing.assert_allclose(copy.unlabelled.markers, unlabelled.markers, atol=1e-6)


@settings(max_examples=6)
@given(count=st.integers(250, 700), width=st.integers(5, 120))
def test_more_labels_than_one_parameter_holds(tmp_path_factory, count, width):
    path = tmp_path_factory.mktemp("many") / "take.c3d"
    labels = tuple(f"M{i}".ljust(width, "x") for i in range(count))
    markers = np.random.default_rng(0).normal(size=(2, count, 3))
    write_c3d(path, Take(markers, labels, 100))
    copy = capture.read_take(path)
    assert copy.labels == labels
    np.testing.assert_allclose(copy.markers, markers, atol=1e-6)
    np.testing.assert_allclose(read_with_c3d(path)[1][..., :3], markers[..., [2, 0, 1]] * 1000, rtol=1e-4, atol=1e-3)


def test_more_frames_than_the_header_holds(tmp_path):
    markers = np.random.default_rng(0).normal(size=(70_000, 1, 3))
    write_c3d(tmp_path / "long.c3d", Take(markers, ("LFHD",), 100, first_frame=3))
    copy = capture.read_take(tmp_path / "long.c3d")
    assert (copy.first_frame, copy.frame_count) == (3, 70_000)
    np.testing.assert_allclose(copy.markers, markers, atol=1e-6)
    assert ezc3d.c3d(str(tmp_path / "long.c3d"))["data"]["points"].shape == (4, 1, 70_000)
    reader, points = read_with_c3d(tmp_path / "long.c3d")
    assert (reader.first_frame, reader.last_frame, len(points)) == (3, 70_002, 70_000)


def test_a_take_without_a_file_is_written_in_millimetres_with_z_up(tmp_path):
    write_c3d(tmp_path / "take.c3d", Take(Y_UP, LABELS, 100, first_frame=-20))
    point = ezc3d.c3d(str(tmp_path / "take.c3d"))["parameters"]["POINT"]
    assert (point["UNITS"]["value"], point["X_SCREEN"]["value"], point["Y_SCREEN"]["value"]) == (["mm"], ["+X"], ["+Z"])
    assert capture.read_take(tmp_path / "take.c3d").first_frame == 1  # C3D has no negative frame numbers


def test_takes_that_a_c3d_cannot_hold_are_refused(tmp_path):
    take = Take(Y_UP, LABELS, 100)
    with pytest.raises(WriteError, match="longer than the 255 bytes"):
        write_c3d(tmp_path / "take.c3d", replace(take, labels=("x" * 256, "LANK", "LFIN")))
    many = Take(np.zeros((1, 1000, 3)), tuple(f"{i}".ljust(200, "x") for i in range(1000)), 100)
    with pytest.raises(WriteError, match="1000 points with such labels are more than a C3D can hold"):
        write_c3d(tmp_path / "take.c3d", many)
    with pytest.raises(WriteError, match="cannot be written"):
        write_c3d(tmp_path / "nowhere" / "take.c3d", take)
    assert not list(tmp_path.iterdir())
