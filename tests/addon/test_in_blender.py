"""The add-on in Blender: import, import again, retarget, undo, and errors. All steps are taken by one process of Blender.

`make blender` installs Blender's Python module in .blender; without it these tests are skipped.
"""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.characters.load_character import load_character_preset
from mocapfix.io.c3d import write_c3d
from mocapfix.lab.hands import compose_hands
from mocapfix.model.windows import select_frames
from mocapfix.synthetic import compose_take, write_synthetic_take

ROOT = Path(__file__).parents[2]
PYTHON = Path(os.environ.get("BLENDER_PYTHON", ROOT / ".blender" / "bin" / "python"))
pytestmark = pytest.mark.skipif(not PYTHON.is_file(), reason="Blender's Python module is not installed (make blender)")
EXECUTABLE = Path(sys.executable).with_name("mocapfix")
CLOSE_M = 1e-4
RATE_HZ = 120.0
FRAMES = [1, 40, 77, 119, 160]
"""of the scene, after an import that starts at 1"""
LATE_START = 501
HIDDEN = (slice(100, 130), "STRN")
"""frames and marker that stay empty: its gap is longer than the option allows"""
FILLED = (slice(30, 50), "RELB")
LEG_LENGTH = 0.7
"""of the character that the motion is retargeted onto, relative to Mixamo's"""
CHANGES_BY_USER = """
armature.location, armature["note"], armature.name = (1.0, 2.0, 3.0), "mine", "Actor"
armature.constraints.new("COPY_LOCATION").name = "object constraint"
armature.pose.bones["LeftFoot"].constraints.new("IK").name = "bone constraint"
bpy.context.view_layer.objects.active = armature
bpy.ops.object.mode_set(mode="EDIT")
bone = armature.data.edit_bones.new("control")
bone.head, bone.tail = (0, 0, 0), (0, 0, 1)
bpy.ops.object.mode_set(mode="OBJECT")
bpy.context.scene.timeline_markers.new("mine", frame=7)
armature.constraints[0].mute = armature.pose.bones["LeftFoot"].constraints[0].mute = True
"""


@pytest.fixture(scope="module")
def takes(tmp_path_factory) -> Path:
    """A folder with takes: walk.c3d, motion.bvh and damaged.c3d of the same person, and hands.c3d with finger markers."""
    folder = tmp_path_factory.mktemp("takes")
    truth = compose_take(seed=3, seconds=1.4, rate=RATE_HZ)
    markers = truth.marker_positions.copy()
    for frames, label in (HIDDEN, FILLED):
        markers[frames, truth.labels.index(label)] = np.nan
    missing = np.isnan(markers[..., 0])
    write_synthetic_take(folder / "walk.c3d", replace(truth, damaged_positions=markers, missing_mask=missing))
    write_c3d(folder / "hands.c3d", select_frames(compose_hands(seed=1).take, slice(0, max(FRAMES))))
    (folder / "damaged.c3d").write_bytes((folder / "walk.c3d").read_bytes()[:6000])
    return folder


def build_character_bones() -> list[tuple[str, str | None, list[float], list[float]]]:
    """Return Mixamo's bones in centimetres, Y up, with shorter legs: names, parents, heads and tails."""
    character = load_character_preset("mixamo")
    heads, rotations = character.skeleton.compute_rest_pose()
    tails = heads + np.einsum("jab,jb->ja", rotations, np.nan_to_num(character.skeleton.ends, nan=0.03))
    hip = heads[character.skeleton.find_joint("mixamorig:LeftUpLeg"), 1]
    for points in (heads, tails):
        points[:, 1] = np.where(points[:, 1] < hip, points[:, 1] * LEG_LENGTH, points[:, 1] - hip * (1 - LEG_LENGTH))
        points *= 100.0
    parents = [character.skeleton.names[parent] if parent >= 0 else None for parent in character.skeleton.parents]
    return [
        (name, parent, head.tolist(), (tail if np.linalg.norm(tail - head) > 0.1 else head + [0, 3, 0]).tolist())
        for name, parent, head, tail in zip(character.skeleton.names, parents, heads, tails, strict=True)
    ]


@pytest.fixture(scope="module")
def archive(tmp_path_factory) -> Path:
    """The zip file of the add-on."""
    folder = tmp_path_factory.mktemp("dist")
    subprocess.run([sys.executable, ROOT / "addon" / "build_addon.py", folder], check=True, capture_output=True)
    return next(folder.glob("mocapfix_blender-*.zip"))


