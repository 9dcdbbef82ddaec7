"""The benchmark of robots: known motions of a small robot have known figures."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

from mocapfix.characters.body_frames import build_body_frame, compute_segment_motion
from mocapfix.characters.character import build_cmu31_character, convert_motion
from mocapfix.errors import ReadError
from mocapfix.lab.retargeting import BenchMotion, find_marker_middles
from mocapfix.lab.robots import list_robot_files, measure_collisions, measure_figures, measure_robot, measure_standing
from mocapfix.robots.retarget_robot import compose_robot_motion
from mocapfix.robots.robot import compile_model, load_robot
from mocapfix.robots.robot_map import find_robot_map, list_leaders
from mocapfix.robots.robot_targets import build_robot_body, compute_robot_targets
from mocapfix.solve.trajectory import ROOT_UNKNOWNS
from mocapfix.synthetic import compose_take
from tests.characters.walking_body import build_contacts

RATE, SPEED_M_S, FRAMES = 100.0, 0.05, 50
LEG = """
<body name="{s}_thigh" pos="0 {y} -0.05"><joint name="{s}_hip_pitch" axis="0 1 0" range="-2 1"/>
 <joint name="{s}_hip_roll" axis="1 0 0" range="-1 1"/><joint name="{s}_hip_yaw" axis="0 0 1" range="-1 1"/>
 <geom type="capsule" size="0.04" fromto="0 0 -0.05 0 0 -0.25"/>
 <body name="{s}_shin" pos="0 0 -0.3"><joint name="{s}_knee" axis="0 1 0" range="0 2.5"/>
  <geom type="capsule" size="0.03" fromto="0 0 -0.05 0 0 -0.25"/>
  <body name="{s}_foot" pos="0 0 -0.3"><joint name="{s}_ankle" axis="0 1 0" range="-1 1"/>
   <geom type="box" size="0.09 0.03 0.01" pos="0.04 0 -0.04"/></body></body></body>"""
ARM = """
<body name="{s}_upper_arm" pos="0 {y} 0.4"><joint name="{s}_shoulder_pitch" axis="0 1 0" range="-3 3"/>
 <joint name="{s}_shoulder_roll" axis="1 0 0" range="-3 3"/><joint name="{s}_shoulder_yaw" axis="0 0 1" range="-2 2"/>
 <geom type="capsule" size="0.03" fromto="0 0 -0.05 0 0 -0.18"/>
 <body name="{s}_forearm" pos="0 0 -0.22"><joint name="{s}_elbow" axis="0 1 0" range="-2.5 0"/>
  <geom name="{s}_hand" type="capsule" size="0.025" fromto="0 0 -0.05 0 0 -0.2"/></body></body>"""


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    limbs = "".join(
        limb.format(s=side, y=sign * apart)
        for side, sign in (("left", 1), ("right", -1))
        for limb, apart in ((LEG, 0.08), (ARM, 0.18))
    )
    file = tmp_path_factory.mktemp("robot") / "small.xml"
    trunk = f'<geom type="capsule" size="0.08" fromto="0 0 0.05 0 0 0.35"/>{limbs}'
    file.write_text(
        f'<mujoco><compiler angle="radian"/><worldbody><body name="trunk"><freejoint/>{trunk}</body></worldbody></mujoco>',
        encoding="utf-8",
    )
    return file


@pytest.fixture(scope="module")
def performed() -> BenchMotion:
    take = compose_take(seed=3, seconds=1.0)
    skeleton, middles = take.subject.skeleton, find_marker_middles(take.subject, take.labels, take.marker_positions)
    contacts = build_contacts(skeleton, take.motion, take.rate)
    return BenchMotion("walk", skeleton, convert_motion(take.motion, take.rate), contacts, middles)


@pytest.fixture(scope="module")
def body(path):
    robot = load_robot(path)
    return build_robot_body(robot, find_robot_map(robot))


@pytest.fixture(scope="module")
def targets(body, performed):
    """The robot's targets; both feet are in contact in frames 10 to 29."""
    source = build_body_frame(build_cmu31_character(performed.skeleton))
    segments = compute_segment_motion(source, performed.motion)
    found = compute_robot_targets(body, source, segments, performed.contacts, RATE)
    found.contacts.update({key: [(10, 29)] for key in found.contacts})
    return found


