"""The motion of a robot that follows a walk: limbs, standing feet, floor, limits, and how a take begins or is divided."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.characters.body_frames import build_body_frame, compute_segment_motion
from mocapfix.characters.character import CharacterMotion
from mocapfix.characters.kept_positions import resample_foot_contacts
from mocapfix.contacts.contacts import FOOT_JOINTS
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import load_cmu31_skeleton
from mocapfix.robots import retarget_robot
from mocapfix.robots.retarget_robot import RobotMotion, retarget_to_robot
from mocapfix.robots.robot import SIDES, load_robot
from mocapfix.robots.robot_files import measure_robot_motion
from mocapfix.robots.robot_map import find_robot_map, turn_upright
from mocapfix.robots.robot_targets import RobotBody, RobotTargets, build_robot_body, compute_robot_targets, stand_feet
from mocapfix.solve.trajectory import place_points
from mocapfix.stats.sequences import find_runs
from tests.characters.walking_body import RATE, build_contacts, load_walk
from tests.robots.humanoid import build_mjcf, build_urdf, list_parts

pytest.importorskip("mujoco", reason="MuJoCo is in the extra `robot`")
CUT = int(RATE)  # frames left out at the start


@pytest.fixture(scope="module")
def contacts():
    """The contacts of the walk."""
    character, motion = load_walk()
    skeleton, zeros = load_cmu31_skeleton(), np.zeros(motion.frame_count, int)
    skeleton = type(skeleton)(skeleton.names, skeleton.parents, character.skeleton.offsets, skeleton.ends)
    solved = Motion(motion.pelvis_position, motion.local_rotations, zeros, zeros, np.zeros((0, 0)), np.zeros((0, 0)))
    return resample_foot_contacts(build_contacts(skeleton, solved, RATE), motion.frame_count, RATE)


@pytest.fixture(scope="module")
def body(tmp_path_factory) -> RobotBody:
    """The humanoid with the speed limits of a URDF."""
    folder = tmp_path_factory.mktemp("robot")
    (folder / "own.xml").write_text(build_mjcf(list_parts()), encoding="utf-8")
    (folder / "own.urdf").write_text(build_urdf(list_parts()), encoding="utf-8")
    robot = load_robot(folder / "own.xml")
    return build_robot_body(robot, find_robot_map(robot))


def build_targets(body, contacts, first=0) -> RobotTargets:
    """Return the targets of the walk from a frame on."""
    character, motion = load_walk()
    part = CharacterMotion(motion.pelvis_position[first:], motion.local_rotations[first:], RATE)
    source = build_body_frame(character)
    arrays = {name: getattr(contacts, name)[first:] for name in ("is_contact", "probability", "is_known")}
    feet = replace(contacts, **arrays)
    return compute_robot_targets(body, source, compute_segment_motion(source, part), feet, RATE)


@pytest.fixture(scope="module")
def moved(body, contacts) -> RobotMotion:
    return retarget_to_robot(body, build_targets(body, contacts))


def place_corners(body, motion, side) -> np.ndarray:
    """Return the corners of a sole (T, 4, 3)."""
    sole = body.soles[side]
    turn = motion.link_rotations[:, sole.link]
    return motion.link_positions[:, sole.link, None] + np.einsum("tij,pj->tpi", turn, sole.corners)


def test_limbs_point_as_the_performers(body, contacts, moved):
    figures = measure_robot_motion(body, build_targets(body, contacts), moved)
    assert figures.limb_deg[0] < 2.0
    assert figures.overlap_m < 0.002
    assert figures.speed_ratio < 1.0
    assert figures.has_speed_limit


@pytest.mark.parametrize(
    ("quaternion", "is_stated"),
    [("0.5 0.5 0.5 0.5", False), ("0.70710678 0 0 0.70710678", False), ("0.36 0.48 -0.48 0.64", True)],
)
def test_axes_of_the_root_do_not_matter(tmp_path, contacts, moved, quaternion, is_stated):
    w, *xyz = map(float, quaternion.split())
    head, inner = build_mjcf(list_parts()).split('<body name="pelvis" pos="0 0 0">')
    inner, tail = inner.replace('<freejoint name="base"/>', "", 1).split("</worldbody>")
    base = f'<body name="base" quat="{quaternion if is_stated else "1 0 0 0"}"><freejoint name="base"/>'
    inertial = '<inertial pos="0 0 0" mass="0.001" diaginertia="0.001 0.001 0.001"/>'
    inverse = " ".join(map(str, [w, *(-each for each in xyz)]))
    text = f'{head}{base}{inertial}<body name="pelvis" quat="{inverse}">{inner}</body></worldbody>{tail}'
    (tmp_path / "own.xml").write_text(text, encoding="utf-8")
    (tmp_path / "own.urdf").write_text(build_urdf(list_parts()), encoding="utf-8")
    robot = load_robot(tmp_path / "own.xml")
    turned = build_robot_body(*turn_upright(robot, find_robot_map))
    motion = retarget_to_robot(turned, build_targets(turned, contacts))
    np.testing.assert_allclose(motion.joint_positions, moved.joint_positions, atol=1e-3)
    np.testing.assert_allclose(motion.link_positions[:, 1:], moved.link_positions, atol=1e-3)
    rotation = Rotation.from_quat([*xyz, w]).as_matrix()
    np.testing.assert_allclose(motion.link_rotations[:, 0], moved.link_rotations[:, 0] @ rotation, atol=1e-3)
    assert "The axes of its root are not X ahead and Z up." in turned.map.reason


def test_turns_of_the_trunk_and_the_joint_at_a_limit_are_measured(body, contacts, moved):
    targets, joint = build_targets(body, contacts), body.robot.joint_names.index("left_shin_joint")
    positions, rotations = moved.joint_positions.copy(), moved.link_rotations.copy()
    positions[::2, joint] = body.robot.limits[joint, 1]
    rotations[:, body.map.trunk] = targets.terms.rotation.rotations[:, 1] @ Rotation.from_rotvec([0.0, 0.3, 0.0]).as_matrix()
    figures = measure_robot_motion(body, targets, replace(moved, joint_positions=positions, link_rotations=rotations))
    assert figures.trunk_deg[1] == pytest.approx(np.degrees(0.3))
    assert figures.limited_joint == "left_shin_joint"
    assert figures.at_limit_share >= 0.5


def test_balance_is_kept_as_the_performers(body, contacts, moved):
    """The performer carries his centre of mass 60 mm farther to the left of the standing feet than the robot would."""
    masses, both = body.robot.masses, dict[bool, np.ndarray]()
    for keeps_balance in (False, True):
        balanced = replace(body, map=replace(body.map, keeps_balance=keeps_balance))
        targets = build_targets(balanced, contacts)
        balance = targets.terms.balance
        shifted = balance._replace(places=balance.places + np.array([0.0, 0.06]))
        targets = replace(targets, terms=targets.terms._replace(balance=shifted))
        found = retarget_to_robot(balanced, targets)
        edges, _ = place_points(body.tree, found.references, found.unknowns, body.edge_links, body.edge_offsets)
        term = stand_feet(balanced, targets, edges, 0.001).terms
        is_standing = term.place.weights[:, 1:5, 0] > 0.0
        is_flat = (is_standing[:, ::2] & is_standing[:, 1::2]).any(axis=1)
        assert is_flat.mean() > 0.5
        np.testing.assert_array_equal(term.balance.weights > 0.0, is_flat & keeps_balance)
        weights = is_standing[is_flat, :, None].astype(float)
        middle = (edges[is_flat, :, :2] * weights).sum(axis=1) / weights.sum(axis=1)
        centre = np.average(found.mass_centres, axis=1, weights=masses)[is_flat, :2]
        both[keeps_balance] = np.linalg.norm(centre - middle - shifted.places[is_flat], axis=1)
    assert both[True].mean() < 0.5 * both[False].mean()


def test_standing_soles_keep_their_places(body, contacts, moved):
    count = 0
    for side in SIDES:
        corners = place_corners(body, moved, side)
        for edge, joint in enumerate(FOOT_JOINTS[side]):
            middle = corners[:, 2 * edge : 2 * edge + 2].mean(axis=1)
            for first, last in find_runs(contacts.is_contact[:, contacts.joints.index(joint)]):
                place = middle[first : last + 1]
                assert np.linalg.norm(place - place.mean(axis=0), axis=1).max() < 1e-3
                assert np.abs(place[:, 2]).max() < 1e-3
                count += 1
    assert count > 6


def test_nothing_is_below_the_floor(body, moved):
    lowest = min(place_corners(body, moved, side)[..., 2].min() for side in SIDES)
    each = body.robot.collision
    turns = moved.link_rotations[:, each.links]
    ends = moved.link_positions[:, each.links, None] + np.einsum("tcij,ckj->tcki", turns, each.ends)
    is_foot = np.isin(each.links, [sole.link for sole in body.soles.values()])
    shapes = (ends[..., 2] - each.radii[:, None])[:, ~is_foot]
    assert min(lowest, shapes.min()) > -0.002


def test_positions_and_speeds_are_within_their_limits(body, moved):
    joints, limits = moved.joint_positions, body.robot.limits
    assert (joints >= limits[:, 0] - 1e-9).all()
    assert (joints <= limits[:, 1] + 1e-9).all()
    assert (np.abs(np.diff(joints, axis=0)) * RATE <= body.robot.speed_limits).all()


def test_narrow_limits_are_kept(body, contacts):
    """Knees that hardly bend, and arms that turn slowly."""
    limits, speeds = body.robot.limits.copy(), body.robot.speed_limits.copy()
    for side in SIDES:
        limits[body.robot.joint_names.index(f"{side}_shin_joint")] = 0.1, 0.5
    speeds[[("arm" in name) for name in body.robot.joint_names]] = 0.5
    narrow = replace(body, robot=replace(body.robot, limits=limits, speed_limits=speeds))
    found = retarget_to_robot(narrow, build_targets(narrow, contacts))
    assert (found.joint_positions >= limits[:, 0] - 1e-9).all()
    assert (found.joint_positions <= limits[:, 1] + 1e-9).all()
    assert (np.abs(np.diff(found.joint_positions, axis=0)) * RATE <= speeds + 1e-9).all()


def test_motion_does_not_depend_on_how_a_take_begins(body, contacts, moved):
    later = retarget_to_robot(body, build_targets(body, contacts, CUT))
    margin = CUT // 2
    difference = later.joint_positions[margin:] - moved.joint_positions[CUT + margin :]
    assert np.degrees(np.abs(difference)).max() < 1.0


def test_windows_give_the_motion_that_is_solved_at_once(body, contacts, moved, monkeypatch):
    monkeypatch.setattr(retarget_robot, "WINDOW_S", 2.0)
    parts = retarget_to_robot(body, build_targets(body, contacts))
    assert np.linalg.norm(parts.root_position - moved.root_position, axis=1).max() < 1e-3
    assert np.degrees(np.abs(parts.joint_positions - moved.joint_positions)).max() < 0.5
