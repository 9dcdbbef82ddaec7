"""Which pose of a file is the rest pose, and what it shows: swapped sides, posed limbs, and soles that lie flat."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.characters.character import SIDES, Character, CharacterSource, build_cmu31_character, compute_character_poses
from mocapfix.characters.character_files import write_character_glb
from mocapfix.characters.load_character import are_soles_flat, check_sides, load_character, load_character_preset
from mocapfix.characters.rest_poses import MAX_ASYMMETRY_DEG, MAX_TILT_DEG, measure_poses
from mocapfix.errors import SceneError
from mocapfix.io.bvh import write_bvh
from mocapfix.io.gltf import GltfBuffer, add_animation, build_glb, parse_glb, read_gltf_nodes
from mocapfix.io.gltf_mesh import compute_node_matrices
from mocapfix.model.skeleton import Skeleton, load_cmu31_skeleton
from mocapfix.options import CHARACTER_PRESETS
from mocapfix.stats.rigid_alignment import compute_shortest_rotation
from tests.characters.character_files import (
    FIGURE,
    PREFIX,
    build_mixamo_glb,
    build_motion,
    change_bones,
    edit_glb,
    node_of,
)
from tests.io.read_back import motion_of, smooth_rotations

SOLVED = build_cmu31_character(load_cmu31_skeleton())


def turn(character: Character, segment: str, axis: str, degrees: float) -> Character:
    """Return the character with a segment, and what it carries, turned about an axis of the world in its rest pose."""
    _, world = character.skeleton.compute_rest_pose()
    bone = character.mapping.bones[segment][0]
    above = world[character.skeleton.parents[bone]]
    rotations = character.skeleton.rest_rotations.copy()
    rotations[bone] = above.T @ Rotation.from_euler(axis, degrees, degrees=True).as_matrix() @ world[bone]
    return change_bones(character, rest_rotations=rotations)


def turn_both(character: Character, segment: str, axis: str, degrees: float) -> Character:
    """Turn both sides alike; about axes other than X in opposite directions, positive outwards for legs."""
    for side, sign in zip(SIDES, (1, -1), strict=True):
        character = turn(character, f"{side}_{segment}", axis, degrees if axis == "x" else sign * degrees)
    return character


def face(character: Character, degrees: float) -> Character:
    """Return the character facing another direction."""
    turned = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    positions, rotations = character.skeleton.offsets.copy(), character.skeleton.rest_rotations.copy()
    for bone in np.flatnonzero(character.skeleton.parents < 0):
        positions[bone], rotations[bone] = turned @ positions[bone], turned @ rotations[bone]
    return change_bones(character, offsets=positions, rest_rotations=rotations)


def swap_sides(character: Character, *segments: str) -> Character:
    """Return the character with the bones of both sides exchanged in its mapping."""
    bones = dict(character.mapping.bones)
    for segment in segments:
        left, right = f"left_{segment}", f"right_{segment}"
        bones[left], bones[right] = bones[right], bones[left]
    return replace(character, mapping=replace(character.mapping, bones=bones))


def as_file(character: Character, kind: str) -> Character:
    return replace(character, source=CharacterSource("a file", b"", np.zeros(0, int), kind))


@pytest.mark.parametrize("name", CHARACTER_PRESETS)
def test_presets_face_the_front_in_a_standard_pose(name):
    preset = load_character_preset(name)
    check_sides(preset, name)
    assert is_standard(preset)
    for segments in (("thigh", "shin", "foot", "toe", "clavicle", "upper_arm", "forearm", "hand"),):
        swapped = swap_sides(preset, *segments)
        with pytest.raises(SceneError, match=f"^{name}: the toes .* point backwards, so the bones of left and right are swapped"):
            check_sides(swapped, name)
    with pytest.raises(SceneError, match=r"are on different sides of the body; exchange"):
        check_sides(swap_sides(preset, "thigh", "shin", "foot", "toe"), name)


@given(heel=st.floats(-30, 55), toes_out=st.floats(-45, 60), facing=st.floats(-180, 180))
def test_feet_in_any_shoes_are_not_swapped(heel, toes_out, facing):
    character = turn_both(turn_both(load_character_preset("mixamo"), "foot", "x", heel), "foot", "y", toes_out)
    check_sides(face(character, facing), "a figure")


def test_figures_without_toes_are_no_evidence():
    preset = load_character_preset("mixamo")
    bones = {segment: chain for segment, chain in preset.mapping.bones.items() if not segment.endswith("toe")}
    segments = ("thigh", "shin", "foot", "clavicle", "upper_arm", "forearm", "hand")
    check_sides(swap_sides(replace(preset, mapping=replace(preset.mapping, bones=bones)), *segments), "a figure")


def is_standard(character: Character) -> bool:
    """Return whether the rest pose is a T- or A-pose."""
    angles = measure_poses(character.skeleton.rest_positions[None], character.mapping.bones)
    return bool(angles.tilt[0] <= MAX_TILT_DEG and angles.asymmetry[0] <= MAX_ASYMMETRY_DEG)


@pytest.mark.parametrize(
    ("segment", "axis", "degrees", "tilt", "asymmetry"),
    [
        ("left_thigh", "x", -55, 56, 55),
        ("right_shin", "x", 80, 85, 80),
        ("left_upper_arm", "z", -45, 5, 45),
        ("right_forearm", "y", 60, 5, 60),
    ],
)
@pytest.mark.parametrize("facing", [0, 130])
def test_a_posed_limb_is_measured(segment, axis, degrees, tilt, asymmetry, facing):
    character = face(turn(load_character_preset("mixamo"), segment, axis, degrees), facing)
    angles = measure_poses(character.skeleton.rest_positions[None], character.mapping.bones)
    assert (float(angles.tilt[0]), float(angles.asymmetry[0])) == pytest.approx((tilt, asymmetry), abs=4)


def test_other_standard_poses_are_not_posed():
    preset = load_character_preset("mixamo")
    for segment, axis, degrees in (("upper_arm", "z", -75), ("thigh", "z", 20), ("upper_arm", "x", 40), ("thigh", "x", -10)):
        assert is_standard(turn_both(preset, segment, axis, degrees)), (segment, axis)


@pytest.mark.parametrize("facing", [0, -70])
def test_feet_of_recorded_skeletons_go_with_their_spread_shins(facing):
    assert not are_soles_flat(face(as_file(SOLVED, "bvh"), facing))
    assert not are_soles_flat(as_file(SOLVED, "gltf"))  # the file that is written of the solved skeleton
    upright = turn_both(SOLVED, "thigh", "z", -20)
    assert are_soles_flat(as_file(upright, "bvh"))


@pytest.mark.parametrize("kind", ["gltf", "bvh"])
@pytest.mark.parametrize("spread", [13, 20])
def test_feet_that_stand_flat_below_spread_legs_stay_flat(kind, spread):
    preset = as_file(load_character_preset("mixamo"), kind)
    standing = turn_both(turn_both(preset, "thigh", "z", spread), "foot", "z", -spread)
    assert are_soles_flat(standing)
    assert are_soles_flat(turn_both(standing, "foot", "y", 15))
    assert are_soles_flat(turn_both(preset, "thigh", "z", spread)) is (kind == "gltf")
    assert are_soles_flat(turn(preset, "left_thigh", "z", spread))


def pose_glb(document: dict[str, Any]) -> None:
    """Bend the nodes of the figure's limbs, as in a file that was exported in a frame of an animation."""
    for name, axis, degrees in (("LeftUpLeg", "x", 70), ("RightLeg", "z", -60), ("LeftFoot", "x", 90), ("RightForeArm", "y", 80)):
        node = document["nodes"][node_of(FIGURE.names.index(name))]
        turn_node = Rotation.from_euler(axis, degrees, degrees=True)
        node["rotation"] = (Rotation.from_quat(node["rotation"]) * turn_node).as_quat().tolist()
    document["nodes"][node_of(0)]["translation"][1] += 20.0


