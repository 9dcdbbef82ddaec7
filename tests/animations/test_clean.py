"""Cleaning of a composed motion that was damaged in known places, through the command line and the Python API."""

import json
import re
from dataclasses import dataclass, replace
from html import unescape
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation, Slerp

from mocapfix import pipeline
from mocapfix.animations.clean import AnimationResult, find_body
from mocapfix.animations.detect import detect_animation_faults
from mocapfix.cli import app
from mocapfix.io import asf_amc, bvh
from mocapfix.io.asf_amc import write_asf_amc
from mocapfix.io.bvh import write_bvh
from mocapfix.io.coordinates import ROTATIONS_TO_Y_UP
from mocapfix.io.patches import patch_animation
from mocapfix.model.animation import Animation
from mocapfix.synthetic import compose_take
from tests import bvh_files
from tests.captures import CAPTURES, needs_captures

ARM = ("RightArm", "RightForeArm")
# Damaged tracks, first and last frame in the file's numbering from 1, and kind of the fault.
DAMAGE = (
    (ARM, 200, 260, "gap"),
    (("LeftUpLeg",), 330, 330, "pop"),
    (("LeftForeArm",), 400, 411, "flip"),
    (("Spine",), 480, 515, "jitter"),
    (("Hips position",), 560, 561, "spike"),
)


@dataclass(frozen=True)
class Walk:
    """A sound motion, the path of the damaged file, and the files that cleaning it wrote."""

    truth: Animation
    path: Path
    outputs: dict[str, Path]


def damage_values(truth: Animation) -> np.ndarray:
    """Return the channel values (T, C) with all faults of DAMAGE."""
    values, rng = truth.values.copy(), np.random.default_rng(0)
    for joints, first, last, kind in DAMAGE:
        span = slice(first - 1, last)
        for joint in joints:
            is_root = kind == "spike"
            columns = truth.get_position_channels(0)[0] if is_root else get_rotation_columns(truth, joint)
            if kind == "gap":
                values[span, columns] = 0.0
            elif kind == "jitter":
                values[span, columns] += rng.normal(scale=2.0, size=values[span, columns].shape)
            else:
                values[span, columns[0]] += {"pop": 35.0, "flip": 180.0, "spike": 20.0}[kind]
    return values


def get_rotation_columns(animation: Animation, joint: str) -> np.ndarray:
    return animation.get_rotation_channels(animation.names.index(joint))[0]


@pytest.fixture(scope="module")
def walk(tmp_path_factory) -> Walk:
    folder = tmp_path_factory.mktemp("walk")
    composed = compose_take(seed=1, seconds=6.0)
    write_bvh(folder / "truth.bvh", composed.subject.skeleton, composed.motion, composed.rate)
    truth = bvh.read_bvh(folder / "truth.bvh")
    patch_animation(folder / "walk.bvh", truth, damage_values(truth))
    with pytest.raises(SystemExit) as exit_info:
        app.run_command_line(["clean", str(folder / "walk.bvh"), "--also", "gltf,trc", "--bvh-for", "blender", "--fps", "60"])
    assert exit_info.value.code == 0
    outputs = {path.name.removeprefix("walk."): path for path in (folder / "walk.mocapfix").iterdir()}
    return Walk(truth, folder / "walk.bvh", outputs)


def compute_rms_error_deg(truth: Animation, rotations: np.ndarray, joints: tuple[str, ...], first: int, last: int) -> float:
    """Return the error of local rotations over frames in the file's numbering."""
    indices, span = [truth.names.index(joint) for joint in joints], slice(first - 1, last)
    difference = np.swapaxes(truth.compute_local_rotations()[span, indices], -1, -2) @ rotations[span, indices]
    return float(np.degrees(np.sqrt((Rotation.from_matrix(difference.reshape(-1, 3, 3)).magnitude() ** 2).mean())))


def interpolate_rotations(truth: Animation, joints: tuple[str, ...], first: int, last: int) -> np.ndarray:
    """Return the local rotations with some joints interpolated over frames in the file's numbering."""
    local, ends = truth.compute_local_rotations().copy(), np.array([first - 2, last])
    for j in (truth.names.index(joint) for joint in joints):
        local[first - 1 : last, j] = Slerp(ends, Rotation.from_matrix(local[ends, j]))(np.arange(first - 1, last)).as_matrix()
    return local


def test_requested_files_are_written_and_no_subject(walk):
    default = {"bvh", "changes.yaml", "report.json", "report.html", "rrd"}
    assert set(walk.outputs) == default | {"glb", "trc", "blender.bvh"}
    assert "Frames: 360\n" in walk.outputs["blender.bvh"].read_text(encoding="utf-8")


