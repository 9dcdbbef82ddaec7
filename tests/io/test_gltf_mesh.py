"""The mesh of a glTF, posed by the nodes that move it."""

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from mocapfix.io.gltf import ARRAY_BUFFER, GlbContent, GltfBuffer, add_animation, build_glb, parse_glb, read_gltf_nodes
from mocapfix.io.gltf_mesh import compute_node_matrices, read_gltf_mesh

CUBE = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
CUBE_TRIANGLES = np.array([
    [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
    [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
])  # fmt: skip
NAME = Path("cube.glb")


def build_cube(*, bone_at=(0.0, 2.0, 0.0), is_skinned: bool = True) -> tuple[dict[str, Any], GltfBuffer]:
    """Return a file with a cube beneath (0, 2, 0) and one bone there, which carries the cube by a skin or as its parent."""
    mesh = {"mesh": 0, "skin": 0} if is_skinned else {"mesh": 0, "translation": [0.0, -2.0, 0.0]}
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "nodes": [{"name": "Bone", "translation": list(bone_at)} | ({} if is_skinned else {"children": [1]}), mesh],
    }
    buffer = GltfBuffer(document)
    attributes = {"POSITION": buffer.add_array(CUBE, "VEC3", ARRAY_BUFFER)}
    if is_skinned:
        attributes["JOINTS_0"] = buffer.add_array(np.zeros((8, 4), int), "VEC4")
        attributes["WEIGHTS_0"] = buffer.add_array(np.tile([1.0, 0, 0, 0], (8, 1)), "VEC4")
        inverse = np.eye(4)
        inverse[:3, 3] = [0.0, -2.0, 0.0]
        matrices = buffer.add_array(inverse.T[None], "MAT4")
        document["skins"] = [{"joints": [0], "inverseBindMatrices": matrices}]
    indices = buffer.add_array(CUBE_TRIANGLES.reshape(-1, 1), "SCALAR")
    document["meshes"] = [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}]
    document["materials"] = [{"pbrMetallicRoughness": {"baseColorFactor": [1.0, 0.0, 0.0, 1.0]}}]
    return document, buffer


def read_back(document: dict[str, Any], buffer: GltfBuffer):
    content = parse_glb(NAME, build_glb(GlbContent(document, buffer.finish())))
    return content, read_gltf_nodes(NAME, content.document)


@pytest.mark.parametrize("is_skinned", [True, False])
def test_a_cube_is_where_its_bone_carries_it(is_skinned):
    """The bone turns by 90 degrees about Z at (0, 2, 0), so the corner (1, 0, 0) goes to (2, 3, 0)."""
    document, buffer = build_cube(is_skinned=is_skinned)
    turned = Rotation.from_euler("z", [[0.0], [90.0]], degrees=True).as_matrix()
    add_animation(buffer, "turn", turned[:, None], {0: np.array([[0.0, 2, 0]] * 2)}, {0: 0}, rate=10.0)
    content, nodes = read_back(document, buffer)
    mesh = read_gltf_mesh(content, nodes)
    rest = mesh.pose(compute_node_matrices(content, nodes)[0])
    np.testing.assert_allclose(rest, CUBE, atol=1e-6)
    first, last = map(mesh.pose, compute_node_matrices(content, nodes, content.document["animations"][0], (0.0, 0.1)))
    np.testing.assert_allclose(first, CUBE, atol=1e-6)
    expected = np.stack([2 - CUBE[:, 1], 2 + CUBE[:, 0], CUBE[:, 2]], axis=1)
    np.testing.assert_allclose(last, expected, atol=1e-6)
    np.testing.assert_array_equal(mesh.triangles, CUBE_TRIANGLES)
    np.testing.assert_allclose(mesh.colours, np.tile([1.0, 0, 0], (12, 1)))


def test_a_mesh_follows_the_bone_from_its_bind_pose_to_its_node():
    document, buffer = build_cube(bone_at=(5.0, 2.0, 0.0))
    content, nodes = read_back(document, buffer)
    posed = read_gltf_mesh(content, nodes).pose(compute_node_matrices(content, nodes)[0])
    np.testing.assert_allclose(posed, CUBE + [5, 0, 0], atol=1e-6)


def test_the_texture_colours_triangles_and_hides_transparent_ones():
    document, buffer = build_cube()
    image = Image.fromarray(np.array([[[0, 0, 255, 255], [0, 255, 0, 0]]], np.uint8))  # blue, and a transparent green
    encoded = BytesIO()
    image.save(encoded, "PNG")
    place = np.where(np.arange(8) < 4, 0.1, 0.9)  # the corners at x = 0, and at x = 1
    primitive = document["meshes"][0]["primitives"][0]
    primitive["attributes"]["TEXCOORD_0"] = buffer.add_array(np.stack([place, place], axis=1), "VEC2")
    document["bufferViews"].append({"buffer": 0, "byteOffset": len(buffer.data), "byteLength": len(encoded.getvalue())})
    buffer.data += encoded.getvalue()
    document["images"] = [{"bufferView": len(document["bufferViews"]) - 1}]
    document["textures"] = [{"source": 0}]
    document["materials"] = [{"alphaMode": "MASK", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    mesh = read_gltf_mesh(*read_back(document, buffer))
    is_blue = place[CUBE_TRIANGLES].mean(1) < 0.5
    np.testing.assert_array_equal(mesh.triangles, CUBE_TRIANGLES[is_blue])
    np.testing.assert_allclose(mesh.colours, np.tile([0.0, 0, 1], (is_blue.sum(), 1)))


@pytest.mark.parametrize(
    "damage",
    [
        lambda document: document["accessors"][0].update(count=1000),
        lambda document: document["accessors"][0].pop("bufferView"),
        lambda document: document["accessors"][0].update(componentType=1),
        lambda document: document["skins"][0].update(joints=[]),
        lambda document: document["bufferViews"][0].update(extensions={"EXT_meshopt_compression": {}}),
        lambda document: document.update(meshes=[7]),
        lambda document: document.update(materials=[[]]),
        lambda document: document["bufferViews"][0].update(byteOffset=10**30),
    ],
)
def test_a_mesh_that_cannot_be_read_is_left_out(damage):
    document, buffer = build_cube()
    content, nodes = read_back(document, buffer)
    damage(content.document)
    mesh = read_gltf_mesh(content, nodes)
    assert len(mesh.triangles) == 0
    assert mesh.pose(compute_node_matrices(content, nodes)[0]).shape == (0, 3)