def measure_rest_error_deg(character: Character, axes: np.ndarray = FIGURE.axes) -> float:
    """Return the largest angle of the figure's bones from those of its T-pose."""
    _, rotations = character.skeleton.compute_rest_pose()
    found = np.array([rotations[character.skeleton.find_joint(f"{PREFIX}{name}")] for name in FIGURE.names])
    return float(np.rad2deg(Rotation.from_matrix(axes.swapaxes(1, 2) @ found).magnitude().max()))


def test_a_posed_export_has_the_rest_pose_of_its_bind_matrices(tmp_path):
    (tmp_path / "posed.glb").write_bytes(edit_glb(build_mixamo_glb(), pose_glb))
    character = load_character(tmp_path / "posed.glb")
    assert measure_rest_error_deg(character) < 1e-3
    positions, _ = character.skeleton.compute_rest_pose()
    hips = character.skeleton.find_joint(f"{PREFIX}Hips")
    np.testing.assert_allclose(positions[hips], FIGURE.heads[0], atol=1e-6)
    assert character.mapping.reason.endswith("Its rest pose is the bind pose of its mesh.")

    motion = build_motion(character)
    write_character_glb(tmp_path / "out.glb", character, motion, "take")
    content = parse_glb(tmp_path / "out.glb", (tmp_path / "out.glb").read_bytes())
    source = parse_glb(tmp_path / "posed.glb", (tmp_path / "posed.glb").read_bytes())
    assert content.document["nodes"] == source.document["nodes"]
    nodes = read_gltf_nodes(tmp_path / "out.glb", content.document)
    times = np.arange(motion.frame_count) / motion.rate
    shown = compute_node_matrices(content, nodes, content.document["animations"][0], times.tolist())
    expected, _ = compute_character_poses(character, motion)
    np.testing.assert_allclose(shown[:, list_nodes(character)][..., :3, 3], expected, atol=1e-5)


