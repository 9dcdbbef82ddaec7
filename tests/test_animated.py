"""A composed motion as BVH, damaged in known places, and cleaned as the command line does it."""

import json
import re
from dataclasses import dataclass
from html import unescape
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation, Slerp

from mocapfix import pipeline, synthetic, write
from mocapfix.animation import Animation
from mocapfix.animations import clean as animated
from mocapfix.animations import joint_points
from mocapfix.cli import app
from mocapfix.options import FillOptions
from mocapfix.read import amc, bvh
from mocapfix.write.animation_patch import patch_animation

CAPTURES = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "captures"
ARM = ("RightArm", "RightForeArm")
# joints, first and last frame (the file's, from 1) and kind of what is done to the motion
DAMAGE = (
    (ARM, 200, 260, "gap"),
    (("LeftUpLeg",), 330, 330, "pop"),
    (("LeftForeArm",), 400, 411, "flip"),
    (("Spine",), 480, 515, "jitter"),
    (("Hips's place",), 560, 561, "spike"),
)


@dataclass(frozen=True)
class Walk:
    """A motion as it was, the file with its damage, and what cleaning gave."""

    truth: Animation
    path: Path
    outputs: dict[str, Path]


def damaged(truth: Animation) -> np.ndarray:
    """-> (T, C) the values with all of DAMAGE."""
    values, rng = truth.values.copy(), np.random.default_rng(0)
    for joints, first, last, kind in DAMAGE:
        span = slice(first - 1, last)
        for joint in joints:
            where = 0 if kind == "spike" else truth.names.index(joint)
            columns = truth.get_position_channels(0)[0] if kind == "spike" else truth.get_rotation_channels(where)[0]
            if kind == "gap":
                values[span, columns] = 0.0
            elif kind == "jitter":
                values[span, columns] += rng.normal(scale=2.0, size=values[span, columns].shape)
            else:
                values[span, columns[0]] += {"pop": 35.0, "flip": 180.0, "spike": 20.0}[kind]
    return values


@pytest.fixture(scope="module")
def walk(tmp_path_factory) -> Walk:
    folder = tmp_path_factory.mktemp("walk")
    made = synthetic.compose_take(seed=1, seconds=6.0)
    write.write_bvh(folder / "truth.bvh", made.subject.skeleton, made.motion, made.rate)
    truth = bvh.read_bvh(folder / "truth.bvh")
    patch_animation(folder / "walk.bvh", truth, damaged(truth))
    with pytest.raises(SystemExit) as left:
        app.run_command_line(["clean", str(folder / "walk.bvh"), "--also", "gltf,trc", "--bvh-for", "blender", "--fps", "60"])
    assert left.value.code == 0
    outputs = {path.name.removeprefix("walk."): path for path in (folder / "walk.mocapfix").iterdir()}
    return Walk(truth, folder / "walk.bvh", outputs)


def off(truth: Animation, rotations: np.ndarray, joints: tuple[str, ...], first: int, last: int) -> float:
    """-> degrees, root mean square, over the file's frames."""
    own, span = [truth.names.index(joint) for joint in joints], slice(first - 1, last)
    turned = np.swapaxes(truth.compute_local_rotations()[span, own], -1, -2) @ rotations[span, own]
    return float(np.degrees(np.sqrt((Rotation.from_matrix(turned.reshape(-1, 3, 3)).magnitude() ** 2).mean())))


def bridged(truth: Animation, joints: tuple[str, ...], first: int, last: int) -> np.ndarray:
    """-> the rotations with these joints turned evenly across the damage."""
    local, ends = truth.compute_local_rotations().copy(), np.array([first - 2, last])
    for j in (truth.names.index(joint) for joint in joints):
        local[first - 1 : last, j] = Slerp(ends, Rotation.from_matrix(local[ends, j]))(np.arange(first - 1, last)).as_matrix()
    return local


def test_what_is_written_is_what_is_asked_for_and_no_subject(walk):
    usual = {"bvh", "changes.yaml", "report.json", "report.html", "rrd"}
    assert set(walk.outputs) == usual | {"glb", "trc", "blender.bvh"}
    assert "Frames: 360\n" in walk.outputs["blender.bvh"].read_text()


def test_the_faults_are_found_where_they_are_and_nowhere_else(walk):
    report = json.loads(walk.outputs["report.json"].read_text())
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


