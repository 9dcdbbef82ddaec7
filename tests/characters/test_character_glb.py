"""The bytes of the files are parsed by the specification (Khronos, glTF 2.0), independently of the writer."""

import json
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from mocapfix.characters.character import compute_character_poses
from mocapfix.characters.character_files import write_character_glb, write_clips
from mocapfix.characters.load_character import load_character_preset, read_character_skeletons
from mocapfix.errors import WriteError
from mocapfix.io.gltf import write_gltf
from mocapfix.options import CHARACTER_PRESETS
from tests.characters.character_files import (
    FIGURE,
    PREFIX,
    build_figure_character,
    build_mixamo_glb,
    build_motion,
    build_vrm,
    edit_glb,
    map_figure,
    node_of,
    read_accessor,
    split_glb,
)
from tests.io.read_back import SKELETON, motion_of, smooth_rotations

ROOT = Path(__file__).parents[2]
VALIDATOR = ROOT / ".gltf-validator" / "node_modules" / "gltf-validator"
GLB = build_mixamo_glb()
VALIDATION_SCRIPT = """
const validator = require(process.argv[1]);
const fs = require("fs");
(async () => {
  const reports = [];
  for (const path of process.argv.slice(2)) {
    const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(path)), {maxIssues: 20});
    reports.push({errors: report.issues.numErrors, messages: report.issues.messages});
  }
  console.log(JSON.stringify(reports));
})();
"""


def read_figure(folder, data=GLB, name="figure.glb"):
    (folder / name).write_bytes(data)
    character = read_character_skeletons(folder / name)[0]
    return character if character.mapping.bones else replace(character, mapping=map_figure(character.skeleton.names))


def compute_worlds(document, binary, animation, times):
    """Return the world matrices (T, N, 4, 4) of all nodes at some times, as a viewer computes them."""
    nodes = document["nodes"]
    curves = {}
    for channel in animation["channels"]:
        sampler = animation["samplers"][channel["sampler"]]
        keys = read_accessor(document, binary, sampler["input"])[:, 0]
        values = read_accessor(document, binary, sampler["output"])
        at = np.clip(times, keys[0], keys[-1])
        if channel["target"]["path"] == "rotation":
            rotations = Rotation.from_quat(values)
            sampled = Slerp(keys, rotations)(at) if len(keys) > 1 else Rotation.concatenate([rotations] * len(times))
            curves[channel["target"]["node"], "rotation"] = sampled.as_matrix()
        else:
            curves[channel["target"]["node"], "translation"] = np.stack([np.interp(at, keys, v) for v in values.T], axis=1)
    worlds = np.tile(np.eye(4), (len(times), len(nodes), 1, 1))

    def visit(index, above):
        node, local = nodes[index], np.tile(np.eye(4), (len(times), 1, 1))
        if "matrix" in node:
            assert not any(key[0] == index for key in curves)
            local[:] = np.reshape(node["matrix"], (4, 4)).T
        else:
            rest = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix()
            local[:, :3, :3] = curves.get((index, "rotation"), rest) * np.array(node.get("scale", [1, 1, 1]))
            local[:, :3, 3] = curves.get((index, "translation"), node.get("translation", [0, 0, 0]))
        worlds[:, index] = above @ local
        for child in node.get("children", []):
            visit(child, worlds[:, index])

    for root in document["scenes"][document["scene"]]["nodes"]:
        visit(root, np.tile(np.eye(4), (len(times), 1, 1)))
    return worlds


def check_written_poses(path, character, motion, nodes, atol=2e-6):
    document, binary = (json.loads(split_glb(path.read_bytes())[0]), split_glb(path.read_bytes())[1])
    times = np.arange(motion.frame_count) / motion.rate
    worlds = compute_worlds(document, binary, document["animations"][0], times)[:, nodes]
    positions, rotations = compute_character_poses(character, motion)
    np.testing.assert_allclose(worlds[..., :3, 3], positions, atol=atol)
    scale = np.linalg.norm(worlds[..., :3, 0], axis=-1)[..., None, None]
    np.testing.assert_allclose(worlds[..., :3, :3] / scale, rotations, atol=atol)
    return document


