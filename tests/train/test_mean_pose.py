"""The fit of the mean pose, on rotations whose mean and spread are known."""

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.files.shipped import find_shipped_folder
from mocapfix.pose_prior import mean_pose as prior
from mocapfix.skeleton import load_cmu31_body
from mocapfix.train import mean_pose

MIRROR = np.diag([-1.0, 1.0, 1.0])
MEAN = Rotation.from_rotvec([0.4, -0.7, 0.3]).as_matrix()
SPREAD = np.array([[0.16, 0.03, -0.02], [0.03, 0.09, 0.01], [-0.02, 0.01, 0.06]])
NAMES = ["Hips", "LeftArm", "RightArm", "LeftForeArm", "RightForeArm", "Head", "LThumb", "RThumb"]


def covariance_of(joint):
    return prior.build_symmetric_matrix(joint["covariance"])


def rotation_of(joint):
    return Rotation.from_quat(joint["quaternion_xyzw"]).as_matrix()


@pytest.fixture(scope="module")
def fitted():
    """People whose arms stray from MEAN by SPREAD, mirrored on the other side, whose heads nod and whose rest is still."""
    rng, count = np.random.default_rng(0), 8000
    turns = {name: np.tile(np.eye(3), (count, 1, 1)) for name in NAMES}
    for side, mirror in (("Left", np.eye(3)), ("Right", MIRROR)):
        away = Rotation.from_rotvec(rng.multivariate_normal(np.zeros(3), SPREAD, count)).as_matrix()
        turns[f"{side}Arm"] = mirror @ away @ MEAN @ mirror
    turns["Head"] = Rotation.from_rotvec(rng.normal(0, 0.4, (count, 1)) * [1.0, 0, 0] + [0, 0.2, 0]).as_matrix()
    euler = np.stack([Rotation.from_matrix(turns[name]).as_euler("ZYX", degrees=True) for name in NAMES], axis=1)
    return mean_pose.fit_mean_pose(NAMES, euler, np.arange(count) // 100)


def test_mean_and_covariance_are_found_again(fitted):
    assert list(fitted) == NAMES[1:]
    np.testing.assert_allclose(rotation_of(fitted["LeftArm"]), MEAN, atol=0.015)
    np.testing.assert_allclose(covariance_of(fitted["LeftArm"]), SPREAD, atol=0.008)


def test_the_other_side_is_the_mirror_image(fitted):
    left, right = fitted["LeftArm"], fitted["RightArm"]
    np.testing.assert_allclose(rotation_of(right), MIRROR @ rotation_of(left) @ MIRROR, atol=1e-4)
    np.testing.assert_allclose(covariance_of(right), MIRROR @ covariance_of(left) @ MIRROR, atol=1e-4)


def test_a_head_turned_to_one_side_has_its_mean_in_the_middle(fitted):
    np.testing.assert_allclose(fitted["Head"]["quaternion_xyzw"][1:3], 0, atol=1e-4)
    assert covariance_of(fitted["Head"])[1, 1] == pytest.approx(0.2**2, rel=0.1)  # each straying 0.2 to its own side


def test_a_joint_that_never_turns_is_held_about_every_axis(fitted):
    np.testing.assert_allclose(covariance_of(fitted["LThumb"]), np.eye(3) * mean_pose.LOCKED_JOINT_SD_RAD**2, atol=1e-5)
    np.testing.assert_allclose(np.abs(np.linalg.det(fitted["LThumb"]["held"])), 1.0, atol=1e-4)
    assert fitted["LeftArm"]["held"] == []


@given(st.integers(0, 2**32 - 1))
def test_a_hinge_is_held_across_its_axis_and_keeps_its_own_spread(seed):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    angles = rng.normal(0, 0.5, (60, 1))
    found, held = mean_pose.compute_pose_covariance(Rotation.from_rotvec(angles * axis).as_matrix(), is_forearm=False)
    assert held.shape == (2, 3)
    np.testing.assert_allclose(held @ axis, 0, atol=1e-6)
    assert axis @ found @ axis == pytest.approx((angles**2).mean(), rel=1e-6)
    np.testing.assert_allclose(held @ found @ held.T, np.eye(2) * mean_pose.HINGE_CROSS_AXIS_SD_RAD**2, atol=1e-9)


def test_an_elbow_is_given_the_forearms_turn():
    angles = np.random.default_rng(2).normal(0, 0.6, (60, 1))
    found, held = mean_pose.compute_pose_covariance(Rotation.from_rotvec(angles * [[0.0, 0.8, 0.6]]).as_matrix(), is_forearm=True)
    assert found[0, 0] == pytest.approx(mean_pose.FOREARM_TWIST_SD_RAD**2)
    np.testing.assert_allclose(np.abs(held), [[0, 0.6, 0.8]], atol=1e-6)


@given(st.integers(0, 2**32 - 1))
def test_a_joint_that_turns_every_way_has_the_moment_of_its_turns(seed):
    rng = np.random.default_rng(seed)
    vectors = rng.normal(size=(50, 3)) * rng.uniform(0.1, 0.5, 3)
    found, held = mean_pose.compute_pose_covariance(Rotation.from_rotvec(vectors).as_matrix(), is_forearm=True)
    assert held.shape == (0, 3)
    np.testing.assert_allclose(found, vectors.T @ vectors / 50, atol=1e-9)


def test_what_lies_between_takes_is_told_from_what_lies_within_them():
    rng, takes = np.random.default_rng(3), np.repeat(np.arange(400), 50)
    own, poses = rng.normal(0, 0.1, (400, 3)) * [1.0, 2.0, 0.0], rng.normal(0, 0.2, (len(takes), 3))
    away = Rotation.from_rotvec(own[takes] + poses).as_matrix()
    found = mean_pose.compute_between_take_covariance(away, takes, np.zeros((0, 3)))
    np.testing.assert_allclose(np.sqrt(np.diag(found)), np.hypot([0.1, 0.2, 0.0], 0.2 / np.sqrt(50)), rtol=0.1)
    np.testing.assert_allclose(
        mean_pose.compute_between_take_covariance(away, takes, np.array([[0.0, 1.0, 0.0]]))[1], 0, atol=1e-12
    )


def test_no_more_lies_between_takes_than_there_is(fitted):
    for name in ("LeftArm", "RightForeArm", "LThumb"):
        c, apart = (prior.build_symmetric_matrix(fitted[name][key]) for key in ("covariance", "between"))
        assert np.linalg.eigvalsh(c - apart).min() > 0


@given(st.integers(0, 2**32 - 1))
def test_the_mean_rotation_is_one_and_turns_with_its_rotations(seed):
    rng = np.random.default_rng(seed)
    several = Rotation.from_rotvec(rng.normal(0, 0.5, (6, 3))).as_matrix()
    by = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    mean = mean_pose.compute_chordal_mean_rotation(several)
    assert np.linalg.det(mean) == pytest.approx(1)
    np.testing.assert_allclose(mean_pose.compute_chordal_mean_rotation(by @ several), by @ mean, atol=1e-6)


def test_the_mean_of_a_few_half_turns_is_still_no_reflection():
    half = Rotation.from_rotvec(np.pi * np.eye(3)).as_matrix()
    assert np.linalg.det(mean_pose.compute_chordal_mean_rotation(half)) == pytest.approx(1)


def test_a_fitted_file_is_a_prior_that_loads(tmp_path, monkeypatch):
    names, count = list(load_cmu31_body().skeleton.names), 40
    angles = np.random.default_rng(1).uniform(-20, 20, (count, len(names), 3))
    (tmp_path / "skeletons.json").write_text(f'{{"joints": {names}}}'.replace("'", '"'))
    np.savez(tmp_path / "train-0.npz", euler=np.round(angles / 180 * 32767).astype(np.int16), length=[30, 10])
    mean_pose.write_mean_pose(str(tmp_path), str(tmp_path / "mine.yaml"))
    text = (tmp_path / "mine.yaml").read_text(encoding="utf-8")
    assert "40 frames of 2 trials" in text
    monkeypatch.setattr(prior, "folder", lambda _: tmp_path)
    loaded = prior.load_mean_pose_prior("mine", load_cmu31_body().skeleton)
    expected = mean_pose.fit_mean_pose(names, angles, np.repeat([0, 1], [30, 10]))["LeftArm"]
    np.testing.assert_allclose(loaded.mean_rotations[names.index("LeftArm")], rotation_of(expected), atol=1e-3)
    shipped = yaml.safe_load((find_shipped_folder("priors") / "mean-pose.yaml").read_text(encoding="utf-8"))
    assert yaml.safe_load(text)["joints"].keys() == shipped["joints"].keys()
