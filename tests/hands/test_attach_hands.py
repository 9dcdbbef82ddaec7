"""Hands in BVH: every joint and tip at its solved place in the world, beside the body's own joints, which do not change."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix import pipeline
from mocapfix.characters.character_yaml import load_rig
from mocapfix.errors import WriteError
from mocapfix.hands.hand_model import HAND_JOINTS
from mocapfix.hands.solve_hands import ATTACHED_NAMES, attach_hands, solve_hand
from mocapfix.io.bvh import read_bvh, write_bvh, write_bvh_tree
from mocapfix.io.c3d import write_c3d
from mocapfix.io.gltf import write_gltf
from mocapfix.lab.hands import compose_hands
from mocapfix.model.windows import select_frames
from mocapfix.options import ReadOptions
from mocapfix.output_formats import write_rig_bvh
from mocapfix.solve.kinematics import compute_world_poses
from mocapfix.synthetic import compose_motion, draw_subject
from tests.hands.composed_hands import FRAMES, RATE_HZ, build_hand, carry_markers, compose_poses
from tests.io.test_gltf import read as read_glb


def compose_hands_on_body(sides=("Left", "Right")):
    """Return a body's motion and hands that move near it, not as its hand joints do."""
    subject = draw_subject(np.random.default_rng(5), False, "frontwaist53")
    motion, hands = compose_motion(subject, FRAMES / RATE_HZ, RATE_HZ), []
    for side in sides:
        hand = build_hand(side)
        palm, poses = compose_poses(hand)
        markers = carry_markers(hand, poses)
        hands.append(solve_hand(hand, markers, np.ones(markers.shape[:2], bool), palm, RATE_HZ))
    return subject.skeleton, motion, tuple(hands)


def read_back(path):
    return read_bvh(path, options=ReadOptions(unit="cm", up_axis="Y"))


def measure_distances(read, hand, frames):
    """Return how far the palm, joints and tips of a BVH are from where they were solved, in metres."""
    positions, rotations = read.compute_world_poses()
    palm = read.names.index(f"{hand.hand.model.side}Palm")
    joints = [palm + 1 + index for index in range(len(HAND_JOINTS))]
    assert read.names[read.parents[palm]] == f"{hand.hand.model.side}Hand"
    tips = [j for j in joints if len(read.end_sites[j])]
    ends = np.stack([read.end_sites[j][0] * read.unit_m for j in tips])
    places = positions[:, tips] + (rotations[:, tips] @ ends[..., None])[..., 0]
    found = np.concatenate([positions[:, [palm]], positions[:, joints], places], axis=1)
    solved = np.concatenate([hand.palm_position[:, None], hand.point_positions], axis=1)
    return np.linalg.norm(found - solved[frames], axis=-1)


@pytest.mark.parametrize("step", [1, 2])
def test_joints_and_tips_of_a_bvh_are_where_they_were_solved(tmp_path, step):
    skeleton, motion, hands = compose_hands_on_body()
    frames, rate = np.arange(0, motion.frame_count, step), RATE_HZ / step
    selected = motion.select_frames(frames)
    write_bvh_tree(tmp_path / "hands.bvh", *attach_hands(skeleton, selected, rate, hands, RATE_HZ), rate)
    read = read_back(tmp_path / "hands.bvh")
    assert len(set(read.names)) == len(read.names) == 31 + 2 * 16
    for hand in hands:
        assert measure_distances(read, hand, frames).max() < 1e-6
    body = [read.names.index(name) for name in skeleton.names]
    positions, _ = read.compute_world_poses()
    np.testing.assert_allclose(positions[:, body], compute_world_poses(skeleton, selected)[0], atol=1e-6)


def read_bvh_text(path):
    """Return the text of each joint's offset and channels, by joint."""
    hierarchy, _, motion = path.read_text(encoding="utf-8").partition("MOTION\n")
    joints = re.findall(r"(?:ROOT|JOINT) (\S+)\s*{\s*OFFSET (.*)\s*CHANNELS (\d)", hierarchy)
    rows = [line.split() for line in motion.splitlines()[2:]]
    ends = np.cumsum([int(count) for *_, count in joints]).tolist()
    return {
        name: (offset, [row[end - int(count) : end] for row in rows])
        for (name, offset, count), end in zip(joints, ends, strict=True)
    }


def test_a_cleaned_take_has_its_hands_in_the_bvh_and_the_same_body_as_without_finger_markers(tmp_path):
    take = select_frames(compose_hands(seed=1).take, slice(0, 300))
    write_c3d(tmp_path / "take.c3d", take)
    result = pipeline.clean(tmp_path / "take.c3d", floor_height_m=0.25)
    written = result.write(tmp_path / "out", options=result.requested.output)
    body = np.array([m for m, label in enumerate(take.labels) if label[1:4] not in ("THM", "IDX", "MID", "RNG", "PNK")])
    assert len(body) == 53
    write_c3d(tmp_path / "body.c3d", take.select(body, take.visible[:, body]))
    bare = pipeline.clean(tmp_path / "body.c3d", floor_height_m=0.25)
    without = read_bvh_text(bare.write(tmp_path / "bare", options=bare.requested.output)["bvh"])
    assert len(without) == 31
    assert without == {name: text for name, text in read_bvh_text(written["bvh"]).items() if name in without}
    assert result.output_take.markers[:, body].tobytes() == bare.output_take.markers.tobytes()
    read = read_back(written["bvh"])
    for hand in result.hands:
        assert measure_distances(read, hand.lower_floor(0.25), np.arange(300)).max() < 1e-6
    assert len(result.hands) == 2
    assert any("left hand" in note for note in result.subject_report["notes"])


