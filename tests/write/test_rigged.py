from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.errors import WriteError
from mocapfix.motion import Motion
from mocapfix.options import RIG_NAMES
from mocapfix.read.bvh import read_bvh
from mocapfix.skeleton import load_cmu31_body
from mocapfix.solve import kinematics
from mocapfix.write import rig, write_rig_bvh
from mocapfix.write.rig import retarget_to_rig
from tests.write.read_back import SKELETON, Bvh, motion_of, smooth_rotations

FREE = load_cmu31_body().free_joints
FORWARD, UP, LEFT = np.array([0, 0, 1.0]), np.array([0, 1.0, 0]), np.array([1.0, 0, 0])


def moving(seed: int = 0, frames: int = 40) -> Motion:
    """-> a motion of a body whose hip stubs, toes, fingers and thumbs rest"""
    rotations = smooth_rotations(seed, frames, 31, swing=2.5)
    rotations[:, ~FREE] = np.eye(3)
    return motion_of(rotations, np.random.default_rng(seed).normal(size=(frames, 3)) * 3)


def written(folder, name: str, skeleton, motion) -> tuple[rig.Rig, Bvh]:
    told = rig.load_rig(name)
    write_rig_bvh(folder / "walk.bvh", told, skeleton, motion, 120.0)
    return told, Bvh((folder / "walk.bvh").read_text())


def stretched(seed: int):
    """-> the skeleton with other lengths, and bones that point a little elsewhere"""
    noise = np.random.default_rng(seed).normal(size=SKELETON.offsets.shape) * 0.01
    return replace(SKELETON, offsets=SKELETON.offsets + noise * (SKELETON.offsets != 0).any(-1, keepdims=True))


@pytest.mark.parametrize("name", RIG_NAMES)
@given(seed=st.integers(0, 2**32))
def test_every_joint_that_is_kept_is_where_the_solve_has_it(tmp_path_factory, name, seed):
    skeleton, motion = stretched(seed), moving(seed)
    told, read = written(tmp_path_factory.mktemp("rig"), name, skeleton, motion)
    places, _ = kinematics.compute_world_poses(skeleton, motion)
    found = (
        read.compute_world_positions()[int(told.starts_with_t_pose) :, [read.names.index(joint.name) for joint in told.joints]]
        * told.unit_m
    )
    assert read.names[0] == "Hips"
    np.testing.assert_allclose(found, places[:, [skeleton.index(joint.joint) for joint in told.joints]], atol=1e-5)


@pytest.mark.parametrize("name", RIG_NAMES)
def test_every_joint_that_is_kept_turns_as_it_did(name):
    told, motion = rig.load_rig(name), moving()
    skeleton, moved = retarget_to_rig(told, SKELETON, motion)
    before, after = (
        kinematics.compute_world_poses(SKELETON, motion)[1],
        kinematics.compute_world_poses(skeleton, moved)[1][int(told.starts_with_t_pose) :],
    )
    for j, joint in enumerate(told.joints):
        carried = before[:, SKELETON.index(joint.axes)].swapaxes(-1, -2) @ after[:, j]
        np.testing.assert_allclose(carried, np.tile(carried[0], (len(carried), 1, 1)), atol=1e-12)


@pytest.mark.parametrize("name", RIG_NAMES)
def test_the_file_keeps_the_rules_that_programs_have(tmp_path, name):
    _, read = written(tmp_path, name, SKELETON, moving())
    assert [len(names) for names in read.channels] == [6] + [3] * (len(read.names) - 1)
    assert len(set(read.names)) == len(read.names)
    assert not any(set(each) & set(" :.-") for each in read.names)
    leaves = set(range(len(read.names))) - set(read.parents)
    assert {read.names[leaf] for leaf in leaves} == set(read.ends)
    assert all(np.linalg.norm(end) > 0 for end in read.ends.values())
    assert read.offsets[0] == [0, 0, 0]


def rest(read: Bvh) -> list[np.ndarray]:
    """-> where each joint is while nothing turns"""
    places = [np.zeros(3)]
    for offset, parent in list(zip(read.offsets, read.parents, strict=True))[1:]:
        places.append(places[parent] + offset)
    return places


