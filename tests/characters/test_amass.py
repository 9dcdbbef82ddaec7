"""Files as of AMASS: what a reader of SMPL-X's parameters places, by the published tree and axes, is the solved body."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.characters.alignment import pose_skeleton
from mocapfix.characters.amass import pose_smpl, write_amass
from mocapfix.characters.character import build_cmu31_character, convert_motion
from mocapfix.characters.character_files import convert_hand_motion, measure_animation_hands, write_character_bvh
from mocapfix.characters.load_character import load_character
from mocapfix.characters.retarget_motion import retarget_motion
from mocapfix.hands.hand_model import HAND_JOINTS
from mocapfix.io.bvh import read_bvh
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.options import ReadOptions
from mocapfix.solve.kinematics import compute_world_poses
from mocapfix.synthetic import compose_take
from tests.hands.test_attach_hands import RATE_HZ, compose_hands_on_body

SKELETON = load_cmu31_body().skeleton
ALL_JOINTS = np.ones(len(SKELETON.names), bool)
BODY_PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
LEFT_FINGER_PARENTS = tuple(20 if joint % 3 == 1 else joint - 1 for joint in range(25, 40))
RIGHT_FINGER_PARENTS = tuple(21 if joint % 3 == 1 else joint - 1 for joint in range(40, 55))
PARENTS = (*BODY_PARENTS, 15, 15, 15, *LEFT_FINGER_PARENTS, *RIGHT_FINGER_PARENTS)
"""of SMPL-X's joints, as its package `smplx` publishes them"""
JOINTS = (
    "Hips", "LeftUpLeg", "RightUpLeg", "LowerBack", "LeftLeg", "RightLeg", "Spine", "LeftFoot", "RightFoot", "Spine1",
    "LeftToeBase", "RightToeBase", "Neck", "LeftShoulder", "RightShoulder", "Head", "LeftArm", "RightArm",
    "LeftForeArm", "RightForeArm", "LeftFingerBase", "RightFingerBase",
)  # fmt: skip
"""the solved joints of the 22 of the body"""
LIMBS = [(1, 4), (2, 5), (4, 7), (5, 8), (7, 10), (8, 11), (16, 18), (17, 19), (18, 20), (19, 21)]
TRUNK = [(0, 1), (0, 2), (3, 6), (6, 9), (9, 12), (9, 13), (9, 14), (12, 15), (13, 16), (14, 17)]
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # from axes with Z up
LEFT_ELBOW, LEFT_WRIST = 18, 20


def write_and_read(path, skeleton, motion, rate, is_solved=ALL_JOINTS, *hands):
    write_amass(path / "a.npz", pose_smpl(skeleton, motion, rate, is_solved, *hands), rate)
    with np.load(path / "a.npz", allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def place_joints(found):
    """Return the joints (T, 55, 3) with Y up and their rotations, as a reader does with the proportions of the file."""
    local = Rotation.from_rotvec(found["poses"].reshape(-1, 3)).as_matrix().reshape(-1, 55, 3, 3)
    position, rotation = np.zeros(local.shape[:3]), local.copy()
    position[:, 0] = found["mean_pelvis"] + found["trans"]
    for joint, parent in list(enumerate(PARENTS))[1:]:
        rotation[:, joint] = rotation[:, parent] @ local[:, joint]
        position[:, joint] = position[:, parent] + rotation[:, parent] @ found["joint_offsets"][joint]
    return position @ Y_UP.T, Y_UP @ rotation


def measure_angles_deg(one, other, pairs):
    """Return the angles between the directions of bones."""
    directions = [each[:, [b for _, b in pairs]] - each[:, [a for a, _ in pairs]] for each in (one, other)]
    one, other = (each / np.linalg.norm(each, axis=-1, keepdims=True) for each in directions)
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(one, other), axis=-1), (one * other).sum(-1)))