def test_a_figure_that_lies_in_its_rest_pose_and_all_frames_needs_the_up_axis(walk):
    body, reason = find_body(replace(walk.truth, rotation_y_up_file=ROTATIONS_TO_Y_UP["X"]))
    assert body is None
    assert reason.endswith("give it with --up.")
    assert find_body(walk.truth)[0] is not None


def test_faults_are_detected_where_they_are_and_nowhere_else(walk):
    report = json.loads(walk.outputs["report.json"].read_text(encoding="utf-8"))
    found = {(each["kind"], each["marker"]): (each["first"], each["last"]) for each in report["faults"]}
    assert {(kind, joints[0]) for joints, _, _, kind in DAMAGE} == set(found)
    for joints, first, last, kind in DAMAGE:
        a, b = found[kind, joints[0]]
        slack = 6 if kind == "jitter" else 0
        assert first <= a <= first + slack
        assert last - slack <= b <= last
    assert report["take"]["markers"] == 31
    assert report["take"]["animation"] is True
    assert report["fill"]["missing_before"] == report["fill"]["filled"] == 2 * 61
    assert report["fill"]["left_empty"] == 0
    pop = next(each for each in report["faults"] if each["kind"] == "pop")
    assert pop["severity_deg"] == pytest.approx(35, abs=2)
    assert pop["severity_m"] is None


def test_repaired_joints_are_more_accurate_than_interpolated_ones(walk):
    repaired, damaged = bvh.read_bvh(walk.outputs["bvh"]), bvh.read_bvh(walk.path)
    for joints, first, last, kind in DAMAGE:
        if kind == "spike":
            difference = repaired.compute_local_positions() - walk.truth.compute_local_positions()
            assert np.abs(difference[first - 1 : last, 0]).max() < 0.002
            continue
        error = compute_rms_error_deg(walk.truth, repaired.compute_local_rotations(), joints, first, last)
        if kind == "jitter":  # the true motion is so smooth that interpolation cannot be improved on
            assert error < 0.9 * compute_rms_error_deg(walk.truth, damaged.compute_local_rotations(), joints, first, last)
        else:
            interpolated = interpolate_rotations(walk.truth, joints, first, last)
            assert error <= max(compute_rms_error_deg(walk.truth, interpolated, joints, first, last), 0.2)


def test_bytes_outside_the_faults_do_not_change(walk):
    before, after = (path.read_bytes().split(b"\n") for path in (walk.path, walk.outputs["bvh"]))
    head = next(n for n, line in enumerate(before) if line.startswith(b"Frame Time")) + 1
    assert before[:head] == after[:head]
    allowed = {head + frame - 1 for _, first, last, _ in DAMAGE for frame in range(first, last + 1)}
    assert {n for n, (a, b) in enumerate(zip(before, after, strict=True)) if a != b} <= allowed
    words = [line.split() for line in (before[head + 329], after[head + 329])]
    columns = set(get_rotation_columns(walk.truth, "LeftUpLeg"))
    assert {n for n, (a, b) in enumerate(zip(*words, strict=True)) if a != b} <= columns


def test_second_cleaning_changes_nothing(walk, mocapfix, tmp_path):
    status, out, _ = mocapfix("inspect", walk.outputs["bvh"])
    assert (status, "No faults were detected." in out) == (0, True)
    mocapfix("clean", walk.outputs["bvh"], "--out", tmp_path)
    assert (tmp_path / "walk.bvh").read_bytes() == walk.outputs["bvh"].read_bytes()


@pytest.mark.parametrize("decision", ["reject", "keep"])
def test_declined_change_restores_the_bytes(walk, mocapfix, tmp_path, decision):
    review = yaml.safe_load(walk.outputs["changes.yaml"].read_text(encoding="utf-8"))
    review["changes"][[each["kind"] for each in review["changes"]].index("pop")]["decision"] = decision
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(review), encoding="utf-8")
    status, out, _ = mocapfix("clean", walk.path, "--out", tmp_path, "--changes", tmp_path / "mine.yaml")
    assert (status, "1 rejected by decision" in out) == (0, True)
    before, first, second = (path.read_bytes().split(b"\n") for path in (walk.path, walk.outputs["bvh"], tmp_path / "walk.bvh"))
    differing = [n for n, (a, b) in enumerate(zip(first, second, strict=True)) if a != b]
    pop = second.index(next(line for line in second if line.startswith(b"Frame Time"))) + 330
    assert second[pop] == before[pop]
    # If the pop is kept, repairs that use these frames may change slightly.
    assert differing == [pop] if decision == "reject" else pop in differing


