"""All joints given: what a prior may not change, and twists of known size."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.bench import all_joints, compared_priors, unseen_poses
from mocapfix.bench.compared_priors import place_known_poses
from mocapfix.pose_prior import io, mean_pose
from mocapfix.skeleton import load_cmu31_body

SKELETON = load_cmu31_body().skeleton
MIDDLE = mean_pose.load_mean_pose_prior("mean-pose", SKELETON).mean_rotations
NONE = np.zeros((4, 3))


@pytest.fixture(scope="module")
def poses():
    return unseen_poses.load_unseen_poses()[::250]


def test_bones_are_joints_with_one_child_some_way_off():
    bones, children = all_joints.find_twist_bones(SKELETON)
    names = {SKELETON.names[bone]: SKELETON.names[child] for bone, child in zip(bones, children, strict=True)}
    assert names["LeftArm"] == "LeftForeArm"
    assert not {"Hips", "Spine1", "LeftHand", "Head", "LThumb"} & set(names)


@pytest.mark.parametrize("angle", [0.3, -0.3, 3.0])
def test_a_twist_is_the_turn_about_the_bone_and_nothing_else(poses, angle):
    truth, twisted = place_known_poses(SKELETON, NONE, poses), poses.copy()
    arm, elbow = SKELETON.find_joint("LeftArm"), SKELETON.find_joint("LeftForeArm")
    along = SKELETON.offsets[elbow] / np.linalg.norm(SKELETON.offsets[elbow])
    turn = Rotation.from_rotvec(angle * along).as_matrix()
    twisted[:, arm] = twisted[:, arm] @ turn
    twisted[:, elbow] = turn.T @ twisted[:, elbow]
    found = all_joints.compute_bone_twist_errors(SKELETON, place_known_poses(SKELETON, NONE, twisted), truth)
    bones = all_joints.find_twist_bones(SKELETON)[0]
    np.testing.assert_allclose(found[:, bones == arm], abs(angle), atol=1e-6)
    np.testing.assert_allclose(found[:, bones != arm], 0, atol=1e-6)


def test_swinging_a_bone_is_no_twist(poses):
    truth, swung = place_known_poses(SKELETON, NONE, poses), poses.copy()
    arm, elbow = SKELETON.find_joint("RightArm"), SKELETON.find_joint("RightForeArm")
    swung[:, arm] = swung[:, arm] @ Rotation.from_rotvec(0.4 * np.cross(SKELETON.offsets[elbow], [0, 1, 0])).as_matrix()
    found = all_joints.compute_bone_twist_errors(SKELETON, place_known_poses(SKELETON, NONE, swung), truth)
    np.testing.assert_allclose(found[:, all_joints.find_twist_bones(SKELETON)[0] == arm], 0, atol=1e-6)


def test_bias_is_against_the_solve_without_a_prior_and_the_noise_is_the_same_for_all(poses, monkeypatch):
    off, tasks = {None: 0.0, "biased": 0.002}, []

    def solve(task, model, start):
        tasks.append(task)
        return place_known_poses(SKELETON, NONE + [off[model], 0, 0], poses)

    monkeypatch.setattr(compared_priors, "solve", solve)
    shelf: dict[str, Any] = {"none": None, "biased": "biased"}
    said = all_joints.measure_all_joints(poses, shelf, MIDDLE, lambda what: None)
    assert said["none"] == pytest.approx({"bias_mm": 0, "noisy_mm": 0, "twist_deg": 0}, abs=1e-4)
    assert said["biased"] == pytest.approx({"bias_mm": 2, "noisy_mm": 2, "twist_deg": 0}, abs=1e-4)
    exact, noisy, again, noisy_again = tasks
    np.testing.assert_array_equal(noisy.given_positions, noisy_again.given_positions)
    np.testing.assert_array_equal(exact.given_positions, again.given_positions)
    assert (noisy.given_positions - exact.given_positions).std() == pytest.approx(all_joints.ALL_JOINTS_SD_M, rel=0.1)


def test_without_a_prior_exact_places_are_met_and_with_one_twists_are_fewer(poses):
    shelf = {"none": None, "gaussian": io.load_pose_model("gaussian", SKELETON)}
    said = all_joints.measure_all_joints(poses, shelf, MIDDLE, lambda what: None)
    assert said["none"]["bias_mm"] == 0
    assert 0 < said["gaussian"]["bias_mm"] < 5
    assert said["gaussian"]["twist_deg"] < said["none"]["twist_deg"]
