"""Import the written files of characters into Blender and compare the heads of bones with the motion.

`make blender` installs Blender's Python module in .blender; without it these tests are skipped.
"""

import base64
import json
import os
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from mocapfix.characters.character import Character, CharacterMotion, compute_character_poses
from mocapfix.characters.character_files import write_character_bvh, write_character_glb
from mocapfix.characters.clips import carry_path, prepare_root_bone
from mocapfix.characters.fbx import BLENDER_VARIABLE, write_fbx
from mocapfix.characters.load_character import load_character_preset, read_character_skeletons
from mocapfix.io.gltf import GlbContent, GltfBuffer, add_animation, build_glb, parse_glb
from mocapfix.options import CHARACTER_PRESETS, ROOT_BONE
from tests.characters.character_files import (
    FIGURE,
    build_figure_character,
    build_mixamo_glb,
    build_motion,
    build_vrm,
    map_figure,
    node_of,
)

ROOT = Path(__file__).parents[2]
PYTHON = Path(os.environ.get("BLENDER_PYTHON", ROOT / ".blender" / "bin" / "python"))
pytestmark = pytest.mark.skipif(not PYTHON.is_file(), reason="Blender's Python module is not installed (make blender)")
RATE_HZ = 50.0
FRAME_COUNT = 25
FRAMES = (0, 7, 24)
MAX_HEAD_ERROR_M = 1e-4


TEXTURE = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAIAAACQd1PeAAAADElEQVR4nGNgYPgPAAEDAQAIicLsAAAAAElFTkSuQmCC"
)  # 1 x 1


