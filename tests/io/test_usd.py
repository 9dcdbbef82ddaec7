"""USD files, opened with OpenUSD's own libraries."""

import sys
from dataclasses import replace
from importlib import import_module
from typing import Any, cast

import numpy as np
import pytest

from mocapfix.characters.character import compute_character_poses
from mocapfix.characters.character_files import write_character_glb
from mocapfix.characters.load_character import load_character_preset, read_character_skeletons
from mocapfix.io.gltf import parse_glb, read_gltf_nodes
from mocapfix.io.gltf_mesh import compute_node_matrices, read_gltf_mesh
from mocapfix.io.usd import write_usd
from tests.characters.character_files import build_mixamo_glb, build_motion, map_figure

RATE, FRAME_COUNT = 30.0, 40
Usd, UsdGeom, UsdSkel = (cast(Any, import_module(f"pxr.{name}")) for name in ("Usd", "UsdGeom", "UsdSkel"))


def build_character(name, folder):
    if name != "user":
        return load_character_preset(name)
    (folder / "user.glb").write_bytes(build_mixamo_glb())
    character = read_character_skeletons(folder / "user.glb")[0]
    return replace(character, mapping=map_figure(character.skeleton.names))


def open_skeleton(path):
    """Return the stage, the query of its skeleton, and the index of each joint by the last part of its path."""
    stage = Usd.Stage.Open(str(path))
    skeleton = UsdSkel.Skeleton(stage.GetPrimAtPath("/Character/Skeleton"))
    query = UsdSkel.Cache().GetSkelQuery(skeleton)
    return stage, query, {str(joint).rpartition("/")[2]: index for index, joint in enumerate(query.GetJointOrder())}


@pytest.mark.parametrize("name", ["user", "unreal", "smpl"])
def test_joints_are_where_the_motion_has_them_in_every_frame(tmp_path, name):
    """Of an armature that scales by 0.01 and turns by 90 degrees, and of figures with a test skin."""
    character = build_character(name, tmp_path)
    motion = build_motion(character, FRAME_COUNT, RATE)
    write_character_glb(tmp_path / "walk.glb", character, motion, "my take")
    assert write_usd(tmp_path / "walk.usd", tmp_path / "walk.glb", RATE) is None
    stage, query, joints = open_skeleton(tmp_path / "walk.usd")
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, FRAME_COUNT - 1)
    assert (stage.GetTimeCodesPerSecond(), UsdGeom.GetStageMetersPerUnit(stage)) == (RATE, 1.0)
    assert stage.GetPrimAtPath("/Character/Skeleton/my_take")
    columns = [joints[bone.replace(":", "_")] for bone in character.skeleton.names]
    found = np.array([query.ComputeJointSkelTransforms(frame) for frame in range(FRAME_COUNT)])[:, columns, 3, :3]
    np.testing.assert_allclose(found, compute_character_poses(character, motion)[0], atol=1e-5)


def test_the_skin_moves_as_that_of_the_glb(tmp_path):
    character = build_character("user", tmp_path)
    write_character_glb(tmp_path / "walk.glb", character, build_motion(character, FRAME_COUNT, RATE), "take")
    assert write_usd(tmp_path / "walk.usd", tmp_path / "walk.glb", RATE) is None
    stage, query, _ = open_skeleton(tmp_path / "walk.usd")
    cache, root = UsdSkel.Cache(), UsdSkel.Root(stage.GetPrimAtPath("/Character"))
    cache.Populate(root, Usd.PrimDefaultPredicate)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Character/Mesh"))
    skinning = cache.GetSkinningQuery(mesh.GetPrim())
    content = parse_glb(tmp_path / "walk.glb", (tmp_path / "walk.glb").read_bytes())
    nodes = read_gltf_nodes(tmp_path / "walk.glb", content.document)
    expected = read_gltf_mesh(content, nodes)
    assert len(mesh.GetFaceVertexCountsAttr().Get()) == len(expected.triangles)
    for frame in (0, 17, FRAME_COUNT - 1):
        points = mesh.GetPointsAttr().Get()
        assert skinning.ComputeSkinnedPoints(query.ComputeSkinningTransforms(frame), points, frame)
        matrices = compute_node_matrices(content, nodes, content.document["animations"][0], (frame / RATE,))[0]
        np.testing.assert_allclose(np.array(points), expected.pose(matrices), atol=1e-5)


def test_without_the_library_a_sentence_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr.Gf", None)
    sentence = write_usd(tmp_path / "walk.usd", tmp_path / "walk.glb", RATE)
    assert sentence is not None
    assert sentence.startswith("walk.usd was not written: USD needs usd-core; install it with: pip install 'mocapfix[usd]'.")
    assert not (tmp_path / "walk.usd").exists()