@pytest.mark.parametrize(
    ("options", "kinds"),
    [
        ({"repair_kinds": ("pop",)}, {"pop"}),
        ({"frames": (300, 420)}, {"pop", "flip"}),
        ({"keep": ("LeftUpLeg", *ARM, "Hips")}, {"flip", "jitter"}),
        ({"max_gap_s": 0.4}, {"pop", "flip", "jitter", "spike"}),
        ({"max_sd_m": 1e-4, "prior": "none"}, {"pop", "flip", "jitter", "spike"}),
    ],
)
def test_only_editable_values_change(walk, options, kinds):
    result = pipeline.clean(walk.path, **options)
    assert isinstance(result, AnimationResult)
    assert {each.kind for each in result.changes} == kinds
    before, after = result.input_animation.values, result.animation.values
    changed = {frame + 1 for frame in np.flatnonzero((before != after).any(1))}
    assert changed <= {frame for _, first, last, kind in DAMAGE if kind in kinds for frame in range(first, last + 1)}
    if "gap" not in kinds:
        assert {each.marker for each in result.unfilled_runs} == {result.input_take.labels.index(joint) for joint in ARM}
        assert all(each.reason for each in result.unfilled_runs)


def test_held_limb_with_an_uncertain_repair_is_reported(walk, mocapfix, tmp_path):
    values, columns = walk.truth.values.copy(), [get_rotation_columns(walk.truth, joint) for joint in ARM]
    values[200:260, np.concatenate(columns)] = values[200, np.concatenate(columns)]
    patch_animation(tmp_path / "held.bvh", walk.truth, values)
    status, out, _ = mocapfix("clean", tmp_path / "held.bvh", "--limit", "0.1", "--prior", "none")
    assert status == 0
    assert "0 values were missing, 0 filled; 0 faulty ones replaced; 118 left unchanged" in out
    assert "left unchanged: RightForeArm, frames 202-260: its predicted standard deviation exceeds 0.1 mm." in out
    np.testing.assert_array_equal(bvh.read_bvh(tmp_path / "held.mocapfix" / "held.bvh").values, values)


@pytest.mark.parametrize("fault", ["none", "repeated frames", "joined takes", "reference pose"])
def test_frames_that_no_recording_has_are_reported(walk, tmp_path, fault):
    values = walk.truth.values.copy()
    if fault == "repeated frames":
        values[1::2] = values[::2]
    elif fault == "joined takes":
        values[200:, walk.truth.get_position_channels(0)[0]] += 150.0
    elif fault == "reference pose":
        values[0] = 0.0
    patch_animation(tmp_path / "walk.bvh", walk.truth, values)
    notes = pipeline.clean(tmp_path / "walk.bvh", prior="none").subject_report["notes"]
    assert sum("frames repeat the frame before" in note for note in notes) == (fault == "repeated frames")
    assert sum(note.startswith("All joints jump at frame 201:") for note in notes) == (fault == "joined takes")
    assert not any("jump at" in note for note in notes) or fault == "joined takes"


def test_html_report_uses_terms_for_joints(walk):
    page = re.sub(r"(?s)<(style|script)\b.*?</\1>", " ", walk.outputs["report.html"].read_text(encoding="utf-8"))
    text = unescape(re.sub(r"<[^>]+>", " ", page))
    assert "31 joints" in text
    assert "marker" not in text
    assert "LeftUpLeg is off by 35 degrees in one frame." in text
    assert "Relative to LHipJoint." in text


def test_inspect_reports_degrees(walk, mocapfix):
    status, out, _ = mocapfix("inspect", walk.path)
    assert status == 0
    assert "35 degrees" in out
    assert re.search(r"\bjoint\b", out)
    assert "31 joints" in out


def test_figure_with_unknown_joint_names_is_cleaned(walk, mocapfix, tmp_path):
    text = walk.path.read_text(encoding="utf-8")
    for n, name in enumerate(walk.truth.names):
        text = re.sub(rf"(ROOT|JOINT) {name}\n", rf"\1 Part{n}\n", text)
    (tmp_path / "crane.bvh").write_text(text, encoding="utf-8")
    status, out, _ = mocapfix("clean", tmp_path / "crane.bvh", "--out", tmp_path / "out", "--also", "gltf")
    found = re.search(
        r"By the shape of the skeleton: found \d+ of the 31 joints; 1\.\d+ m tall with 10 mm a unit, upright in", out
    )
    assert (status, found is not None) == (0, True)
    assert {path.suffix for path in (tmp_path / "out").iterdir()} == {".bvh", ".yaml", ".json", ".html", ".rrd", ".glb"}
    convention = ["name: parts", "title: parts of a crane", "joints:"]
    convention += [f"  {name}: [Part{n}]" for n, name in enumerate(walk.truth.names)]
    (tmp_path / "parts.yaml").write_text("\n".join(convention), encoding="utf-8")
    result = pipeline.clean(tmp_path / "crane.bvh", hierarchy=tmp_path / "parts.yaml")
    assert result.motion is not None
    assert result.motion.frame_count == walk.truth.frame_count


