"""From a take to the files of a robot by the command line, read back as their users read them."""

import json
import pickle
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.robots.humanoid import build_mjcf, list_parts

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is in the extra `robot`")
FRAMES, FPS = 50, 50  # of the brief take, at the rate that is asked for

LEGLESS = [part for part in list_parts() if not any(name in part.name for name in ("thigh", "shin", "foot"))]


@pytest.fixture
def robot(tmp_path) -> Path:
    path = tmp_path / "own.xml"
    path.write_text(build_mjcf(list_parts()), encoding="utf-8")
    return path


@pytest.fixture
def folder(mocapfix, brief, robot, tmp_path) -> Path:
    also = "robot-npz,robot-csv,robot-pkl"
    named = ("--subject", brief.subject, "--character", robot, "--out", tmp_path / "out")
    status, out, err = mocapfix("clean", brief.path, *named, "--fps", FPS, "--also", also)
    assert (status, err) == (0, "")
    for suffix in ("npz", "glb", "map.yaml", "csv", "columns.json", "pkl"):
        assert f"brief.own.{suffix}" in out
    return tmp_path / "out"


def test_mujoco_plays_the_files_of_a_take(folder, robot):
    """MuJoCo's own kinematics of `qpos` give the places, rotations and velocities of the links that the NPZ states."""
    with np.load(folder / "brief.own.npz") as arrays:
        content = dict(arrays)
    model = mujoco.MjModel.from_xml_path(str(robot))
    data, bodies = mujoco.MjData(model), [model.body(name).id for name in content["body_names"]]
    assert content["fps"] == FPS
    assert content["qpos"].shape == (FRAMES, model.nq)
    assert [model.joint(name).qposadr[0] for name in content["joint_names"]] == [*range(7, model.nq)]
    places, turns, centres = [], [], []
    for qpos in content["qpos"]:
        data.qpos = qpos
        mujoco.mj_kinematics(model, data)
        for found, values in ((places, data.xpos), (turns, data.xmat), (centres, data.xipos)):
            found.append(values[bodies].copy())
    np.testing.assert_allclose(content["body_pos_w"], places, atol=1e-9)
    matrices = Rotation.from_quat(content["body_quat_w"][..., [1, 2, 3, 0]].reshape(-1, 4)).as_matrix()
    np.testing.assert_allclose(matrices.reshape(FRAMES, len(bodies), 9), turns, atol=1e-9)
    np.testing.assert_allclose(content["body_lin_vel_w"], np.gradient(centres, 1 / FPS, axis=0), atol=1e-6)
    np.testing.assert_allclose(content["joint_vel"], np.gradient(content["joint_pos"], 1 / FPS, axis=0), atol=1e-9)
    np.testing.assert_array_equal(content["root_pos"], content["body_pos_w"][:, 0])
    assert 0.0 < np.array(places)[..., 2].min() < 0.2  # an ankle is the lowest: it stands on the floor at height 0


def test_all_formats_have_the_same_motion(folder):
    with np.load(folder / "brief.own.npz") as arrays:
        qpos, names = arrays["qpos"], arrays["joint_names"].tolist()
    table = np.loadtxt(folder / "brief.own.csv", delimiter=",")
    columns = json.loads((folder / "brief.own.columns.json").read_text(encoding="utf-8"))
    content = pickle.loads((folder / "brief.own.pkl").read_bytes())
    order = [0, 1, 2, 4, 5, 6, 3, *range(7, qpos.shape[1])]  # x y z w instead of w x y z
    np.testing.assert_allclose(table, qpos[:, order], atol=1e-6)
    joined = np.hstack([content["root_pos"], content["root_rot"], content["dof_pos"]])
    np.testing.assert_allclose(joined, qpos[:, order], atol=1e-12)
    assert (columns["columns"][7:], columns["fps"], content["fps"]) == (names, FPS, FPS)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<mujoco><worldbody><body", "own.xml: MuJoCo cannot read this robot: "),
        ("<mujoco><worldbody><body><geom size='1'/></body></worldbody></mujoco>", "no tree of links with joints was found"),
        (build_mjcf(LEGLESS), "own: found no arm and leg on the left; a robot has both"),
    ],
)
def test_a_file_that_is_no_humanoid_is_refused_in_one_sentence(mocapfix, brief, robot, tmp_path, text, message):
    robot.write_text(text, encoding="utf-8")
    status, out, err = mocapfix("clean", brief.path, "--character", robot, "--out", tmp_path / "out")
    assert (status, out) == (2, "")
    assert message in " ".join(err.split())
    assert not (tmp_path / "out").exists()