def build_glb_that_moves_a_finger() -> bytes:
    """Return the GLB with a texture and an animation that moves the index finger, which the written motion leaves alone."""
    content = parse_glb(Path("user.glb"), build_mixamo_glb())
    buffer = GltfBuffer(content.document, content.binary)
    node = node_of(FIGURE.names.index("LeftHandIndex1"))
    places = np.array(content.document["nodes"][node]["translation"]) + [[2.0, 0.0, 0.0], [5.0, 1.0, 0.0]]
    add_animation(buffer, "wave", np.tile(np.eye(3), (2, 1, 1, 1)), {node: places}, {}, 1.0)
    document, uri = content.document, f"data:image/png;base64,{base64.b64encode(TEXTURE).decode()}"
    document |= {"images": [{"uri": uri}], "textures": [{"source": 0}]}
    document["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    document["meshes"][0]["primitives"][0]["material"] = 0
    return build_glb(GlbContent(document, buffer.finish()))


USER_FILES = {
    "user-mixamo": build_mixamo_glb,
    "user-fingers": build_glb_that_moves_a_finger,
    "user-root": build_mixamo_glb,  # with a root bone that carries the path
    "user-vrm": lambda: build_vrm(1),
}
CHARACTERS = (*USER_FILES, "figure", *CHARACTER_PRESETS)
FILES = [f"{name}.{suffix}" for name in CHARACTERS for suffix in ("glb", "bvh")]
FBX_CHARACTERS = ("user-mixamo", "user-fingers", "user-root", "unreal")


@dataclass(frozen=True)
class WrittenCharacter:
    """A character, its motion, and the scale of its BVH."""

    character: Character
    motion: CharacterMotion
    bvh_unit_m: float
    folder: Path


def load(name: str, folder: Path) -> Character:
    if name in CHARACTER_PRESETS:
        return load_character_preset(name)
    if name == "figure":
        return build_figure_character()
    (folder / f"{name}.source").write_bytes(USER_FILES[name]())
    character = read_character_skeletons(folder / f"{name}.source")[0]
    return character if character.mapping.bones else replace(character, mapping=map_figure(character.skeleton.names))


def find_bvh_unit(character: Character) -> float:
    """Return the unit of the position of the pelvis."""
    parent = character.skeleton.parents[character.mapping.bones["pelvis"][0]]
    return float(character.scales[parent]) if parent >= 0 else character.root_scale


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> dict[str, WrittenCharacter]:
    """The characters, of which all files are in the folder "characters"."""
    folder = tmp_path_factory.mktemp("characters")
    characters: dict[str, WrittenCharacter] = {}
    for name in CHARACTERS:
        character = load(name, folder)
        motion = build_motion(character, FRAME_COUNT, RATE_HZ)
        if name == "user-root":
            character = prepare_root_bone(character)
            motion = carry_path(character, build_motion(character, FRAME_COUNT, RATE_HZ), ROOT_BONE)
            assert "root" in character.skeleton.names
        write_character_glb(folder / f"{name}.glb", character, motion, "take")
        write_character_bvh(folder / f"{name}.bvh", character, motion)
        characters[name] = WrittenCharacter(character, motion, find_bvh_unit(character), folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(BLENDER_VARIABLE, str(PYTHON))
        for name in FBX_CHARACTERS:
            assert write_fbx(folder / f"{name}.fbx", folder / f"{name}.glb", RATE_HZ) is None
    return characters


@pytest.fixture(scope="module")
def opened(written) -> dict[str, dict]:
    """Blender's scene of every file. One process imports all: its start takes longer than an import."""
    folder = written["figure"].folder
    files = [*FILES, *(f"{name}.fbx" for name in FBX_CHARACTERS)]
    jobs = [
        {
            "path": str(folder / file),
            "scale": written[file.partition(".")[0]].bvh_unit_m,
            "rate": RATE_HZ,
            "frames": FRAMES,
        }
        for file in files
    ]
    jobs_path, answers = folder / "jobs.json", folder / "answers.json"
    jobs_path.write_text(json.dumps(jobs, default=list), encoding="utf-8")
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    process = subprocess.run(
        [PYTHON, Path(__file__).with_name("inside_characters.py"), jobs_path, answers],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert process.returncode == 0, process.stderr[-3000:]
    return dict(zip(files, json.loads(answers.read_text(encoding="utf-8")), strict=True))


@pytest.mark.parametrize("file", [*FILES, *(f"{name}.fbx" for name in FBX_CHARACTERS)])
def test_heads_of_bones_are_where_the_motion_has_them(opened, written, file):
    each = written[file.partition(".")[0]]
    positions, _ = compute_character_poses(each.character, each.motion)
    segments = {bone for chain in each.character.mapping.bones.values() for bone in chain}
    for frame, heads in zip(FRAMES, opened[file]["heads"], strict=True):
        compared = 0
        for bone, name in enumerate(each.character.skeleton.names):
            if name not in heads:
                assert bone not in segments, name
                continue
            x, y, z = positions[frame, bone]
            np.testing.assert_allclose(heads[name], [x, -z, y], atol=MAX_HEAD_ERROR_M, err_msg=name)  # Blender's Z is up
            compared += 1
        assert compared >= len(segments)


@pytest.mark.parametrize("file", [*FILES, *(f"{name}.fbx" for name in FBX_CHARACTERS)])
def test_motion_has_its_rate_and_length(opened, file):
    assert opened[file]["rate"] == pytest.approx(RATE_HZ, rel=1e-6)
    assert opened[file]["frames"] == pytest.approx(FRAME_COUNT, abs=1e-3)


@pytest.mark.parametrize("name", CHARACTERS)
def test_a_character_has_a_mesh(opened, name):
    assert opened[f"{name}.glb"]["meshes"] == 1


@pytest.mark.parametrize("name", FBX_CHARACTERS)
def test_fbx_has_the_armature_the_mesh_and_the_take_alone(opened, name):
    each = opened[f"{name}.fbx"]
    assert each["objects"] == ["ARMATURE", "MESH"]
    assert each["meshes"] == 1
    assert each["action"].endswith("|take")


def test_fbx_has_the_textures(written, opened):
    assert TEXTURE in (written["user-fingers"].folder / "user-fingers.fbx").read_bytes()
