"""What `clean` is told to write beside the usual files."""

import re

import pytest

from mocapfix.options import RIG_NAMES
from mocapfix.write.output_formats import OPTIONAL_FORMATS


def test_help_names_every_kind_and_every_program(mocapfix):
    status, out, _ = mocapfix("clean", "--help")
    told = " ".join(out.replace("│", " ").split())
    assert status == 0
    assert "--bvh-for PROGRAM,..." in told
    assert f"a BVH more for each: {', '.join(RIG_NAMES)}, or a rig's .yaml" in told
    assert f"files of other kinds beside the usual: {', '.join(OPTIONAL_FORMATS)}" in told
    assert "--fps N" in told


def test_what_is_asked_for_is_written_and_told(mocapfix, brief, tmp_path):
    asked = ("--bvh-for", "blender,motionbuilder", "--also", "gltf, npz", "--fps", 60)
    status, out, err = mocapfix("clean", brief.path, "--subject", brief.subject, "--out", tmp_path, *asked)
    assert (status, err) == (0, "")
    wanted = {"brief.blender.bvh", "brief.motionbuilder.bvh", "brief.glb", "brief.npz"}
    assert wanted <= {path.name for path in tmp_path.iterdir()}
    assert all(name in out for name in wanted)
    assert re.search(r"Motion files have 60 frames per second \(one of 2 solved frames\); markers keep 120", out)
    assert "Frames: 60\n" in (tmp_path / "brief.bvh").read_text()


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (("--also", "fbx"), "no kind of file 'fbx' to write; choose of: gltf, amc, npz, c3d, trc, csv"),
        (("--bvh-for", "maya"), "There is no rig 'maya'; choose one of 3dsmax, blender, cmu, motionbuilder"),
        (("--bvh-for", "nowhere.yaml"), "nowhere.yaml: cannot be read"),
        (("--fps", "0"), "more than 0 and at most 1000, not 0"),
    ],
)
def test_what_there_is_not_is_wrong_usage_and_nothing_is_written(mocapfix, brief, tmp_path, asked, said):
    status, out, err = mocapfix("clean", brief.path, "--out", tmp_path / "out", *asked)
    assert (status, out) == (2, "")
    assert said in " ".join(err.split())
    assert not (tmp_path / "out").exists()


def test_an_output_of_another_kind_that_is_there_stops_the_take_before_it_is_read(mocapfix, brief, tmp_path):
    (tmp_path / "brief.npz").write_text("mine")
    status, _, err = mocapfix("clean", brief.path, "--out", tmp_path, "--also", "npz")
    assert status == 1
    assert "brief.npz: already exists; give --overwrite" in " ".join(err.split())
    assert [path.name for path in tmp_path.iterdir()] == ["brief.npz"]