def test_nodes_without_a_bind_pose_need_a_frame_that_stands(tmp_path):
    def remove_bind_pose(document: dict[str, Any]) -> None:
        pose_glb(document)
        del document["skins"][0]["inverseBindMatrices"], document["nodes"][-1]["mesh"], document["animations"]

    (tmp_path / "posed.glb").write_bytes(edit_glb(build_mixamo_glb(), remove_bind_pose))
    with pytest.raises(SceneError, match=r"posed\.glb: its trunk or a leg is \d\d degrees from the vertical"):
        load_character(tmp_path / "posed.glb")
    with pytest.raises(SceneError, match=r"posed\.glb: has no frames, so frame 1 cannot be its rest pose \(--rest-frame\)"):
        load_character(tmp_path / "posed.glb", rest_frame=1)

    stored = parse_glb(tmp_path / "posed.glb", (tmp_path / "posed.glb").read_bytes())
    upright = load_character_from(tmp_path, build_mixamo_glb())
    rotations = np.tile(upright.skeleton.rest_rotations, (3, 1, 1, 1))
    rotations[[0, 2]] = rotations[[0, 2]] @ smooth_rotations(0, 2, len(upright.skeleton.names), swing=1.0)
    buffer, nodes = GltfBuffer(stored.document, stored.binary), dict(enumerate(list_nodes(upright)))
    hips = nodes[upright.mapping.bones["pelvis"][0]]
    add_animation(buffer, "poses", rotations, {hips: np.tile([0.0, 100.0, 0.0], (3, 1))}, nodes, 30.0)
    (tmp_path / "posed.glb").write_bytes(build_glb(replace(stored, binary=buffer.finish())))
    for frame in (None, 2):
        assert measure_rest_error_deg(load_character(tmp_path / "posed.glb", rest_frame=frame)) < 1e-3
    assert measure_rest_error_deg(load_character(tmp_path / "posed.glb", rest_frame=1)) > 20
    with pytest.raises(SceneError, match="has frames 1 to 3, so frame 4 cannot"):
        load_character(tmp_path / "posed.glb", rest_frame=4)


def list_nodes(character: Character) -> list[int]:
    assert character.source is not None
    return character.source.nodes.tolist()


def load_character_from(folder: Path, data: bytes) -> Character:
    (folder / "figure.glb").write_bytes(data)
    return load_character(folder / "figure.glb")


def write_bvh_along_bones(target: Path, frames: np.ndarray) -> tuple[Skeleton, np.ndarray]:
    """Write the solved skeleton with offsets along X of its bones, in rotations of it; return it and the axes of the bones."""
    skeleton = load_cmu31_skeleton()
    axes = np.tile(np.eye(3), (len(skeleton.names), 1, 1))
    for joint in range(len(skeleton.names)):
        children = np.flatnonzero(skeleton.parents == joint)
        if len(children) and np.linalg.norm(skeleton.offsets[children[0]]):
            axes[joint] = compute_shortest_rotation(np.array([1.0, 0.0, 0.0]), skeleton.offsets[children[0]])
    above = np.where((skeleton.parents < 0)[:, None, None], np.eye(3), axes[skeleton.parents])
    offsets, ends = (np.einsum("jba,jb->ja", *each) for each in ((above, skeleton.offsets), (axes, skeleton.ends)))
    along = replace(skeleton, offsets=offsets, ends=ends)
    local = above.swapaxes(1, 2) @ frames @ axes
    write_bvh(target, along, motion_of(local, np.tile([0.5, 0.9, 3.0], (len(frames), 1))), 30.0)
    return skeleton, axes