def test_mended_joints_are_nearer_to_the_truth_than_turned_evenly_across(walk):
    mended = bvh.read_bvh(walk.outputs["bvh"])
    for joints, first, last, kind in DAMAGE:
        if kind == "spike":
            apart = (mended.compute_local_positions() - walk.truth.places())[first - 1 : last, 0]
            assert np.abs(apart).max() < 0.002
        elif kind == "jitter":  # the truth is smooth, so that nothing is better than bridging it
            was = off(walk.truth, bvh.read_bvh(walk.path).compute_local_rotations(), joints, first, last)
            assert off(walk.truth, mended.compute_local_rotations(), joints, first, last) < 0.9 * was
        else:
            even = off(walk.truth, bridged(walk.truth, joints, first, last), joints, first, last)
            assert off(walk.truth, mended.compute_local_rotations(), joints, first, last) <= max(even, 0.2)


def test_all_else_is_as_it_was_to_the_byte(walk):
    before, after = (path.read_bytes().split(b"\n") for path in (walk.path, walk.outputs["bvh"]))
    head = next(n for n, line in enumerate(before) if line.startswith(b"Frame Time")) + 1
    assert before[:head] == after[:head]
    touched = {head + frame - 1 for _, first, last, _ in DAMAGE for frame in range(first, last + 1)}
    assert {n for n, (a, b) in enumerate(zip(before, after, strict=True)) if a != b} <= touched
    words = [line.split() for line in (before[head + 329], after[head + 329])]
    own = set(walk.truth.get_rotation_channels(walk.truth.names.index("LeftUpLeg"))[0])
    assert {n for n, (a, b) in enumerate(zip(*words, strict=True)) if a != b} <= own


def test_cleaning_again_finds_nothing_and_gives_the_same_file(walk, mocapfix, tmp_path):
    status, out, _ = mocapfix("inspect", walk.outputs["bvh"])
    assert (status, "Nothing is wrong with it." in out) == (0, True)
    mocapfix("clean", walk.outputs["bvh"], "--out", tmp_path)
    assert (tmp_path / "walk.bvh").read_bytes() == walk.outputs["bvh"].read_bytes()


@pytest.mark.parametrize("decision", ["reject", "keep"])
def test_a_decision_gives_the_old_bytes_back(walk, mocapfix, tmp_path, decision):
    said = yaml.safe_load(walk.outputs["changes.yaml"].read_text())
    said["changes"][[each["kind"] for each in said["changes"]].index("pop")]["decision"] = decision
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(said))
    status, out, _ = mocapfix("clean", walk.path, "--out", tmp_path, "--changes", tmp_path / "mine.yaml")
    assert (status, "1 not made, by decision" in out) == (0, True)
    before, made, now = (path.read_bytes().split(b"\n") for path in (walk.path, walk.outputs["bvh"], tmp_path / "walk.bvh"))
    differing = [n for n, (a, b) in enumerate(zip(made, now, strict=True)) if a != b]
    pop = now.index(next(line for line in now if line.startswith(b"Frame Time"))) + 330
    assert now[pop] == before[pop]
    # where the pop is believed, what is smoothed or recalled may come out a little otherwise
    assert differing == [pop] if decision == "reject" else pop in differing


@pytest.mark.parametrize(
    ("asked", "kinds"),
    [
        ({"repair_kinds": ("pop",)}, {"pop"}),
        ({"frames": (300, 420)}, {"pop", "flip"}),
        ({"keep": ("LeftUpLeg", *ARM, "Hips")}, {"flip", "jitter"}),
        ({"max_gap_s": 0.4}, {"pop", "flip", "jitter", "spike"}),
        ({"max_sd_m": 1e-4, "prior": "none"}, {"pop", "flip", "jitter", "spike"}),
    ],
)
def test_only_what_may_be_touched_is(walk, asked, kinds):
    result = pipeline.clean(walk.path, **asked)
    assert {each.kind for each in result.changes} == kinds
    before, after = (joint_points.get_animation(take).values for take in (result.input_take, result.take))
    changed = {frame + 1 for frame in np.flatnonzero((before != after).any(1))}
    assert changed <= {frame for _, first, last, kind in DAMAGE if kind in kinds for frame in range(first, last + 1)}
    if "gap" not in kinds:
        assert {each.marker for each in result.unfilled_runs} == {result.input_take.labels.index(joint) for joint in ARM}
        assert all(each.reason for each in result.unfilled_runs)


