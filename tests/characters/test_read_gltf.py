import base64
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.characters.load_character import read_character_skeletons
from mocapfix.errors import ReadError
from mocapfix.io.gltf import parse_glb
from tests.characters.character_files import (
    FIGURE,
    IMAGE,
    PREFIX,
    SEGMENTS,
    build_mixamo_glb,
    build_vrm,
    edit_glb,
    node_of,
    split_glb,
)

GLB = build_mixamo_glb()
COUNT = len(FIGURE.names)


def read(folder, data, name="figure.glb"):
    (folder / name).write_bytes(data)
    return read_character_skeletons(folder / name)[0]


def check_rest_pose(character, names):
    """Check heads and axes of the figure's bones in the world, and their tree."""
    positions, rotations = character.skeleton.compute_rest_pose()
    bones = [character.skeleton.find_joint(name) for name in names]
    np.testing.assert_allclose(positions[bones], FIGURE.heads, atol=1e-6)
    np.testing.assert_allclose(rotations[bones], FIGURE.axes, atol=1e-6)
    for bone, parent in zip(bones, FIGURE.parents, strict=True):
        assert parent < 0 or character.skeleton.parents[bone] == bones[parent]
    assert (character.skeleton.parents < np.arange(len(character.skeleton.parents))).all()


def test_a_mixamo_character_has_its_rest_pose_in_metres(tmp_path):
    character = read(tmp_path, GLB)
    check_rest_pose(character, [f"{PREFIX}{name}" for name in FIGURE.names])
    assert character.name == "figure"
    assert character.skeleton.names[:2] == ("Armature", f"{PREFIX}Hips")
    assert len(character.skeleton.names) == COUNT + 1  # not the mesh
    np.testing.assert_allclose(character.scales, 0.01)
    assert character.root_scale == 1.0
    assert character.source is not None
    assert character.source.kind == "gltf"
    assert character.source.data == GLB
    names = parse_glb(tmp_path, GLB).document["nodes"]
    assert [names[node]["name"] for node in character.source.nodes] == list(character.skeleton.names)
    assert not character.mapping.bones


def test_tails_are_at_the_farther_children(tmp_path):
    character = read(tmp_path, GLB)
    for name, child in (("LeftUpLeg", "LeftLeg"), ("Head", "HeadTop_End"), ("RightToeBase", "RightToe_End")):
        bone, end = FIGURE.names.index(name), FIGURE.names.index(child)
        tail = character.skeleton.ends[character.skeleton.find_joint(f"{PREFIX}{name}")]
        np.testing.assert_allclose(FIGURE.heads[bone] + FIGURE.axes[bone] @ tail, FIGURE.heads[end], atol=1e-6)
    assert np.isnan(character.skeleton.ends[character.skeleton.find_joint(f"{PREFIX}HeadTop_End")]).all()


def test_joints_that_are_no_longer_joints_are_tails(tmp_path):
    """FBX2glTF leaves bones without weights out of the skin, such as the ends of toes."""
    end = node_of(FIGURE.names.index("LeftToe_End"))

    def edit(document):
        document["skins"][0]["joints"].remove(end)

    character = read(tmp_path, edit_glb(GLB, edit))
    assert f"{PREFIX}LeftToe_End" not in character.skeleton.names
    assert np.linalg.norm(character.skeleton.ends[character.skeleton.find_joint(f"{PREFIX}LeftToeBase")]) == pytest.approx(0.07)


@pytest.mark.parametrize("version", [0, 1])
def test_a_vrm_names_the_segments(tmp_path, version):
    character = read(tmp_path, build_vrm(version), "avatar.vrm")
    check_rest_pose(character, [f"J_{node_of(bone)}" for bone in range(COUNT)])
    for segment, bones in SEGMENTS.items():
        expected = [f"J_{node_of(FIGURE.names.index(bone))}" for bone in bones]
        assert [character.skeleton.names[bone] for bone in character.mapping.bones[segment]] == expected
    assert "VRM" in character.mapping.reason
    assert not character.mapping.missing_segments


def test_bones_between_humanoid_bones_belong_to_the_upper_segment(tmp_path):
    def edit(document):
        bones = document["extensions"]["VRMC_vrm"]["humanoid"]["humanBones"]
        del bones["chest"], bones["upperChest"]

    character = read(tmp_path, edit_glb(build_vrm(1), edit))
    spine = [character.skeleton.names[bone] for bone in character.mapping.bones["spine"]]
    assert spine == [f"J_{node_of(FIGURE.names.index(name))}" for name in ("Spine", "Spine1", "Spine2")]