def test_character_of_a_figure_without_a_body_is_an_error(mocapfix, tmp_path):
    path = tmp_path / "crane.bvh"
    path.write_text(bvh_files.TEXT, encoding="utf-8")
    status, _, error = mocapfix("clean", path, "--character", "mixamo", "--accept-contradictions")
    assert (status, "mixamo.glb is not written: the animation has no body." in error) == (1, True)
    assert mocapfix("clean", path, "--also", "gltf", "--accept-contradictions", "--overwrite")[0] == 0


def check_error(outcome, *fragments: str) -> None:
    """Check that a command failed and that its error message contains the fragments."""
    status, out, err = outcome
    assert (status, out) == (1, "")
    assert "Traceback" not in err
    message = err.strip().splitlines()[-1]  # a first run reports the compilation before it
    for fragment in fragments:
        assert fragment in message


@pytest.mark.parametrize(
    ("option", "value"),
    [("--marker-set", "cmu41"), ("--subject", "x.yaml"), ("--subject-prefix", "Jim"), ("--init", "registration")],
)
def test_marker_options_are_refused(walk, mocapfix, tmp_path, option, value):
    outcome = mocapfix("clean", walk.path, "--out", tmp_path, option, value)
    check_error(outcome, f"walk.bvh: is an animation, which has no markers; clean it without {option}.")
    assert not list(tmp_path.iterdir())


def test_invalid_files_and_options_are_refused(walk, mocapfix, tmp_path, brief):
    truncated = tmp_path / "truncated.bvh"
    truncated.write_bytes(walk.path.read_bytes()[:-200])
    check_error(mocapfix("clean", truncated), "truncated.bvh, line ", "the file is damaged there")
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("name: x\ntitle: x\njoints: {Hip: [Hips]}\n", encoding="utf-8")
    clean = ("clean", walk.path, "--out", tmp_path)
    check_error(mocapfix(*clean, "--hierarchy", wrong), "wrong.yaml: joints.Hip", "there is no joint 'Hip'")
    check_error(mocapfix(*clean, "--hierarchy", "smpl"), "smpl: does not fit walk.bvh")
    check_error(
        mocapfix("clean", brief.path, "--out", tmp_path, "--hierarchy", "cmu"),
        "has markers and no joints; clean it without --hierarchy",
    )
    contacts = tmp_path / "contacts.json"
    contacts.write_text('{"LeftFoot": [[0, 100000]]}', encoding="utf-8")
    check_error(mocapfix(*clean, "--contacts", contacts), "contacts.json: LeftFoot: [0, 100000] is no first and last frame")
    check_error(
        mocapfix("clean", brief.path, "--out", tmp_path, "--contacts", contacts),
        "has markers and no joints; clean it without --contacts",
    )
    check_error(mocapfix("calibrate", walk.path, "-o", tmp_path / "s.yaml"), "is an animation without markers")
    check_error(mocapfix("marker-set", "learn", walk.path, "-o", tmp_path / "s.yaml"), "has joints and no markers to learn from")
    check_error(mocapfix(*clean, "--refill"), "has no markers; clean it without --refill")
    check_error(mocapfix(*clean, "--events"), "has no markers; clean it without --events")
    check_error(mocapfix(*clean, "--keep", "Tail"), "has no joint Tail to keep; its joints are Hips")
    check_error(mocapfix(*clean, "--changes", wrong), "wrong.yaml: ")
    check_error(mocapfix("clean", walk.path, "--out", walk.path.parent), "would replace the input file")
    assert {path.name for path in tmp_path.iterdir()} == {"truncated.bvh", "wrong.yaml", "contacts.json"}


def test_single_frame_does_not_change(walk, tmp_path):
    lines = walk.path.read_text(encoding="utf-8").split("\n")
    head = next(n for n, line in enumerate(lines) if line.startswith("Frame Time")) + 1
    text = "\n".join([*lines[: head + 1], ""]).replace("Frames: 720", "Frames: 1")
    (tmp_path / "pose.bvh").write_text(text, encoding="utf-8")
    outputs = pipeline.clean(tmp_path / "pose.bvh").write(tmp_path / "out")
    assert outputs["bvh"].read_text(encoding="utf-8") == text


