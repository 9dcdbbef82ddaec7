"""MNN-IK's test: the same joints of the same poses for every prior, and errors that are known."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.bench import compared_priors, given_joints
from mocapfix.bench.compared_priors import build_joint_task, place_known_poses
from mocapfix.pose_prior import io, mean_pose
from mocapfix.skeleton import load_cmu31_body

SKELETON = load_cmu31_body().skeleton
MIDDLE = mean_pose.load_mean_pose_prior("mean-pose", SKELETON).mean_rotations


@pytest.fixture(scope="module")
def poses():
    """-> (6, 31, 3, 3) poses near the mean pose, without heading"""
    rng = np.random.default_rng(0)
    turned = Rotation.from_rotvec(rng.normal(0, 0.2, (6 * 31, 3))).as_matrix().reshape(6, 31, 3, 3) @ MIDDLE
    turned[:, 0] = np.eye(3)
    return turned


def telling(said):
    return lambda what: said.append(what)


@pytest.mark.parametrize("count", given_joints.GIVEN_JOINT_COUNTS)
def test_so_many_joints_are_drawn_for_every_pose_and_always_the_same(count):
    joints = given_joints.draw_given_joints(50, 31, count)
    assert (joints.sum(axis=1) == count).all()
    np.testing.assert_array_equal(joints, given_joints.draw_given_joints(50, 31, count))
    assert len(np.unique(joints, axis=0)) > 45
    assert joints.any(axis=0).all()


def test_all_priors_are_given_the_same_joints_of_the_same_poses_and_none_sees_the_others(poses, monkeypatch):
    tasks = {}

    def solve(task, model, start):
        tasks.setdefault(model, []).append(task)
        np.testing.assert_array_equal(start[1], np.tile(MIDDLE, (12, 1, 1, 1)))
        return place_known_poses(SKELETON, *start)

    monkeypatch.setattr(compared_priors, "solve", solve)
    said: list[str] = []
    shelf: dict[str, Any] = {"one": 1, "other": 2}
    given_joints.measure_given_joints(poses, shelf, MIDDLE, 2, telling(said))
    for one, other in zip(tasks[1], tasks[2], strict=True):
        np.testing.assert_array_equal(one.joints, other.joints)
        np.testing.assert_array_equal(one.given_positions, other.given_positions)
    assert [int(task.joints[0].sum()) for task in tasks[1]] == [6, 8, 10, 15]
    assert not np.array_equal(tasks[1][0].joints[:6], tasks[1][0].joints[6:])  # the second set is another
    assert said[:2] == ["6 joints given, one", "6 joints given, other"]


def test_who_knows_the_truth_errs_by_nothing_and_the_table_has_its_keys(poses, monkeypatch):
    monkeypatch.setattr(
        compared_priors, "solve", lambda task, model, start: place_known_poses(SKELETON, start[0], task.rotations)
    )
    said = given_joints.measure_given_joints(poses, {"seer": None}, MIDDLE, 1, telling([]))
    assert list(said) == ["6", "8", "10", "15"]
    for rows in said.values():
        assert set(rows["seer"]) == {"position_mm", "rotation_deg", "position_sd", "rotation_sd"}
        assert max(rows["seer"].values()) < 1e-4


def test_errors_are_means_over_all_joints(poses):
    task = build_joint_task(poses, given_joints.draw_given_joints(6, 31, 6), 0.005)
    far, turned = given_joints.compute_pose_errors(task, place_known_poses(SKELETON, np.tile([0.03, 0.0, 0.04], (6, 1)), poses))
    np.testing.assert_allclose(far, 0.05)
    np.testing.assert_allclose(turned, 0, atol=1e-6)
    other = poses.copy()
    other[:, 22] = other[:, 22] @ Rotation.from_rotvec([0, 0.31, 0]).as_matrix()  # a leaf: nothing hangs on it
    far, turned = given_joints.compute_pose_errors(task, place_known_poses(SKELETON, np.zeros((6, 3)), other))
    np.testing.assert_allclose(far, 0, atol=1e-12)
    np.testing.assert_allclose(turned, 0.01)


def test_a_row_has_means_and_deviations_over_poses():
    said = given_joints.summarise_pose_errors(np.array([0.01, 0.03]), np.radians([10.0, 30.0]))
    assert said == pytest.approx({"position_mm": 20, "rotation_deg": 20, "position_sd": 10, "rotation_sd": 10})


def test_better_is_the_mean_of_the_reductions_not_the_reduction_of_the_mean():
    def rows(mine, its):
        return {"mine": {"position_mm": mine, "rotation_deg": 8.0}, "its": {"position_mm": its, "rotation_deg": 10.0}}

    said = given_joints.compute_improvements({"6": rows(50, 100), "8": rows(9, 10)}, "mine")
    assert said == {"its": {"position_percent": pytest.approx(30.0), "rotation_percent": pytest.approx(20.0)}}


def test_a_prior_helps_where_few_joints_are_given_and_all_given_joints_are_met(poses):
    shelf = {"none": None, "gaussian": io.load_pose_model("gaussian", SKELETON)}
    task = build_joint_task(poses, given_joints.draw_given_joints(6, 31, 8), 0.005)
    for model in shelf.values():
        found = compared_priors.solve_joint_task(task, model, task.build_start(MIDDLE))
        assert np.linalg.norm(found.joint_positions - task.given_positions, axis=2)[task.is_given].mean() < 0.01
    said = given_joints.measure_given_joints(poses, shelf, MIDDLE, 1, telling([]))
    assert said["15"]["none"]["position_mm"] < said["6"]["none"]["position_mm"]
