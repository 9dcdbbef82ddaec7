"""Errors over the iterations: where the curves begin and end, and that the costs are those that the solve minimises."""

import numpy as np
import pytest

from mocapfix.bench import compared_priors, given_joints, pictures, unseen_poses
from mocapfix.bench.compared_priors import build_joint_task
from mocapfix.bench.given_joints import GIVEN_JOINT_SD_M, compute_pose_errors, draw_given_joints
from mocapfix.pose_prior import io, mean_pose
from mocapfix.pose_prior.model import compute_pose_vectors
from mocapfix.skeleton import load_cmu31_body

MIDDLE = mean_pose.load_mean_pose_prior("mean-pose", load_cmu31_body().skeleton).mean_rotations
SHELF = {"none": None, "gaussian": io.load_pose_model("gaussian", load_cmu31_body().skeleton)}


@pytest.fixture(scope="module")
def poses():
    return unseen_poses.load_unseen_poses()[::200]


@pytest.fixture(scope="module")
def said(poses):
    return given_joints.measure_iterations(poses, SHELF, MIDDLE, "gaussian", lambda what: None)


def test_curves_begin_at_the_start_and_end_where_the_whole_solve_does(poses, said):
    task = build_joint_task(
        poses, draw_given_joints(len(poses), poses.shape[1], given_joints.CURVE_JOINT_COUNT), GIVEN_JOINT_SD_M
    )
    start = compared_priors.place_known_poses(task.skeleton, *task.build_start(MIDDLE))
    for name, model in SHELF.items():
        assert len(said["position_mm"][name]) == len(said["iterations"][name]) == given_joints.MAX_SHOWN_ITERATIONS + 1
        assert said["iterations"][name][:2] == [0, 1]
        assert said["position_mm"][name][0] == pytest.approx(1e3 * compute_pose_errors(task, start)[0].mean())
        whole = compared_priors.solve_joint_task(task, model, task.build_start(MIDDLE))
        assert said["position_mm"][name][-1] == pytest.approx(1e3 * compute_pose_errors(task, whole)[0].mean(), rel=0.05)


def test_the_total_falls_and_is_the_sum_of_its_parts(said):
    cost = {name: np.array(curve) for name, curve in said["cost"].items()}
    np.testing.assert_allclose(cost["total"], cost["given"] + cost["prior"])
    assert (np.diff(cost["total"]) < 1e-6).all()
    assert cost["given"][-1] < 1e-3 * cost["given"][0]


def test_what_the_prior_costs_is_how_far_a_pose_is_off_its_code_and_its_code_off_the_mean(poses, said):
    model, task = (
        SHELF["gaussian"],
        build_joint_task(poses, draw_given_joints(len(poses), poses.shape[1], given_joints.CURVE_JOINT_COUNT), GIVEN_JOINT_SD_M),
    )
    found = compared_priors.solve_joint_task(task, model, task.build_start(MIDDLE), given_joints.MAX_SHOWN_ITERATIONS)
    away = (compute_pose_vectors(found.rotations, model.reference_rotations) - model.decode(found.codes)) / model.residual_sd_rad[
        :, None
    ]
    expected = 0.5 * ((away**2).sum(axis=(1, 2)) + (found.codes**2).sum(axis=1))
    assert said["cost"]["prior"][-1] == pytest.approx(expected.mean(), rel=1e-6)


def test_the_curves_are_drawn(said, tmp_path):
    pictures.draw_iterations(tmp_path / "curves.png", said, "gaussian")
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG\r\n")
    assert {path.name for path in tmp_path.iterdir()} == {"curves.png"}
