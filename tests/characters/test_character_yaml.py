"""Character files: axes by rule or quaternion, units, round trips, and sentences for what is wrong."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.characters.character import BoneMapping, Character
from mocapfix.characters.character_yaml import read_character_yaml
from mocapfix.characters.load_character import load_character_preset
from mocapfix.errors import SceneError
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.model.skeleton import UNLIMITED_RAD, Skeleton
from mocapfix.options import CHARACTER_PRESETS
from tests.characters.character_files import write_character_yaml

MIXAMO_FILE = find_shipped_folder("scenes") / "rigs" / "mixamo.yaml"


def write_file(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def assert_characters_equal(read: Character, written: Character) -> None:
    assert (read.name, read.skeleton.names) == (written.name, written.skeleton.names)
    assert read.skeleton.parents.tolist() == written.skeleton.parents.tolist()
    for name in ("offsets", "rest_rotations", "ends", "limits_rad"):
        assert np.allclose(getattr(read.skeleton, name), getattr(written.skeleton, name), atol=1e-6, equal_nan=True), name
    assert np.allclose(read.scales, written.scales, atol=1e-6)
    assert np.allclose(read.rotation_y_up_file, written.rotation_y_up_file, atol=1e-6)
    assert read.root_scale == written.root_scale
    assert read.has_feet_flat == written.has_feet_flat
    assert dict(read.mapping.bones) == dict(written.mapping.bones)
    assert dict(read.mapping.twists) == dict(written.mapping.twists)


@pytest.mark.parametrize("name", CHARACTER_PRESETS)
def test_written_preset_is_read_back(name: str, tmp_path: Path):
    preset = load_character_preset(name)
    write_character_yaml(tmp_path / "mine.yaml", preset)
    assert_characters_equal(read_character_yaml(tmp_path / "mine.yaml"), preset)


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 12))
@settings(max_examples=40, deadline=None)
def test_any_armature_is_read_back(seed: int, count: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    """With rotated bones, several roots, bones without tails, scales, and any axes of the file."""
    rng = np.random.default_rng(seed)
    tails = rng.normal(0, 0.3, (count, 3))
    tails[rng.random(count) < 0.3] = np.nan
    parents = np.array([-1, *(int(rng.integers(-1, bone)) for bone in range(1, count))])
    limits_rad = np.tile(UNLIMITED_RAD, (count, 1, 1))
    limits_rad[0] = np.deg2rad([[-10.0, 20.5], [0.0, 0.0], [-5.25, 170.0]])
    character = Character(
        name="armature",
        skeleton=Skeleton(
            names=tuple(f"Bone {'Ä:.' * (i % 2)}{i}" for i in range(count)),
            parents=parents,
            offsets=rng.normal(0, 0.5, (count, 3)),
            ends=tails,
            rest_rotations=Rotation.random(count, rng=rng).as_matrix(),
            limits_rad=limits_rad,
        ),
        mapping=BoneMapping({}),
        scales=rng.choice([0.01, 0.5], count),
        root_scale=0.01,
        rotation_y_up_file=Rotation.random(rng=rng).as_matrix(),
        has_feet_flat=bool(seed % 2),
    )
    path = tmp_path_factory.mktemp("character") / "armature.yaml"
    write_character_yaml(path, character)
    assert_characters_equal(read_character_yaml(path), character)


def test_source_is_the_file(tmp_path: Path):
    path = write_file(tmp_path / "a.yaml", MIXAMO_FILE.read_text(encoding="utf-8"))
    source = read_character_yaml(path).source
    assert source
    assert (source.path, source.kind, source.data) == (str(path), "yaml", path.read_bytes())


AXES_FILE = """\
kind: character
name: axes
unit_m: 0.01
up: Z
axes: {along: -X, second: Z, toward: [0, 0, 2]}
bones:
  - {name: a, parent: null, head: [0, 1, 0]}
  - {name: b, parent: a, head: [0, 3, 0], tail: [0, 3, 0]}
  - {name: c, parent: a, head: [1, 1, 0], tail: [2, 1, 0], along: Y, second: X, toward: [0, -3, 0.1]}
  - {name: d, parent: c, head: [1, 1, 1], rotation: [2, 0, 0, 2]}
