"""Robots from MJCF and URDF: kinematics, limits, couplings, speed limits, and files that are refused."""

import numpy as np
import pytest

from mocapfix.errors import ReadError, SceneError, format_name_list
from mocapfix.robots.robot import Robot, load_robot
from mocapfix.robots.robot_map import build_hinged_tree, list_leaders
from mocapfix.solve.trajectory import place_points
from tests.robots.humanoid import SPEED_LIMITS, build_mjcf, build_urdf, list_parts

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is in the extra `robot`")

OBLIQUE = """<mujoco>
  <compiler autolimits="false" eulerseq="zyx"/>
  <worldbody>
    <body name="table"><geom size="1"/></body>
    <body name="base" pos="0.1 0.2 0.9" euler="10 20 30">
      <freejoint/><geom size="0.1"/>
      <body name="one" pos="0.1 0 -0.2" euler="30 0 -40">
        <joint name="a" axis="1 2 -1" pos="0.02 0.1 -0.03" ref="25" range="-90 90" limited="true"/>
        <joint name="b" axis="0 1 0.4" pos="-0.1 0 0.2" range="-20 20" limited="false"/>
        <geom size="0.1"/>
        <body name="two" pos="0 0.1 -0.3">
          <joint name="slide" type="slide" axis="1 0 1" ref="0.1" range="-1 1" limited="true"/>
          <geom size="0.1"/>
          <body name="fixed" pos="0.3 0 0" euler="0 0 90"><geom size="0.1"/></body>
        </body>
      </body>
      <body name="three" pos="0 -0.2 0">
        <joint name="c" axis="0 0 1" ref="-15" range="-180 180" limited="true"/>
        <geom size="0.1"/>
      </body>
    </body>
  </worldbody>
  <equality>
    <joint joint1="c" joint2="a" polycoef="0.2 -0.5 0 0 0"/>
    <joint joint1="b" polycoef="0.3 0 0 0 0"/>
  </equality>
</mujoco>"""


def write(path, text):
    path.write_text(text, encoding="utf-8")
    return path


