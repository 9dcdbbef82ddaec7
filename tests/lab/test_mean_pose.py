"""Fitting the mean pose to rotations whose mean and covariance are known."""

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.io.shipped import find_shipped_folder
from mocapfix.lab import body_statistics
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import mean_pose

MIRROR = np.diag([-1.0, 1.0, 1.0])
MEAN = Rotation.from_rotvec([0.4, -0.7, 0.3]).as_matrix()
COVARIANCE = np.array([[0.16, 0.03, -0.02], [0.03, 0.09, 0.01], [-0.02, 0.01, 0.06]])
NAMES = ["Hips", "LeftArm", "RightArm", "LeftForeArm", "RightForeArm", "Head", "LThumb", "RThumb"]


def get_covariance(joint):
    return mean_pose.build_symmetric_matrix(joint["covariance"])


def get_rotation(joint):
    return Rotation.from_quat(joint["quaternion_xyzw"]).as_matrix()


@pytest.fixture(scope="module")
def fitted():
    """Fit subjects whose arms have MEAN and COVARIANCE, mirrored on the right, who nod and do not move otherwise."""
    rng, count = np.random.default_rng(0), 8000
    rotations = {name: np.tile(np.eye(3), (count, 1, 1)) for name in NAMES}
    for side, mirror in (("Left", np.eye(3)), ("Right", MIRROR)):
        difference = Rotation.from_rotvec(rng.multivariate_normal(np.zeros(3), COVARIANCE, count)).as_matrix()
        rotations[f"{side}Arm"] = mirror @ difference @ MEAN @ mirror
    rotations["Head"] = Rotation.from_rotvec(rng.normal(0, 0.4, (count, 1)) * [1.0, 0, 0] + [0, 0.2, 0]).as_matrix()
    euler = np.stack([Rotation.from_matrix(rotations[name]).as_euler("ZYX", degrees=True) for name in NAMES], axis=1)
    return body_statistics.fit_mean_pose(NAMES, euler, np.arange(count) // 100)


def test_fit_recovers_mean_and_covariance(fitted):
    assert list(fitted) == NAMES[1:]
    np.testing.assert_allclose(get_rotation(fitted["LeftArm"]), MEAN, atol=0.015)
    np.testing.assert_allclose(get_covariance(fitted["LeftArm"]), COVARIANCE, atol=0.008)


def test_sides_are_symmetric(fitted):
    left, right = fitted["LeftArm"], fitted["RightArm"]
    np.testing.assert_allclose(get_rotation(right), MIRROR @ get_rotation(left) @ MIRROR, atol=1e-4)
    np.testing.assert_allclose(get_covariance(right), MIRROR @ get_covariance(left) @ MIRROR, atol=1e-4)


def test_mean_of_the_head_is_symmetric(fitted):
    np.testing.assert_allclose(fitted["Head"]["quaternion_xyzw"][1:3], 0, atol=1e-4)
    assert get_covariance(fitted["Head"])[1, 1] == pytest.approx(0.2**2, rel=0.1)  # 0.2 to either side


def test_joint_that_never_rotates_is_locked_about_every_axis(fitted):
    np.testing.assert_allclose(get_covariance(fitted["LThumb"]), np.eye(3) * body_statistics.LOCKED_JOINT_SD_RAD**2, atol=1e-5)
    np.testing.assert_allclose(np.abs(np.linalg.det(fitted["LThumb"]["locked_axes"])), 1.0, atol=1e-4)
    assert fitted["LeftArm"]["locked_axes"] == []


@given(st.integers(0, 2**32 - 1))
def test_hinge_is_locked_across_its_axis_only(seed):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    angles = rng.normal(0, 0.5, (60, 1))
    covariance, locked = body_statistics.compute_pose_covariance(
        Rotation.from_rotvec(angles * axis).as_matrix(), is_forearm=False
    )
    assert locked.shape == (2, 3)
    np.testing.assert_allclose(locked @ axis, 0, atol=1e-6)
    assert axis @ covariance @ axis == pytest.approx((angles**2).mean(), rel=1e-6)
    np.testing.assert_allclose(locked @ covariance @ locked.T, np.eye(2) * body_statistics.HINGE_CROSS_AXIS_SD_RAD**2, atol=1e-9)


def test_elbow_gets_the_twist_of_the_forearm():
    angles = np.random.default_rng(2).normal(0, 0.6, (60, 1))
    covariance, locked = body_statistics.compute_pose_covariance(
        Rotation.from_rotvec(angles * [[0.0, 0.8, 0.6]]).as_matrix(), is_forearm=True
    )
    assert covariance[0, 0] == pytest.approx(body_statistics.FOREARM_TWIST_SD_RAD**2)
    np.testing.assert_allclose(np.abs(locked), [[0, 0.6, 0.8]], atol=1e-6)
    assert locked[0] @ covariance @ locked[0] == pytest.approx(body_statistics.HINGE_CROSS_AXIS_SD_RAD**2)


@given(st.integers(0, 2**32 - 1))
def test_covariance_of_a_free_joint_is_the_second_moment(seed):
    rng = np.random.default_rng(seed)
    vectors = rng.normal(size=(50, 3)) * rng.uniform(0.1, 0.5, 3)
    covariance, locked = body_statistics.compute_pose_covariance(Rotation.from_rotvec(vectors).as_matrix(), is_forearm=True)
    assert locked.shape == (0, 3)
    np.testing.assert_allclose(covariance, vectors.T @ vectors / 50, atol=1e-9)


def test_between_take_covariance_is_separated_from_that_within_takes():
    rng, takes = np.random.default_rng(3), np.repeat(np.arange(400), 50)
    take_means, poses = rng.normal(0, 0.1, (400, 3)) * [1.0, 2.0, 0.0], rng.normal(0, 0.2, (len(takes), 3))
    difference = Rotation.from_rotvec(take_means[takes] + poses).as_matrix()
    covariance = body_statistics.compute_between_take_covariance(difference, takes, np.zeros((0, 3)))
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), np.hypot([0.1, 0.2, 0.0], 0.2 / np.sqrt(50)), rtol=0.1)
    np.testing.assert_allclose(
        body_statistics.compute_between_take_covariance(difference, takes, np.array([[0.0, 1.0, 0.0]]))[1], 0, atol=1e-12
    )


