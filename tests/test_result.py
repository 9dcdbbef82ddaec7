"""Output files: optional formats beside the default ones, all of them or none."""

import json
import re
import threading
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mocapfix import pipeline
from mocapfix.errors import SceneError, WriteError
from mocapfix.io import capture
from mocapfix.io.text_tables import write_trc
from mocapfix.model.take import TableLayout
from mocapfix.options import RIG_NAMES, OutputOptions, build_clean_options
from mocapfix.output_formats import OPTIONAL_FORMATS, list_output_formats
from mocapfix.result import CleaningResult, build_output_notes, list_clean_arguments
from mocapfix.solve.parallel import second_process
from mocapfix.synthetic import compose_take, write_synthetic_take
from tests.conftest import FIRST_FRAME
from tests.io.read_back import Bvh, smooth_rotations

ALL_FORMATS = OutputOptions(extra_formats=tuple(OPTIONAL_FORMATS), rigs=RIG_NAMES)
MOTION_SUFFIXES = ("bvh", "glb", "asf", "amc", *(f"{name}.bvh" for name in RIG_NAMES))


@pytest.fixture
def solved(cleaned) -> CleaningResult:
    """Return the cleaned take with half a second of its motion, which is written quickly."""
    return replace(cleaned.result, motion=cleaned.result.motion.select_frames(np.arange(61)))


@pytest.fixture
def without_body(cleaned) -> CleaningResult:
    return replace(cleaned.result, subject=None, motion=None, joint_position_world=None, residual_m=None)


@pytest.fixture(autouse=True)
def without_report_files(monkeypatch):
    """Replace the recording and the HTML report, which take most of the time and are not tested here."""
    monkeypatch.setattr(
        "mocapfix.report.recording.write_recording",
        lambda target, *_: target.write_text(f"rrd by {threading.current_thread().name}", encoding="utf-8"),
    )
    monkeypatch.setattr(
        "mocapfix.report.html_report.write_html_report", lambda target, *_: target.write_text("page", encoding="utf-8")
    )


def test_optional_formats_are_written_beside_the_default_ones(solved, cleaned, tmp_path, monkeypatch):
    monkeypatch.setattr("mocapfix.characters.fbx.find_blender", lambda: None)
    outputs = solved.write(tmp_path, options=ALL_FORMATS)
    assert set(outputs) == set(cleaned.outputs) | {
        "glb",
        "npz",
        "amass.npz",
        "asf",
        "amc",
        "trc",
        "csv",
        "contacts.json",
        "events.csv",
        "usd",
        "sheet.png",
        *(f"{name}.bvh" for name in RIG_NAMES),
    }
    assert {path.name for path in tmp_path.iterdir()} == {f"walk.{suffix}" for suffix in outputs}
    assert all(path.stat().st_size for path in outputs.values())
    assert any("FBX needs Blender" in note for note in json.loads(outputs["report.json"].read_text(encoding="utf-8"))["notes"])


def test_the_report_has_a_note_on_the_use_of_each_format(solved, tmp_path):
    outputs = solved.write(tmp_path, options=ALL_FORMATS)
    text = outputs["report.json"].read_text(encoding="utf-8")
    for sentence in (
        r"blender\.bvh is for Blender: metres, Y up",
        r"motionbuilder\.bvh is for MotionBuilder: centimetres, Y up; the first frame is a T-pose",
        r"3dsmax\.bvh is for 3ds Max Biped: centimetres",
        r"cmu\.bvh is for tools that read CMU's BVH release: units of 56\.444 mm, Y up; a T-pose comes before the motion",
        r"glb is binary glTF: metres, Y up\.",
    ):
        assert re.search(sentence, text)
    assert "c3d is a new file" not in text  # the cleaned file is the C3D


@pytest.mark.parametrize("suffix", [*MOTION_SUFFIXES, "npz", "c3d"])
def test_output_rate_of_the_take_changes_nothing(solved, tmp_path, suffix):
    plain = solved.write(tmp_path / "plain", options=ALL_FORMATS)
    explicit = solved.write(tmp_path / "explicit", options=replace(ALL_FORMATS, output_rate_hz=120.0))
    if suffix != "npz":
        assert plain[suffix].read_bytes() == explicit[suffix].read_bytes()
        return
    with np.load(plain[suffix]) as first, np.load(explicit[suffix]) as second:
        assert first.files == second.files
        assert all(first[name].tobytes() == second[name].tobytes() for name in first.files)


