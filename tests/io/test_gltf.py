"""The bytes of the file are parsed by the specification (Khronos, glTF 2.0), independently of the writer."""

import json
import struct
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.errors import WriteError
from mocapfix.io.gltf import write_gltf
from mocapfix.solve import kinematics
from tests.io.read_back import SKELETON, motion_of, smooth_rotations

FLOAT, SHORT = 5126, 5123
WIDTH = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}
MOTION = motion_of(smooth_rotations(2, 240, 31, swing=4), np.random.default_rng(1).normal(size=(240, 3)))
POSITIONS, ROTATIONS = kinematics.compute_world_poses(SKELETON, MOTION)


@dataclass(frozen=True)
class Glb:
    """The JSON and the binary chunk of a .glb."""

    json: dict
    data: bytes

    def array(self, accessor: int) -> np.ndarray:
        accessor_json = self.json["accessors"][accessor]
        view = self.json["bufferViews"][accessor_json["bufferView"]]
        kind = {FLOAT: "<f4", SHORT: "<u2"}[accessor_json["componentType"]]
        start, count = (
            view.get("byteOffset", 0) + accessor_json.get("byteOffset", 0),
            accessor_json["count"] * WIDTH[accessor_json["type"]],
        )
        return np.frombuffer(self.data, kind, count, start).reshape(accessor_json["count"], -1)

    def read_channel(self, node: int, path: str) -> np.ndarray:
        """Return the values of the sampler that drives `path` of a node."""
        animation = self.json["animations"][0]
        samplers = [each["sampler"] for each in animation["channels"] if each["target"] == {"node": node, "path": path}]
        assert len(samplers) == 1
        return self.array(animation["samplers"][samplers[0]]["output"])


def read(path) -> Glb:
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert size % 4 == 0
    binary, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0"
    assert binary % 4 == 0
    assert 28 + size + binary == len(data)
    return Glb(json.loads(data[20 : 20 + size]), data[28 + size :])


@pytest.fixture(scope="module")
def glb(tmp_path_factory) -> Glb:
    path = tmp_path_factory.mktemp("gltf") / "walk.glb"
    write_gltf(path, SKELETON, {0: MOTION.root_position}, MOTION.local_rotations, 120.0)
    return read(path)


def test_nodes_are_the_joints_with_their_tree(glb):
    nodes = glb.json["nodes"]
    assert tuple(node["name"] for node in nodes[:31]) == SKELETON.names
    assert glb.json["asset"]["version"] == "2.0"
    parents = {child: index for index, node in enumerate(nodes) for child in node.get("children", [])}
    assert [parents.get(j, -1) for j in range(31)] == SKELETON.parents.tolist()
    assert set(glb.json["scenes"][glb.json["scene"]]["nodes"]) == {0, 31}


def test_joints_read_back_at_their_positions(glb):
    positions, rotations = [], []
    for j, (node, parent) in enumerate(zip(glb.json["nodes"], SKELETON.parents, strict=False)):
        local = Rotation.from_quat(glb.read_channel(j, "rotation")).as_matrix()
        if parent < 0:
            positions.append(glb.read_channel(j, "translation").astype(float))
            rotations.append(local)
        else:
            positions.append(positions[parent] + rotations[parent] @ np.array(node["translation"]))
            rotations.append(rotations[parent] @ local)
    np.testing.assert_allclose(np.stack(positions, 1), POSITIONS, atol=2e-6)
    np.testing.assert_allclose(np.stack(rotations, 1), ROTATIONS, atol=2e-6)


def test_quaternions_have_unit_length_and_no_sign_flips(glb):
    for j in range(31):
        values = glb.read_channel(j, "rotation").astype(float)
        np.testing.assert_allclose(np.linalg.norm(values, axis=1), 1, atol=1e-6)
        assert ((values[1:] * values[:-1]).sum(1) > 0).all()


def test_times_begin_at_zero_and_follow_the_rate(glb):
    animation = glb.json["animations"][0]
    assert {sampler["interpolation"] for sampler in animation["samplers"]} == {"LINEAR"}
    inputs = {sampler["input"] for sampler in animation["samplers"]}
    assert len(inputs) == 1
    times = glb.array(inputs.pop())[:, 0]
    np.testing.assert_allclose(times, np.arange(240) / 120, atol=1e-7)
    assert (np.diff(times) > 0).all()


def test_accessors_are_aligned_within_their_views_and_have_true_bounds(glb):
    needed = {glb.json["animations"][0]["samplers"][0]["input"], glb.json["meshes"][0]["primitives"][0]["attributes"]["POSITION"]}
    for index, accessor_json in enumerate(glb.json["accessors"]):
        view, size = glb.json["bufferViews"][accessor_json["bufferView"]], {FLOAT: 4, SHORT: 2}[accessor_json["componentType"]]
        assert view.get("byteOffset", 0) % 4 == 0
        assert accessor_json["count"] * WIDTH[accessor_json["type"]] * size == view["byteLength"]
        assert view.get("byteOffset", 0) + view["byteLength"] <= glb.json["buffers"][0]["byteLength"] <= len(glb.data)
        assert (index in needed) == ("min" in accessor_json)
        if "min" in accessor_json:
            np.testing.assert_array_equal(np.float32(accessor_json["min"]), glb.array(index).min(0))
            np.testing.assert_array_equal(np.float32(accessor_json["max"]), glb.array(index).max(0))


def test_the_skin_inverts_the_rest_pose(glb):
    skin = glb.json["skins"][0]
    assert skin["joints"] == list(range(31))
    assert glb.json["nodes"][31]["skin"] == glb.json["nodes"][31]["mesh"] == 0
    rest = kinematics.compute_world_poses(SKELETON, motion_of(np.tile(np.eye(3), (1, 31, 1, 1))))[0][0]
    inverse = glb.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)  # stored by columns
    at_rest = inverse @ np.concatenate([rest, np.ones((31, 1))], axis=1)[..., None]
    np.testing.assert_allclose(at_rest[..., 0], np.tile([0, 0, 0, 1], (31, 1)), atol=1e-6)


def test_the_mesh_follows_the_joints_and_faces_outwards(glb):
    attributes = {name: glb.array(accessor) for name, accessor in glb.json["meshes"][0]["primitives"][0]["attributes"].items()}
    joints, weights, corners = attributes["JOINTS_0"], attributes["WEIGHTS_0"], attributes["POSITION"].reshape(-1, 24, 3)
    assert joints.max() < 31
    np.testing.assert_array_equal(weights.sum(1), 1)
    np.testing.assert_allclose(np.linalg.norm(attributes["NORMAL"], axis=1), 1, atol=1e-6)
    bones = 30 - (SKELETON.offsets[1:] == 0).all(1).sum() + np.isfinite(SKELETON.ends).all(1).sum()  # those with a length
    assert len(corners) == bones
    middle = (corners.max(1) + corners.min(1))[:, None] / 2
    normals = attributes["NORMAL"].reshape(-1, 8, 3, 3)[:, :, 0]
    assert (((corners.reshape(-1, 8, 3, 3).mean(2) - middle) * normals).sum(-1) > 0).all()


def test_a_missing_folder_is_refused_and_no_file_remains(tmp_path):
    with pytest.raises(WriteError, match="nowhere"):
        write_gltf(tmp_path / "nowhere" / "walk.glb", SKELETON, {0: MOTION.root_position}, MOTION.local_rotations, 120.0)
    assert not list(tmp_path.iterdir())
