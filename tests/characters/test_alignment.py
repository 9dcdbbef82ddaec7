"""Conversion of poses between an animation's joints and the 31-joint skeleton."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.characters.alignment import SkeletonAlignment, align_skeleton
from mocapfix.characters.bone_mapping import map_joints
from mocapfix.io import asf_amc, bvh
from mocapfix.model.animation import Animation
from mocapfix.model.skeleton import compose_transforms, load_cmu31_body
from tests.captures import CAPTURES

FILES = sorted(CAPTURES.glob("*/*.bvh")) + sorted(CAPTURES.glob("*/*.amc"))
MODEL = load_cmu31_body().skeleton
ROTATIONS = ("Zrotation", "Xrotation", "Yrotation")
POSITIONS = ("Xposition", "Yposition", "Zposition")

# By joint: parent and offset in cm. The figure has hanging arms and faces +X. It has one spine joint, a joint above the hips,
# and a roll joint in an arm.
FIGURE = {
    "Reference": (None, (0, 0, 0)),
    "Hips": ("Reference", (0, 95, 0)),
    "Chest": ("Hips", (0, 30, 0)),
    "Neck": ("Chest", (0, 25, 0)),
    "Head": ("Neck", (0, 10, 0)),
    "LeftCollar": ("Chest", (0, 20, -3)),
    "LeftShoulder": ("LeftCollar", (0, 0, -15)),
    "LeftElbow": ("LeftShoulder", (0, -28, 0)),
    "LeftRoll": ("LeftElbow", (0, -12, 0)),
    "LeftWrist": ("LeftRoll", (0, -12, 0)),
    "RightCollar": ("Chest", (0, 20, 3)),
    "RightShoulder": ("RightCollar", (0, 0, 15)),
    "RightElbow": ("RightShoulder", (0, -28, 0)),
    "RightWrist": ("RightElbow", (0, -24, 0)),
    "LeftHip": ("Hips", (0, 0, -10)),
    "LeftKnee": ("LeftHip", (0, -42, 0)),
    "LeftAnkle": ("LeftKnee", (0, -43, 0)),
    "RightHip": ("Hips", (0, 0, 10)),
    "RightKnee": ("RightHip", (0, -42, 0)),
    "RightAnkle": ("RightKnee", (0, -43, 0)),
}


def build_figure(seed: int, frame_count: int = 5, amplitude: float = 1.0) -> Animation:
    """Return the figure in random poses. Its roll joint does not rotate."""
    names = tuple(FIGURE)
    channels = tuple((*POSITIONS, *ROTATIONS) if name in ("Reference", "Hips") else ROTATIONS for name in names)
    channel_count = sum(len(each) for each in channels)
    values = np.random.default_rng(seed).uniform(-60, 60, (frame_count, channel_count)) * amplitude
    animation = Animation(
        names=names,
        parents=np.array([names.index(parent) if parent else -1 for parent, _ in FIGURE.values()]),
        offsets=np.array([offset for _, offset in FIGURE.values()], float),
        end_sites=tuple(np.array([[15.0, -8, 0]]) if "Ankle" in name else np.empty((0, 3)) for name in names),
        channels=channels,
        values=values,
        rate=120.0,
    )
    values[:, animation.get_rotation_channels(names.index("LeftRoll"))[0]] = 0.0
    return animation


def align(animation: Animation) -> SkeletonAlignment:
    mapping = map_joints(animation.names, animation.parents)
    assert mapping.file_joints is not None, mapping.reason
    alignment = align_skeleton(animation, mapping.file_joints)
    assert alignment is not None
    return alignment


def compute_model_positions(alignment: SkeletonAlignment, root_position: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Return the world positions (T, 31, 3) in metres of the joints of the aligned skeleton."""
    offsets = np.tile(alignment.skeleton.offsets, (len(root_position), 1, 1))
    offsets[:, 0] = root_position
    return compose_transforms(alignment.skeleton.parents, offsets, rotations)[0]


def find_descendants(joint: int, parents: np.ndarray, is_candidate: np.ndarray) -> list[int]:
    """Return a joint if it is a candidate, otherwise the nearest candidates below it."""
    if is_candidate[joint]:
        return [joint]
    return [each for child in np.flatnonzero(parents == joint) for each in find_descendants(int(child), parents, is_candidate)]


