"""What is written beside the usual files: together with them, or not at all."""

import re
from dataclasses import replace

import numpy as np
import pytest

from mocapfix import pipeline, write
from mocapfix.errors import SceneError, WriteError
from mocapfix.files.layouts import TableLayout
from mocapfix.options import RIG_NAMES
from mocapfix.read import capture
from mocapfix.result import CleaningResult
from mocapfix.write.output_formats import OPTIONAL_FORMATS
from mocapfix.options import OutputOptions
from tests.conftest import FIRST
from tests.write.read_back import Bvh, smooth_rotations

EVERYTHING = OutputOptions(extra_formats=tuple(OPTIONAL_FORMATS), rigs=RIG_NAMES)
MOVES = ("bvh", "glb", "asf", "amc", *(f"{name}.bvh" for name in RIG_NAMES))


@pytest.fixture
def solved(cleaned) -> CleaningResult:
    """-> half a second of the cleaned take's body, so that writing it is quick"""
    return replace(cleaned.result, motion=cleaned.result.motion.at(np.arange(61)))


@pytest.fixture
def without(cleaned) -> CleaningResult:
    return replace(cleaned.result, subject=None, motion=None, joint_position_world=None, residual_m=None)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """The recording and the page are not looked at here, and they cost most of the time."""
    monkeypatch.setattr("mocapfix.report.recording", lambda target, shown: target.write_bytes(b"rrd"))
    monkeypatch.setattr("mocapfix.report.html_report", lambda target, report, shown: target.write_text("page"))


def test_what_is_asked_for_is_written_beside_the_usual(solved, cleaned, tmp_path):
    outputs = solved.write(tmp_path, options=EVERYTHING)
    assert set(outputs) == set(cleaned.get_output_paths) | {
        "glb",
        "npz",
        "asf",
        "amc",
        "trc",
        "csv",
        *(f"{name}.bvh" for name in RIG_NAMES),
    }
    assert {path.name for path in tmp_path.iterdir()} == {f"somebody.{kind}" for kind in outputs}
    assert all(path.stat().st_size for path in outputs.values())


def test_the_report_says_of_each_what_whoever_opens_it_must_know(solved, tmp_path):
    outputs = solved.write(tmp_path, options=EVERYTHING)
    said = outputs["report.json"].read_text()
    for sentence in (
        r"blender\.bvh is for Blender: metres, Y up",
        r"motionbuilder\.bvh is for MotionBuilder: centimetres, Y up; its first frame is a T-pose",
        r"3dsmax\.bvh is for 3ds Max Biped: centimetres",
        r"cmu\.bvh is for whatever reads CMU's BVH release: units of 56\.444 mm, Y up; a T-pose comes before the motion",
        r"glb is binary glTF: metres, Y up\.",
    ):
        assert re.search(sentence, said)
    assert "c3d is new" not in said  # the take's own file is that


@pytest.mark.parametrize("kind", [*MOVES, "npz", "c3d"])
def test_at_the_take_s_own_rate_nothing_changes(solved, tmp_path, kind):
    plain = solved.write(tmp_path / "plain", options=EVERYTHING)
    asked = solved.write(tmp_path / "asked", options=replace(EVERYTHING, fps=120.0))
    if kind != "npz":
        assert plain[kind].read_bytes() == asked[kind].read_bytes()
        return
    with np.load(plain[kind]) as first, np.load(asked[kind]) as second:
        assert first.review_files == second.review_files
        assert all(first[name].tobytes() == second[name].tobytes() for name in first.review_files)


@pytest.mark.parametrize(("fps", "frames", "how"), [(30.0, 16, "one of 4, as solved"), (50.0, 26, "on splines through")])
def test_another_rate_is_that_of_all_that_moves_and_is_said(solved, tmp_path, fps, frames, how):
    plain = solved.write(tmp_path / "plain")
    outputs = solved.write(tmp_path / "slow", options=replace(EVERYTHING, fps=fps))
    for kind in (kind for kind in MOVES if kind.endswith("bvh")):
        read = Bvh(outputs[kind].read_text())
        lead = kind in ("cmu.bvh", "motionbuilder.bvh")
        assert (read.frames, float(read.frame_time)) == (frames + lead, pytest.approx(1 / fps, rel=1e-8))
    with np.load(outputs["npz"]) as file:
        assert (len(file["joints"]), float(file["rate"]), float(file["marker_rate"])) == (frames, fps, 120)
        np.testing.assert_array_equal(file["markers"], solved.take.markers)
    assert outputs["c3d"].read_bytes() == plain["c3d"].read_bytes()
    assert len(re.findall(r"^root ", outputs["amc"].read_text(), re.M)) == frames
    said = f"What moves has {fps:g} frames a second \\({how}.*\\); markers keep the take's 120"
    assert re.search(said, outputs["report.json"].read_text())


