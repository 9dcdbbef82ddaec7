"""The body of a robot: found in humanoids with other joints, written and read, and compared with bodies set by hand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from mocapfix.errors import SceneError
from mocapfix.robots.robot import SIDES, LinkPoint, load_robot
from mocapfix.robots.robot_map import find_robot_map, read_robot_map, stand_robot, write_robot_map
from tests.robots.humanoid import LENGTHS, SOLE, build_mjcf, list_parts

pytest.importorskip("mujoco", reason="MuJoCo is in the extra `robot`")
ROBOTS = Path(__file__).resolve().parents[3] / "shared" / "data" / "robots"
needs_robots = pytest.mark.skipif(not ROBOTS.is_dir(), reason="no robots beside the repository")
VARIANTS = {
    "all joints": {},
    "no neck": {"neck": False},
    "no waist": {"waist": False},
    "trunk is the root": {"root": "trunk"},
    "hips yaw, roll, pitch": {"hips": "zxy"},
    "hips yaw, pitch, roll": {"hips": "zyx"},
    "no wrist": {"wrist": False},
    "ankle without roll": {"ankle": "y"},
    "ankle roll, pitch": {"ankle": "xy"},
    "fewest": {"neck": False, "waist": False, "wrist": False, "ankle": "y"},
}


def load(folder, **changes):
    path = folder / "own.xml"
    path.write_text(build_mjcf(list_parts(**changes)), encoding="utf-8")
    return load_robot(path)


@pytest.mark.parametrize("name", VARIANTS)
def test_body_is_found_in_humanoids_with_other_joints(tmp_path, name):
    changes = VARIANTS[name]
    robot = load(tmp_path, **changes)
    found, body = find_robot_map(robot), stand_robot(robot, np.zeros(len(robot.joint_names)))
    names = robot.link_names
    has_waist = changes.get("waist", True)
    assert names[found.pelvis] == "pelvis"
    assert names[found.trunk] == ("trunk" if has_waist else "pelvis")
    assert names[found.head] == ("head" if changes.get("neck", True) else names[found.trunk])
    assert [names[found.feet[side]] for side in SIDES] == ["left_foot", "right_foot"]
    hands = {side: f"{side}_hand" for side in SIDES} if changes.get("wrist", True) else {}
    assert {side: names[link] for side, link in found.hands.items()} == hands
    starts = {"upper_arm": "upper_arm", "forearm": "forearm", "thigh": "thigh", "shin": "shin"}
    for side in SIDES:
        np.testing.assert_allclose(found.soles[side], SOLE, atol=1e-6)
        for limb, link in starts.items():
            near, far = (body.place(point) for point in found.limbs[f"{side}_{limb}"])
            expected = body.positions[names.index(f"{side}_{link}")]
            np.testing.assert_allclose(near, expected, atol=1e-6)
            np.testing.assert_allclose(far - near, [0, 0, -LENGTHS[limb]], atol=1e-6)


def test_written_body_is_read_again(tmp_path):
    robot = load(tmp_path)
    found = replace(find_robot_map(robot), keeps_balance=True)
    write_robot_map(tmp_path / "map.yaml", robot, found)
    read = read_robot_map(tmp_path / "map.yaml", robot)
    assert (read.pelvis, read.trunk, read.head) == (found.pelvis, found.trunk, found.head)
    assert (read.feet, read.hands, read.keeps_balance) == (found.feet, found.hands, True)
    np.testing.assert_allclose(read.standing, found.standing, atol=1e-5)
    for side in SIDES:
        np.testing.assert_allclose(read.soles[side], found.soles[side], atol=1e-5)
    for name, points in found.limbs.items():
        for one, other in zip(read.limbs[name], points, strict=True):
            assert one.link == other.link
            np.testing.assert_allclose(one.position, other.position, atol=1e-5)


def edit(content: dict, *keys, value=None) -> None:
    """Set a value in nested dictionaries, or remove it."""
    for key in keys[:-1]:
        content = content[key]
    if value is None:
        del content[keys[-1]]
    else:
        content[keys[-1]] = value


@pytest.mark.parametrize(
    ("keys", "value", "message"),
    [
        (("pelvis",), "hip", "own has no link hip"),
        (("limbs", "left_thigh", 0, "link"), "leg", "own has no link leg"),
        (("limbs", "left_shin"), None, "left_shin is missing"),
        (("feet", "right"), None, "feet must have right"),
        (("standing",), {"knee": 0.1}, "own has no joint knee"),
        (("trunk",), None, "trunk"),
        (("feet", "left", "sole"), [[0, 0, 0]], "sole"),
        (("heads",), "head", "heads"),
    ],
)
def test_wrong_bodies_are_refused(tmp_path, keys, value, message):
    robot, path = load(tmp_path), tmp_path / "map.yaml"
    write_robot_map(path, robot, find_robot_map(robot))
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    edit(content, *keys, value=value)
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    with pytest.raises(SceneError, match=message) as error:
        read_robot_map(path, robot)
    assert "map.yaml: " in str(error.value)


def test_robots_without_arms_or_that_look_elsewhere_are_refused(tmp_path):
    parts = list_parts()
    legs = [part for part in parts if not any(name in part.name for name in ("arm", "hand"))]
    behind = [
        part._replace(shape=("box", (-0.04, 0, -0.05), (0.11, 0.045, 0.02))) if part.name.endswith("foot") else part
        for part in parts
    ]
    for changed, message in (
        (legs, "found no arm and leg on the left"),
        ([part for part in parts if "right" not in part.name], "found no arm and leg on the right"),
        (behind, "foot must point along X"),
    ):
        path = tmp_path / "own.xml"
        path.write_text(build_mjcf(changed), encoding="utf-8")
        with pytest.raises(SceneError, match=message):
            find_robot_map(load_robot(path))


def test_feet_without_shapes_have_soles_of_usual_size(tmp_path):
    """The soles are below the ankles and ahead of them, and the reason says so."""
    path = tmp_path / "own.xml"
    bare = [part._replace(shape=None) if part.name.endswith("foot") else part for part in list_parts()]
    path.write_text(build_mjcf(bare), encoding="utf-8")
    robot = load_robot(path)
    found = find_robot_map(robot)
    leg_m = LENGTHS["thigh"] + LENGTHS["shin"]
    for side in SIDES:
        np.testing.assert_allclose(found.soles[side][:, 2], -0.07 * leg_m, atol=1e-6)
        np.testing.assert_allclose(np.ptp(found.soles[side], axis=0)[:2], [0.32 * leg_m, 0.12 * leg_m], atol=1e-6)
        assert found.soles[side][:, 0].mean() > 0
    assert "these are of a usual size" in found.reason


def test_forearms_without_wrist_point_to_the_centre_of_mass_of_their_last_part(tmp_path):
    """Its centre of mass is 0.05 m below its joint; the elbow's own is beside this line."""
    path = tmp_path / "own.xml"
    turned = {"offset": (0.03, 0.0, -0.12), "axis": "z", "limits": (-90, 90)}
    parts = [part._replace(**turned) if part.name.endswith("hand") else part for part in list_parts(wrist=False)]
    path.write_text(build_mjcf(parts), encoding="utf-8")
    robot = load_robot(path)
    found, body = find_robot_map(robot), stand_robot(robot, np.zeros(len(robot.joint_names)))
    for side in SIDES:
        near, far = (body.place(point) for point in found.limbs[f"{side}_forearm"])
        direction = (far - near) / np.linalg.norm(far - near)
        np.testing.assert_allclose(direction, np.array([0.03, 0.0, -0.17]) / np.hypot(0.03, 0.17), atol=1e-6)
        assert side not in found.hands