def apply_model_rotations(
    animation: Animation, alignment: SkeletonAlignment, joints: Iterable[int], frames: np.ndarray, rotations: np.ndarray
) -> Animation:
    """Return the animation with the counterparts of some model joints rotated as they are; rotations are (m, 31, 3, 3).

    For a joint without counterpart the nearest ones below it that have one are rotated.
    """
    is_known, parents = alignment.is_mapped, alignment.skeleton.parents
    file_rotations = animation.replace_values(animation.values[frames]).compute_local_rotations()
    affected = sorted({each for joint in joints for each in find_descendants(joint, parents, is_known)})
    computed = [alignment.convert_rotation_back(joint, rotations, animation.parents, file_rotations) for joint in affected]
    return animation.replace_rotations(alignment.source_joints[affected], frames, np.stack(computed, axis=1))


def check_round_trip(animation: Animation) -> None:
    """Check that mapped joints coincide with the file's, and that converted rotations give the file's again."""
    alignment = align(animation)
    root_position, rotations = alignment.convert_poses(*animation.compute_world_poses())
    is_known = alignment.source_joints >= 0
    expected, _ = animation.compute_world_poses()
    positions = compute_model_positions(alignment, root_position, rotations)
    np.testing.assert_allclose(positions[:, is_known], expected[:, alignment.source_joints[is_known]], atol=1e-6)
    again = apply_model_rotations(animation, alignment, range(31), np.arange(animation.frame_count), rotations)
    np.testing.assert_allclose(again.compute_local_rotations(), animation.compute_local_rotations(), atol=1e-8)


@given(st.integers(0, 10**6))
def test_random_poses_are_converted_and_back(seed: int):
    check_round_trip(build_figure(seed))


