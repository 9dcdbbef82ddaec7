"""Shipped rigs, rig files, and the motion on a rig as written to a BVH."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.characters.alignment import place_hands_at_wrists, retarget_to_rig
from mocapfix.characters.character_yaml import Rig, load_rig
from mocapfix.errors import SceneError, WriteError
from mocapfix.io.bvh import read_bvh
from mocapfix.io.shipped import find_shipped_folder
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton, load_cmu31_body
from mocapfix.options import CHARACTER_PRESETS, RIG_NAMES
from mocapfix.output_formats import write_rig_bvh
from mocapfix.solve import kinematics
from tests.io.read_back import SKELETON, Bvh, motion_of, smooth_rotations

IS_FREE = load_cmu31_body().free_joints
FORWARD, UP, LEFT = np.array([0, 0, 1.0]), np.array([0, 1.0, 0]), np.array([1.0, 0, 0])

# Names of HumanIK that MotionBuilder maps automatically.
HUMAN_IK_NAMES = {"Hips", "Spine", "Spine1", "Spine2", "Neck", "Neck1", "Head"} | {
    f"{side}{name}"
    for side in ("Left", "Right")
    for name in ("UpLeg", "Leg", "Foot", "ToeBase", "Shoulder", "Arm", "ForeArm", "Hand")
}
# Parents of the joints in Character Studio's BVH specification.
BIPED_PARENTS = {"Hips": None, "Chest": "Hips", "Chest2": "Chest", "Chest3": "Chest2", "Neck": "Chest3", "Head": "Neck"}
for side in ("Left", "Right"):
    BIPED_PARENTS |= {f"{side}Hip": "Hips", f"{side}Knee": f"{side}Hip", f"{side}Ankle": f"{side}Knee"}
    BIPED_PARENTS |= {f"{side}Toe": f"{side}Ankle", f"{side}Collar": "Chest3", f"{side}Shoulder": f"{side}Collar"}
    BIPED_PARENTS |= {f"{side}Elbow": f"{side}Shoulder", f"{side}Wrist": f"{side}Elbow"}


def test_shipped_rig_files_are_the_rig_names():
    names = {path.stem for path in (find_shipped_folder("scenes") / "rigs").glob("*.yaml")}
    assert names == {*RIG_NAMES, *CHARACTER_PRESETS, "poses"}


@pytest.mark.parametrize("name", RIG_NAMES)
def test_shipped_rig_refers_to_joints_of_the_skeleton(name: str):
    known = set(load_cmu31_body().skeleton.names)
    assert all({joint.joint, joint.axes, joint.end} <= known for joint in load_rig(name).joints)


def test_motionbuilder_rig_has_names_that_are_mapped_automatically():
    rig = load_rig("motionbuilder")
    assert {joint.name for joint in rig.joints} == HUMAN_IK_NAMES
    assert (rig.rest, rig.first_frame) == ("t-pose", "t-pose")


def test_biped_rig_follows_its_specification():
    rig = load_rig("3dsmax")
    assert {joint.name: joint.parent for joint in rig.joints} == BIPED_PARENTS
    assert (rig.rest, rig.first_frame) == ("arms-down", "motion")


def test_cmu_rig_has_all_joints_of_the_skeleton_in_order():
    assert tuple(joint.name for joint in load_rig("cmu").joints) == load_cmu31_body().skeleton.names
    assert load_rig("cmu").unit_m == pytest.approx(0.0254 / 0.45)


def test_blender_rig_has_mirrored_names():
    names = {joint.name for joint in load_rig("blender").joints}
    lateral = {name for name in names if name.startswith(("Left", "Right"))}
    assert {name.replace("Left", "?").replace("Right", "Left").replace("?", "Right") for name in lateral} == lateral
    assert names - lateral == {"Hips", "LowerBack", "Spine", "Spine1", "Neck", "Neck1", "Head"}


def test_unknown_rig_is_refused_with_the_shipped_names():
    message = r"no rig 'maya'; choose one of 3dsmax, blender, cmu, motionbuilder, or give a \.yaml"
    with pytest.raises(SceneError, match=message):
        load_rig("maya")
    with pytest.raises(SceneError, match="no rig 'poses'"):
        load_rig("poses")


RIG_TEXT = """
program: Mine
unit_m: 0.0254
rotations: XYZ
rest: skeleton
first_frame: motion
note: nothing
joints:
  - {name: Pelvis, parent: null, joint: Hips}
  - {name: Trunk, parent: Pelvis, joint: LowerBack, end: Head}
