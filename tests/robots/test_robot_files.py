"""What is written of a robot: conventions of NPZ, CSV and pickle, and options that are not for robots."""

import json
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.characters.body_frames import SegmentMotion, build_body_frame
from mocapfix.characters.character_files import write_character_glb
from mocapfix.contacts.contacts import CONTACT_JOINTS, NO_FLOOR, BodyContacts
from mocapfix.errors import OptionError, WriteError
from mocapfix.io.gltf import parse_glb, read_gltf_nodes
from mocapfix.io.gltf_mesh import compute_node_matrices, read_gltf_mesh
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton, load_cmu31_skeleton
from mocapfix.options import OutputOptions
from mocapfix.output_formats import list_output_formats
from mocapfix.robots.retarget_robot import RobotMotion, compose_robot_motion
from mocapfix.robots.robot import SIDES, load_robot
from mocapfix.robots.robot_files import (
    MAX_LIMB_DEG,
    ON_FLOOR_M,
    RobotFigures,
    build_robot_arrays,
    compute_mass_centre,
    convert_robot_motion,
    describe_balance,
    find_outside,
    load_robot_files,
    write_robot_csv,
    write_robot_pickle,
)
from mocapfix.robots.robot_map import read_robot_map
from tests.characters.walking_body import RATE, load_walk
from tests.robots.humanoid import LENGTHS, SOLE, build_mjcf, list_parts

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is in the extra `robot`")
FRAMES = 50
ALL_JOINTS = np.ones(31, bool)
TURN = np.array([0.4, -0.5, 1.5])  # rad/s, in the world
SPEED = np.array([1.0, 0.5, 0.0])  # m/s


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("robot") / "own.xml"
    path.write_text(build_mjcf(list_parts()), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def turning(path) -> RobotMotion:
    """A robot that turns as a whole about the origin of its root, which moves on a line, with joints at 0.1 rad/s."""
    robot = load_robot(path)
    times = np.arange(FRAMES) / RATE
    start = Rotation.from_euler("z", 0.7)
    turns = (Rotation.from_rotvec(times[:, None] * TURN) * start).as_matrix()
    links = len(robot.link_names)
    rotations = np.repeat(turns[:, None], links, axis=1)
    places = np.zeros((links, 3))
    for link in range(1, links):
        places[link] = places[robot.parents[link]] + robot.link_positions[link]
    positions = (times[:, None] * SPEED)[:, None] + np.einsum("tij,lj->tli", turns, places)
    joints = np.tile(0.1 * times[:, None], len(robot.joint_names))
    return RobotMotion(robot, RATE, turns, np.zeros((FRAMES, 6)), joints, positions, rotations)


def test_npz_has_velocities_of_centres_of_mass_in_the_world(turning):
    arrays, robot = build_robot_arrays(turning), turning.robot
    inner = slice(1, -1)
    np.testing.assert_allclose(arrays["body_ang_vel_w"], np.broadcast_to(TURN, arrays["body_ang_vel_w"].shape), atol=1e-9)
    arms = np.einsum("tlij,lj->tli", turning.link_rotations, robot.mass_centres)
    centres = turning.link_positions + arms - turning.root_position[:, None]
    expected = SPEED + np.cross(TURN, centres)
    assert np.abs(robot.mass_centres).max() > 0.01
    np.testing.assert_allclose(arrays["body_lin_vel_w"][inner], expected[inner], atol=2e-3)
    np.testing.assert_allclose(arrays["joint_vel"], 0.1, atol=1e-9)
    assert arrays["fps"] == RATE


def test_npz_has_quaternions_w_x_y_z_and_the_qpos_of_mujoco(turning, path):
    arrays = build_robot_arrays(turning)
    quaternions = arrays["body_quat_w"]
    found = Rotation.from_quat(quaternions[..., [1, 2, 3, 0]].reshape(-1, 4)).as_matrix()
    np.testing.assert_allclose(found.reshape(turning.link_rotations.shape), turning.link_rotations, atol=1e-9)
    assert ((quaternions[1:] * quaternions[:-1]).sum(axis=2) > 0).all()
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    for frame in (0, 30):
        data.qpos = arrays["qpos"][frame]
        mujoco.mj_kinematics(model, data)
        root = model.body(arrays["body_names"][0]).id
        np.testing.assert_allclose(data.xpos[root], arrays["root_pos"][frame], atol=1e-9)
        np.testing.assert_allclose(data.xmat[root].reshape(3, 3), turning.link_rotations[frame, 0], atol=1e-9)
    np.testing.assert_array_equal(arrays["qpos"][:, 7:], arrays["joint_pos"])
    assert [model.joint(name).qposadr[0] for name in arrays["joint_names"]] == [*range(7, model.nq)]


def test_csv_and_pickle_have_quaternions_x_y_z_w(turning, tmp_path):
    write_robot_csv(tmp_path / "a.csv", turning)
    write_robot_pickle(tmp_path / "a.pkl", turning)
    table = np.loadtxt(tmp_path / "a.csv", delimiter=",")
    columns = json.loads((tmp_path / "a.columns.json").read_text(encoding="utf-8"))
    content = pickle.loads((tmp_path / "a.pkl").read_bytes())
    assert table.shape == (FRAMES, len(columns["columns"]))
    assert columns["columns"][:8] == [
        "root_x", "root_y", "root_z", "root_qx", "root_qy", "root_qz", "root_qw", turning.robot.joint_names[0],
    ]  # fmt: skip
    assert columns["fps"] == content["fps"] == RATE
    for quaternions in (table[:, 3:7], content["root_rot"]):
        np.testing.assert_allclose(Rotation.from_quat(quaternions).as_matrix(), turning.link_rotations[:, 0], atol=3e-6)
    for positions, joints in ((table[:, :3], table[:, 7:]), (content["root_pos"], content["dof_pos"])):
        np.testing.assert_allclose(positions, turning.root_position, atol=1e-6)
        np.testing.assert_allclose(joints, turning.joint_positions, atol=1e-6)


def test_a_take_of_one_frame_has_no_velocities(turning):
    arrays = build_robot_arrays(turning.select_frames(slice(0, 1)))
    for name in ("joint_vel", "body_lin_vel_w", "body_ang_vel_w"):
        np.testing.assert_array_equal(arrays[name], 0.0)


def test_the_glb_has_the_links_in_their_places_with_y_up(turning, path, tmp_path):
    """Also a link that slides in its parent's axes."""
    character, moved = load_robot_files(path, OutputOptions()).character, turning.link_positions.copy()
    moved[:, -1, 0] += 0.1 * np.arange(FRAMES) / RATE
    sliding = replace(turning.robot, is_slide=turning.robot.joint_links == len(turning.robot.link_names) - 1)
    motion = convert_robot_motion(replace(turning, robot=sliding, link_positions=moved))
    write_character_glb(tmp_path / "walk.own.glb", character, motion, "walk")
    content = parse_glb(tmp_path / "walk.own.glb", (tmp_path / "walk.own.glb").read_bytes())
    nodes, times = read_gltf_nodes(tmp_path, content.document), np.arange(FRAMES) / RATE
    links = [nodes.names.index(name) for name in turning.robot.link_names]
    matrices = compute_node_matrices(content, nodes, content.document["animations"][0], times.tolist())[:, links]
    np.testing.assert_allclose(matrices[..., :3, 3], moved[..., [1, 2, 0]], atol=1e-5)
    np.testing.assert_allclose(matrices[..., :3, :3], turning.link_rotations[..., [1, 2, 0], :], atol=1e-5)


def test_the_mesh_of_a_robot_stands_on_its_soles_and_reaches_the_top_of_its_head(path):
    character = load_robot_files(path, OutputOptions()).character
    assert character.source is not None
    content = parse_glb(path, character.source.data)
    nodes = read_gltf_nodes(path, content.document)
    corners = read_gltf_mesh(content, nodes).pose(compute_node_matrices(content, nodes)[0])
    assert corners[:, 1].min() == pytest.approx(0.0, abs=1e-5)
    height = 0.07 + LENGTHS["shin"] + LENGTHS["thigh"] + 0.15 + 0.45 + 0.12 + 0.09
    assert corners[:, 1].max() == pytest.approx(height, abs=1e-5)
    toes = corners[corners[:, 1] < 0.01]
    assert toes[:, 2].max() == pytest.approx(0.15, abs=1e-5)  # it looks along Z


def load_solved() -> tuple[Skeleton, Motion]:
    """Return skeleton and motion of the walk, 30 frames."""
    character, motion = load_walk()
    skeleton, zeros = load_cmu31_skeleton(), np.zeros(30, int)
    skeleton = type(skeleton)(skeleton.names, skeleton.parents, character.skeleton.offsets, skeleton.ends)
    none = np.zeros((0, 0))
    return skeleton, Motion(motion.pelvis_position[:30], motion.local_rotations[:30], zeros, zeros, none, none)


def test_files_of_a_robot(path, tmp_path):
    files = load_robot_files(path, OutputOptions(extra_formats=("robot-csv", "robot-pkl")))
    assert files.suffixes == ("own.npz", "own.glb", "own.map.yaml", "own.csv", "own.columns.json", "own.pkl")
    target = tmp_path / "walk.own.npz"
    notes, moved = files.write(target, *load_solved(), RATE, None, slice(5, 25), ALL_JOINTS)
    assert {each.name for each in tmp_path.iterdir()} == {f"walk.{suffix}" for suffix in files.suffixes if suffix != "own.glb"}
    assert moved.frame_count == 20
    with np.load(target) as arrays:
        assert arrays["joint_pos"].shape == (20, len(files.body.robot.joint_names))
        feet = [arrays["body_names"].tolist().index(f"{side}_foot") for side in ("left", "right")]
        turns = Rotation.from_quat(arrays["body_quat_w"][:, feet][..., [1, 2, 3, 0]].reshape(-1, 4)).as_matrix()
        soles = arrays["body_pos_w"][:, feet][:, :, None] + (SOLE @ turns.swapaxes(1, 2)).reshape(20, 2, 4, 3)
    share = (soles[..., 2].min(axis=(1, 2)) < ON_FLOOR_M).mean()
    assert "own.npz: Found by the structure of the robot." in notes[0]
    assert "Places are scaled by" in notes[0]
    assert "Limbs point as the performer's within" in notes[1]
    assert f"; a sole is on the floor in {share:.0%} of the frames;" in notes[1]
    again = load_robot_files(path, OutputOptions(character_map=str(tmp_path / "walk.own.map.yaml")))
    assert again.body.map.reason == "Read from walk.own.map.yaml."
    assert read_robot_map(tmp_path / "walk.own.map.yaml", again.body.robot).feet == files.body.map.feet


def test_points_outside_of_the_soles_that_stand():
    """Two soles of 1 by 1 and 3 apart: the hull is that of the edges in contact."""
    sole = np.array([[0.0, 1.0], [0.0, 0.0], [1.0, 1.0], [1.0, 0.0]])
    corners = np.tile(np.concatenate([sole + [0.0, 3.0], sole]), (6, 1, 1))
    centres = np.array([[0.5, 3.5], [0.5, 2.0], [0.5, 2.0], [0.9, 2.0], [0.9, 2.0], [0.5, 0.5]])
    both, left, heels, none = [True] * 4, [True, True, False, False], [True, True, True, False], [False] * 4
    found = find_outside(centres, corners, np.array([left, left, both, both, heels, none]))
    assert found.tolist() == [False, True, False, False, True, True]


def test_mass_centre_of_a_person_who_stands():
    """A person of 1.7 m with hanging arms: 55 to 60 % of the stature."""
    heights = {"thigh": 0.9, "shin": 0.49, "foot": 0.08, "upper_arm": 1.4, "forearm": 1.12, "hand": 0.87}
    sides = {"left": 0.1, "right": -0.1}
    place = {f"{side}_{each}": np.array([[x, y, 0.0]]) for side, x in sides.items() for each, y in heights.items()}
    centre = compute_mass_centre(SegmentMotion(place, {}, {}))[0]
    assert centre[[0, 2]] == pytest.approx(0.0, abs=1e-12)
    assert 0.55 < centre[1] / 1.7 < 0.6


def test_balance_of_a_robot_that_leans(path):
    """It stands in half of the frames and leans by 30 degrees in the others; the performer stands upright."""
    body = load_robot_files(path, OutputOptions()).body
    turns = np.repeat(Rotation.from_euler("y", [[0.0], [30.0]], degrees=True).as_matrix(), 5, axis=0)
    moved = compose_robot_motion(body, RATE, turns, np.zeros((10, 6 + len(body.robot.joint_names))))
    frame = build_body_frame(load_walk()[0])
    bones = frame.character.mapping.bones
    place = {segment: np.tile(frame.rest_position[each[0]], (12, 1)) for segment, each in bones.items() if each}
    upright = SegmentMotion(place, {f"{side}_foot": np.tile(np.eye(3), (12, 1, 1)) for side in SIDES}, {})
    stands = np.ones((12, len(CONTACT_JOINTS)), bool)
    contacts = BodyContacts(CONTACT_JOINTS, stands, stands.astype(float), stands, NO_FLOOR, RATE)
    text = describe_balance(body, moved, frame, upright, contacts, slice(2, 12))
    assert "outside of the standing soles in 50% of the frames, the performer's in 0%." in text
    assert describe_balance(body, moved, frame, upright, contacts.change_contacts(~stands), slice(2, 12)) == ""


def test_limbs_that_the_take_does_not_show_are_not_measured_and_hang(path, tmp_path):
    files, (skeleton, motion) = load_robot_files(path, OutputOptions()), load_solved()
    hidden = [skeleton.find_joint(f"{side}{joint}") for side in ("Left", "Right") for joint in ("ForeArm", "Hand")]
    is_solved = ~np.isin(np.arange(31), hidden)
    level = motion.local_rotations.copy()
    level[:, [skeleton.find_joint(f"{side}{joint}") for side in ("Left", "Right") for joint in ("Arm", "ForeArm")]] = np.eye(3)
    notes, _ = files.write(
        tmp_path / "walk.own.npz", skeleton, replace(motion, local_rotations=level), RATE, None, slice(None), is_solved
    )
    assert "The 4 limbs that the take shows point as the performer's within" in notes[1]
    with np.load(tmp_path / "walk.own.npz") as arrays:
        names = arrays["body_names"].tolist()
        for side in ("left", "right"):
            shoulder, elbow = (arrays["body_pos_w"][:, names.index(f"{side}_{link}")] for link in ("upper_arm", "forearm"))
            assert ((elbow - shoulder)[:, 2] < -0.8 * LENGTHS["upper_arm"]).all()
    figures = RobotFigures(8, (MAX_LIMB_DEG + 1.0, 40.0), (1.0, 9.0), 0.5, "ankle", 0.9, "knee", False, 0.0, 0.0, 1.0)
    assert figures.describe().startswith("It does something else: check the limits of its joints, and its map. Limbs point")


def test_frames_outside_of_the_take_are_refused(path, tmp_path):
    files = load_robot_files(path, OutputOptions())
    with pytest.raises(WriteError, match="none of its frames is among those of --trim"):
        files.write(tmp_path / "walk.own.npz", *load_solved(), RATE, None, slice(40, 50), ALL_JOINTS)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "value", "flag"),
    [("loop", True, "--loop"), ("root_motion", "in-place", "--root-motion"), ("rest_frame", 3, "--rest-frame")],
)
def test_options_of_characters_are_refused(path, name, value, flag):
    options = replace(OutputOptions(characters=(str(path),)), **{name: value})
    with pytest.raises(OptionError, match=r"is not for robots; own\.xml is one") as error:
        list_output_formats(options)
    assert error.value.flag == flag


@pytest.mark.parametrize("characters", [(), ("mixamo",)])
def test_formats_of_robots_need_a_robot(characters):
    with pytest.raises(OptionError, match="robot-csv is the motion of a robot; name it as --character"):
        list_output_formats(OutputOptions(characters=characters, extra_formats=("robot-csv",)))
