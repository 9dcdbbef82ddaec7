"""Errors over the iterations: where the curves begin and end, and that the costs are those that the solve minimises."""

import numpy as np
import pytest

from mocapfix import prior
from mocapfix.bench import contenders, iterations, pictures, unseen
from mocapfix.bench.contenders import given
from mocapfix.bench.given_joints import SD, drawn, errors
from mocapfix.prior import models
from mocapfix.prior.contract import from_middle
from mocapfix.skeleton import cmu31

MIDDLE = prior.load("mean-pose", cmu31().skeleton).rotations
SHELF = {"none": None, "gaussian": models.load("gaussian", cmu31().skeleton)}


@pytest.fixture(scope="module")
def poses():
    return unseen.shipped()[::200]


@pytest.fixture(scope="module")
def said(poses):
    return iterations.measure(poses, SHELF, MIDDLE, "gaussian", lambda what: None)


def test_curves_begin_at_the_start_and_end_where_the_whole_solve_does(poses, said):
    task = given(poses, drawn(len(poses), poses.shape[1], iterations.GIVEN), SD)
    start = contenders.placed(task.skeleton, *task.upright(MIDDLE))
    for name, model in SHELF.items():
        assert len(said["position_mm"][name]) == len(said["iterations"][name]) == iterations.MOST + 1
        assert said["iterations"][name][:2] == [0, 1]
        assert said["position_mm"][name][0] == pytest.approx(1e3 * errors(task, start)[0].mean())
        whole = contenders.solve(task, model, task.upright(MIDDLE))
        assert said["position_mm"][name][-1] == pytest.approx(1e3 * errors(task, whole)[0].mean(), rel=0.05)


def test_the_total_falls_and_is_the_sum_of_its_parts(said):
    cost = {name: np.array(curve) for name, curve in said["cost"].items()}
    np.testing.assert_allclose(cost["total"], cost["given"] + cost["prior"])
    assert (np.diff(cost["total"]) < 1e-6).all()
    assert cost["given"][-1] < 1e-3 * cost["given"][0]


def test_what_the_prior_costs_is_how_far_a_pose_is_off_its_code_and_its_code_off_the_mean(poses, said):
    model, task = SHELF["gaussian"], given(poses, drawn(len(poses), poses.shape[1], iterations.GIVEN), SD)
    found = contenders.solve(task, model, task.upright(MIDDLE), iterations.MOST)
    away = (from_middle(found.rotations, model.middle) - model.decode(found.codes)) / model.sigma[:, None]
    expected = 0.5 * ((away**2).sum(axis=(1, 2)) + (found.codes**2).sum(axis=1))
    assert said["cost"]["prior"][-1] == pytest.approx(expected.mean(), rel=1e-6)


def test_the_curves_are_drawn(said, tmp_path):
    pictures.iterations(tmp_path / "curves.png", said, "gaussian")
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG\r\n")
    assert {path.name for path in tmp_path.iterdir()} == {"curves.png"}