def test_all_of_the_users_file_is_kept(tmp_path):
    character = read_figure(tmp_path)
    write_character_glb(tmp_path / "out.glb", character, build_motion(character), "walk")
    (old_text, old_binary), (new_text, new_binary) = split_glb(GLB), split_glb((tmp_path / "out.glb").read_bytes())
    old, new = json.loads(old_text), json.loads(new_text)
    length = old["buffers"][0]["byteLength"]
    assert new_binary[:length] == old_binary[:length]
    for key, value in old.items():
        if key in ("accessors", "bufferViews"):
            assert new[key][: len(value)] == value
        elif key == "animations":
            assert new[key][1:] == value
        elif key == "buffers":
            assert new[key][0]["byteLength"] <= len(new_binary)
        else:
            assert new[key] == value, key
    assert set(new) == set(old)
    assert [each["name"] for each in new["animations"]] == ["walk.001", "walk"]


@pytest.mark.parametrize("data", [GLB, build_vrm(0), build_vrm(1)], ids=["mixamo", "vrm 0", "vrm 1"])
def test_bones_move_as_in_the_motion(tmp_path, data):
    character = read_figure(tmp_path, data)
    motion = build_motion(character)
    assert write_character_glb(tmp_path / "out.glb", character, motion, "walk") is None
    assert character.source is not None
    check_written_poses(tmp_path / "out.glb", character, motion, character.source.nodes)


def test_animated_nodes_have_no_matrix(tmp_path):
    def edit(document):
        for node in document["nodes"]:
            matrix = np.eye(4)
            matrix[:3, :3] = Rotation.from_quat(node.pop("rotation", [0, 0, 0, 1])).as_matrix() * node.pop("scale", [1])[0]
            matrix[:3, 3] = node.pop("translation", [0, 0, 0])
            node["matrix"] = matrix.T.ravel().tolist()

    character = read_figure(tmp_path, edit_glb(GLB, edit))
    motion = build_motion(character)
    write_character_glb(tmp_path / "out.glb", character, motion, "walk")
    assert character.source is not None
    document = check_written_poses(tmp_path / "out.glb", character, motion, character.source.nodes, 1e-5)
    assert "matrix" in next(node for node in document["nodes"] if node["name"] == "Armature")


def test_side_files_become_one_glb(tmp_path):
    document = json.loads(split_glb(GLB)[0])
    (tmp_path / "side.bin").write_bytes(split_glb(GLB)[1])
    document["buffers"][0]["uri"] = "side.bin"
    (tmp_path / "figure.gltf").write_text(json.dumps(document), encoding="utf-8")
    character = read_character_skeletons(tmp_path / "figure.gltf")[0]
    character = replace(character, mapping=map_figure(character.skeleton.names))
    (tmp_path / "side.bin").unlink()
    motion = build_motion(character)
    write_character_glb(tmp_path / "out.glb", character, motion, "walk")
    assert character.source is not None
    check_written_poses(tmp_path / "out.glb", character, motion, character.source.nodes)
    length = document["buffers"][0]["byteLength"]
    assert split_glb((tmp_path / "out.glb").read_bytes())[1][:length] == split_glb(GLB)[1][:length]