def test_a_bvh_with_offsets_along_the_bones_stands_as_in_its_t_pose(tmp_path):
    count = len(load_cmu31_skeleton().names)
    frames = np.concatenate([np.tile(np.eye(3), (1, count, 1, 1)), smooth_rotations(0, 8, count, swing=0.6)])
    skeleton, _ = write_bvh_along_bones(tmp_path / "along.bvh", frames)
    character = load_character(tmp_path / "along.bvh")
    assert character.mapping.reason.endswith("Its rest pose is frame 1 of its file.")
    positions, expected = character.skeleton.rest_positions, skeleton.rest_positions
    names = [name for name in skeleton.names if name in character.skeleton.names]
    found = positions[[character.skeleton.find_joint(name) for name in names]]
    wanted = expected[[skeleton.find_joint(name) for name in names]]
    np.testing.assert_allclose(found - found[0], wanted - wanted[0], atol=1e-4)


def test_where_the_figure_only_walks_trunk_and_feet_are_straightened(tmp_path):
    """The trunk leans to either side; the left foot is flat where its ankle is lowest, the right one always on its toes."""
    names, count = load_cmu31_skeleton().names, 40
    frames, phase = np.tile(np.eye(3), (count, len(names), 1, 1)), np.linspace(0, 4 * np.pi, count, endpoint=False)
    swing, pitch = 25 + 5 * (1 + np.cos(phase)), 20 * (1 + np.cos(phase))
    turns = {
        "LowerBack": ("z", 15 * np.sin(phase)), "LeftUpLeg": ("x", swing), "LeftFoot": ("x", pitch - swing),
        "RightUpLeg": ("x", 0 * phase - 20), "RightFoot": ("x", 0 * phase + 35),
        "LeftArm": ("z", 0 * phase - 80), "RightArm": ("z", 0 * phase + 80),
    }  # fmt: skip
    for name, (axis, degrees) in turns.items():
        frames[:, names.index(name)] = Rotation.from_euler(axis, degrees[:, None], degrees=True).as_matrix()
    axes = write_bvh_along_bones(tmp_path / "walk.bvh", frames)[1]
    character = load_character(tmp_path / "walk.bvh")
    assert re.search(r"Its rest pose is frame \d+ of its file\.$", character.mapping.reason)
    _, rotations = character.skeleton.compute_rest_pose()
    for name in ("LowerBack", "LeftFoot", "RightFoot"):
        upward = rotations[character.skeleton.find_joint(name)] @ axes[names.index(name), 1]
        assert np.linalg.norm(upward - [0, 1, 0]) < np.deg2rad(2), name


@pytest.mark.parametrize(("pitch_deg", "roll_deg", "height_m"), [(0, 0, -0.02), (25, 0, -0.035), (-10, 0, -0.06), (0, 15, -0.1)])
def test_the_rest_pose_stands_on_the_soles_of_the_mesh(tmp_path, pitch_deg, roll_deg, height_m):
    """Shoes are boxes that the feet carry; they are inclined, and lie below the floor, as those of high boots may."""
    content = parse_glb(tmp_path, build_mixamo_glb())
    buffer, document = GltfBuffer(content.document, content.binary), content.document
    box = np.stack(np.meshgrid([-0.05, 0.05], [-0.09, 0.0], [-0.07, 0.2], indexing="ij"), axis=-1).reshape(-1, 3)
    soles: list[np.ndarray] = []
    for side, sign in (("Left", 1), ("Right", -1)):
        foot = FIGURE.names.index(f"{side}Foot")
        inclined = Rotation.from_euler("xz", [pitch_deg, sign * roll_deg], degrees=True).as_matrix()
        soles.append((FIGURE.axes[foot].T @ inclined @ box[box[:, 1] < 0].T).T)
        lift = np.array([0.0, height_m - FIGURE.heads[foot, 1] - (box @ inclined.T)[:, 1].min(), 0.0])
        vertices = (box @ inclined.T + lift) @ FIGURE.axes[foot] / 0.01
        soles[-1] += lift @ FIGURE.axes[foot]
        document["meshes"].append(
            {"primitives": [{"attributes": {"POSITION": buffer.add_array(vertices, "VEC3")}, "indices": add_triangle(buffer)}]}
        )
        document["nodes"][node_of(foot)]["children"].append(len(document["nodes"]))
        document["nodes"].append({"mesh": len(document["meshes"]) - 1})
    character = load_character_from(tmp_path, build_glb(replace(content, binary=buffer.finish())))
    positions, rotations = character.skeleton.compute_rest_pose()
    for side, sole in zip(SIDES, soles, strict=True):
        bone = character.mapping.bones[f"{side}_foot"][0]
        heights = (positions[bone] + sole @ rotations[bone].T)[:, 1]
        np.testing.assert_allclose(heights, 0.0, atol=5e-4)
    assert character.has_feet_flat


def add_triangle(buffer: GltfBuffer) -> int:
    return buffer.add_array(np.array([[0], [1], [2]]), "SCALAR")