"""


def test_axes_follow_the_rule_of_the_file_and_of_the_bone(tmp_path: Path):
    character = read_character_yaml(write_file(tmp_path / "axes.yaml", AXES_FILE))
    positions, rotations = character.skeleton.compute_rest_pose()
    assert np.allclose(positions, [[0, 1, 0], [0, 3, 0], [1, 1, 0], [1, 1, 1]])
    assert np.allclose(rotations[0] @ [-1, 0, 0], [0, 1, 0])  # along the bone, to the first child
    assert np.allclose(rotations[0] @ [0, 0, 1], [0, 0, 1])
    assert np.allclose(rotations[1], rotations[0])  # no tail: as the parent
    assert np.isnan(character.skeleton.ends[1]).all()
    assert np.allclose(rotations[2] @ [0, 1, 0], [1, 0, 0])
    assert np.allclose(rotations[2] @ [1, 0, 0], np.array([0, -3, 0.1]) / np.hypot(3, 0.1))
    assert np.allclose(rotations[3], Rotation.from_euler("z", 90, degrees=True).as_matrix())
    assert np.allclose(np.linalg.det(rotations), 1)
    assert np.allclose(character.rotation_y_up_file @ [0, 0, 1], [0, 1, 0])
    assert not character.mapping.bones


def test_segment_of_one_bone_may_be_written_without_brackets(tmp_path: Path):
    text = MIXAMO_FILE.read_text(encoding="utf-8").replace("pelvis: ['mixamorig:Hips']", "pelvis: 'mixamorig:Hips'")
    assert read_character_yaml(write_file(tmp_path / "a.yaml", text)).mapping.bones["pelvis"] == (0,)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("kind: character\n", "", "kind: is missing."),
        ("unit_m: 0.01", "unit_m: -1", "unit_m: "),
        ("up: Y", "up: X", "up: must be 'Y' or 'Z'."),
        ("feet_flat: true", "feet: true", "feet: there is no such key"),
        ("head: [0, 1, 0]", "head: [0, 1]", "bones.0.head.2: is missing."),
        ("head: [0, 1, 0]", "head: [0, 1, .nan]", "bones.0.head.2: "),
        ("along: Y, second: Z", "along: Y, second: Y", "bones.0 (mixamorig:Hips): its second axis is along the bone"),
        ("second: Z, toward: [0, 0, 1]", "second: Z, toward: [0, 1, 0]", "its second axis is along the bone"),
        ("name: 'mixamorig:Spine', parent", "name: 'mixamorig:Hips', parent", "bones.1: the name 'mixamorig:Hips' is used twice"),
        ("parent: 'mixamorig:Spine1'", "parent: 'mixamorig:Head'", "the parent 'mixamorig:Head' of 'mixamorig:Spine2' must be"),
        ("  pelvis: [", "  pelvsi: [", "segments.pelvsi: there is no such segment"),
        ("head: ['mixamorig:Head']", "head: ['Head']", "segments.head: there is no bone 'Head'"),
        ("head: ['mixamorig:Head']", "head: ['mixamorig:Neck']", "segments.head: the bone 'mixamorig:Neck' is already in segm"),
        ("  left_foot: ['mixamorig:LeftFoot']\n", "", "segments.left_foot: is missing"),
        ("'mixamorig:Neck': {x", "'mixamorig:Nec': {x", "limits.mixamorig:Nec: there is no such bone"),
        ("'mixamorig:Neck': {x: [-35, 45]", "'mixamorig:Neck': {x: [5, 45]", "limits.mixamorig:Neck.x: must be the least"),
        ("'mixamorig:Neck': {x: [-35, 45], ", "'mixamorig:Neck': {", "limits.mixamorig:Neck.x: is missing."),
    ],
)
def test_invalid_file_is_explained_with_file_and_key(old: str, new: str, message: str, tmp_path: Path):
    text = MIXAMO_FILE.read_text(encoding="utf-8")
    assert old in text
    path = write_file(tmp_path / "mine.yaml", text.replace(old, new, 1))
    with pytest.raises(SceneError) as caught:
        read_character_yaml(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)
    assert str(caught.value).endswith(".")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (AXES_FILE.replace("rotation: [2, 0, 0, 2]", "rotation: [0, 0, 0, 0]"), "bones.3.rotation: is no rotation"),
        (AXES_FILE.replace("axes: {along: -X, second: Z, toward: [0, 0, 2]}\n", ""), "bones.2: `along`, `second` and `toward`"),
    ],
)
def test_invalid_axes_are_explained(text: str, message: str, tmp_path: Path):
    with pytest.raises(SceneError, match=message.replace("(", r"\(")):
        read_character_yaml(write_file(tmp_path / "mine.yaml", text))