def test_without_a_humanoid_neck_the_bones_above_the_arms_are_the_neck(tmp_path):
    data = edit_glb(build_vrm(1), lambda document: document["extensions"]["VRMC_vrm"]["humanoid"]["humanBones"].pop("neck"))
    mapping = read(tmp_path, data).mapping.bones
    assert (len(mapping["spine"]), len(mapping["neck"])) == (3, 1)


def add_bone_beside_the_shin(document, name, share):
    """Add a joint below the left thigh, at a share of the way to the knee, and return its node."""
    thigh, knee = node_of(FIGURE.names.index("LeftUpLeg")), node_of(FIGURE.names.index("LeftLeg"))
    place = [share * each for each in document["nodes"][knee]["translation"]]
    document["nodes"].append({"name": name, "translation": place})
    document["nodes"][thigh]["children"].append(len(document["nodes"]) - 1)
    document["skins"][0]["joints"].append(len(document["nodes"]) - 1)
    return len(document["nodes"]) - 1


@pytest.mark.parametrize("version", [0, 1])
def test_twist_bones_of_a_vrm_are_found(tmp_path, version):
    def edit(document):
        add_bone_beside_the_shin(document, "twist far", 0.8)
        add_bone_beside_the_shin(document, "twist near", 0.4)

    character = read(tmp_path, edit_glb(build_vrm(version), edit), "avatar.vrm")
    assert {key: [character.skeleton.names[bone] for bone in chain] for key, chain in character.mapping.twists.items()} == {
        "left_thigh": ["twist near", "twist far"]
    }


@pytest.mark.parametrize("version", [0, 1])
def test_springs_of_a_vrm_are_no_twist_bones(tmp_path, version):
    def edit(document):
        node = add_bone_beside_the_shin(document, "skirt", 0.5)
        if version == 0:
            document["extensions"]["VRM"]["secondaryAnimation"] = {"boneGroups": [{"bones": [node], "hitRadius": 0.02}]}
        else:
            document["extensions"]["VRMC_springBone"] = {"springs": [{"name": "skirt", "joints": [{"node": node}]}]}

    character = read(tmp_path, edit_glb(build_vrm(version), edit), "avatar.vrm")
    assert "skirt" in character.skeleton.names
    assert not character.mapping.twists


def test_a_humanoid_bone_without_skin_is_a_bone(tmp_path):
    def edit(document):
        document["skins"][0]["joints"].remove(node_of(FIGURE.names.index("LeftToeBase")))
        document["skins"][0]["joints"].remove(node_of(FIGURE.names.index("LeftToe_End")))

    character = read(tmp_path, edit_glb(build_vrm(1), edit))
    assert len(character.mapping.bones["left_toe"]) == 1


@pytest.mark.parametrize(
    ("edit", "problem"),
    [
        (lambda bones: bones.pop("leftFoot"), "left_foot"),
        (lambda bones: bones["leftFoot"].update(node=5000), "refers to entry 5000"),
        (lambda bones: bones["leftFoot"].update(node=bones["rightFoot"]["node"]), "already in"),
        (lambda bones: bones["spine"].update(node=COUNT), "below"),
    ],
)
def test_an_incomplete_vrm_is_refused(tmp_path, edit, problem):
    data = edit_glb(build_vrm(1), lambda document: edit(document["extensions"]["VRMC_vrm"]["humanoid"]["humanBones"]))
    with pytest.raises(ReadError, match=problem) as error:
        read(tmp_path, data, "avatar.vrm")
    assert "avatar.vrm" in str(error.value)


def test_matrices_and_rotations_give_the_same_bones(tmp_path):
    def edit(document):
        for node in document["nodes"]:
            matrix = np.eye(4)
            matrix[:3, :3] = Rotation.from_quat(node.pop("rotation", [0, 0, 0, 1])).as_matrix() * node.pop("scale", [1])[0]
            matrix[:3, 3] = node.pop("translation", [0, 0, 0])
            node["matrix"] = matrix.T.ravel().tolist()

    character = read(tmp_path, edit_glb(GLB, edit))
    check_rest_pose(character, [f"{PREFIX}{name}" for name in FIGURE.names])
    np.testing.assert_allclose(character.scales, 0.01)


