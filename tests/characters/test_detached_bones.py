"""Bones that no bone of the body carries, as in rigs with controls: they follow the body all the same."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.characters.character import Character, compute_character_poses
from mocapfix.characters.character_files import write_character_bvh, write_character_glb, write_mapping_file
from mocapfix.characters.load_character import load_character
from mocapfix.errors import SceneError
from mocapfix.io.gltf import parse_glb, read_gltf_nodes
from mocapfix.io.gltf_mesh import compute_node_matrices
from tests.characters.character_files import (
    ARMATURE_ROTATION,
    ARMATURE_SCALE,
    FIGURE,
    PREFIX,
    build_mixamo_glb,
    build_motion,
    edit_glb,
    node_of,
)
from tests.io.read_back import Bvh

ARMATURE = len(FIGURE.names)


def detach(document: dict[str, Any], *names: str) -> None:
    """Put bones below the armature, at the same place."""
    for name in names:
        bone = FIGURE.names.index(name)
        document["nodes"][node_of(int(FIGURE.parents[bone]))]["children"].remove(node_of(bone))
        document["nodes"][ARMATURE]["children"].append(node_of(bone))
        axes = ARMATURE_ROTATION.inv() * Rotation.from_matrix(FIGURE.axes[bone])
        place = ARMATURE_ROTATION.inv().apply(FIGURE.heads[bone]) / ARMATURE_SCALE
        document["nodes"][node_of(bone)] |= {"translation": place.tolist(), "rotation": axes.as_quat().tolist()}


def load_detached(folder: Path, *names: str, **renamed: str) -> Character:
    def edit(document: dict[str, Any]) -> None:
        detach(document, *names)
        for name, new_name in renamed.items():
            document["nodes"][node_of(FIGURE.names.index(name))]["name"] = new_name

    (folder / "figure.glb").write_bytes(edit_glb(build_mixamo_glb(), edit))
    return load_character(folder / "figure.glb")


@pytest.mark.parametrize(
    "names", [("LeftFoot", "RightFoot"), ("LeftHand", "RightHand", "LeftFoot"), ("LeftUpLeg", "RightShoulder")]
)
def test_parts_of_the_body_below_the_root_move_with_it(tmp_path, names):
    character = load_detached(tmp_path, *names)
    skeleton, mapping = character.skeleton, character.mapping
    for name in names:
        assert f"{PREFIX}{name}" in mapping.reason
        parent = FIGURE.names[FIGURE.parents[FIGURE.names.index(name)]]
        assert skeleton.names[skeleton.parents[skeleton.find_joint(f"{PREFIX}{name}")]] == f"{PREFIX}{parent}"
    heads, axes = skeleton.compute_rest_pose()
    bones = [skeleton.find_joint(f"{PREFIX}{name}") for name in FIGURE.names]
    np.testing.assert_allclose(heads[bones], FIGURE.heads, atol=1e-6)
    np.testing.assert_allclose(axes[bones], FIGURE.axes, atol=1e-6)

    motion = build_motion(character)
    write_character_glb(tmp_path / "out.glb", character, motion, "take")
    content = parse_glb(tmp_path / "out.glb", (tmp_path / "out.glb").read_bytes())
    nodes, animation = read_gltf_nodes(tmp_path / "out.glb", content.document), content.document["animations"][0]
    times = (np.arange(motion.frame_count) / motion.rate).tolist()
    assert character.source is not None
    shown = compute_node_matrices(content, nodes, animation, times)[:, character.source.nodes.tolist()]
    positions, rotations = compute_character_poses(character, motion)
    np.testing.assert_allclose(shown[..., :3, 3], positions, atol=1e-5)
    np.testing.assert_allclose(shown[:, 1:, :3, :3] / ARMATURE_SCALE, rotations[:, 1:], atol=1e-5)
    moved = {channel["target"]["node"] for channel in animation["channels"] if channel["target"]["path"] == "translation"}
    assert moved == {node_of(FIGURE.names.index(name)) for name in ("Hips", *names)}

    write_character_bvh(tmp_path / "out.bvh", character, motion)
    bvh = Bvh((tmp_path / "out.bvh").read_text(encoding="utf-8"))
    places = [skeleton.find_joint(name) for name in bvh.names]
    np.testing.assert_allclose(bvh.compute_world_positions() * ARMATURE_SCALE, positions[:, places], atol=1e-4)

    write_mapping_file(tmp_path / "figure.map.yaml", character)
    assert load_character(tmp_path / "figure.glb", tmp_path / "figure.map.yaml").mapping.bones == mapping.bones


def test_a_skinned_bone_beside_the_body_follows_the_nearest_bone(tmp_path):
    character = load_detached(tmp_path, "LeftHandIndex1", LeftHandIndex1="strap")
    skeleton = character.skeleton
    assert skeleton.names[skeleton.parents[skeleton.find_joint("strap")]] == f"{PREFIX}LeftHand"
    assert character.mapping.reason.endswith("The body moves strap, though none of its bones carries them.")


def test_skin_of_the_body_on_a_bone_above_the_pelvis_is_refused(tmp_path):
    """It would stay behind, and the mesh would be torn."""

    def weight_to_armature(document: dict[str, Any]) -> None:
        joints = document["skins"][0]["joints"]
        joints[joints.index(node_of(FIGURE.names.index("LeftToe_End")))] = ARMATURE

    path = tmp_path / "figure.glb"
    path.write_bytes(edit_glb(build_mixamo_glb(), weight_to_armature))
    with pytest.raises(SceneError, match=r"figure\.glb: the bone 'Armature' carries skin at '.*', but is above the pelvis"):
        load_character(path)