"""


@pytest.mark.parametrize(
    ("valid", "invalid", "message"),
    [
        ("parent: Pelvis", "parent: Hips", "Trunk: must be listed once, after its parent"),
        ("name: Trunk", "name: Pelvis", "Pelvis: must be listed once"),
        ("parent: Pelvis", "parent: null", "Trunk: must be listed once, after its parent; only the first joint is a root"),
        ("name: Trunk", "name: my trunk", r"joints\.1\.name"),
        ("rotations: XYZ", "rotations: XYX", "rotations"),
        ("unit_m: 0.0254", "unit_m: 0", "unit_m"),
        ("program: Mine", "programme: Mine", "program"),
    ],
)
def test_rig_file_is_read_and_its_errors_are_named(tmp_path: Path, valid: str, invalid: str, message: str):
    path = tmp_path / "mine.yaml"
    path.write_text(RIG_TEXT, encoding="utf-8")
    rig = load_rig(path)
    assert (rig.name, rig.unit_m, rig.parents) == ("mine", 0.0254, [-1, 0])
    assert (rig.joints[1].joint, rig.joints[1].axes, rig.joints[1].end) == ("LowerBack", "LowerBack", "Head")
    path.write_text(RIG_TEXT.replace(valid, invalid), encoding="utf-8")
    with pytest.raises(SceneError, match=rf"mine\.yaml.*{message}"):
        load_rig(path)


class WrittenRig(NamedTuple):
    """A rig and the BVH that was written for it."""

    rig: Rig
    bvh: Bvh


def write_for_rig(folder: Path, name: str, skeleton: Skeleton, motion: Motion) -> WrittenRig:
    rig = load_rig(name)
    write_rig_bvh(folder / "walk.bvh", rig, skeleton, motion, 120.0)
    return WrittenRig(rig, Bvh((folder / "walk.bvh").read_text(encoding="utf-8")))


def build_motion(seed: int = 0, frame_count: int = 40) -> Motion:
    """Return a random motion in which hip stubs, toes, fingers and thumbs keep their rest pose."""
    rotations = smooth_rotations(seed, frame_count, 31, swing=2.5)
    rotations[:, ~IS_FREE] = np.eye(3)
    return motion_of(rotations, np.random.default_rng(seed).normal(size=(frame_count, 3)) * 3)


def vary_skeleton(seed: int) -> Skeleton:
    """Return the skeleton with other bone lengths and slightly different directions of bones."""
    noise = np.random.default_rng(seed).normal(size=SKELETON.offsets.shape) * 0.01
    return replace(SKELETON, offsets=SKELETON.offsets + noise * (SKELETON.offsets != 0).any(-1, keepdims=True))


def place_as_rig(name: str, skeleton: Skeleton, motion: Motion) -> tuple[Skeleton, Motion]:
    """Return the skeleton as a rig has it: with CMU's joints, or with the hands at the wrists."""
    return (skeleton, motion) if name == "cmu" else place_hands_at_wrists(skeleton, motion)


@pytest.mark.parametrize("name", RIG_NAMES)
@given(seed=st.integers(0, 2**32))
def test_rig_joints_have_the_positions_of_the_skeletons(tmp_path_factory, name: str, seed: int):
    skeleton, motion = vary_skeleton(seed), build_motion(seed)
    rig, bvh = write_for_rig(tmp_path_factory.mktemp("rig"), name, skeleton, motion)
    expected, _ = kinematics.compute_world_poses(*place_as_rig(name, skeleton, motion))
    written_joints = [bvh.names.index(joint.name) for joint in rig.joints]
    positions = bvh.compute_world_positions()[int(rig.first_frame == "t-pose") :, written_joints] * rig.unit_m
    assert bvh.names[0] == "Hips"
    skeleton_joints = [skeleton.find_joint(joint.joint) for joint in rig.joints]
    np.testing.assert_allclose(positions, expected[:, skeleton_joints], atol=1e-5)