def test_scales_along_the_tree_are_multiplied_out(tmp_path):
    knee, foot = (node_of(FIGURE.names.index(name)) for name in ("LeftLeg", "LeftFoot"))

    def edit(document):
        document["nodes"][knee]["scale"] = [2, 2, 2]
        document["nodes"][foot]["translation"] = [x / 2 for x in document["nodes"][foot]["translation"]]
        for child in document["nodes"][foot]["children"]:
            document["nodes"][child]["translation"] = [x / 2 for x in document["nodes"][child]["translation"]]
            for end in document["nodes"][child]["children"]:
                document["nodes"][end]["translation"] = [x / 2 for x in document["nodes"][end]["translation"]]

    character = read(tmp_path, edit_glb(GLB, edit))
    check_rest_pose(character, [f"{PREFIX}{name}" for name in FIGURE.names])
    assert character.scales[character.skeleton.find_joint(f"{PREFIX}LeftToeBase")] == pytest.approx(0.02)


def test_of_several_skeletons_the_largest_comes_first(tmp_path):
    hand = node_of(FIGURE.names.index("LeftHand"))

    def edit(document):
        first = len(document["nodes"])
        document["nodes"] += [{"name": f"prop {index}", "children": [first + index + 1]} for index in range(3)]
        document["nodes"][-1].pop("children")
        document["scenes"][0]["nodes"].append(first)
        document["skins"].insert(0, {"joints": [first, first + 1, first + 2]})
        document["skins"].append({"joints": [hand]})  # a glove that shares a joint

    (tmp_path / "two.glb").write_bytes(edit_glb(GLB, edit))
    skeletons = read_character_skeletons(tmp_path / "two.glb")
    assert [len(each.skeleton.names) for each in skeletons] == [COUNT + 1, 3]
    assert skeletons[1].skeleton.names == ("prop 0", "prop 1", "prop 2")


def test_nodes_without_skin_are_bones(tmp_path):
    def edit(document):
        document.pop("skins")
        document["nodes"][COUNT + 1].pop("skin")

    check_rest_pose(read(tmp_path, edit_glb(GLB, edit)), [f"{PREFIX}{name}" for name in FIGURE.names])


def test_unnamed_and_repeated_names_become_unique(tmp_path):
    def edit(document):
        document["nodes"][node_of(3)].pop("name")
        document["nodes"][node_of(4)]["name"] = document["nodes"][node_of(5)]["name"] = "twin"

    names = read(tmp_path, edit_glb(GLB, edit)).skeleton.names
    assert len(set(names)) == len(names)
    assert f"node {node_of(3)}" in names


def test_side_files_are_packed_without_a_change_of_their_bytes(tmp_path):
    document = json.loads(split_glb(GLB)[0])
    binary = split_glb(GLB)[1]
    length = document["buffers"][0]["byteLength"]
    (tmp_path / "my figure.bin").write_bytes(binary)
    (tmp_path / "skin.png").write_bytes(IMAGE)
    document["buffers"][0]["uri"] = "my%20figure.bin"
    document["buffers"].append(
        {"byteLength": 5, "uri": "data:application/octet-stream;base64," + base64.b64encode(b"12345").decode()}
    )
    document["bufferViews"].append({"buffer": 1, "byteLength": 5})
    document["images"] = [{"uri": "skin.png"}, {"uri": "missing.png"}]
    (tmp_path / "figure.gltf").write_text(json.dumps(document), encoding="utf-8")
    character = read_character_skeletons(tmp_path / "figure.gltf")[0]
    check_rest_pose(character, [f"{PREFIX}{name}" for name in FIGURE.names])
    assert character.source is not None
    packed, data = json.loads(split_glb(character.source.data)[0]), split_glb(character.source.data)[1]
    assert data[:length] == binary[:length]
    assert len(packed["buffers"]) == 1
    assert "uri" not in packed["buffers"][0]
    for view, expected in ((packed["bufferViews"][-2], b"12345"), (packed["bufferViews"][-1], IMAGE)):
        assert data[view["byteOffset"] : view["byteOffset"] + view["byteLength"]] == expected
    assert packed["images"] == [{"bufferView": len(packed["bufferViews"]) - 1, "mimeType": "image/png"}, {"uri": "missing.png"}]
    assert packed["accessors"] == document["accessors"]


def test_compressed_meshes_keep_their_buffers(tmp_path):
    def edit(document):
        document["buffers"].append({"byteLength": 99, "extensions": {"EXT_meshopt_compression": {"fallback": True}}})
        document["buffers"].append({"byteLength": 3, "uri": "data:;base64,YWJj"})
        compression = {"buffer": 2, "byteLength": 3, "count": 1, "mode": "ATTRIBUTES", "byteStride": 4}
        view = {"buffer": 1, "byteLength": 99, "extensions": {"EXT_meshopt_compression": compression}}
        document["bufferViews"].append(view)

    character = read(tmp_path, edit_glb(GLB, edit))
    assert character.source is not None
    packed, data = json.loads(split_glb(character.source.data)[0]), split_glb(character.source.data)[1]
    view = packed["bufferViews"][-1]
    inner = view["extensions"]["EXT_meshopt_compression"]
    assert data[inner["byteOffset"] :][:3] == b"abc"
    assert inner["buffer"] == 0
    assert packed["buffers"][view["buffer"]]["byteLength"] == 99


