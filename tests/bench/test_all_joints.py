"""All joints given: what a prior may not change, and twists of known size."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix import prior
from mocapfix.bench import all_joints, contenders, unseen
from mocapfix.bench.contenders import placed
from mocapfix.prior import models
from mocapfix.skeleton import cmu31

SKELETON = cmu31().skeleton
MIDDLE = prior.load("mean-pose", SKELETON).rotations
NONE = np.zeros((4, 3))


@pytest.fixture(scope="module")
def poses():
    return unseen.shipped()[::250]


def test_bones_are_joints_with_one_child_some_way_off():
    bones, children = all_joints.bones_of(SKELETON)
    names = {SKELETON.names[bone]: SKELETON.names[child] for bone, child in zip(bones, children, strict=True)}
    assert names["LeftArm"] == "LeftForeArm"
    assert not {"Hips", "Spine1", "LeftHand", "Head", "LThumb"} & set(names)


@pytest.mark.parametrize("angle", [0.3, -0.3, 3.0])
def test_a_twist_is_the_turn_about_the_bone_and_nothing_else(poses, angle):
    truth, twisted = placed(SKELETON, NONE, poses), poses.copy()
    arm, elbow = SKELETON.index("LeftArm"), SKELETON.index("LeftForeArm")
    along = SKELETON.offsets[elbow] / np.linalg.norm(SKELETON.offsets[elbow])
    turn = Rotation.from_rotvec(angle * along).as_matrix()
    twisted[:, arm] = twisted[:, arm] @ turn
    twisted[:, elbow] = turn.T @ twisted[:, elbow]
    found = all_joints.twists(SKELETON, placed(SKELETON, NONE, twisted), truth)
    bones = all_joints.bones_of(SKELETON)[0]
    np.testing.assert_allclose(found[:, bones == arm], abs(angle), atol=1e-6)
    np.testing.assert_allclose(found[:, bones != arm], 0, atol=1e-6)


def test_swinging_a_bone_is_no_twist(poses):
    truth, swung = placed(SKELETON, NONE, poses), poses.copy()
    arm, elbow = SKELETON.index("RightArm"), SKELETON.index("RightForeArm")
    swung[:, arm] = swung[:, arm] @ Rotation.from_rotvec(0.4 * np.cross(SKELETON.offsets[elbow], [0, 1, 0])).as_matrix()
    found = all_joints.twists(SKELETON, placed(SKELETON, NONE, swung), truth)
    np.testing.assert_allclose(found[:, all_joints.bones_of(SKELETON)[0] == arm], 0, atol=1e-6)


def test_bias_is_against_the_solve_without_a_prior_and_the_noise_is_the_same_for_all(poses, monkeypatch):
    off, tasks = {None: 0.0, "biased": 0.002}, []

    def solve(task, model, start):
        tasks.append(task)
        return placed(SKELETON, NONE + [off[model], 0, 0], poses)

    monkeypatch.setattr(contenders, "solve", solve)
    shelf: dict[str, Any] = {"none": None, "biased": "biased"}
    said = all_joints.measure(poses, shelf, MIDDLE, lambda what: None)
    assert said["none"] == pytest.approx({"bias_mm": 0, "noisy_mm": 0, "twist_deg": 0}, abs=1e-4)
    assert said["biased"] == pytest.approx({"bias_mm": 2, "noisy_mm": 2, "twist_deg": 0}, abs=1e-4)
    exact, noisy, again, noisy_again = tasks
    np.testing.assert_array_equal(noisy.places, noisy_again.places)
    np.testing.assert_array_equal(exact.places, again.places)
    assert (noisy.places - exact.places).std() == pytest.approx(all_joints.SD, rel=0.1)


def test_without_a_prior_exact_places_are_met_and_with_one_twists_are_fewer(poses):
    shelf = {"none": None, "gaussian": models.load("gaussian", SKELETON)}
    said = all_joints.measure(poses, shelf, MIDDLE, lambda what: None)
    assert said["none"]["bias_mm"] == 0
    assert 0 < said["gaussian"]["bias_mm"] < 5
    assert said["gaussian"]["twist_deg"] < said["none"]["twist_deg"]