def read_gltf_positions(path):
    """Return the positions of the nodes of a GLB in the frames of its animation, by name."""
    glb = read_glb(path)
    parents = {child: index for index, node in enumerate(glb.json["nodes"]) for child in node.get("children", [])}
    moved = {each["target"]["node"] for each in glb.json["animations"][0]["channels"] if each["target"]["path"] == "translation"}
    found: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for index, node in enumerate(glb.json["nodes"]):
        if "mesh" not in node:
            rotation = Rotation.from_quat(glb.read_channel(index, "rotation")).as_matrix()
            place = glb.read_channel(index, "translation") if index in moved else np.array(node["translation"])[None]
            above, axes = found.get(parents.get(index, -1), (np.zeros((1, 3)), np.eye(3)[None]))
            found[index] = above + (axes @ place[..., None])[..., 0], axes @ rotation
    return {glb.json["nodes"][index]["name"]: position for index, (position, _) in found.items()}


def test_the_joints_of_a_gltf_are_where_they_were_solved(tmp_path):
    skeleton, motion, hands = compose_hands_on_body()
    write_gltf(tmp_path / "hands.glb", *attach_hands(skeleton, motion, RATE_HZ, hands, RATE_HZ), RATE_HZ)
    positions = read_gltf_positions(tmp_path / "hands.glb")
    for hand in hands:
        side = hand.hand.model.side
        names = [f"{side}{name}" for name in ATTACHED_NAMES]
        solved = np.concatenate([hand.palm_position[:, None], hand.point_positions[:, : len(HAND_JOINTS)]], axis=1)
        np.testing.assert_allclose(np.stack([positions[name] for name in names], axis=1), solved, atol=1e-5)


@pytest.mark.parametrize(("name", "first"), [("blender", 0), ("motionbuilder", 1)])
def test_a_rigs_fingers_are_where_they_were_solved(tmp_path, name, first):
    skeleton, motion, hands = compose_hands_on_body()
    write_rig_bvh(tmp_path / "rig.bvh", load_rig(name), skeleton, motion, RATE_HZ, hands, RATE_HZ)
    read = read_bvh(tmp_path / "rig.bvh", options=ReadOptions(unit="m" if name == "blender" else "cm", up_axis="Y"))
    assert len(set(read.names)) == len(read.names)
    assert ("LeftHandMiddle3" in read.names) == (name == "motionbuilder")
    poses = read.replace_values(read.values[first:])
    for hand in hands:
        assert measure_distances(poses, hand, np.arange(motion.frame_count)).max() < 1e-5  # a unit may be a metre
    if first:
        _, rotations = read.replace_values(read.values[:1]).compute_world_poses()
        palm = read.names.index("LeftPalm")
        np.testing.assert_allclose(rotations[0, palm : palm + 16], np.tile(rotations[0, palm], (16, 1, 1)), atol=1e-9)


def test_a_rig_without_fingers_or_with_their_names_is_not_written_with_two_joints_of_one_name(tmp_path):
    skeleton, motion, hands = compose_hands_on_body(("Left",))
    for name in ("body", "hands"):
        write_rig_bvh(tmp_path / name, load_rig("3dsmax"), skeleton, motion, RATE_HZ, hands if name == "hands" else (), RATE_HZ)
    assert (tmp_path / "hands").read_bytes() == (tmp_path / "body").read_bytes()
    rig = load_rig("blender").model_copy(update={"fingers": "numbers"})
    with pytest.raises(WriteError, match="LeftHandIndex1 is a finger too"):
        write_rig_bvh(tmp_path / "rig.bvh", rig, skeleton, motion, RATE_HZ, hands, RATE_HZ)


def test_a_take_without_fingers_has_the_bvh_of_its_body(tmp_path):
    skeleton, motion, _ = compose_hands_on_body(())
    write_bvh(tmp_path / "body.bvh", skeleton, motion, RATE_HZ)
    write_bvh_tree(tmp_path / "hands.bvh", *attach_hands(skeleton, motion, RATE_HZ, (), RATE_HZ), RATE_HZ)
    assert (tmp_path / "hands.bvh").read_bytes() == (tmp_path / "body.bvh").read_bytes()


def test_a_bvh_with_hands_has_the_bodys_joints_unchanged_and_turns_without_jumps(tmp_path):
    skeleton, motion, hands = compose_hands_on_body(("Right",))
    write_bvh_tree(tmp_path / "hands.bvh", *attach_hands(skeleton, motion, RATE_HZ, hands, RATE_HZ), RATE_HZ)
    write_bvh(tmp_path / "body.bvh", skeleton, motion, RATE_HZ)
    read, body = read_back(tmp_path / "hands.bvh"), read_back(tmp_path / "body.bvh")
    kept = [name for name in read.names if name in skeleton.names]
    assert kept == list(body.names)
    is_kept = np.repeat([name in skeleton.names for name in read.names], [len(each) for each in read.channels])
    np.testing.assert_array_equal(read.values[:, is_kept], body.values)
    assert "LeftIndexProximal" not in read.names
    assert np.abs(np.diff(read.values[:, ~is_kept], axis=0)).max() < 90
