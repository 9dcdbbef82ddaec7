"""Curves over the iterations: their first and last values, and the cost that the solver minimises."""

import numpy as np
import pytest

from mocapfix.lab import compared_priors, hands, pose_priors, sound_takes
from mocapfix.lab.compared_priors import ComparedPriors, build_joint_task
from mocapfix.lab.pose_priors import GIVEN_JOINT_SD_M, compute_pose_errors, draw_given_joints
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import mean_pose, trained_priors
from mocapfix.solve.pose_prior import compute_pose_vectors

REFERENCE = mean_pose.load_mean_pose_prior("mean-pose", load_cmu31_body().skeleton).mean_rotations
GAUSSIAN = trained_priors.load_pose_model("gaussian", load_cmu31_body().skeleton)
PRIORS: ComparedPriors = {"none": None, "gaussian": GAUSSIAN}


@pytest.fixture(scope="module")
def poses():
    return sound_takes.load_unseen_poses()[::200]


@pytest.fixture(scope="module")
def results(poses):
    return pose_priors.measure_iterations(poses, PRIORS, REFERENCE, "gaussian", lambda text: None)


def test_curves_begin_at_the_start_and_end_at_the_full_solve(poses, results):
    task = build_joint_task(poses, draw_given_joints(len(poses), poses.shape[1], pose_priors.CURVE_JOINT_COUNT), GIVEN_JOINT_SD_M)
    start = compared_priors.place_known_poses(task.skeleton, *task.build_start(REFERENCE))
    for name, model in PRIORS.items():
        assert len(results["position_mm"][name]) == len(results["iterations"][name]) == pose_priors.MAX_SHOWN_ITERATIONS + 1
        assert results["iterations"][name][:2] == [0, 1]
        assert results["position_mm"][name][0] == pytest.approx(1e3 * compute_pose_errors(task, start)[0].mean())
        full = compared_priors.solve_joint_task(task, model, task.build_start(REFERENCE))
        assert results["position_mm"][name][-1] == pytest.approx(1e3 * compute_pose_errors(task, full)[0].mean(), rel=0.05)


def test_total_cost_decreases_and_is_the_sum_of_its_parts(results):
    cost = {name: np.array(curve) for name, curve in results["cost"].items()}
    np.testing.assert_allclose(cost["total"], cost["given"] + cost["prior"])
    assert (np.diff(cost["total"]) < 1e-6).all()
    assert cost["given"][-1] < 1e-3 * cost["given"][0]


def test_prior_cost_is_that_of_residual_and_code(poses, results):
    model, task = (
        GAUSSIAN,
        build_joint_task(poses, draw_given_joints(len(poses), poses.shape[1], pose_priors.CURVE_JOINT_COUNT), GIVEN_JOINT_SD_M),
    )
    solution = compared_priors.solve_joint_task(task, model, task.build_start(REFERENCE), pose_priors.MAX_SHOWN_ITERATIONS)
    residuals = (
        compute_pose_vectors(solution.rotations, model.reference_rotations) - model.decode(solution.codes)
    ) / model.residual_sd_rad[:, None]
    expected = 0.5 * ((residuals**2).sum(axis=(1, 2)) + (solution.codes**2).sum(axis=1))
    assert results["cost"]["prior"][-1] == pytest.approx(expected.mean(), rel=1e-6)


def test_curves_are_drawn(results, tmp_path):
    hands.draw_iterations(tmp_path / "curves.png", results, "gaussian")
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG\r\n")
    assert {path.name for path in tmp_path.iterdir()} == {"curves.png"}