def build_side_gltf(**buffer):
    document = json.loads(split_glb(GLB)[0])
    document["buffers"] = [document["buffers"][0] | buffer]
    return json.dumps(document).encode()


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (GLB[:10], "cut off"),
        (GLB[: len(GLB) // 2], "cut off"),
        (b"glTF\x01\0\0\0" + GLB[8:], "version 1 of GLB"),
        (GLB[:12] + b"\xff\xff\xff\x7f" + GLB[16:], "ends beyond the file"),
        (GLB[:20] + b"?" + GLB[21:], "JSON is damaged"),
        (GLB.replace(b'"scene":0', b'"scene":NaN').replace(b'"author"', b'"auth"'), "NaN"),
        (GLB[:25] + b"\xff" + GLB[26:], "not valid UTF-8"),
        (b"{" * 100000, "JSON"),
        (b"[1]", "no character"),
        (b"solid stl", "no character"),
        (b'{"asset": {"version": "1.0"}}', "version 1.0"),
        (b"{}", "version None"),
        (build_side_gltf(uri="side.bin"), "side.bin"),
        (build_side_gltf(uri="../../etc/passwd"), "folder"),
        (build_side_gltf(uri="http://example.org/side.bin"), "folder"),
        (build_side_gltf(uri="data:;base64,***"), "base64"),
        (build_side_gltf(uri="data:;base64,YWJj"), "3 of"),
        (build_side_gltf(), "no data"),
        (edit_glb(GLB, lambda document: document["buffers"][0].update(byteLength=10**9)), "cut off"),
        (edit_glb(GLB, lambda document: document["buffers"][0].update(byteLength=10**400)), "no valid byteLength"),
    ],
)
def test_a_damaged_file_is_refused_in_one_sentence(tmp_path, data, problem):
    with pytest.raises(ReadError, match=problem) as error:
        read(tmp_path, data, "broken.glb")
    assert "broken.glb" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("edit", "problem"),
    [
        (lambda nodes: nodes[3].update(scale=[1, 2, 1]), r"has the scale \(1, 2, 1\)"),
        (lambda nodes: nodes[3].update(scale=[-1, -1, -1]), "positive scale"),
        (lambda nodes: nodes[3].update(scale=[0, 0, 0]), "positive scale"),
        (lambda nodes: nodes[3].update(matrix=[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1]), "scale"),
        (lambda nodes: nodes[3].update(matrix=[1, 0, 0, 0, 0.5, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]), "sheared|scale"),
        (lambda nodes: nodes[3].update(rotation=[0, 0, 0, 0]), "is zero"),
        (lambda nodes: nodes[3].update(translation=[0, 0]), "not 3 finite numbers"),
        (lambda nodes: nodes[3].update(translation=[0, 0, 1e300]), "not 3 finite numbers"),
        (lambda nodes: nodes[3].update(translation="x"), "not 3 finite numbers"),
        (lambda nodes: nodes[0].setdefault("children", []).append(node_of(0)), "is a child of"),
        (lambda nodes: nodes[COUNT].update(children=[COUNT]), "below itself"),
        (lambda nodes: nodes[COUNT].update(children=[10**9]), "refers to entry 1000000000"),
        (lambda nodes: nodes[COUNT].update(children=["a"]), "refers to entry a"),
        (lambda nodes: nodes[COUNT].update(children=3), "no list"),
    ],
)
def test_bones_that_cannot_be_are_refused(tmp_path, edit, problem):
    with pytest.raises(ReadError, match=problem) as error:
        read(tmp_path, edit_glb(GLB, lambda document: edit(document["nodes"])))
    assert "figure.glb" in str(error.value)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(ReadError, match="no such file"):
        read_character_skeletons(tmp_path / "nothing.glb")[0]


def test_few_nodes_without_skin_are_refused(tmp_path):
    def edit(document):
        document.pop("skins")
        document["nodes"] = [{"name": "lamp"}]
        document["scenes"][0]["nodes"] = [0]

    with pytest.raises(ReadError, match="has no skin"):
        read(tmp_path, edit_glb(GLB, edit))


def test_further_chunks_are_kept():
    content = replace(parse_glb(Path("x.glb"), GLB), other_chunks=((0x12345678, b"abcd"),))
    from mocapfix.io.gltf import build_glb

    assert parse_glb(Path("x.glb"), build_glb(content)) == content