def hold_pose(turns=(), count=2):
    """Return a motion that stands in the T-pose with some joints turned about axes of the world."""
    skeleton = pose_skeleton(SKELETON, "t-pose")
    _, world = skeleton.compute_rest_pose()
    local = np.tile(skeleton.rest_rotations, (count, 1, 1, 1))
    for name, vector in turns:
        joint = skeleton.find_joint(name)
        above = world[skeleton.parents[joint]] if joint else np.eye(3)
        local[:, joint] = above.T @ Rotation.from_rotvec(vector).as_matrix() @ above @ local[0, joint]
    none = np.zeros(count, int)
    return Motion(np.tile([0.1, 0.95, 0.2], (count, 1)), local, none, none, np.zeros((count, 0)), np.zeros((count, 0)))


def test_a_t_pose_has_no_rotations_and_faces_backwards_along_y(tmp_path):
    found = write_and_read(tmp_path, SKELETON, hold_pose(), 120.0)
    np.testing.assert_allclose(found["root_orient"], np.tile([np.pi / 2, 0, 0], (2, 1)), atol=1e-9)
    assert np.degrees(np.abs(found["poses"][:, 3:])).max() < 0.02
    position, rotation = place_joints(found)
    np.testing.assert_allclose(Y_UP.T @ rotation[0, 0] @ [0, 0, 1], [0, -1, 0], atol=1e-9)
    np.testing.assert_allclose(found["trans"][0] + found["mean_pelvis"], [0.1, -0.2, 0.95])
    np.testing.assert_allclose(position[0, 0], [0.1, 0.95, 0.2])


@pytest.mark.parametrize(
    ("joint", "vector", "number"),
    [
        ("LeftArm", [0, 0, np.pi / 2], 16),  # raised overhead
        ("RightArm", [0, 0, -np.pi / 3], 17),
        ("LeftForeArm", [0, -np.pi / 2, 0], 18),  # bent forwards
        ("RightLeg", [np.pi / 4, 0, 0], 5),  # the foot goes back
        ("LeftUpLeg", [-np.pi / 4, 0, 0], 1),  # the knee goes forwards
        ("Head", [0, np.pi / 6, 0], 15),  # looks to the left
    ],
)
def test_a_turned_joint_has_the_axis_and_the_sign_of_smpl(tmp_path, joint, vector, number):
    poses = write_and_read(tmp_path, SKELETON, hold_pose([(joint, vector)]), 120.0)["poses"].reshape(-1, 55, 3)
    np.testing.assert_allclose(poses[0, number], vector, atol=1e-3)
    others = [k for k in range(1, 55) if k not in (number, 12)]  # the neck points at the head
    assert np.degrees(np.abs(poses[0, others])).max() < 0.02


def test_joints_of_a_reader_are_the_solved_ones(tmp_path):
    take = compose_take(seed=2, seconds=4.0, rate=60.0)
    skeleton = take.subject.skeleton
    found = write_and_read(tmp_path, skeleton, take.motion, 60.0)
    assert tuple(found["joint_parents"]) == PARENTS
    assert not found["joint_offsets"][0].any()
    assert list(found["joint_names"][[0, 1, 16, 22, 25, 31, 34, 37, 54]]) == [
        "pelvis", "left_hip", "left_shoulder", "jaw", "left_index1", "left_pinky1", "left_ring1", "left_thumb1", "right_thumb3",
    ]  # fmt: skip
    read = place_joints(found)[0][:, :22]
    solved = compute_world_poses(skeleton, take.motion)[0][:, [skeleton.find_joint(name) for name in JOINTS]]
    assert measure_angles_deg(read, solved, LIMBS).max() < 1e-3
    assert measure_angles_deg(read, solved, TRUNK).max() < 1e-3
    distance = np.linalg.norm(read - solved, axis=-1)
    assert distance[:, :15].max() < 1e-6
    assert distance.max() < 0.02  # forearm and neck have fewer joints, and one length


def test_keys_are_those_of_both_releases(tmp_path):
    found = write_and_read(tmp_path, SKELETON, hold_pose(count=3), 100.0)
    shapes = {"root_orient": 3, "pose_body": 63, "pose_jaw": 3, "pose_eye": 6, "pose_hand": 90}
    assert {name: found[name].shape for name in shapes} == {name: (3, count) for name, count in shapes.items()}
    np.testing.assert_array_equal(np.concatenate([found[name] for name in shapes], axis=1), found["poses"])
    assert found["mocap_frame_rate"].item() == found["mocap_framerate"].item() == 100
    assert (str(found["gender"]), str(found["surface_model_type"]), int(found["num_betas"])) == ("neutral", "smplx", 16)
    assert (found["betas"] == 0).all()
    assert found["betas"].shape == (16,)
    assert found["trans"].shape == (3, 3)