@pytest.mark.parametrize(("name", "arm"), [("blender", LEFT), ("motionbuilder", LEFT), ("3dsmax", -UP)])
def test_no_rotation_at_all_is_the_pose_that_the_program_wants_facing_forward(tmp_path, name, arm):
    told, read = written(tmp_path, name, stretched(3), moving())
    assert read.names == [joint.name for joint in told.joints]
    at = {joint.joint: place for joint, place in zip(told.joints, rest(read), strict=True)}
    for side, mirror in (("Left", [1, 1, 1]), ("Right", [-1, 1, 1])):
        bones = (("UpLeg", "Leg", -UP), ("Leg", "Foot", -UP), ("Arm", "ForeArm", arm * mirror), ("ForeArm", "Hand", arm * mirror))
        for start, end, way in bones:
            along = at[f"{side}{end}"] - at[f"{side}{start}"]
            np.testing.assert_allclose(along / np.linalg.norm(along), way, atol=1e-6)
        foot = at[f"{side}ToeBase"] - at[f"{side}Foot"]
        assert foot @ FORWARD > 0.9 * np.linalg.norm(foot)
    assert at["LeftUpLeg"] @ LEFT > 0 > at["RightUpLeg"] @ LEFT


@pytest.mark.parametrize("name", [name for name in RIG_NAMES if rig.load_rig(name).starts_with_t_pose])
def test_the_first_frame_is_a_t_pose_on_the_floor_where_the_motion_begins(tmp_path, name):
    motion = moving()
    told, read = written(tmp_path, name, SKELETON, motion)
    assert read.frames == motion.frame_count + 1
    place = read.compute_world_positions()[0] * told.unit_m
    at = {joint.joint: place[read.names.index(joint.name)] for joint in told.joints}
    np.testing.assert_allclose(at["Hips"][[0, 2]], motion.root[0, [0, 2]], atol=1e-6)
    np.testing.assert_allclose(at["LeftFoot"][[0, 2]], at["LeftUpLeg"][[0, 2]], atol=1e-4)
    np.testing.assert_allclose(at["RightHand"][1:], at["RightArm"][1:], atol=1e-6)
    toes = [at[f"{side}ToeBase"][1] for side in ("Left", "Right")]
    assert min(toes) == pytest.approx(0, abs=1e-6)  # the toes' ends are level with them
    assert told.rest != "t-pose" or np.abs(read.rows[0, 3:]).max() < 1e-6


def test_cmu_s_t_pose_turns_the_thighs_as_its_release_does_by_whole_degrees(tmp_path):
    told, read = written(tmp_path, "cmu", stretched(1), moving())
    np.testing.assert_array_equal(read.rows[0, 3:], np.round(read.rows[0, 3:]))
    assert (read.rows[1, 3:] != np.round(read.rows[1, 3:])).any()
    told, read = written(tmp_path, "cmu", SKELETON, moving())
    thigh = 3 + 3 * [joint.name for joint in told.joints].index("LeftUpLeg")
    np.testing.assert_allclose(read.rows[0, thigh : thigh + 3], [-20, 0, 0])  # -21 or so, by the person


@pytest.mark.parametrize("name", RIG_NAMES)
def test_read_again_the_t_pose_is_told_from_the_motion(tmp_path, name):
    told, _ = written(tmp_path, name, stretched(2), moving())
    assert read_bvh(tmp_path / "walk.bvh").has_reference_pose == told.starts_with_t_pose


def test_a_joint_that_turns_cannot_be_left_out(tmp_path):
    motion = moving()
    motion.rotations[:, SKELETON.index("LHipJoint")] = smooth_rotations(9, 40, 1, swing=0.5)[:, 0]
    with pytest.raises(WriteError, match=r"MotionBuilder.*Left(UpLeg|Leg|Foot|ToeBase) would be .* mm off"):
        written(tmp_path, "motionbuilder", SKELETON, motion)
    assert not list(tmp_path.iterdir())
    written(tmp_path, "cmu", SKELETON, motion)  # which leaves none out


def test_a_skeleton_without_one_of_the_joints_is_named(tmp_path):
    other = replace(SKELETON, names=tuple("Pelvis" if name == "Hips" else name for name in SKELETON.names))
    with pytest.raises(WriteError, match=r"3ds Max Biped.*no joint Hips"):
        written(tmp_path, "3dsmax", other, moving())


def test_a_bone_that_points_the_other_way_is_turned_right_round():
    offsets = SKELETON.offsets.copy()
    offsets[SKELETON.index("LeftLeg")] = [0, 0.4, 0]
    skeleton, _ = retarget_to_rig(rig.load_rig("blender"), replace(SKELETON, offsets=offsets), moving())
    np.testing.assert_allclose(skeleton.offsets[skeleton.index("LeftLeg")], [0, -0.4, 0], atol=1e-9)
