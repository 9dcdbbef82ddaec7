"""Poses under the naturalness of MNN-IK: the cost decreases, and complete observations are hardly changed."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.terms import PointTerm
from mocapfix.solve import pose_solver
from mocapfix.solve.naturalness import NaturalnessModel
from tests.kernels import dense_oracle
from tests.solve.test_autoencoder import REFERENCE, SKELETON, draw_model
from tests.solve.test_naturalness import draw_rotations
from tests.solve.test_pose_solver import given

TREE = KinematicTree(SKELETON.parents, SKELETON.offsets, np.ones(31, bool))
ROOT = np.zeros((4, 3))
START = ROOT + 0.02, np.tile(REFERENCE, (4, 1, 1, 1))
LOCAL = draw_rotations(4)
HANDS_AND_FEET = np.array([0, 5, 10, 16, 22, 29])


@pytest.fixture(scope="module")
def model():
    return NaturalnessModel(replace(draw_model("euler", "relu"), residual_sd_rad=np.full(31, 0.5)))


def points(joints, places) -> PointTerm:
    return given(np.random.default_rng(0), TREE, ROOT, LOCAL, joints, places=places)


def costs(model, term, root, local, scale=1.0):
    """Return (T,) half the squares of points and number over their deviations"""
    frames = [term._replace(measured=term.measured[[t]], weight=term.weight[[t]]) for t in range(len(root))]
    away = [
        dense_oracle.compute_residual(each, dense_oracle.compute_world(TREE, root[t], local[t])) for t, each in enumerate(frames)
    ]
    return np.array([(each**2).sum() / 2 for each in away]) + (model.evaluate(local)[0] / model.naturalness_sd / scale) ** 2 / 2


def test_cost_decreases_monotonically(model):
    term, states = points(HANDS_AND_FEET, 1), [START]
    pose_solver.solve_poses(
        TREE, (term,), model, *START, prior_scale=0.1, callback=lambda root, local, _: states.append((root.copy(), local.copy()))
    )
    changes = np.diff([costs(model, term, *each, scale=0.1) for each in states], axis=0)
    assert (changes <= 1e-6).all()
    assert (changes[1:] < -0.05).any()


def test_stronger_prior_gives_more_natural_poses(model):
    term = points(HANDS_AND_FEET, 1)
    found = [pose_solver.solve_poses(TREE, (term,), model, *START, prior_scale=scale) for scale in (0.1, 1e6)]
    natural, free = (model.evaluate(each.local_rotations)[0] for each in found)
    assert (natural < free).all()


def test_complete_observations_change_little(model):
    found = pose_solver.solve_poses(TREE, (points(np.arange(31), 4),), model, *START)
    np.testing.assert_allclose(found.local_rotations[:, 1:], LOCAL[:, 1:], atol=0.05)
    assert found.codes.shape == (4, 0)


def test_batches_and_frame_order_are_irrelevant(model, monkeypatch):
    term = points(HANDS_AND_FEET, 1)
    found = pose_solver.solve_poses(TREE, (term,), model, *START)
    order = np.array([2, 0, 3, 1])
    monkeypatch.setattr(pose_solver, "MAX_BATCH_FRAMES", 3)
    turned = term._replace(measured=term.measured[order], weight=term.weight[order])
    again = pose_solver.solve_poses(TREE, (turned,), model, *(each[order] for each in START))
    np.testing.assert_allclose(again.local_rotations, found.local_rotations[order], atol=1e-4)
