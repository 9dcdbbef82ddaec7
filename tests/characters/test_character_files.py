"""The files of a character beside the other outputs of a take."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.characters.character import CharacterMotion, compute_character_poses
from mocapfix.characters.character_files import CharacterFiles, describe_depth
from mocapfix.characters.load_character import load_character
from mocapfix.characters.retarget_motion import retarget_motion
from mocapfix.contacts.contacts import HeldFeet
from mocapfix.errors import WriteError
from mocapfix.io.capture import read_capture
from mocapfix.io.gltf import parse_glb
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.model.animation import Animation
from mocapfix.model.skeleton import Skeleton, load_cmu31_skeleton
from mocapfix.options import FEET_LOCK, FEET_SOFT, OutputOptions
from mocapfix.output_formats import list_output_formats
from tests.characters.character_files import build_vrm
from tests.characters.walking_body import RATE, build_contacts, load_walk
from tests.io.read_back import motion_of


@pytest.fixture(autouse=True)
def without_report_files(monkeypatch):
    """Replace the recording and the HTML report, which take most of the time and are not tested here."""
    monkeypatch.setattr("mocapfix.report.recording.write_recording", lambda target, *_: target.write_bytes(b"rrd"))
    monkeypatch.setattr(
        "mocapfix.report.html_report.write_html_report", lambda target, *_: target.write_text("page", encoding="utf-8")
    )
    monkeypatch.setattr("mocapfix.characters.fbx.find_blender", lambda: None)


@pytest.fixture
def solved(cleaned):
    """Return the cleaned take with half a second of its motion."""
    return replace(cleaned.result, motion=cleaned.result.motion.select_frames(np.arange(61)))


def test_all_files_of_each_character_are_written(solved, tmp_path):
    options = OutputOptions(characters=("mixamo", "smpl"))
    outputs = solved.write(tmp_path, options=options)
    for name in ("mixamo", "smpl"):
        assert {f"{name}.{suffix}" for suffix in ("glb", "bvh", "npz", "map.yaml")} <= set(outputs)
    notes = json.loads(outputs["report.json"].read_text(encoding="utf-8"))["notes"]
    assert any("walk.mixamo.glb" in note and "as the legs are" in note for note in notes)


def test_bvh_of_a_character_moves_like_its_arrays(solved, tmp_path):
    outputs = solved.write(tmp_path, options=OutputOptions(characters=("mixamo",), output_rate_hz=30.0))
    animation = read_capture(outputs["mixamo.bvh"])
    assert isinstance(animation, Animation)
    arrays = np.load(outputs["mixamo.npz"])
    assert animation.rate == pytest.approx(30.0)
    position, _ = animation.compute_world_poses()
    hips = position[:, animation.names.index("mixamorig:Hips")]
    assert arrays["rate"] == 30.0
    assert len(arrays["pelvis_position"]) == len(hips) == 16
    np.testing.assert_allclose(hips, arrays["pelvis_position"], atol=1e-4)


def test_fbx_that_cannot_be_written_is_no_failure(solved, tmp_path):
    outputs = solved.write(tmp_path, options=OutputOptions(characters=("mixamo",), extra_formats=("fbx",)))
    assert "mixamo.fbx" not in outputs
    notes = json.loads(outputs["report.json"].read_text(encoding="utf-8"))["notes"]
    assert sum("FBX needs Blender" in note for note in notes) == 2  # of the solved skeleton, and of the character


@pytest.mark.parametrize("mode", [FEET_LOCK, FEET_SOFT])
def test_the_floor_and_locked_contacts_reach_the_character(mode, tmp_path):
    """The files hold what retargeting gives with both, and neither of them is without effect."""
    source, motion = load_walk()
    rest = load_cmu31_skeleton()
    skeleton = Skeleton(rest.names, rest.parents, source.skeleton.offsets, rest.ends)
    solved = motion_of(motion.local_rotations, motion.pelvis_position)
    contacts = build_contacts(skeleton, solved, RATE)
    raised = replace(contacts, floor=replace(contacts.floor, level_heights_m=(0.1,)), held_feet=HeldFeet(mode, 0.0))
    target = load_character("mixamo")
    CharacterFiles(target, OutputOptions()).write(tmp_path / "walk.mixamo.glb", skeleton, solved, RATE, raised)
    arrays = np.load(tmp_path / "walk.mixamo.npz")
    pelvis = arrays["pelvis_position"]

    def retarget(height_m, mode):
        floor = replace(contacts.floor, level_heights_m=(height_m,))
        return retarget_motion(source, motion, target, contacts=replace(contacts, floor=floor, held_feet=HeldFeet(mode, 0.0)))

    expected, other, on_zero = (
        retarget(*each) for each in ((0.1, mode), (0.1, FEET_SOFT if mode == FEET_LOCK else FEET_LOCK), (0.0, mode))
    )
    foot = target.mapping.bones["left_foot"][0]
    rotations = Rotation.from_quat(arrays["rotations"][:, foot]).as_matrix()
    np.testing.assert_allclose(pelvis, expected.pelvis_position, atol=1e-5)
    np.testing.assert_allclose(rotations, expected.local_rotations[:, foot], atol=1e-5)
    assert np.abs(rotations - other.local_rotations[:, foot]).max() > 1e-3
    assert (on_zero.pelvis_position[:, 1] > pelvis[:, 1] + 0.02).all()


def test_a_bone_far_under_the_floor_is_named_with_its_frame(tmp_path):
    target = load_character("mixamo")
    frames = 5
    rotations = np.tile(target.skeleton.rest_rotations, (frames, 1, 1, 1))
    pelvis = np.tile([0.0, 2.0, 0.0], (frames, 1))
    motion = CharacterMotion(pelvis, rotations, RATE)
    assert describe_depth(target, motion, 0.0) == []
    lowered = replace(motion, pelvis_position=pelvis - np.array([0.0, 4.0, 0.0]) * (np.arange(frames) == 3)[:, None])
    height = compute_character_poses(target, lowered)[0][3, :, 1]
    feet = [bone for side in ("left", "right") for part in ("foot", "toe") for bone in target.mapping.bones[f"{side}_{part}"]]
    bones = [bone for bone, parent in enumerate(target.skeleton.parents) if not {bone, parent} & {*feet}]
    bones = [bone for bone in bones if "Toe" not in target.skeleton.names[bone]]
    lowest = min(bones, key=lambda bone: height[bone])
    (sentence,) = describe_depth(target, lowered, -0.2)
    assert sentence.startswith(
        f"{target.skeleton.names[lowest]} is {-(height[lowest] + 0.2) * 1e3:.0f} mm under the floor in frame 4"
    )
    assert describe_depth(target, lowered, -5.0) == []


def test_file_names_are_checked_before_anything_is_cleaned():
    files = CharacterFiles(load_character("mixamo"), OutputOptions(extra_formats=("fbx", "npz")))
    assert files.suffixes == ("mixamo.glb", "mixamo.bvh", "mixamo.npz", "mixamo.map.yaml", "mixamo.fbx")
    list_output_formats(OutputOptions(characters=("mixamo", "mixamo")))  # the same twice is written once
    with pytest.raises(WriteError, match=r"both have the suffix \.mixamo\.glb"):
        list_output_formats(OutputOptions(characters=("mixamo", find_preset_path("mixamo"))))


def find_preset_path(name: str) -> str:
    """Return the path of a preset's file, which has the preset's name."""
    return str(find_shipped_folder("scenes") / "rigs" / f"{name}.yaml")


@pytest.mark.parametrize("version", [0, 1])
def test_a_vrm_stays_one(solved, tmp_path, version):
    """It has its suffix, and the extension with the same nodes; another program's extensions stay too."""
    path = tmp_path / "hero.vrm"
    path.write_bytes(build_vrm(version))
    outputs = solved.write(tmp_path / "out", options=OutputOptions(characters=(path,)))
    assert "hero.glb" not in outputs
    before, after = (parse_glb(each, each.read_bytes()).document for each in (path, outputs["hero.vrm"]))
    assert after["extensions"] == before["extensions"]
    assert after["extensionsUsed"] == before["extensionsUsed"]
    assert [each["name"] for each in after["animations"]] == ["walk.001", "walk"]
    again = load_character(outputs["hero.vrm"])
    assert again.mapping.bones == load_character(path).mapping.bones