@pytest.mark.skipif(not FILES, reason="the real captures are not here")
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_captures_are_converted_and_back(path: Path):
    capture = bvh.read_bvh(path) if path.suffix == ".bvh" else asf_amc.read_amc(path)
    check_round_trip(capture.replace_values(capture.values[:: max(1, capture.frame_count // 50)]))


def test_rest_pose_is_converted_to_model_axes():
    resting = build_figure(0, frame_count=1, amplitude=0.0)
    alignment = align(resting)
    _, rotations = alignment.convert_poses(*resting.compute_world_poses())
    positions = compute_model_positions(alignment, np.zeros((1, 3)), np.tile(np.eye(3), (1, 31, 1, 1)))[0]
    position_by_name = dict(zip(MODEL.names, positions, strict=True))
    for elbow, (shoulder, direction) in {"LeftForeArm": ("LeftArm", 1), "RightForeArm": ("RightArm", -1)}.items():
        bone = position_by_name[elbow] - position_by_name[shoulder]
        np.testing.assert_allclose(bone / np.linalg.norm(bone), [direction, 0, 0], atol=1e-6)  # a T-pose that faces +Z
    np.testing.assert_allclose(rotations[0, 0] @ [0, 0, 1], [1, 0, 0], atol=1e-9)
    lowered = Rotation.from_euler("Z", -90, degrees=True).as_matrix()
    np.testing.assert_allclose(rotations[0, MODEL.find_joint("LeftArm")], lowered, atol=1e-6)
    np.testing.assert_allclose(rotations[0, MODEL.find_joint("LeftForeArm")], np.eye(3), atol=1e-6)
    assert np.linalg.norm(alignment.skeleton.offsets[MODEL.find_joint("LeftLeg")]) == pytest.approx(0.42)
    assert np.linalg.norm(alignment.skeleton.ends[MODEL.find_joint("LThumb")]) > 0


def test_trunk_rotation_is_shared_evenly():
    bent = build_figure(0, frame_count=1, amplitude=0.0)
    values = bent.values.copy()
    values[:, bent.get_rotation_channels(bent.names.index("Chest"))[0]] = [30, 0, 0]
    _, rotations = align(bent).convert_poses(*bent.replace_values(values).compute_world_poses())
    degrees = np.degrees(Rotation.from_matrix(rotations[0]).magnitude())
    shares = [degrees[MODEL.find_joint(name)] for name in ("LowerBack", "Spine", "Spine1")]
    np.testing.assert_allclose(shares, 10, atol=1e-9)


def test_absent_values_are_absent_after_conversion():
    complete = build_figure(4)
    values = complete.values.copy()
    values[2, complete.get_rotation_channels(complete.names.index("Chest"))[0][1]] = np.nan
    incomplete, alignment = complete.replace_values(values), align(complete)
    root_position, rotations = alignment.convert_poses(*incomplete.compute_world_poses())
    _, expected = alignment.convert_poses(*complete.compute_world_poses())
    assert np.isfinite(root_position).all()
    is_absent = np.asarray(np.isnan(rotations).any((2, 3)))
    assert set(np.argwhere(is_absent)[:, 0]) == {2}
    present = {MODEL.names[joint] for joint in np.flatnonzero(~is_absent[2])}
    assert "Spine1" not in present
    assert {"Hips", "LeftUpLeg", "RightFoot"} <= present
    np.testing.assert_array_equal(rotations[~is_absent], expected[~is_absent])


@pytest.mark.parametrize(
    ("joint", "file_joint"),
    [
        ("LeftArm", "LeftShoulder"),
        ("LeftHand", "LeftWrist"),
        ("Spine1", "Chest"),
        ("LowerBack", "Chest"),
        ("Hips", "Hips"),
        ("Head", "Head"),
    ],
)
def test_rotation_of_one_model_joint_changes_its_counterpart_only(joint: str, file_joint: str):
    before, rotation = build_figure(1), Rotation.from_euler("XYZ", [20, 30, -40], degrees=True).as_matrix()
    roll_column = before.get_rotation_channels(before.names.index("LeftRoll"))[0][0]
    before = before.replace_values(np.where(np.arange(before.values.shape[1]) == roll_column, 25.0, before.values))
    alignment = align(before)
    _, rotations = alignment.convert_poses(*before.compute_world_poses())
    rotations[:, MODEL.find_joint(joint)] = rotations[:, MODEL.find_joint(joint)] @ rotation
    frames = np.array([1, 3])
    after = apply_model_rotations(before, alignment, [MODEL.find_joint(joint)], frames, rotations[frames])
    is_changed = after.values != before.values
    assert {name for name, columns in zip(before.names, before.joint_columns, strict=True) if is_changed[:, columns].any()} == {
        file_joint
    }
    assert not is_changed[[0, 2, 4]].any()
    _, again = alignment.convert_poses(*after.compute_world_poses())
    chain = {"Chest": ("LowerBack", "Spine", "Spine1"), "Head": ("Neck1", "Head")}.get(file_joint, (joint,))
    expected, found = np.eye(3), np.eye(3)
    for name in chain:
        expected, found = expected @ rotations[1, MODEL.find_joint(name)], found @ again[1, MODEL.find_joint(name)]
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_figure_that_is_never_upright_is_not_aligned():
    lying = replace(build_figure(2, amplitude=0.0), rotation_y_up_file=np.eye(3)[[0, 2, 1]] * [[1], [1], [-1]])
    mapping = map_joints(lying.names, lying.parents)
    assert mapping.file_joints is not None
    assert align_skeleton(lying, mapping.file_joints) is None


def test_upright_frame_replaces_an_unusable_rest_pose():
    """The joints' axes are rotated at random, which changes the values and the rest pose but not the motion."""
    plain, rng = build_figure(3, amplitude=0.3), np.random.default_rng(3)
    values = plain.values.copy()
    for joint in range(len(plain.names)):
        values[0, plain.get_rotation_channels(joint)[0]] = 0.0
    plain = plain.replace_values(values)
    axes = Rotation.random(len(plain.names), rng=rng).as_matrix()
    parent_axes = np.concatenate([np.eye(3)[None], axes[plain.parents[1:]]])
    rotations = np.swapaxes(parent_axes, 1, 2) @ plain.compute_local_rotations() @ axes
    other = replace(
        plain,
        offsets=np.einsum("jba,jb->ja", parent_axes, plain.offsets),
        end_sites=tuple(ends @ own for ends, own in zip(plain.end_sites, axes, strict=True)),
    )
    hips, frames = np.array([other.names.index("Hips")]), np.arange(5)
    other = other.replace_rotations(np.arange(len(other.names)), frames, rotations)
    other = other.replace_positions(hips, frames, plain.compute_local_positions()[:, hips] @ parent_axes[hips])
    np.testing.assert_allclose(other.compute_world_poses()[0], plain.compute_world_poses()[0], atol=1e-9)
    expected, found = (align(each).convert_poses(*each.compute_world_poses()) for each in (plain, other))
    np.testing.assert_allclose(found[0], expected[0], atol=1e-9)
    np.testing.assert_allclose(found[1], expected[1], atol=1e-6)


def test_wrist_of_a_body_is_at_the_hand_of_a_file_without_cmus_finger_base():
    """The body that characters and contacts follow has its wrists at the joints FingerBase."""
    alignment = align(build_figure(3))
    body, skeleton = alignment.body, alignment.skeleton
    wrist, hand = (skeleton.find_joint(f"Left{joint}") for joint in ("FingerBase", "Hand"))
    assert alignment.is_mapped[hand]
    assert not alignment.is_mapped[wrist]
    np.testing.assert_array_equal(body.rest_positions[wrist], skeleton.rest_positions[hand])
    others = [not name.endswith("FingerBase") for name in skeleton.names]
    np.testing.assert_allclose(body.rest_positions[others], skeleton.rest_positions[others], atol=1e-12)