def test_the_page_speaks_of_joints(walk):
    text = unescape(re.sub(r"<[^>]+>", " ", walk.outputs["report.html"].read_text()))
    assert "31 joints" in text
    assert "marker" not in text.replace("markers keep", "")
    assert "LeftUpLeg is off by 35 degrees in one frame." in text
    assert "Seen from LHipJoint." in text


def test_inspect_tells_degrees(walk, mocapfix):
    status, out, _ = mocapfix("inspect", walk.path)
    assert status == 0
    assert "35 degrees" in out
    assert re.search(r"\bjoint\b", out)
    assert "31 joints" in out


def test_a_figure_that_is_nobodys_is_cleaned_all_the_same(walk, mocapfix, tmp_path):
    text = walk.path.read_text()
    for n, name in enumerate(walk.truth.names):
        text = re.sub(rf"(ROOT|JOINT) {name}\n", rf"\1 Part{n}\n", text)
    (tmp_path / "crane.bvh").write_text(text)
    status, out, _ = mocapfix("clean", tmp_path / "crane.bvh", "--out", tmp_path / "out", "--also", "gltf")
    assert (status, "There is no glb, for whose joints are whose is not known." in out) == (0, True)
    assert {path.suffix for path in (tmp_path / "out").iterdir()} == {".bvh", ".yaml", ".json", ".html", ".rrd"}
    known = ["name: parts", "title: parts of a crane", "joints:"]
    known += [f"  {name}: [Part{n}]" for n, name in enumerate(walk.truth.names)]
    (tmp_path / "parts.yaml").write_text("\n".join(known))
    found = pipeline.clean(tmp_path / "crane.bvh", hierarchy=tmp_path / "parts.yaml")
    assert found.motion is not None
    assert found.motion.frame_count == walk.truth.frames


def said(done, *sentences: str) -> None:
    status, out, err = done
    assert (status, out) == (1, "")
    assert "Traceback" not in err
    last = err.strip().splitlines()[-1]  # a first run tells before it that it compiles
    for sentence in sentences:
        assert sentence in last


@pytest.mark.parametrize(
    ("option", "value"),
    [("--marker-set", "cmu41"), ("--subject", "x.yaml"), ("--subject-prefix", "Jim"), ("--init", "registration")],
)
def test_what_is_about_markers_is_refused(walk, mocapfix, tmp_path, option, value):
    done = mocapfix("clean", walk.path, "--out", tmp_path, option, value)
    said(done, f"walk.bvh: has joints and no markers, of which {option} tells; clean it without.")
    assert not list(tmp_path.iterdir())


def test_faults_of_files_are_sentences(walk, mocapfix, tmp_path, brief):
    torn = tmp_path / "torn.bvh"
    torn.write_bytes(walk.path.read_bytes()[:-200])
    said(mocapfix("clean", torn), "torn.bvh, line ", "the file is torn there")
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("name: x\ntitle: x\njoints: {Hip: [Hips]}\n")
    clean = ("clean", walk.path, "--out", tmp_path)
    said(mocapfix(*clean, "--hierarchy", wrong), "wrong.yaml: joints.Hip", "there is no joint 'Hip'")
    said(mocapfix(*clean, "--hierarchy", "smpl"), "smpl: does not fit walk.bvh")
    said(mocapfix("clean", brief.path, "--out", tmp_path, "--hierarchy", "cmu"), "has markers and no joints")
    said(mocapfix("calibrate", walk.path, "-o", tmp_path / "s.yaml"), "has joints and no markers to learn from")
    said(mocapfix("marker-set", "learn", walk.path, "-o", tmp_path / "s.yaml"), "has joints and no markers to learn from")
    said(mocapfix(*clean, "--refill"), "has joints and no markers, of which --refill tells")
    said(mocapfix(*clean, "--keep", "Tail"), "has no joint Tail to keep; its joints are Hips")
    said(mocapfix(*clean, "--changes", wrong), "wrong.yaml: ")
    said(mocapfix("clean", walk.path, "--out", walk.path.parent), "would replace the input file")
    assert {path.name for path in tmp_path.iterdir()} == {"torn.bvh", "wrong.yaml"}


def test_one_pose_comes_back_as_it_is(walk, tmp_path):
    lines = walk.path.read_text().split("\n")
    head = next(n for n, line in enumerate(lines) if line.startswith("Frame Time")) + 1
    text = "\n".join([*lines[: head + 1], ""]).replace("Frames: 720", "Frames: 1")
    (tmp_path / "pose.bvh").write_text(text)
    outputs = pipeline.clean(tmp_path / "pose.bvh").write(tmp_path / "out")
    assert outputs["bvh"].read_text() == text