def test_without_a_body_what_needs_one_is_not_there_and_that_is_said(without, tmp_path):
    outputs = without.write(tmp_path, options=replace(EVERYTHING, fps=30.0))
    assert set(outputs) == {"c3d", "npz", "trc", "csv", "changes.yaml", "rrd", "report.html", "report.json"}
    said = outputs["report.json"].read_text()
    assert all(f"There is no {kind}, for the take has no skeleton." in said for kind in MOVES if kind not in ("bvh", "asf"))
    assert "frames a second" not in said


def test_of_an_earlier_cleaning_with_a_body_nothing_stays(solved, without, tmp_path):
    solved.write(tmp_path, options=EVERYTHING)
    outputs = without.write(tmp_path, overwrite=True, options=EVERYTHING)
    assert {path.name for path in tmp_path.iterdir()} == {f"somebody.{kind}" for kind in outputs}


def test_a_text_take_comes_back_as_what_it_was_and_as_a_c3d_where_asked(brief, tmp_path):
    source = tmp_path / "brief.trc"
    write.write_trc(source, capture.read_capture(brief.path))
    result = pipeline.clean(source, subject=brief.subject)
    outputs = result.write(tmp_path / "out", options=OutputOptions(extra_formats=("c3d", "trc", "npz")))
    assert [path.name for kind, path in outputs.items() if kind in ("trc", "c3d")] == ["brief.trc", "brief.c3d"]
    for kind in ("trc", "c3d"):
        back = capture.read_capture(outputs[kind])
        assert (back.labels, back.rate, back.first_frame) == (result.take.labels, 120, FIRST)
        np.testing.assert_allclose(back.markers, result.take.markers, atol=2e-5)
    told = source.read_text().splitlines(), outputs["trc"].read_text().splitlines()
    assert sum(before == after for before, after in zip(*told, strict=True)) > 50  # lines in which nothing was mended


def test_of_a_table_that_lists_only_what_was_seen_a_plain_one_is_made_and_that_is_said(solved, tmp_path):
    layout = TableLayout("utf-8", "\n", ",", ".", unit_m=1.0)
    before = replace(solved.before, layout=layout, path=solved.before.path.with_suffix(".csv"))
    outputs = replace(solved, before=before).write(tmp_path, options=OutputOptions(extra_formats=("csv",)))
    assert outputs["csv"].name == "somebody.csv"
    np.testing.assert_allclose(capture.read_capture(outputs["csv"]).markers, solved.take.markers, atol=2e-5)
    assert "somebody.csv lists only what was seen" in outputs["report.json"].read_text()


def test_where_one_of_them_cannot_be_written_none_is(solved, tmp_path):
    stub = solved.subject.skeleton.index("LHipJoint")
    solved.motion.rotations[:, stub] = smooth_rotations(0, 61, 1, swing=0.5)[:, 0]
    (tmp_path / "somebody.bvh").write_text("earlier")
    with pytest.raises(WriteError, match="MotionBuilder"):
        solved.write(tmp_path, overwrite=True, options=OutputOptions(rigs=("motionbuilder",)))
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"somebody.bvh": "earlier"}


def test_what_is_there_of_another_kind_stops_all_of_them(solved, tmp_path):
    (tmp_path / "somebody.glb").write_text("mine")
    with pytest.raises(WriteError, match=r"somebody\.glb: is there already"):
        solved.write(tmp_path, options=OutputOptions(extra_formats=("gltf",)))
    assert [path.name for path in tmp_path.iterdir()] == ["somebody.glb"]


def test_a_kind_that_is_named_twice_is_written_once():
    suffixes = [kind.suffix for kind in OutputOptions(extra_formats=("npz", "npz"), rigs=("cmu", "cmu")).formats]
    assert (suffixes.count("npz"), suffixes.count("cmu.bvh")) == (1, 1)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"also": ("fbx",)}, "no kind of file 'fbx' to write; choose of: gltf, amc, npz, c3d, trc, csv"),
        ({"bvh_for": ("maya",)}, "no rig 'maya'"),
        ({"fps": 0.0}, "more than 0 and at most 1000, not 0"),
        ({"fps": float("nan")}, "more than 0 and at most 1000, not nan"),
        ({"fps": 1e9}, "more than 0 and at most 1000"),
    ],
)
def test_what_there_is_not_is_answered_with_what_there_is(asked, said):
    with pytest.raises((WriteError, SceneError), match=said):
        OutputOptions(**asked)


def test_two_rigs_of_one_name_would_be_one_file(tmp_path):
    mine = tmp_path / "cmu.yaml"
    mine.write_text(
        "{program: p, unit_m: 1, rotations: ZYX, rest: skeleton, first_frame: motion, note: n, "
        "joints: [{name: Hips, parent: null}]}"
    )
    with pytest.raises(WriteError, match=r"both be called \.cmu\.bvh"):
        OutputOptions(bvh_for=("cmu", str(mine)))