@pytest.mark.parametrize("name", RIG_NAMES)
def test_rig_joints_rotate_like_the_skeletons(name: str):
    rig, motion = load_rig(name), build_motion()
    rig_skeleton, rig_motion = retarget_to_rig(rig, SKELETON, motion)
    _, rotations = kinematics.compute_world_poses(*place_as_rig(name, SKELETON, motion))
    rig_rotations = kinematics.compute_world_poses(rig_skeleton, rig_motion)[1][int(rig.first_frame == "t-pose") :]
    for index, joint in enumerate(rig.joints):
        difference = rotations[:, SKELETON.find_joint(joint.axes)].swapaxes(-1, -2) @ rig_rotations[:, index]
        np.testing.assert_allclose(difference, np.tile(difference[0], (len(difference), 1, 1)), atol=1e-12)


HANDS = {"blender": "Hand", "motionbuilder": "Hand", "3dsmax": "Wrist"}  # of the rigs whose hands begin at the wrists
ELBOWS = {"blender": "ForeArm", "motionbuilder": "ForeArm", "3dsmax": "Elbow"}


@pytest.mark.parametrize("name", HANDS)
def test_hand_begins_at_the_wrist_and_points_as_the_solved_hand(tmp_path: Path, name: str):
    """CMU's Hand is 199.6 mm from the elbow, FingerBase 99.8 mm beyond it."""
    motion = motion_of(np.tile(np.eye(3), (2, 31, 1, 1)), np.zeros((2, 3)))
    motion.local_rotations[1, SKELETON.find_joint("LeftHand")] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # bent up by 90 degrees
    motion.local_rotations[1, SKELETON.find_joint("LeftFingerBase")] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    rig, bvh = write_for_rig(tmp_path, name, SKELETON, motion)
    places = bvh.compute_world_positions()[-2:] * rig.unit_m
    elbow, wrist = (places[:, bvh.names.index(f"Left{joint[name]}")] for joint in (ELBOWS, HANDS))
    solved, rotations = kinematics.compute_world_poses(SKELETON, motion)
    np.testing.assert_allclose(elbow, solved[:, SKELETON.find_joint("LeftForeArm")], atol=1e-6)
    bent = np.array([0.1996, 0.0998, 0])
    expected = elbow + 0.2994 * np.array([[1, 0, 0], bent / np.linalg.norm(bent)])
    np.testing.assert_allclose(wrist, expected, atol=1e-6)
    rig_skeleton, rig_motion = retarget_to_rig(rig, SKELETON, motion)
    hand = rig_skeleton.find_joint(f"Left{HANDS[name]}")
    rest, turned = (kinematics.compute_world_poses(rig_skeleton, rig_motion)[1][frame, hand] for frame in (-2, -1))
    np.testing.assert_allclose(turned @ rest.T, rotations[1, SKELETON.find_joint("LeftFingerBase")], atol=1e-9)


@pytest.mark.parametrize("name", RIG_NAMES)
def test_written_file_follows_the_conventions_of_programs(tmp_path: Path, name: str):
    _, bvh = write_for_rig(tmp_path, name, SKELETON, build_motion())
    assert [len(names) for names in bvh.channels] == [6] + [3] * (len(bvh.names) - 1)
    assert len(set(bvh.names)) == len(bvh.names)
    assert not any(set(each) & set(" :.-") for each in bvh.names)
    leaves = set(range(len(bvh.names))) - set(bvh.parents)
    assert {bvh.names[leaf] for leaf in leaves} == set(bvh.ends)
    assert all(np.linalg.norm(end) > 0 for end in bvh.ends.values())
    assert bvh.offsets[0] == [0, 0, 0]


def compute_rest_positions(bvh: Bvh) -> list[np.ndarray]:
    positions = [np.zeros(3)]
    for offset, parent in list(zip(bvh.offsets, bvh.parents, strict=True))[1:]:
        positions.append(positions[parent] + offset)
    return positions


@pytest.mark.parametrize(("name", "arm"), [("blender", LEFT), ("motionbuilder", LEFT), ("3dsmax", -UP)])
def test_rest_pose_is_the_one_that_the_program_expects(tmp_path: Path, name: str, arm: np.ndarray):
    rig, bvh = write_for_rig(tmp_path, name, vary_skeleton(3), build_motion())
    assert bvh.names == [joint.name for joint in rig.joints]
    position = {joint.joint: each for joint, each in zip(rig.joints, compute_rest_positions(bvh), strict=True)}
    for side, mirror in (("Left", [1, 1, 1]), ("Right", [-1, 1, 1])):
        bones = (("UpLeg", "Leg", -UP), ("Leg", "Foot", -UP), ("Arm", "ForeArm", arm * mirror), ("ForeArm", "Hand", arm * mirror))
        for start, end, direction in bones:
            bone = position[f"{side}{end}"] - position[f"{side}{start}"]
            np.testing.assert_allclose(bone / np.linalg.norm(bone), direction, atol=1e-6)
        foot = position[f"{side}ToeBase"] - position[f"{side}Foot"]
        assert foot @ FORWARD > 0.9 * np.linalg.norm(foot)
    assert position["LeftUpLeg"] @ LEFT > 0 > position["RightUpLeg"] @ LEFT