def test_a_scene_names_the_joints(walk, mocapfix, tmp_path):
    (tmp_path / "s.yaml").write_text(f"kind: clean\ntitle: one\ntakes: ['{walk.path}']\nhierarchy: smpl\n")
    status, _, err = mocapfix("run", tmp_path / "s.yaml", "--out", tmp_path / "out")
    assert status == 1
    assert "smpl: does not fit walk.bvh" in err


def test_an_amc_comes_back_as_one_with_its_skeleton(walk, tmp_path):
    made = pipeline.clean(walk.path, repair_kinds=("flip",))
    assert made.subject is not None
    assert made.motion is not None
    write.write_asf_amc(tmp_path / "walk.asf", tmp_path / "walk.amc", made.subject.skeleton, made.motion, made.input_take.rate, 7)
    found = pipeline.clean(tmp_path / "walk.amc")
    outputs = found.write(tmp_path / "out")
    assert {"amc", "asf", "bvh", "report.json"} <= set(outputs)
    assert outputs["asf"].read_bytes() == (tmp_path / "walk.asf").read_bytes()
    kinds = {(each.kind, each.first) for each in found.changes}
    assert ("pop", 330 + 6) in kinds
    before, after = (amc.read_amc(path) for path in (tmp_path / "walk.amc", outputs["amc"]))
    differing = np.flatnonzero((before.values != after.values).any(1)) + 1
    assert set(differing) <= {frame for _, first, last, _ in DAMAGE for frame in range(first, last + 1)}


def test_numbers_that_are_not_there_are_missing_and_found_again(walk, tmp_path):
    words = [line.split(" ") for line in walk.path.read_text().split("\n")]
    head = next(n for n, line in enumerate(words) if line[0] == "Frame") + 1
    own = walk.truth.get_rotation_channels(walk.truth.names.index("LeftForeArm"))[0]
    for frame in range(100, 130):
        for column in own:
            words[head + frame][column] = "nan"
    (tmp_path / "holes.bvh").write_text("\n".join(" ".join(line) for line in words))
    result = pipeline.clean(tmp_path / "holes.bvh", repair_kinds=("gap",))
    elbow = result.input_take.labels.index("LeftForeArm")
    assert not result.input_take.visible[100:130, elbow].any()
    assert np.isfinite(joint_points.get_animation(result.take).values).all()
    assert "nan" not in result.write(tmp_path / "out")["bvh"].read_text()


@pytest.mark.skipif(not CAPTURES.is_dir(), reason="the real captures are not here")
@pytest.mark.parametrize("name", ["cmu/02_01.bvh", "cmu/02_01.amc", "bvh-other/louise.bvh", "bvh-other/Male1_B3_Walk.bvh"])
def test_a_sound_capture_comes_back_byte_for_byte(name, tmp_path):
    result = pipeline.clean(CAPTURES / name)
    outputs = result.write(tmp_path)
    own = outputs[Path(name).suffix[1:]]
    assert result.faults.items == ()
    assert own.read_bytes() == (CAPTURES / name).read_bytes()


@pytest.mark.skipif(not CAPTURES.is_dir(), reason="the real captures are not here")
def test_a_damaged_capture_is_mended_where_it_was_damaged(tmp_path):
    truth = bvh.read_bvh(CAPTURES / "cmu/06_01.bvh")
    values = truth.values.copy()
    leg = truth.get_rotation_channels(truth.names.index("LeftUpLeg"))[0]
    values[150, leg[0]] += 40
    arm = np.concatenate([truth.get_rotation_channels(truth.names.index(joint))[0] for joint in ARM])
    values[250:290, arm] = 0
    patch_animation(tmp_path / "in.bvh", truth, values)
    result = pipeline.clean(tmp_path / "in.bvh")
    told = [(each.kind, each.markers[0], each.first, each.last) for each in result.changes]
    assert [each for each in told if "Thumb" not in each[1]] == [  # CMU's own thumbs turn over now and then
        ("pop", "LeftUpLeg", 151, 151),
        ("gap", "RightArm", 251, 290),
    ]
    mended = joint_points.get_animation(result.take)
    assert off(truth, mended.compute_local_rotations(), ("LeftUpLeg",), 151, 151) < 1.5
    even = off(truth, bridged(truth, ARM, 251, 290), ARM, 251, 290)
    assert off(truth, mended.compute_local_rotations(), ARM, 251, 290) < even
    assert animated.detect_animation_faults(mended) == []
