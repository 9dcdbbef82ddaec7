import re
from dataclasses import replace

import numpy as np
import pytest

from mocapfix.characters.load_character import load_character, read_character_skeletons
from mocapfix.errors import ReadError
from mocapfix.io.bvh import write_bvh
from mocapfix.model.motion import Motion
from tests.io.read_back import SKELETON, motion_of, smooth_rotations


@pytest.fixture
def motion() -> Motion:
    return motion_of(smooth_rotations(0, 5, len(SKELETON.names), swing=0.3), np.full((5, 3), 0.9))


def test_the_rest_pose_is_that_of_the_offsets(tmp_path, motion):
    write_bvh(tmp_path / "walk.bvh", SKELETON, motion, 120.0)
    character = read_character_skeletons(tmp_path / "walk.bvh")[0]
    assert set(character.skeleton.names) == set(SKELETON.names)
    positions, rotations = character.skeleton.compute_rest_pose()
    expected = SKELETON.rest_positions - SKELETON.rest_positions[0]
    for bone, name in enumerate(character.skeleton.names):
        joint = SKELETON.find_joint(name)
        np.testing.assert_allclose(positions[bone], expected[joint], atol=1e-6)
        parent = SKELETON.parents[joint]
        assert parent < 0 or character.skeleton.names[character.skeleton.parents[bone]] == SKELETON.names[parent]
    np.testing.assert_allclose(rotations, np.tile(np.eye(3), (len(rotations), 1, 1)))
    np.testing.assert_allclose(character.scales, 0.01)
    assert character.root_scale == 0.01
    hand = character.skeleton.find_joint("LeftHandIndex1")
    np.testing.assert_allclose(character.skeleton.ends[hand], SKELETON.ends[SKELETON.find_joint("LeftHandIndex1")], atol=1e-6)
    knee = character.skeleton.find_joint("LeftLeg")
    np.testing.assert_allclose(character.skeleton.ends[knee], SKELETON.offsets[SKELETON.find_joint("LeftFoot")], atol=1e-6)
    assert character.source is not None
    assert character.source.kind == "bvh"


@pytest.mark.parametrize(("unit_m", "scale", "unit"), [(0.01, 1.0, "10 mm"), (1.0, 1.0, "1000 mm"), (0.01, 0.5, "25.4 mm")])
def test_unit_is_reported(tmp_path, motion, unit_m, scale, unit):
    skeleton = replace(SKELETON, offsets=SKELETON.offsets * scale, ends=SKELETON.ends * scale)
    write_bvh(tmp_path / "walk.bvh", skeleton, motion, 120.0, unit_m)
    assert f"Its unit is taken as {unit}, by its height." in load_character(tmp_path / "walk.bvh").mapping.reason


Z_UP = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 90
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Head
  {
    OFFSET 0 2 60
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 0 20
    }
  }
  JOINT Foot
  {
    OFFSET 10 0 -80
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 -15 0
    }
  }
}
MOTION
Frames: 1
Frame Time: 0.01
0 0 90 0 0 0 0 0 0 0 0 0
"""


def test_a_file_with_z_up_stands_with_y_up(tmp_path):
    (tmp_path / "figure.bvh").write_text(Z_UP, encoding="utf-8")
    character = read_character_skeletons(tmp_path / "figure.bvh")[0]
    positions, rotations = character.skeleton.compute_rest_pose()
    np.testing.assert_allclose(positions, [[0, 0.9, 0], [0.02, 1.5, 0], [0, 0.1, 0.1]], atol=1e-9)
    foot = character.skeleton.find_joint("Foot")
    np.testing.assert_allclose(character.skeleton.ends[foot], [0, -0.15, 0])  # in the bone's own axes
    np.testing.assert_allclose(rotations[foot] @ character.skeleton.ends[foot], [-0.15, 0, 0], atol=1e-9)


def test_repeated_names_become_unique(tmp_path):
    (tmp_path / "figure.bvh").write_text(Z_UP.replace("JOINT Foot", "JOINT Head"), encoding="utf-8")
    assert read_character_skeletons(tmp_path / "figure.bvh")[0].skeleton.names == ("Hips", "Head", "Head#2")


def test_a_damaged_file_is_refused(tmp_path):
    (tmp_path / "figure.bvh").write_text(Z_UP.replace("MOTION", "MOTI"), encoding="utf-8")
    with pytest.raises(ReadError, match=r"figure\.bvh"):
        read_character_skeletons(tmp_path / "figure.bvh")[0]


def test_bones_in_position_channels_replace_offsets(tmp_path, motion):
    write_bvh(tmp_path / "walk.bvh", SKELETON, motion, 120.0)
    plain = read_character_skeletons(tmp_path / "walk.bvh")[0]
    text = (tmp_path / "walk.bvh").read_text(encoding="utf-8")
    knee = text.index("JOINT LeftLeg")
    offset = re.search(r"OFFSET (.*)\n", text[knee:])
    assert offset
    changed = text[knee:].replace(offset[0], "OFFSET 0 0 900\n", 1)
    changed = changed.replace("CHANNELS 3 ", "CHANNELS 6 Xposition Yposition Zposition ", 1)
    names = re.findall(r"(?:ROOT|JOINT) (\S+)", text)
    header, *rows = (text[:knee] + changed).partition("Frame Time")[2].splitlines()
    column = 3 + 3 * names.index("LeftLeg")
    rows = [" ".join([*row.split()[:column], offset[1], *row.split()[column:]]) for row in rows]
    lines = [(text[:knee] + changed).partition("Frame Time")[0] + "Frame Time" + header, *rows]
    (tmp_path / "positions.bvh").write_text("\n".join(lines), encoding="utf-8")
    found = read_character_skeletons(tmp_path / "positions.bvh")[0]
    np.testing.assert_allclose(found.skeleton.offsets, plain.skeleton.offsets, atol=1e-9)
    np.testing.assert_allclose(found.skeleton.ends, plain.skeleton.ends, atol=1e-9)