def test_a_character_without_mesh_gets_a_test_skin(tmp_path):
    character = build_figure_character()
    motion = build_motion(character)
    write_character_glb(tmp_path / "out.glb", character, motion, "walk")
    document = check_written_poses(tmp_path / "out.glb", character, motion, range(len(FIGURE.names)))
    binary = split_glb((tmp_path / "out.glb").read_bytes())[1]
    inverse = read_accessor(document, binary, document["skins"][0]["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
    rest_positions, rest_rotations = character.skeleton.compute_rest_pose()
    np.testing.assert_allclose(inverse[:, :3, :3] @ rest_rotations, np.tile(np.eye(3), (len(inverse), 1, 1)), atol=1e-6)
    np.testing.assert_allclose((inverse[:, :3, :3] @ rest_positions[..., None])[..., 0] + inverse[:, :3, 3], 0, atol=1e-6)
    corners = read_accessor(document, binary, document["meshes"][0]["primitives"][0]["attributes"]["POSITION"])
    assert np.ptp(corners[:, 1]) == pytest.approx(np.ptp(FIGURE.heads[:, 1]) + 0.05, abs=0.02)


def test_rotations_that_do_not_change_have_one_key_and_resting_bones_none(tmp_path):
    character = read_figure(tmp_path)
    motion = build_motion(character)
    held = character.skeleton.find_joint(f"{PREFIX}LeftArm")
    motion.local_rotations[:, held] = motion.local_rotations[7, held]
    write_character_glb(tmp_path / "out.glb", character, motion, "walk")
    document = json.loads(split_glb((tmp_path / "out.glb").read_bytes())[0])
    assert character.source is not None
    nodes, animation = character.source.nodes, document["animations"][0]
    counts = {}
    for channel in animation["channels"]:
        sampler = animation["samplers"][channel["sampler"]]
        accessor = document["accessors"][sampler["output"]]
        assert accessor["count"] == document["accessors"][sampler["input"]]["count"]
        counts[channel["target"]["node"], channel["target"]["path"]] = accessor["count"]
    assert counts.pop((nodes[held], "rotation")) == 1
    assert set(counts.values()) == {motion.frame_count}
    unmapped = character.skeleton.find_joint(f"{PREFIX}LeftHandIndex1")
    assert (nodes[unmapped], "rotation") not in counts
    assert (nodes[character.skeleton.find_joint(f"{PREFIX}Hips")], "translation") in counts


def test_a_missing_folder_is_refused(tmp_path):
    character = build_figure_character()
    with pytest.raises(WriteError, match="nowhere"):
        write_character_glb(tmp_path / "nowhere" / "out.glb", character, build_motion(character), "walk")


@pytest.mark.skipif(
    not shutil.which("node") or not VALIDATOR.is_dir(), reason="Khronos' validator is not installed (make gltf-validator)"
)
def test_khronos_validator_reports_no_errors(tmp_path):
    paths = []
    for name, data in {"mixamo": GLB, "vrm0": build_vrm(0), "vrm1": build_vrm(1), "bones": None}.items():
        character = build_figure_character() if data is None else read_figure(tmp_path, data)
        paths.append(tmp_path / f"{name}.glb")
        write_character_glb(paths[-1], character, build_motion(character), "walk")
    for name in CHARACTER_PRESETS:
        paths.append(tmp_path / f"preset {name}.glb")
        character = load_character_preset(name)
        write_character_glb(paths[-1], character, build_motion(character, 10), "walk")
    solved = motion_of(smooth_rotations(2, 60, 31, swing=1), np.zeros((60, 3)))
    paths.append(tmp_path / "solved.glb")
    write_gltf(paths[-1], SKELETON, {0: solved.root_position}, solved.local_rotations, 60.0)
    done = subprocess.run(
        ["node", "-e", VALIDATION_SCRIPT, VALIDATOR, *paths], capture_output=True, text=True, check=True, env=os.environ
    )
    for path, report in zip(paths, json.loads(done.stdout), strict=True):
        assert not report["errors"], (path.name, report["messages"])


def test_clips_of_several_takes_are_animations_of_one_file(tmp_path):
    """Each has the keys of its own file, they are before the user's animation, and a name that is used gets a number."""
    character = read_figure(tmp_path)
    motions = [build_motion(character, 20 + 10 * seed, seed=seed) for seed in range(3)]
    paths = [tmp_path / f"{seed}.glb" for seed in range(3)]
    assert character.source is not None
    for path, motion, name in zip(paths, motions, ("run", "turn", "run"), strict=True):
        write_character_glb(path, character, motion, name)
    write_clips(tmp_path / "all.glb", paths)
    text, binary = split_glb((tmp_path / "all.glb").read_bytes())
    document = json.loads(text)
    assert [each["name"] for each in document["animations"]] == ["run", "turn", "run.001", "walk"]
    for motion, animation in zip(motions, document["animations"][:-1], strict=True):
        times = np.arange(motion.frame_count) / motion.rate
        worlds = compute_worlds(document, binary, animation, times)[:, character.source.nodes]
        np.testing.assert_allclose(worlds[..., :3, 3], compute_character_poses(character, motion)[0], atol=2e-6)


def test_what_other_animations_move_returns_to_the_rest_pose(tmp_path):
    """Fingers that another animation of the file bends are keyed once, so that no program leaves them bent."""

    def move_finger(document):
        animation = document["animations"][0]
        node = node_of(FIGURE.names.index("LeftHandIndex1"))
        for path in ("rotation", "translation"):
            animation["channels"].append({"sampler": 0, "target": {"node": node, "path": path}})

    character = read_figure(tmp_path, edit_glb(GLB, move_finger))
    assert character.source is not None
    motion = build_motion(character)
    write_character_glb(tmp_path / "out.glb", character, motion, "take")
    document = check_written_poses(tmp_path / "out.glb", character, motion, character.source.nodes)
    node = node_of(FIGURE.names.index("LeftHandIndex1"))
    keys = {
        each["target"]["path"]: document["accessors"][document["animations"][0]["samplers"][each["sampler"]]["output"]]["count"]
        for each in document["animations"][0]["channels"]
        if each["target"]["node"] == node
    }
    assert keys == {"rotation": 1, "translation": 1}