def pose(robot: Robot, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return joint positions, and places and rotations of the links, from positions of the joints that follow no others."""
    tree, links = build_hinged_tree(robot), np.arange(len(robot.parents))
    unknowns = np.concatenate([np.zeros(6), joints[list_leaders(robot)]])[None]
    places, rotations = place_points(tree, np.eye(3)[None], unknowns, links, np.zeros((len(links), 3)))
    return tree.offsets + tree.factors * unknowns[0, 6 + tree.unknowns] + robot.zero_positions, places[0], rotations[0]


@pytest.mark.parametrize("name", ["oblique", "own"])
def test_links_are_where_mujoco_has_them(tmp_path, name):
    path = write(tmp_path / "robot.xml", {"oblique": OBLIQUE, "own": build_mjcf(list_parts())}[name])
    robot, model, rng = load_robot(path), mujoco.MjModel.from_xml_path(str(path)), np.random.default_rng(1)
    data, bodies = mujoco.MjData(model), [model.body(link).id for link in robot.link_names]
    for _ in range(5):
        joints, places, rotations = pose(robot, rng.uniform(-1.0, 1.0, len(robot.joint_names)))
        data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
        for joint, value in zip(robot.joint_names, joints, strict=True):
            data.qpos[model.joint(joint).qposadr] = value
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(places, data.xpos[bodies], atol=1e-9)
        np.testing.assert_allclose(rotations, data.xmat[bodies].reshape(-1, 3, 3), atol=1e-9)


def test_couplings_are_those_that_mujoco_enforces(tmp_path):
    path = write(tmp_path / "robot.xml", OBLIQUE)
    robot, model = load_robot(path), mujoco.MjModel.from_xml_path(str(path))
    follower, leader, *_ = robot.couplings[0]
    assert (robot.joint_names[follower], robot.joint_names[leader]) == ("c", "a")
    joints, _, _ = pose(robot, np.array([0.7, 9.0, 0.3, 9.0]))  # 9: of followers, not used
    data = mujoco.MjData(model)
    data.qpos[7:] = joints
    mujoco.mj_fwdPosition(model, data)
    is_equality = data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
    assert is_equality.sum() == 2
    np.testing.assert_allclose(data.efc_pos[is_equality], 0.0, atol=1e-9)
    assert joints[robot.joint_names.index("b")] == pytest.approx(0.3)


def test_a_coupling_that_is_switched_off_is_none(tmp_path):
    equality = '<equality><joint joint1="left_forearm_joint" joint2="right_forearm_joint" active="{}"/></equality>'
    on, off = (
        load_robot(write(tmp_path / "a.xml", build_mjcf(list_parts(), equality.format(each)))) for each in ("true", "false")
    )
    assert (len(on.couplings), len(off.couplings)) == (1, 0)


def test_limits_are_in_radians_and_only_of_limited_joints(tmp_path):
    robot = load_robot(write(tmp_path / "robot.xml", OBLIQUE))
    limits = dict(zip(robot.joint_names, robot.limits.tolist(), strict=True))
    np.testing.assert_allclose(limits["a"], np.radians([-90, 90]))
    assert limits["b"] == [-np.inf, np.inf]
    assert limits["slide"] == [-1.0, 1.0]
    assert robot.is_slide[robot.joint_names.index("slide")]
    assert "fixed" in robot.link_names
    assert "table" not in robot.link_names


def test_a_urdf_is_the_robot_of_its_mjcf(tmp_path):
    """A URDF has no free joint, and MuJoCo would join its fixed links."""
    parts = list_parts(wrist=False, waist=False)
    one, other = (
        load_robot(write(tmp_path / name, text)) for name, text in (("a.xml", build_mjcf(parts)), ("b.urdf", build_urdf(parts)))
    )
    assert one.link_names == other.link_names
    assert one.joint_names == other.joint_names
    assert {"trunk", "left_hand"} <= set(other.link_names)
    np.testing.assert_allclose(one.limits, other.limits, atol=1e-6)
    joints = np.random.default_rng(2).uniform(-1, 1, len(one.joint_names))
    for found, expected in zip(pose(one, joints), pose(other, joints), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_mimicked_joints_follow(tmp_path):
    text = build_urdf(list_parts()).replace(
        '<child link="left_hand"/>', '<child link="left_hand"/><mimic joint="left_hand_y_joint" multiplier="-0.5" offset="0.1"/>'
    )
    robot = load_robot(write(tmp_path / "robot.urdf", text))
    ((follower, leader, offset, factor),) = robot.couplings
    assert (robot.joint_names[follower], robot.joint_names[leader]) == ("left_hand_joint", "left_hand_y_joint")
    assert (offset, factor) == pytest.approx((0.1, -0.5))


def test_speed_limits_are_those_of_the_urdf_or_of_one_beside_the_mjcf(tmp_path):
    parts = list_parts()
    alone = load_robot(write(tmp_path / "robot.xml", build_mjcf(parts)))
    assert np.isinf(alone.speed_limits).all()
    assert "states no speed limits" in " ".join(alone.notes)
    urdf = load_robot(write(tmp_path / "own.urdf", build_urdf(parts)))
    assert urdf.speed_limits[urdf.joint_names.index("left_forearm_joint")] == SPEED_LIMITS["arm"]
    beside = load_robot(tmp_path / "robot.xml")
    np.testing.assert_array_equal(beside.speed_limits, urdf.speed_limits)
    assert "own.urdf" in " ".join(beside.notes)
    text = build_urdf(parts).replace('velocity="9.0"', 'velocity="0"')  # of ankles, the neck and the waist
    part = load_robot(write(tmp_path / "own.urdf", text))
    is_silent = np.array([not any(name in joint for name in SPEED_LIMITS) for joint in part.joint_names])
    np.testing.assert_array_equal(part.speed_limits, np.where(is_silent, np.inf, urdf.speed_limits))
    assert part.notes == (f"No speed limit is stated for {format_name_list(np.array(part.joint_names)[is_silent].tolist())}.",)
    write(tmp_path / "own.urdf", build_urdf(list_parts(neck=False)))
    assert np.isinf(load_robot(tmp_path / "robot.xml").speed_limits).all()


def test_missing_meshes_are_left_out_with_a_note(tmp_path):
    parts = list_parts()
    mesh = '<asset><mesh name="shell" file="nowhere.stl"/></asset>'
    text = build_mjcf(parts, mesh).replace('<body name="trunk"', '<geom type="mesh" mesh="shell"/><body name="trunk"')
    robot = load_robot(write(tmp_path / "robot.xml", text))
    whole = load_robot(write(tmp_path / "whole.xml", build_mjcf(parts)))
    assert robot.joint_names == whole.joint_names
    np.testing.assert_array_equal(robot.collision.pairs, whole.collision.pairs)
    assert "meshes are missing" in " ".join(robot.notes)


def test_an_mjcf_without_a_free_joint_gets_one(tmp_path):
    text = build_mjcf(list_parts()).replace('<freejoint name="base"/>', "")
    assert load_robot(write(tmp_path / "robot.xml", text)).link_names[0] == "pelvis"


def test_links_near_each_other_may_touch(tmp_path):
    robot = load_robot(write(tmp_path / "robot.xml", build_mjcf(list_parts())))
    names = [robot.link_names[link] for link in robot.collision.links]
    pairs = {frozenset((names[i], names[j])) for i, j in robot.collision.pairs}
    boxes = {(names[i], robot.link_names[robot.collision.box_links[j]]) for i, j in robot.collision.box_pairs}
    assert frozenset(("left_thigh", "right_thigh")) in pairs
    assert frozenset(("left_foot", "right_foot")) in pairs
    assert frozenset(("left_thigh", "left_shin")) not in pairs
    assert ("left_shin", "right_foot") in boxes
    assert ("left_shin", "left_foot") not in boxes


BALL = build_mjcf(list_parts()).replace('name="left_shin_joint"', 'name="left_shin_joint" type="ball"').replace(
    'type="ball" class="about_y" range="0 140"', 'type="ball"'
)  # fmt: skip

LOCKS = "".join(f'<joint joint1="{part.name}_joint"/>' for part in list_parts() if part.axis)
LOCKED = build_mjcf(list_parts(), f"<equality>{LOCKS}</equality>")


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        (BALL, SceneError, "left_shin_joint is a ball joint; replace it by three hinges"),
        ("<mujoco><worldbody>", ReadError, "MuJoCo cannot read this robot"),
        ("no XML", ReadError, "MuJoCo cannot read this robot"),
        ("", ReadError, "MuJoCo cannot read this robot"),
        ("<svg/>", ReadError, "MuJoCo cannot read this robot"),
        ("<mujoco/>", SceneError, "no tree of links with joints was found"),
        ("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>", SceneError, "no tree of links with joints was found"),
        (
            OBLIQUE.replace("0.2 -0.5 0 0 0", "0 1 1 0 0"),
            SceneError,
            "joint c follows another one by a polynomial",
        ),
        (LOCKED, SceneError, "no joint can move: each is locked or follows another one"),
        (
            build_urdf(list_parts()).replace('<child link="left_hand"/>', '<child link="nobody"/>'),
            ReadError,
            "MuJoCo cannot read this robot",
        ),
    ],
)
def test_what_is_no_robot_of_hinges_is_refused(tmp_path, text, error, message):
    suffix = "urdf" if text.startswith("<robot") else "xml"
    with pytest.raises(error, match=message):
        load_robot(write(tmp_path / f"robot.{suffix}", text))


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(ReadError, match=r"^nowhere\.xml: cannot be read"):
        load_robot(tmp_path / "nowhere.xml")
    (tmp_path / "folder.xml").mkdir()
    with pytest.raises(ReadError, match=r"^folder\.xml: "):
        load_robot(tmp_path / "folder.xml")


@pytest.mark.parametrize(("name", "text"), [("x.xml", "<mujoco><worldbody>"), ("x.urdf", "<svg/>"), ("x.xml", BALL)])
def test_the_command_line_names_the_file_that_is_no_robot(mocapfix, tmp_path, name, text):
    take = tmp_path / "take.c3d"
    take.write_bytes(b"")
    status, _, error = mocapfix("clean", take, "--character", write(tmp_path / name, text), "--out", tmp_path / "out")
    assert status not in (0, None)
    assert name in error
    assert "Traceback" not in error
    assert not (tmp_path / "out").exists()