@pytest.mark.parametrize(
    ("fps", "frames", "how"), [(30.0, 16, "one of 4 solved frames"), (50.0, 26, "splines between the solved frames")]
)
def test_another_rate_applies_to_all_motion_files_with_a_note(solved, tmp_path, fps, frames, how):
    plain = solved.write(tmp_path / "plain")
    outputs = solved.write(tmp_path / "slow", options=replace(ALL_FORMATS, output_rate_hz=fps))
    for suffix in (suffix for suffix in MOTION_SUFFIXES if suffix.endswith("bvh")):
        file = Bvh(outputs[suffix].read_text(encoding="utf-8"))
        has_rest_frame = suffix in ("cmu.bvh", "motionbuilder.bvh")
        assert (file.frames, float(file.frame_time)) == (frames + has_rest_frame, pytest.approx(1 / fps, rel=1e-8))
    with np.load(outputs["npz"]) as file:
        assert (len(file["joints"]), float(file["rate"]), float(file["marker_rate"])) == (frames, fps, 120)
        np.testing.assert_array_equal(file["markers"], solved.take.markers)
    assert outputs["c3d"].read_bytes() == plain["c3d"].read_bytes()
    assert len(re.findall(r"^root ", outputs["amc"].read_text(encoding="utf-8"), re.MULTILINE)) == frames
    note = f"Motion files have {fps:g} frames per second \\({how}\\); markers keep 120"
    assert re.search(note, outputs["report.json"].read_text(encoding="utf-8"))


def test_formats_that_need_a_body_are_left_out_with_a_note(without_body, tmp_path):
    outputs = without_body.write(tmp_path, options=replace(ALL_FORMATS, output_rate_hz=30.0))
    assert set(outputs) == {"c3d", "npz", "trc", "csv", "changes.yaml", "rrd", "report.html", "report.json"}
    text = outputs["report.json"].read_text(encoding="utf-8")
    assert all(
        f"{suffix} is not written: the take has no body." in text for suffix in MOTION_SUFFIXES if suffix not in ("bvh", "asf")
    )
    assert "frames per second" not in text


def test_outputs_of_an_earlier_run_with_a_body_are_removed(solved, without_body, tmp_path):
    solved.write(tmp_path, options=ALL_FORMATS)
    outputs = without_body.write(tmp_path, overwrite=True, options=ALL_FORMATS)
    assert {path.name for path in tmp_path.iterdir()} == {f"walk.{suffix}" for suffix in outputs}


def test_a_text_take_is_written_in_its_format_and_as_a_c3d_on_request(brief, tmp_path):
    source = tmp_path / "brief.trc"
    write_trc(source, capture.read_take(brief.path))
    result = pipeline.clean(source, subject=brief.subject, extra_formats=("c3d", "trc", "npz"))
    outputs = result.write(tmp_path / "out")
    assert [path.name for suffix, path in outputs.items() if suffix in ("trc", "c3d")] == ["brief.trc", "brief.c3d"]
    for suffix in ("trc", "c3d"):
        back = capture.read_take(outputs[suffix])
        assert (back.labels, back.rate, back.first_frame) == (result.take.labels, 120, FIRST_FRAME)
        np.testing.assert_allclose(back.markers, result.take.markers, atol=2e-5)
    lines = source.read_text(encoding="utf-8").splitlines(), outputs["trc"].read_text(encoding="utf-8").splitlines()
    assert sum(before == after for before, after in zip(*lines, strict=True)) > 50  # lines without changes


def test_a_table_without_fields_for_missing_samples_is_replaced_by_a_plain_one_with_a_note(solved, tmp_path):
    layout = TableLayout("utf-8", "\n", ",", ".", unit_m=1.0)
    input_take = replace(solved.input_take, layout=layout, path=solved.input_take.path.with_suffix(".csv"))
    outputs = replace(solved, input_take=input_take).write(tmp_path, options=OutputOptions(extra_formats=("csv",)))
    assert outputs["csv"].name == "walk.csv"
    np.testing.assert_allclose(capture.read_take(outputs["csv"]).markers, solved.take.markers, atol=2e-5)
    assert "walk.csv lists only visible markers" in outputs["report.json"].read_text(encoding="utf-8")


def test_no_file_is_written_if_one_of_them_fails(solved, tmp_path):
    joint = solved.subject.skeleton.find_joint("LHipJoint")
    solved.motion.local_rotations[:, joint] = smooth_rotations(0, 61, 1, swing=0.5)[:, 0]
    (tmp_path / "walk.bvh").write_text("earlier", encoding="utf-8")
    with pytest.raises(WriteError, match="MotionBuilder"):
        solved.write(tmp_path, overwrite=True, options=OutputOptions(rigs=("motionbuilder",)))
    assert {path.name: path.read_text(encoding="utf-8") for path in tmp_path.iterdir()} == {"walk.bvh": "earlier"}


@pytest.fixture
def recorder() -> Generator[ThreadPoolExecutor]:
    """Return a thread that takes the place of the second process."""
    with ThreadPoolExecutor(1) as thread:
        thread.submit(threading.current_thread).result().name = "recorder"
        token = second_process.set(thread)
        yield thread
        second_process.reset(token)


