"""Options of `clean` about the output files."""

import re
import shutil

import pytest

from mocapfix.characters.fbx import BLENDER_VARIABLE
from mocapfix.io.gltf import parse_glb
from mocapfix.options import EXTRA_FORMAT_NAMES, RIG_NAMES, ROBOT_FORMAT_NAMES
from mocapfix.output_formats import OPTIONAL_FORMATS
from tests.characters.character_files import build_vrm


def test_help_names_every_format_and_program(mocapfix):
    status, out, _ = mocapfix("clean", "--help")
    text = " ".join(out.replace("│", " ").split())
    assert status == 0
    assert "--bvh-for PROGRAM,..." in text
    assert f"also write a BVH for each program: {', '.join(RIG_NAMES)}, or a rig's .yaml" in text
    assert f"also write these formats: {', '.join(EXTRA_FORMAT_NAMES)}" in text
    assert "--fps N" in text


def test_requested_files_are_written_and_listed(mocapfix, brief, tmp_path):
    requested = ("--bvh-for", "blender,motionbuilder", "--also", "gltf, npz", "--fps", 60)
    status, out, err = mocapfix("clean", brief.path, "--subject", brief.subject, "--out", tmp_path, *requested)
    assert (status, err) == (0, "")
    expected = {"brief.blender.bvh", "brief.motionbuilder.bvh", "brief.glb", "brief.npz"}
    assert expected <= {path.name for path in tmp_path.iterdir()}
    assert all(name in out for name in expected)
    assert re.search(r"Motion files have 60 frames per second \(one of 2 solved frames\); markers keep 120", out)
    assert "Frames: 60\n" in (tmp_path / "brief.bvh").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("requested", "message"),
    [
        (("--also", "avi"), f"--also must be one of {', '.join(EXTRA_FORMAT_NAMES)}, not 'avi'"),
        (("--character", "maya"), "There is no character 'maya'; choose one of daz-g8"),
        (("--character", "nowhere.glb"), "nowhere.glb: "),
        (("--feet", "glued"), "--feet must be one of off, soft, lock, not 'glued'"),
        (("--bvh-for", "maya"), "There is no rig 'maya'; choose one of 3dsmax, blender, cmu, motionbuilder"),
        (("--bvh-for", "nowhere.yaml"), "nowhere.yaml: cannot be read"),
        (("--character", "mixamo", "--rest-frame", "0"), "--rest-frame must be at least 1, not 0"),
        (("--character", "mixamo", "--rest-frame", "3"), "mixamo.yaml: has no frames, so frame 3 cannot be its rest pose"),
        (("--trim", "301:"), "--trim is for the motion of a character; name a character too"),
        (("--loop",), "--loop is for the motion of a character"),
        (("--fps", "1"), "--fps must be at least 5 Hz and at most 1000 Hz, not 1"),
    ],
)
def test_unknown_output_is_wrong_usage(mocapfix, brief, tmp_path, requested, message):
    status, out, err = mocapfix("clean", brief.path, "--out", tmp_path / "out", *requested)
    assert (status, out) == (2, "")
    assert message in " ".join(err.split())
    assert not (tmp_path / "out").exists()


def test_existing_output_is_not_overwritten(mocapfix, brief, tmp_path):
    (tmp_path / "brief.npz").write_text("mine", encoding="utf-8")
    status, _, err = mocapfix("clean", brief.path, "--out", tmp_path, "--also", "npz")
    assert status == 1
    assert "brief.npz: already exists; give --overwrite" in " ".join(err.split())
    assert [path.name for path in tmp_path.iterdir()] == ["brief.npz"]


def test_every_extra_format_can_be_requested():
    assert (*OPTIONAL_FORMATS, *ROBOT_FORMAT_NAMES) == EXTRA_FORMAT_NAMES  # a robot's are part of its character


def test_an_output_that_cannot_be_written_is_not_listed_and_fails(mocapfix, brief, tmp_path, monkeypatch):
    """All other files of the take are written."""
    monkeypatch.setenv(BLENDER_VARIABLE, "/nowhere/blender")
    status, out, err = mocapfix("clean", brief.path, "--subject", brief.subject, "--out", tmp_path, "--also", "fbx,npz")
    assert status == 1
    assert err.startswith("brief.fbx was not written: /nowhere/blender cannot be started")
    assert "brief.npz" in out
    assert "brief.fbx," not in out
    assert not (tmp_path / "brief.fbx").exists()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--clips", "all.glb"), "give exactly one --character"),
        (("--clips", "all.fbx", "--character", "mixamo"), "name a file that ends in .glb or .vrm"),
        (("--clips", "nowhere/all.glb", "--character", "mixamo"), "name a file in a folder that exists"),
    ],
)
def test_clips_that_cannot_be_written_are_wrong_usage(mocapfix, brief, tmp_path, arguments, sentence):
    status, out, err = mocapfix("clean", brief.path, "--out", tmp_path / "out", *arguments)
    assert (status, out) == (2, "")
    assert sentence in " ".join(err.split())


def test_frames_that_are_refused_are_named_as_they_were_given(mocapfix, brief, tmp_path):
    """Colons around a number are no emoji on the terminal."""
    arguments = "clean", brief.path, "--subject", brief.subject, "--out", tmp_path, "--character", "mixamo", "--trim"
    status, _, err = mocapfix(*arguments, "900:100")
    assert status == 2
    assert "--trim must be FIRST:LAST with FIRST at most LAST, not 900:100." in " ".join(err.split())
    status, _, err = mocapfix(*arguments, "900:1000")
    assert status == 1
    assert "brief.c3d: --trim 900:1000 is not in the take, which has frames 301 to 420." in " ".join(err.split())


def test_clips_hold_the_motions_of_all_takes(mocapfix, brief, tmp_path):
    second = tmp_path / f"second.Ann{brief.path.suffix}"
    shutil.copyfile(brief.path, second)
    arguments = ("--subject", brief.subject, "--character", "mixamo", "--clips", tmp_path / "all.glb")
    status, out, _ = mocapfix("clean", brief.path, second, "--out", tmp_path / "out", *arguments)
    assert status == 0
    assert "all.glb: 2 motions as animations of one character." in " ".join(out.split())
    document = parse_glb(tmp_path / "all.glb", (tmp_path / "all.glb").read_bytes()).document
    assert [each["name"] for each in document["animations"]] == ["brief", "second.Ann"]
    status, _, err = mocapfix("clean", brief.path, second, "--out", tmp_path / "other", *arguments)
    assert status == 1
    assert "all.glb: already exists; give --overwrite" in " ".join(err.split())


def test_clips_replace_neither_the_character_nor_another_output(mocapfix, brief, tmp_path):
    hero = tmp_path / "hero.vrm"
    hero.write_bytes(build_vrm(0))
    arguments = "clean", brief.path, "--subject", brief.subject, "--out", tmp_path, "--character", hero, "--overwrite"
    status, _, err = mocapfix(*arguments, "--clips", hero)
    assert status == 2
    assert "would replace the character or a take" in " ".join(err.split())
    status, _, err = mocapfix(*arguments, "--clips", tmp_path / "brief.hero.vrm")
    assert status == 1
    assert "brief.hero.vrm: would be replaced by an output" in " ".join(err.split())
    assert [path.name for path in tmp_path.iterdir()] == ["hero.vrm"]
    assert hero.read_bytes() == build_vrm(0)
