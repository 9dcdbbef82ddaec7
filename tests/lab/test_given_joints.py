"""MNN-IK's test: equal tasks for every prior, and known errors."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.lab import compared_priors, pose_priors
from mocapfix.lab.compared_priors import ComparedPriors, build_joint_task, place_with_joints
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import mean_pose, trained_priors

SKELETON = load_cmu31_body().skeleton
REFERENCE = mean_pose.load_mean_pose_prior("mean-pose", SKELETON).mean_rotations


@pytest.fixture(scope="module")
def poses():
    """Return poses (6, 31, 3, 3) near the mean pose, without heading."""
    rng = np.random.default_rng(0)
    rotations = Rotation.from_rotvec(rng.normal(0, 0.2, (6 * 31, 3))).as_matrix().reshape(6, 31, 3, 3) @ REFERENCE
    rotations[:, 0] = np.eye(3)
    return rotations


@pytest.mark.parametrize("count", pose_priors.GIVEN_JOINT_COUNTS)
def test_given_joints_are_drawn_for_every_pose_reproducibly(count):
    joints = pose_priors.draw_given_joints(50, 31, count)
    assert (joints.sum(axis=1) == count).all()
    np.testing.assert_array_equal(joints, pose_priors.draw_given_joints(50, 31, count))
    assert len(np.unique(joints, axis=0)) > 45
    assert joints.any(axis=0).all()


def test_all_priors_solve_the_same_tasks_from_the_same_start(poses, monkeypatch):
    tasks = {}

    def solve(task, model, start):
        tasks.setdefault(model is None, []).append(task)
        np.testing.assert_array_equal(start[1], np.tile(REFERENCE, (12, 1, 1, 1)))
        return place_with_joints(SKELETON, *start)

    monkeypatch.setattr(pose_priors, "solve_joint_task", solve)
    messages: list[str] = []
    priors: ComparedPriors = {"one": None, "other": trained_priors.load_pose_model("gaussian", SKELETON)}
    pose_priors.measure_given_joints(poses, priors, REFERENCE, 2, messages.append)
    for one, other in zip(tasks[True], tasks[False], strict=True):
        np.testing.assert_array_equal(one.is_given, other.is_given)
        np.testing.assert_array_equal(one.given_positions, other.given_positions)
    assert [int(task.is_given[0].sum()) for task in tasks[True]] == [6, 8, 10, 15]
    assert not np.array_equal(tasks[True][0].is_given[:6], tasks[True][0].is_given[6:])  # the second set differs
    assert messages[:2] == ["6 joints given, one", "6 joints given, other"]


def test_true_poses_have_no_error(poses, monkeypatch):
    def solve(task, model, start):
        return place_with_joints(SKELETON, start[0], task.true_rotations)

    monkeypatch.setattr(pose_priors, "solve_joint_task", solve)
    results = pose_priors.measure_given_joints(poses, {"oracle": None}, REFERENCE, 1, lambda text: None)
    assert list(results) == ["6", "8", "10", "15"]
    for rows in results.values():
        assert set(rows["oracle"]) == {"position_mm", "rotation_deg", "position_sd", "rotation_sd"}
        assert max(rows["oracle"].values()) < 1e-4


def test_pose_errors_are_means_over_joints(poses):
    task = build_joint_task(poses, pose_priors.draw_given_joints(6, 31, 6), 0.005)
    position_error, rotation_error = pose_priors.compute_pose_errors(
        task, place_with_joints(SKELETON, np.tile([0.03, 0.0, 0.04], (6, 1)), poses)
    )
    np.testing.assert_allclose(position_error, 0.05)
    np.testing.assert_allclose(rotation_error, 0, atol=1e-6)
    other = poses.copy()
    other[:, 22] = other[:, 22] @ Rotation.from_rotvec([0, 0.31, 0]).as_matrix()  # a leaf joint
    position_error, rotation_error = pose_priors.compute_pose_errors(task, place_with_joints(SKELETON, np.zeros((6, 3)), other))
    np.testing.assert_allclose(position_error, 0, atol=1e-12)
    np.testing.assert_allclose(rotation_error, 0.01)


def test_summary_has_means_and_standard_deviations():
    results = pose_priors.summarise_pose_errors(np.array([0.01, 0.03]), np.radians([10.0, 30.0]))
    assert results == pytest.approx({"position_mm": 20, "rotation_deg": 20, "position_sd": 10, "rotation_sd": 10})


def test_improvement_is_the_mean_of_reductions():
    def rows(mine, its):
        return {"mine": {"position_mm": mine, "rotation_deg": 8.0}, "its": {"position_mm": its, "rotation_deg": 10.0}}

    results = pose_priors.compute_improvements({"6": rows(50.0, 100.0), "8": rows(9.0, 10.0)}, "mine")
    assert results == {"its": {"position_percent": pytest.approx(30.0), "rotation_percent": pytest.approx(20.0)}}


def test_given_joints_are_met_and_more_of_them_reduce_the_error(poses):
    priors: ComparedPriors = {"none": None, "gaussian": trained_priors.load_pose_model("gaussian", SKELETON)}
    task = build_joint_task(poses, pose_priors.draw_given_joints(6, 31, 8), 0.005)
    for model in priors.values():
        found = compared_priors.solve_joint_task(task, model, task.build_start(REFERENCE))
        assert np.linalg.norm(found.joint_positions - task.given_positions, axis=2)[task.is_given].mean() < 0.01
    results = pose_priors.measure_given_joints(poses, priors, REFERENCE, 1, lambda text: None)
    assert results["15"]["none"]["position_mm"] < results["6"]["none"]["position_mm"]