@needs_robots
@pytest.mark.parametrize("folder", ["unitree_g1", "booster_t1", "fourier_n1", "engineai_pm01", "unitree_h1"])
def test_bodies_of_real_robots_are_as_set_by_hand(folder):
    name = folder.split("_")[-1]
    robot = load_robot(ROBOTS / folder / f"{name}.xml")
    expected = yaml.safe_load((ROBOTS / folder / f"{name}.yaml").read_text(encoding="utf-8"))
    found, body = find_robot_map(robot), stand_robot(robot, np.zeros(len(robot.joint_names)))

    def place(point) -> np.ndarray:
        link, *position = [point, 0, 0, 0] if isinstance(point, str) else point
        return body.place(LinkPoint(robot.link_names.index(link), np.array(position, float)))

    assert robot.link_names[found.pelvis] == expected["pelvis"]
    assert expected["trunk"] in [robot.link_names[link] for link in body.list_fixed_links(found.trunk)]
    assert [robot.link_names[found.feet[side]] for side in SIDES] == [expected["feet"][side]["body"] for side in SIDES]
    for limb, ends in found.limbs.items():
        near, far = (body.place(point) for point in ends)
        start, end = (place(point) for point in expected["limbs"][limb.replace("shin", "shank")])
        cosine = (far - near) @ (end - start) / np.linalg.norm(far - near) / np.linalg.norm(end - start)
        assert np.degrees(np.arccos(min(cosine, 1.0))) < 2.0, limb