def test_job_file_names_the_hierarchy(walk, mocapfix, tmp_path):
    (tmp_path / "s.yaml").write_text(f"kind: clean\ntitle: one\ntakes: ['{walk.path}']\nhierarchy: smpl\n", encoding="utf-8")
    status, _, err = mocapfix("run", tmp_path / "s.yaml", "--out", tmp_path / "out")
    assert status == 1
    assert "smpl: does not fit walk.bvh" in err


def test_amc_is_written_with_its_asf(walk, tmp_path):
    source = pipeline.clean(walk.path, repair_kinds=("flip",))
    assert source.subject is not None
    assert source.motion is not None
    rate, skeleton = source.input_take.rate, source.subject.skeleton
    write_asf_amc(tmp_path / "walk.asf", tmp_path / "walk.amc", skeleton, source.motion, rate, 7)
    result = pipeline.clean(tmp_path / "walk.amc")
    outputs = result.write(tmp_path / "out")
    assert {"amc", "asf", "bvh", "report.json"} <= set(outputs)
    assert outputs["asf"].read_bytes() == (tmp_path / "walk.asf").read_bytes()
    kinds = {(each.kind, each.first) for each in result.changes}
    assert ("pop", 330 + 6) in kinds
    before, after = (asf_amc.read_amc(path) for path in (tmp_path / "walk.amc", outputs["amc"]))
    changed = np.flatnonzero((before.values != after.values).any(1)) + 1
    assert set(changed) <= {frame for _, first, last, _ in DAMAGE for frame in range(first, last + 1)}


def test_absent_values_are_filled(walk, tmp_path):
    words = [line.split(" ") for line in walk.path.read_text(encoding="utf-8").split("\n")]
    head = next(n for n, line in enumerate(words) if line[0] == "Frame") + 1
    columns = get_rotation_columns(walk.truth, "LeftForeArm")
    for frame in range(100, 130):
        for column in columns:
            words[head + frame][column] = "nan"
    (tmp_path / "holes.bvh").write_text("\n".join(" ".join(line) for line in words), encoding="utf-8")
    result = pipeline.clean(tmp_path / "holes.bvh", repair_kinds=("gap",))
    assert isinstance(result, AnimationResult)
    elbow = result.input_take.labels.index("LeftForeArm")
    assert not result.input_take.visible[100:130, elbow].any()
    assert np.isfinite(result.animation.values).all()
    assert "nan" not in result.write(tmp_path / "out")["bvh"].read_text(encoding="utf-8")


@needs_captures
@pytest.mark.parametrize("name", ["cmu/02_01.bvh", "cmu/02_01.amc", "bvh-other/louise.bvh", "bvh-other/Male1_B3_Walk.bvh"])
def test_sound_capture_does_not_change(name, tmp_path):
    result = pipeline.clean(CAPTURES / name)
    outputs = result.write(tmp_path)
    copy = outputs[Path(name).suffix[1:]]
    assert result.faults.items == ()
    assert copy.read_bytes() == (CAPTURES / name).read_bytes()


@needs_captures
def test_damaged_capture_is_repaired(tmp_path):
    truth = bvh.read_bvh(CAPTURES / "cmu/06_01.bvh")
    values = truth.values.copy()
    leg = get_rotation_columns(truth, "LeftUpLeg")
    values[150, leg[0]] += 40
    arm = np.concatenate([get_rotation_columns(truth, joint) for joint in ARM])
    values[250:290, arm] = 0
    patch_animation(tmp_path / "in.bvh", truth, values)
    result = pipeline.clean(tmp_path / "in.bvh")
    assert isinstance(result, AnimationResult)
    changes = [(each.kind, each.markers[0], each.first, each.last) for each in result.changes]
    assert [each for each in changes if "Thumb" not in each[1]] == [  # CMU's own thumbs flip now and then
        ("pop", "LeftUpLeg", 151, 151),
        ("gap", "RightArm", 251, 290),
    ]
    rotations = result.animation.compute_local_rotations()
    assert compute_rms_error_deg(truth, rotations, ("LeftUpLeg",), 151, 151) < 1.5
    interpolated = compute_rms_error_deg(truth, interpolate_rotations(truth, ARM, 251, 290), ARM, 251, 290)
    assert compute_rms_error_deg(truth, rotations, ARM, 251, 290) < interpolated
    assert detect_animation_faults(result.animation) == []
