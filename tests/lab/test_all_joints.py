"""All joints given: errors of a prior, and twists of known size."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.lab import pose_priors, sound_takes
from mocapfix.lab.compared_priors import ComparedPriors, place_with_joints
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import mean_pose, trained_priors

SKELETON = load_cmu31_body().skeleton
REFERENCE = mean_pose.load_mean_pose_prior("mean-pose", SKELETON).mean_rotations
ORIGIN = np.zeros((4, 3))


@pytest.fixture(scope="module")
def poses():
    return sound_takes.load_unseen_poses()[::250]


def test_twist_bones_have_one_child_at_some_distance():
    bones, children = pose_priors.find_twist_bones(SKELETON)
    names = {SKELETON.names[bone]: SKELETON.names[child] for bone, child in zip(bones, children, strict=True)}
    assert names["LeftArm"] == "LeftForeArm"
    assert not {"Hips", "Spine1", "LeftHand", "Head", "LThumb"} & set(names)


@pytest.mark.parametrize("angle", [0.3, -0.3, 3.0])
def test_twist_error_is_the_rotation_about_the_bone(poses, angle):
    truth, twisted = place_with_joints(SKELETON, ORIGIN, poses), poses.copy()
    arm, elbow = SKELETON.find_joint("LeftArm"), SKELETON.find_joint("LeftForeArm")
    direction = SKELETON.offsets[elbow] / np.linalg.norm(SKELETON.offsets[elbow])
    rotation = Rotation.from_rotvec(angle * direction).as_matrix()
    twisted[:, arm] = twisted[:, arm] @ rotation
    twisted[:, elbow] = rotation.T @ twisted[:, elbow]
    errors = pose_priors.compute_bone_twist_errors(SKELETON, place_with_joints(SKELETON, ORIGIN, twisted), truth)
    bones = pose_priors.find_twist_bones(SKELETON)[0]
    np.testing.assert_allclose(errors[:, bones == arm], abs(angle), atol=1e-6)
    np.testing.assert_allclose(errors[:, bones != arm], 0, atol=1e-6)


def test_swing_of_a_bone_is_not_a_twist(poses):
    truth, rotated = place_with_joints(SKELETON, ORIGIN, poses), poses.copy()
    arm, elbow = SKELETON.find_joint("RightArm"), SKELETON.find_joint("RightForeArm")
    rotated[:, arm] = rotated[:, arm] @ Rotation.from_rotvec(0.4 * np.cross(SKELETON.offsets[elbow], [0, 1, 0])).as_matrix()
    errors = pose_priors.compute_bone_twist_errors(SKELETON, place_with_joints(SKELETON, ORIGIN, rotated), truth)
    np.testing.assert_allclose(errors[:, pose_priors.find_twist_bones(SKELETON)[0] == arm], 0, atol=1e-6)


def test_bias_is_relative_to_no_prior_and_noise_is_the_same_for_all(poses, monkeypatch):
    offsets, tasks = {None: 0.0, "biased": 0.002}, []

    def solve(task, model, start):
        tasks.append(task)
        return place_with_joints(SKELETON, ORIGIN + [offsets[model], 0, 0], poses)

    monkeypatch.setattr(pose_priors, "solve_joint_task", solve)
    priors: dict[str, Any] = {"none": None, "biased": "biased"}
    results = pose_priors.measure_all_joints(poses, priors, REFERENCE, lambda text: None)
    assert results["none"] == pytest.approx({"bias_mm": 0, "noisy_mm": 0, "twist_deg": 0}, abs=1e-4)
    assert results["biased"] == pytest.approx({"bias_mm": 2, "noisy_mm": 2, "twist_deg": 0}, abs=1e-4)
    exact, noisy, again, noisy_again = tasks
    np.testing.assert_array_equal(noisy.given_positions, noisy_again.given_positions)
    np.testing.assert_array_equal(exact.given_positions, again.given_positions)
    assert (noisy.given_positions - exact.given_positions).std() == pytest.approx(pose_priors.ALL_JOINTS_SD_M, rel=0.1)


def test_exact_positions_are_met_without_a_prior_and_twists_are_better_with_one(poses):
    priors: ComparedPriors = {"none": None, "gaussian": trained_priors.load_pose_model("gaussian", SKELETON)}
    results = pose_priors.measure_all_joints(poses, priors, REFERENCE, lambda text: None)
    assert results["none"]["bias_mm"] == 0
    assert 0 < results["gaussian"]["bias_mm"] < 5
    assert results["gaussian"]["twist_deg"] < results["none"]["twist_deg"]