def test_between_take_covariance_is_less_than_the_total(fitted):
    for name in ("LeftArm", "RightForeArm", "LThumb"):
        covariance, between = (mean_pose.build_symmetric_matrix(fitted[name][key]) for key in ("covariance", "between_takes"))
        assert np.linalg.eigvalsh(covariance - between).min() > 0


@given(st.integers(0, 2**32 - 1))
def test_chordal_mean_is_a_rotation_and_equivariant(seed):
    rng = np.random.default_rng(seed)
    several = Rotation.from_rotvec(rng.normal(0, 0.5, (6, 3))).as_matrix()
    by = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    mean = body_statistics.compute_chordal_mean_rotation(several)
    assert np.linalg.det(mean) == pytest.approx(1)
    np.testing.assert_allclose(body_statistics.compute_chordal_mean_rotation(by @ several), by @ mean, atol=1e-6)


def test_chordal_mean_of_half_rotations_is_not_a_reflection():
    half = Rotation.from_rotvec(np.pi * np.eye(3)).as_matrix()
    assert np.linalg.det(body_statistics.compute_chordal_mean_rotation(half)) == pytest.approx(1)


def test_written_mean_pose_loads(tmp_path, monkeypatch):
    names, count = list(load_cmu31_body().skeleton.names), 40
    angles = np.random.default_rng(1).uniform(-20, 20, (count, len(names), 3))
    (tmp_path / "skeletons.json").write_text(f'{{"joints": {names}}}'.replace("'", '"'), encoding="utf-8")
    np.savez(tmp_path / "train-0.npz", euler=np.round(angles / 180 * 32767).astype(np.int16), length=[30, 10])
    body_statistics.write_mean_pose(str(tmp_path), str(tmp_path / "mine.yaml"))
    text = (tmp_path / "mine.yaml").read_text(encoding="utf-8")
    assert "40 frames of 2 trials" in text
    monkeypatch.setattr(mean_pose, "find_shipped_folder", lambda _: tmp_path)
    loaded = mean_pose.load_mean_pose_prior("mine", load_cmu31_body().skeleton)
    expected = body_statistics.fit_mean_pose(names, angles, np.repeat([0, 1], [30, 10]))["LeftArm"]
    np.testing.assert_allclose(loaded.mean_rotations[names.index("LeftArm")], get_rotation(expected), atol=1e-3)
    shipped = yaml.safe_load((find_shipped_folder("priors") / "mean-pose.yaml").read_text(encoding="utf-8"))
    assert yaml.safe_load(text)["joints"].keys() == shipped["joints"].keys()