@pytest.mark.parametrize("name", [name for name in RIG_NAMES if load_rig(name).first_frame == "t-pose"])
def test_first_frame_is_a_t_pose_on_the_floor_at_the_first_position(tmp_path: Path, name: str):
    motion = build_motion()
    rig, bvh = write_for_rig(tmp_path, name, SKELETON, motion)
    assert bvh.frames == motion.frame_count + 1
    first = bvh.compute_world_positions()[0] * rig.unit_m
    position = {joint.joint: first[bvh.names.index(joint.name)] for joint in rig.joints}
    np.testing.assert_allclose(position["Hips"][[0, 2]], motion.root_position[0, [0, 2]], atol=1e-6)
    np.testing.assert_allclose(position["LeftFoot"][[0, 2]], position["LeftUpLeg"][[0, 2]], atol=1e-4)
    np.testing.assert_allclose(position["RightHand"][1:], position["RightArm"][1:], atol=1e-6)
    toe_heights = [position[f"{side}ToeBase"][1] for side in ("Left", "Right")]
    assert min(toe_heights) == pytest.approx(0, abs=1e-6)  # the end sites of the toes are level with them
    assert rig.rest != "t-pose" or np.abs(bvh.rows[0, 3:]).max() < 1e-6


def test_t_pose_of_cmu_rig_has_whole_degrees(tmp_path: Path):
    _, bvh = write_for_rig(tmp_path, "cmu", vary_skeleton(1), build_motion())
    np.testing.assert_array_equal(bvh.rows[0, 3:], np.round(bvh.rows[0, 3:]))
    assert (bvh.rows[1, 3:] != np.round(bvh.rows[1, 3:])).any()
    rig, bvh = write_for_rig(tmp_path, "cmu", SKELETON, build_motion())
    thigh = 3 + 3 * [joint.name for joint in rig.joints].index("LeftUpLeg")
    np.testing.assert_allclose(bvh.rows[0, thigh : thigh + 3], [-20, 0, 0])  # about -21 in CMU's release


@pytest.mark.parametrize("name", RIG_NAMES)
def test_t_pose_is_detected_when_the_file_is_read(tmp_path: Path, name: str):
    rig, _ = write_for_rig(tmp_path, name, vary_skeleton(2), build_motion())
    assert read_bvh(tmp_path / "walk.bvh").has_reference_pose == (rig.first_frame == "t-pose")


def test_joint_that_rotates_cannot_be_omitted(tmp_path: Path):
    motion = build_motion()
    motion.local_rotations[:, SKELETON.find_joint("LHipJoint")] = smooth_rotations(9, 40, 1, swing=0.5)[:, 0]
    with pytest.raises(WriteError, match=r"MotionBuilder.*Left(UpLeg|Leg|Foot|ToeBase) would be off by .* mm"):
        write_for_rig(tmp_path, "motionbuilder", SKELETON, motion)
    assert not list(tmp_path.iterdir())
    write_for_rig(tmp_path, "cmu", SKELETON, motion)  # omits no joint


def test_missing_joint_of_the_skeleton_is_named(tmp_path: Path):
    other = replace(SKELETON, names=tuple("Pelvis" if name == "Hips" else name for name in SKELETON.names))
    with pytest.raises(WriteError, match=r"3ds Max Biped.*no joint Hips"):
        write_for_rig(tmp_path, "3dsmax", other, build_motion())


def test_opposite_bone_is_rotated_by_half_a_turn():
    offsets = SKELETON.offsets.copy()
    offsets[SKELETON.find_joint("LeftLeg")] = [0, 0.4, 0]
    rig_skeleton, _ = retarget_to_rig(load_rig("blender"), replace(SKELETON, offsets=offsets), build_motion())
    np.testing.assert_allclose(rig_skeleton.offsets[rig_skeleton.find_joint("LeftLeg")], [0, -0.4, 0], atol=1e-9)