@pytest.mark.parametrize("step", [1, 2])
def test_fingers_are_where_they_were_solved_in_the_order_of_smpl(tmp_path, step):
    skeleton, motion, hands = compose_hands_on_body()
    frames = np.arange(0, motion.frame_count, step)
    poses = {hand.hand.model.side.lower(): convert_hand_motion(hand, RATE_HZ, RATE_HZ / step) for hand in hands}
    found = write_and_read(tmp_path, skeleton, motion.select_frames(frames), RATE_HZ / step, ALL_JOINTS, poses)
    position, rotation = place_joints(found)
    order = np.concatenate([3 * ray + np.arange(3) for ray in (1, 2, 4, 3, 0)])  # of thumb, index, middle, ring, pinky
    for hand, first, wrist in zip(hands, (25, 40), (20, 21), strict=True):
        np.testing.assert_allclose(rotation[:, wrist], hand.palm_rotation[frames], atol=1e-9)
        solved = hand.point_positions[frames][:, : len(HAND_JOINTS)]
        from_palm = solved - hand.palm_position[frames, None]
        shift = position[:, first : first + 15] - position[:, [wrist]] - from_palm[:, order]
        palm = found["joint_offsets"][first] - hand.hand.model.ray_offsets[3]
        assert np.isfinite(palm).all()
        np.testing.assert_allclose(shift @ rotation[:, wrist], np.broadcast_to(palm, shift.shape), atol=1e-9)


def test_fingers_of_a_bvh_are_those_of_the_solved_hands(tmp_path):
    skeleton, motion, hands = compose_hands_on_body()
    character = load_character("mixamo")
    poses = {hand.hand.model.side.lower(): convert_hand_motion(hand, RATE_HZ, RATE_HZ) for hand in hands}
    moved = retarget_motion(build_cmu31_character(skeleton), convert_motion(motion, RATE_HZ), character, hands=poses)
    write_character_bvh(tmp_path / "hero.bvh", character, moved)
    found_hands, notes = measure_animation_hands(
        read_bvh(tmp_path / "hero.bvh", options=ReadOptions(unit="cm", up_axis="Y")), RATE_HZ
    )
    assert notes == []
    found = write_and_read(tmp_path, skeleton, motion, RATE_HZ, ALL_JOINTS, found_hands)
    position, rotation = place_joints(found)
    names = list(found["joint_names"])
    for side in ("left", "right"):
        for finger in ("thumb", "index", "pinky"):
            joints = [names.index(f"{side}_{finger}{number}") for number in (1, 2, 3)]
            bones = list(character.mapping.fingers[f"{side}_{finger}"])
            relative = rotation[:, [names.index(f"{side}_wrist")]].swapaxes(-1, -2) @ rotation[:, joints]
            np.testing.assert_allclose(relative, poses[side].fingers[finger], atol=0.02)
            lengths = np.linalg.norm(np.diff(position[:, joints], axis=1), axis=2)
            own = np.linalg.norm(np.diff(character.skeleton.rest_positions[bones], axis=0), axis=1)
            np.testing.assert_allclose(lengths, np.broadcast_to(own, lengths.shape), atol=1e-6)
    assert found["joint_solved"][25:].all()


def test_joints_without_markers_are_named(tmp_path):
    is_solved = ALL_JOINTS.copy()
    is_solved[[SKELETON.find_joint(name) for name in ("LeftForeArm", "LeftFingerBase")]] = False
    found = write_and_read(tmp_path, SKELETON, hold_pose(), 120.0, is_solved)
    assert found["joint_solved"][:22].tolist() == [joint not in (LEFT_ELBOW, LEFT_WRIST) for joint in range(22)]
    assert not found["joint_solved"][22:].any()
    assert np.isnan(found["joint_offsets"][22:]).all()