@pytest.fixture(scope="module")
def answers(takes, archive, tmp_path_factory) -> dict:
    """What Blender answers to every step of the tests."""
    folder = tmp_path_factory.mktemp("blender")
    walk, bvh = str(takes / "walk.c3d"), str(takes / "motion.bvh")
    mapping = str(takes / "hero.yaml")
    import_walk = {"name": "import_take", "filepath": walk, "keep_files": True, "options": "--max-gap 0.2"}
    retarget = import_walk | {"name": "retarget"}
    character = {"name": "Hero", "bones": build_character_bones(), "scale": 0.01, "rotation_x": np.pi / 2}
    job = [
        ("installed", "install", {"archive": str(archive), "executable": "/nowhere/mocapfix"}),
        ("wrong path", "run_operator", import_walk),
        ("executable", "set_executable", {"path": str(EXECUTABLE)}),
        ("no file", "run_operator", {"name": "import_take", "filepath": str(takes / "none.c3d")}),
        ("damaged", "run_operator", {"name": "import_take", "filepath": str(takes / "damaged.c3d")}),
        ("unknown option", "run_operator", import_walk | {"options": "--from-the-future"}),
        ("no armature", "run_operator", retarget),
        ("after errors", "describe_scene", {"frames": []}),
        ("import", "run_operator", import_walk),
        ("imported", "describe_scene", {"frames": FRAMES}),
        ("changes", "run_code", {"code": CHANGES_BY_USER}),
        ("import again", "run_operator", import_walk | {"start_frame": LATE_START}),
        ("imported again", "describe_scene", {"frames": [LATE_START - 1 + each for each in FRAMES]}),
        ("clear", "clear_scene", {}),
        ("hero", "add_armature", character),
        ("modes", "run_code", {"code": (
            "bones = armature.pose.bones\n"
            "bones['mixamorig:LeftArm'].rotation_mode = 'XZY'\n"
            "bones['mixamorig:RightArm'].rotation_mode = 'AXIS_ANGLE'\n"
            "bones['mixamorig:LeftLeg'].scale = (1, 2, 1)\n"
            "bpy.ops.ed.undo_push(message='before')"
        )}),
        ("retarget", "run_operator", retarget),
        ("retargeted", "describe_scene", {"frames": FRAMES}),
        ("undo", "run_code", {"code": "bpy.ops.ed.undo_push(message='after'); bpy.ops.ed.undo()"}),
        ("undone", "describe_scene", {"frames": [1]}),
        ("redo", "run_code", {"code": "bpy.ops.ed.redo()"}),
        ("redone", "describe_scene", {"frames": [77]}),
        ("own mapping", "run_operator", retarget | {"mapping_file": str(takes / "wrong.yaml")}),
        ("inherit", "run_code", {"code": "armature.data.bones['mixamorig:LeftLeg'].use_inherit_rotation = False"}),
        ("save mapping", "run_operator", {"name": "save_mapping", "filepath": mapping}),
        ("mapping field", "run_code", {"code": "answer = bpy.context.scene.mocapfix.mapping_file"}),
        ("no inheritance", "run_operator", {
            "name": "retarget", "filepath": str(takes / "walk.mocapfix" / "walk.bvh"), "mapping_file": mapping,
        }),
        ("stretch", "run_code", {"code": "armature.scale = (0.01, 0.02, 0.01); bpy.context.view_layer.update()"}),
        ("stretched", "run_operator", retarget),
        ("clear again", "clear_scene", {}),
        ("bvh", "run_code", {"code": f"import shutil; shutil.copy({str(takes / 'walk.mocapfix' / 'walk.bvh')!r}, {bvh!r})"}),
        ("import bvh", "run_operator", {"name": "import_take", "filepath": bvh, "keep_files": True}),
        ("imported bvh", "describe_scene", {"frames": FRAMES}),
        ("clear once more", "clear_scene", {}),
        ("import hands", "run_operator", import_walk | {"filepath": str(takes / "hands.c3d")}),
        ("imported hands", "describe_scene", {"frames": FRAMES}),
        ("modal", "run_modal", {"arguments": [bvh, "--also", "npz"], "escape_after": None}),
        ("cancelled", "run_modal", {"arguments": [walk], "escape_after": 3}),
        ("disabled", "run_code", {"code": (
            "answer = bpy.ops.preferences.addon_disable(module='bl_ext.user_default.mocapfix') == {'FINISHED'}\n"
            "answer = answer and not hasattr(bpy.types.Scene, 'mocapfix')"
        )}),
    ]  # fmt: skip
    job_path, answers_path = folder / "job.json", folder / "answers.json"
    job_path.write_text(json.dumps(job), encoding="utf-8")
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    environment["BLENDER_USER_RESOURCES"] = str(folder / "user")
    process = subprocess.run(
        [PYTHON, Path(__file__).with_name("inside_blender.py"), job_path, answers_path],
        env=environment, capture_output=True, text=True,
    )  # fmt: skip
    assert process.returncode == 0, process.stderr + process.stdout
    assert "Traceback" not in process.stderr + process.stdout
    return json.loads(answers_path.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def solved(answers, takes) -> dict[str, np.ndarray]:
    """The arrays that mocapfix wrote for the walk."""
    return dict(np.load(takes / "walk.mocapfix" / "walk.npz"))


def to_blender(points: np.ndarray) -> np.ndarray:
    """Return points with Y up in Blender's axes."""
    return np.stack([points[..., 0], -points[..., 2], points[..., 1]], axis=-1)


def check_heads(frames: list[dict], armature: str, solved: dict[str, np.ndarray], shift=(0.0, 0.0, 0.0)) -> None:
    for frame, answer in zip(FRAMES, frames, strict=True):
        for j in np.flatnonzero(solved["solved_joints"]):
            head = answer["heads"][armature][str(solved["names"][j])]
            np.testing.assert_allclose(head, to_blender(solved["joints"][frame - 1, j]) + shift, atol=CLOSE_M)


def test_the_extension_is_installed_from_its_zip_file_and_can_be_disabled(answers):
    assert answers["installed"]
    assert answers["disabled"]


def test_the_extension_is_valid_for_blender(archive):
    validators = list(PYTHON.parents[1].glob("lib/*/site-packages/bpy/*/scripts/addons_core/bl_pkg/cli/blender_ext.py"))
    if not validators:
        pytest.skip("this Blender has no validator of extensions")
    process = subprocess.run([PYTHON, validators[0], "validate", archive], capture_output=True, text=True)
    assert process.returncode == 0, process.stdout + process.stderr


@pytest.mark.parametrize(
    ("step", "sentence"),
    [
        ("wrong path", "/nowhere/mocapfix is not a program that can be started; correct the path of mocapfix"),
        ("no file", "none.c3d is not a file; select a take"),
        ("damaged", "damaged.c3d: is cut off"),
        ("unknown option", "mocapfix does not know the option --from-the-future"),
        ("no armature", "No armature is selected"),
        ("own mapping", "wrong.yaml"),
        ("no inheritance", "bone mixamorig:LeftLeg does not inherit rotation"),
        ("stretched", "Hero is mirrored or scaled differently along its axes"),
    ],
)
def test_errors_are_one_sentence(answers, step, sentence):
    lines = answers[step].splitlines()
    assert sentence in lines[0]
    assert lines[0].startswith("Error: ")
    assert lines[0].endswith(".")
    assert len(lines) == 1


def test_errors_leave_the_scene_as_it_was(answers):
    assert answers["after errors"]["objects"] == 0
    assert answers["after errors"]["actions"] == []


def test_heads_of_imported_bones_are_the_solved_joints(answers, solved):
    assert answers["import"] == "FINISHED"
    assert answers["imported"]["armatures"].keys() == {"walk"}
    assert answers["imported"]["armatures"]["walk"]["bones"] == [str(name) for name in solved["names"]]
    check_heads(answers["imported"]["frames"], "walk", solved)


def test_heads_of_the_bones_of_fingers_are_the_solved_joints(answers, takes):
    assert answers["import hands"] == "FINISHED"
    bones = answers["imported hands"]["armatures"]["hands"]["bones"]
    with np.load(takes / "hands.mocapfix" / "hands.npz") as file:
        for side in ("left", "right"):
            palm = bones.index(f"{side.title()}Palm")
            points = np.concatenate([file[f"{side}_hand_wrist"][:, None], file[f"{side}_hand_points"][:, :15]], axis=1)
            for frame, answer in zip(FRAMES, answers["imported hands"]["frames"], strict=True):
                heads = [answer["heads"]["hands"][bone] for bone in bones[palm : palm + 16]]
                np.testing.assert_allclose(heads, to_blender(points[frame - 1]), atol=CLOSE_M)


def test_scene_has_the_rate_and_the_range_of_the_take(answers, solved):
    scene = answers["imported"]
    assert scene["rate"] == pytest.approx(RATE_HZ)
    assert scene["range"] == [1, len(solved["joints"])]
    assert scene["armatures"]["walk"]["range"] == [1, len(solved["joints"])]


def test_rest_pose_stands_on_the_floor_and_faces_forward(answers):
    rest = {name: np.array(head) for name, head in answers["imported"]["armatures"]["walk"]["rest"].items()}
    assert min(head[2] for head in rest.values()) == pytest.approx(0, abs=0.03)
    assert rest["LeftUpLeg"][0] > 0 > rest["RightUpLeg"][0]
    assert rest["LeftToeBase"][1] < rest["LeftFoot"][1]  # Blender's -Y is the front


def test_markers_are_empties_at_the_cleaned_positions(answers, solved):
    labels = [str(label) for label in solved["labels"]]
    assert len(answers["imported"]["collections"]["walk markers"]) == 1 + len(labels)
    for frame, answer in zip(FRAMES, answers["imported"]["frames"], strict=True):
        positions = to_blender(solved["markers"][frame - 1])
        assert sorted(answer["hidden"]) == sorted(np.array(labels)[np.isnan(positions[:, 0])])
        for label, position in zip(labels, positions, strict=True):
            if np.isfinite(position).all():
                np.testing.assert_allclose(answer["markers"][label], position, atol=CLOSE_M)


def test_filled_samples_are_spheres_and_missing_ones_are_hidden(answers):
    at = dict(zip(FRAMES, answers["imported"]["frames"], strict=True))
    assert at[40]["filled"] == at[40]["spheres"] == [FILLED[1]]
    assert at[77]["filled"] == at[77]["spheres"] == []
    assert at[119]["hidden"] == [HIDDEN[1]]
    assert at[160]["hidden"] == []


def test_stretches_that_stay_empty_are_marked_on_the_timeline(answers):
    first, last = HIDDEN[0].start + 1, HIDDEN[0].stop
    assert [first, "STRN left empty"] in answers["imported"]["timeline"]
    assert [last, "end: STRN left empty"] in answers["imported"]["timeline"]


def test_importing_again_updates_in_place(answers, solved):
    before, after = answers["imported"], answers["imported again"]
    assert answers["import again"] == "FINISHED"
    assert after["armatures"].keys() == {"Actor"}
    assert after["objects"] == before["objects"]
    assert after["actions"] == before["actions"]
    assert after["collections"].keys() == before["collections"].keys()
    assert after["range"] == [LATE_START, LATE_START - 1 + len(solved["joints"])]
    check_heads(after["frames"], "Actor", solved, shift=(1.0, 2.0, 3.0))


def test_importing_again_keeps_what_is_the_users(answers):
    armature = answers["imported again"]["armatures"]["Actor"]
    np.testing.assert_allclose(np.array(armature["matrix"])[:3, 3], [1, 2, 3])
    assert armature["note"] == "mine"
    assert armature["constraints"] == ["object constraint"]
    assert armature["bone_constraints"] == [["LeftFoot", "bone constraint"]]
    assert "control" in armature["bones"]


def test_importing_again_moves_the_markers_of_the_timeline(answers):
    before, after = answers["imported"]["timeline"], answers["imported again"]["timeline"]
    assert after == sorted([[7, "mine"], *([frame + LATE_START - 1, name] for frame, name in before)])


def test_markers_follow_the_armature(answers):
    for before, after in zip(answers["imported"]["frames"], answers["imported again"]["frames"], strict=True):
        for label in set(before["markers"]) - set(before["hidden"]):
            np.testing.assert_allclose(np.subtract(after["markers"][label], before["markers"][label]), [1, 2, 3], atol=1e-5)


def compute_character_heads(motion: dict[str, np.ndarray], frame: int) -> np.ndarray:
    """Return the heads (J, 3) of a character's bones from the file that mocapfix wrote, in Blender's axes."""
    count = len(motion["names"])
    positions, rotations = np.zeros((count, 3)), np.zeros((count, 3, 3))
    local = Rotation.from_quat(motion["rotations"][frame]).as_matrix()
    for j, (parent, name) in enumerate(zip(motion["parents"], motion["names"], strict=True)):
        offset = motion["pelvis_position"][frame] if name == motion["pelvis"] else motion["rest_positions"][j]
        above = np.eye(3) if parent < 0 else rotations[parent]
        positions[j] = above @ offset + (0 if parent < 0 else positions[parent])
        rotations[j] = above @ local[j]
    return to_blender(positions)


def test_retargeted_bones_are_where_mocapfix_has_put_them(answers, takes):
    assert answers["retarget"] == "FINISHED"
    motion = dict(np.load(takes / "walk.mocapfix" / "walk.Hero.npz"))
    for frame, answer in zip(FRAMES, answers["retargeted"]["frames"], strict=True):
        heads = compute_character_heads(motion, frame - 1)
        for name, head in zip(motion["names"], heads, strict=True):
            np.testing.assert_allclose(answer["heads"]["Hero"][str(name)], head, atol=CLOSE_M, err_msg=str(name))


def test_retargeted_character_walks_upright_on_its_shorter_legs(answers, solved):
    names = ("LeftUpLeg", "LeftLeg", "LeftFoot", "RightUpLeg")
    thigh, shin, foot, right_thigh = (list(map(str, solved["names"])).index(each) for each in names)
    source = sum(np.linalg.norm(solved["offsets"][each]) for each in (shin, foot))
    rest = {name: np.array(head) for name, head in answers["retargeted"]["armatures"]["Hero"]["rest"].items()}
    hero = [rest[f"mixamorig:Left{each}"] for each in ("UpLeg", "Leg", "Foot")]
    ratio = sum(np.linalg.norm(a - b) for a, b in zip(hero[1:], hero, strict=False)) / source
    assert ratio < 0.9
    for frame, answer in zip(FRAMES, answers["retargeted"]["frames"], strict=True):
        heads = answer["heads"]["Hero"]
        height = solved["joints"][frame - 1, thigh, 1]
        assert heads["mixamorig:LeftUpLeg"][2] == pytest.approx(ratio * height, abs=0.1)
        assert heads["mixamorig:LeftFoot"][2] > -0.02
        side = np.subtract(heads["mixamorig:LeftUpLeg"], heads["mixamorig:RightUpLeg"])
        other = to_blender(solved["joints"][frame - 1, thigh] - solved["joints"][frame - 1, right_thigh])
        assert side @ other > 0.9 * np.linalg.norm(side) * np.linalg.norm(other)  # it faces the same way


def test_retargeting_keeps_rotation_modes_and_shows_the_mapping(answers):
    hero = answers["retargeted"]["armatures"]["Hero"]
    assert hero["modes"]["mixamorig:LeftArm"] == "XZY"
    assert hero["modes"]["mixamorig:RightArm"] == "AXIS_ANGLE"
    assert hero["modes"]["mixamorig:Hips"] == "QUATERNION"
    assert "mixamorig:LeftUpLeg" in answers["retargeted"]["texts"]["Hero.map.yaml"]


def test_saved_mapping_is_used_from_then_on(answers, takes):
    assert answers["save mapping"] == "FINISHED"
    assert answers["mapping field"] == str(takes / "hero.yaml")
    assert (takes / "hero.yaml").read_text(encoding="utf-8") == answers["retargeted"]["texts"]["Hero.map.yaml"]


def test_undo_removes_the_motion_in_one_step(answers):
    assert answers["undone"]["actions"] == []
    assert answers["undone"]["armatures"]["Hero"]["action"] is None
    rest = answers["undone"]["armatures"]["Hero"]["rest"]
    np.testing.assert_allclose(answers["undone"]["frames"][0]["heads"]["Hero"]["mixamorig:Hips"], rest["mixamorig:Hips"])
    index = FRAMES.index(77)
    assert answers["redone"]["frames"][0]["heads"] == answers["retargeted"]["frames"][index]["heads"]


def test_imported_bvh_has_its_own_skeleton_at_the_joints_that_mocapfix_states(answers, takes):
    assert answers["import bvh"] == "FINISHED"
    motion = np.load(takes / "motion.mocapfix" / "motion.npz")
    scene = answers["imported bvh"]
    assert scene["collections"] == {}  # an animation has no markers
    assert set(scene["armatures"]["motion"]["bones"]) == {str(label) for label in motion["labels"]}
    for frame, answer in zip(FRAMES, scene["frames"], strict=True):
        for label, position in zip(motion["labels"], motion["markers"][frame - 1], strict=True):
            np.testing.assert_allclose(answer["heads"]["motion"][str(label)], to_blender(position), atol=CLOSE_M)


def test_progress_is_shown_in_a_window(answers):
    modal = answers["modal"]
    assert (modal["result"], modal["finished"], modal["removed"]) == ("FINISHED", [True], True)
    assert modal["shown"][-1] is None  # the status text is cleared
    assert any(each and each.startswith("mocapfix: ") for each in modal["shown"])


def test_escape_stops_the_process_with_one_sentence(answers):
    cancelled = answers["cancelled"]
    assert (cancelled["result"], cancelled["finished"], cancelled["removed"]) == ("CANCELLED", [], True)
    assert cancelled["reports"] == ["Cancelled: mocapfix was stopped and nothing was changed."]