def test_the_recording_is_written_by_the_second_process(solved, recorder, tmp_path):
    assert solved.write(tmp_path)["rrd"].read_bytes() == b"rrd by recorder"


def test_no_file_is_written_if_the_second_process_cannot_write_the_recording(recorder, solved, tmp_path, monkeypatch):
    def fail(target: Path, *_: object) -> None:
        raise OSError(f"{target.name}: the disk is full")

    monkeypatch.setattr("mocapfix.report.recording.write_recording", fail)
    with pytest.raises(WriteError, match="disk is full"):
        solved.write(tmp_path)
    assert not list(tmp_path.iterdir())


def test_an_existing_output_of_any_format_is_not_replaced(solved, tmp_path):
    (tmp_path / "walk.glb").write_text("mine", encoding="utf-8")
    with pytest.raises(WriteError, match=r"walk\.glb: already exists"):
        solved.write(tmp_path, options=OutputOptions(extra_formats=("gltf",)))
    assert [path.name for path in tmp_path.iterdir()] == ["walk.glb"]


def test_a_format_named_twice_is_written_once():
    suffixes = [each.suffix for each in list_output_formats(OutputOptions(extra_formats=("npz", "npz"), rigs=("cmu", "cmu")))]
    assert (suffixes.count("npz"), suffixes.count("cmu.bvh")) == (1, 1)


def test_an_unknown_rig_is_an_error():
    with pytest.raises(SceneError, match="no rig 'maya'"):
        list_output_formats(OutputOptions(rigs=("maya",)))


def test_two_rigs_of_one_name_are_an_error(tmp_path):
    mine = tmp_path / "cmu.yaml"
    mine.write_text(
        "{program: p, unit_m: 1, rotations: ZYX, rest: skeleton, first_frame: motion, note: n, "
        "joints: [{name: Hips, parent: null}]}",
        encoding="utf-8",
    )
    with pytest.raises(WriteError, match=r"both have the suffix \.cmu\.bvh"):
        list_output_formats(OutputOptions(rigs=("cmu", str(mine))))


def test_the_file_of_a_rig_is_read_again_only_once_it_is_changed(tmp_path):
    mine = tmp_path / "mine.yaml"
    text = (
        "{program: Maya, unit_m: 1, rotations: ZYX, rest: skeleton, first_frame: motion, note: n, "
        "joints: [{name: Hips, parent: null}]}"
    )
    mine.write_text(text, encoding="utf-8")
    options = OutputOptions(rigs=(str(mine),))
    before = list_output_formats(options)
    assert list_output_formats(options) is before
    mine.write_text(text.replace("Maya", "Houdini"), encoding="utf-8")
    notes = [each.usage_note for each in list_output_formats(options)]
    assert any(note.startswith("is for Houdini") for note in notes)


# the arguments in the report, with which a take can be cleaned again in the same way


def test_files_are_named_relative_to_the_outputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("set.yaml", "jim.yaml", "ann.yaml"):
        Path(name).write_text("", encoding="utf-8")
    options = build_clean_options(marker_set="set.yaml", subject=(("Jim", Path("jim.yaml")), ("Ann", Path("ann.yaml"))))
    arguments = list_clean_arguments(Path("walk.c3d"), options, Path("out") / "deep", "walk")
    assert arguments[1:] == ["--marker-set", "../../set.yaml", "--subject", "Jim=../../jim.yaml,Ann=../../ann.yaml"]
    options = build_clean_options(subject="jim.yaml", review_files=("set.yaml",))
    assert list_clean_arguments(Path("walk.c3d"), options, Path("out"), "walk") == ["../walk.c3d", "--subject", "../jim.yaml"]


@pytest.mark.parametrize(("trim", "is_noted"), [((301, 310), False), ((300, 310), True), ((301, 100000), True), (None, False)])
def test_trim_beyond_the_take_is_reported(cleaned, trim, is_noted):
    take = replace(cleaned.result.input_take, first_frame=301)
    notes = build_output_notes(OutputOptions(trim=trim, characters=("mixamo",)), take, has_body=True)
    assert any(note.startswith("--trim names frames that") for note in notes) == is_noted


def test_arguments_are_in_the_report(tmp_path: Path) -> None:
    path = tmp_path / "walk.c3d"
    write_synthetic_take(path, compose_take(seconds=1.0, rate=60.0))
    result = pipeline.clean(path, prior="none", max_gap_s=0.5)
    subject = result.subject
    outputs = result.write(tmp_path / "out")
    report = json.loads(outputs["report.json"].read_text(encoding="utf-8"))
    assert report["arguments"] == ["../walk.c3d", "--prior", "none", "--max-gap=0.5"]
    known = pipeline.clean(path, prior="none", subject=subject).write(tmp_path / "known")
    report = json.loads(known["report.json"].read_text(encoding="utf-8"))
    assert report["arguments"][1:3] == ["--subject", known["subject.yaml"].name]