def move_forward(body, count, height_m=0.0, **positions):
    """Return a robot that moves forward upright at SPEED_M_S, its soles at a height, with given joint positions."""
    unknowns = np.zeros((count, ROOT_UNKNOWNS + len(list_leaders(body.robot))))
    unknowns[:, 0] = SPEED_M_S * np.arange(count) / RATE
    unknowns[:, 2] = height_m + 0.7
    for name, values in positions.items():
        unknowns[:, ROOT_UNKNOWNS + body.robot.joint_names.index(name)] = values
    return compose_robot_motion(body, RATE, np.tile(np.eye(3), (count, 1, 1)), unknowns)


def test_slide_is_the_speed_of_the_soles_and_drift_half_the_way(body, targets):
    slides, drifts = measure_standing(body, targets, move_forward(body, FRAMES))
    assert slides == pytest.approx(np.full(4 * 18, SPEED_M_S))
    assert drifts == pytest.approx(np.full(4, 0.5 * 19 / RATE * SPEED_M_S))


@pytest.mark.parametrize(("height_m", "penetrates", "floats"), [(0.0, 0.0, 0.0), (-0.011, 1.0, 0.0), (0.016, 0.0, 1.0)])
def test_heights_of_soles_count_as_penetration_and_floating(path, body, targets, height_m, penetrates, floats):
    count = len(targets.hips)
    figures = measure_figures(body, compile_model(path)[0], targets, move_forward(body, count, height_m), 1.0)
    assert (figures["penetration_share"], figures["floating_share"]) == (penetrates, floats)
    assert figures["stance_height_range_mm"] == pytest.approx(0.0, abs=1e-6)
    assert figures["frames_per_second"] == count


def test_positions_and_speeds_beyond_limits_are_counted(path, body, targets):
    knee = np.zeros(len(targets.hips))
    knee[5], knee[20] = -0.01, 0.5
    figures = measure_figures(body, compile_model(path)[0], targets, move_forward(body, len(knee), left_knee=knee), 1.0)
    assert (figures["limit_violations"], figures["speed_violations"]) == (1, 2)


def test_collisions_have_the_depth_by_which_two_capsules_overlap(path, body):
    model, _ = compile_model(path)
    assert measure_collisions(model, move_forward(body, 2)).tolist() == [0.0, 0.0]
    inwards = move_forward(body, 2, left_shoulder_roll=[0.0, -0.9])
    first, second = measure_collisions(model, inwards)
    other, hand = (inwards.link_positions[1, body.robot.link_names.index(name)] for name in ("right_forearm", "left_forearm"))
    turn = inwards.link_rotations[1, body.robot.link_names.index("left_forearm")]
    points = hand + np.linspace(0.05, 0.2, 1001)[:, None] * (turn @ [0.0, 0.0, -1.0])
    nearest = other - np.array([0.0, 0.0, 1.0]) * np.clip(other[2] - points[:, 2:], 0.05, 0.2)
    assert first == 0.0
    assert second == pytest.approx(0.05 - np.linalg.norm(points - nearest, axis=1).min(), abs=1e-5)


def test_the_robot_follows_a_walk_whatever_axes_its_root_has_in_the_world(path, performed, tmp_path):
    text = path.read_text(encoding="utf-8").replace('name="trunk"', 'name="trunk" quat="0.6 0 0 0.8"')
    (tmp_path / "turned.xml").write_text(text, encoding="utf-8")
    row = measure_robot(tmp_path / "turned.xml", performed)[0]
    assert row["limbs_deg"] < 3.0
    assert row["penetration_share"] == row["floating_share"] == row["self_collision_share"] == 0.0
    assert row["limit_violations"] == row["speed_violations"] == 0


def test_folders_give_their_mjcf_files(path, tmp_path):
    assert list_robot_files([path.parent]) == list_robot_files([path]) == [path]
    with pytest.raises(ReadError, match="no robot"):
        list_robot_files([tmp_path])
