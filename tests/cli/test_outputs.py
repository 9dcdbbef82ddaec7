"""Options of `clean` about the output files."""

import re

import pytest

from mocapfix.options import EXTRA_FORMAT_NAMES, RIG_NAMES
from mocapfix.output_formats import OPTIONAL_FORMATS


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
        (("--also", "avi"), "--also must be one of gltf, amc, npz, c3d, trc, csv, contacts, events, fbx, not 'avi'"),
        (("--character", "maya"), "There is no character 'maya'; choose one of daz-g8"),
        (("--character", "nowhere.glb"), "nowhere.glb: "),
        (("--feet", "glued"), "--feet must be one of off, soft, lock, not 'glued'"),
        (("--bvh-for", "maya"), "There is no rig 'maya'; choose one of 3dsmax, blender, cmu, motionbuilder"),
        (("--bvh-for", "nowhere.yaml"), "nowhere.yaml: cannot be read"),
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
    assert tuple(OPTIONAL_FORMATS) == EXTRA_FORMAT_NAMES
