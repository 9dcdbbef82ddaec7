"""The naturalness of MNN-IK: its value and gradient, and poses under it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.terms import PointTerm
from mocapfix.lab.compared_priors import NaturalnessModel, NaturalnessTerm
from mocapfix.solve import model_terms
from mocapfix.solve.minimise import SolverSettings, minimise
from mocapfix.solve.pose_prior import remove_heading
from tests.kernels import dense_oracle
from tests.solve.test_autoencoder import REFERENCE, SKELETON, draw_model
from tests.solve.test_model_terms import given, record_rounds

RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def naturalness():
    """Return the measure of a small untrained network in double precision, for numerical derivatives."""
    model = draw_model("euler", "silu")
    measure = NaturalnessModel(model)
    measure.network.double()
    return measure


def draw_rotations(count):
    """Return random local rotations (N, 31, 3, 3) of any heading."""
    local = build_rotations(RNG.normal(0, 0.3, (count, 31, 3))) @ REFERENCE
    local[:, 0] = Rotation.from_euler("YX", RNG.uniform(-2, 2, (count, 2)) * [1, 0.3]).as_matrix()
    return local


def build_rotations(vectors):
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)


def test_naturalness_is_the_squared_change_of_the_angles(naturalness):
    local = draw_rotations(4)
    tilted = np.concatenate([remove_heading(local[:, 0])[:, None], local[:, 1:]], 1)
    theta = torch.as_tensor(Rotation.from_matrix(tilted.reshape(-1, 3, 3)).as_euler("ZYX").reshape(4, 93))
    with torch.no_grad():
        change = (theta - naturalness.network(theta)).numpy()
    np.testing.assert_allclose(naturalness.evaluate(local)[0], (change**2).sum(1), rtol=1e-9)


def test_naturalness_gradient_is_with_respect_to_rotations_in_parent_axes(naturalness):
    local, step = draw_rotations(5), 1e-5
    gradient = naturalness.evaluate(local)[1]
    for joint in (0, 1, 14, 30):
        for axis in range(3):
            turn = np.zeros((5, 31, 3))
            turn[:, joint, axis] = step
            numeric = (
                naturalness.evaluate(build_rotations(turn) @ local)[0] - naturalness.evaluate(build_rotations(-turn) @ local)[0]
            ) / (2 * step)
            np.testing.assert_allclose(gradient[:, joint, axis], numeric, rtol=1e-4, atol=1e-4)
    assert np.abs(gradient[:, [1, 14, 30]]).min() > 1e-3


def test_naturalness_does_not_depend_on_heading(naturalness):
    local = draw_rotations(3)
    rotated = local.copy()
    rotated[:, 0] = Rotation.from_euler("Y", 1.3).as_matrix() @ local[:, 0]
    value, gradient = naturalness.evaluate(local)
    np.testing.assert_allclose(naturalness.evaluate(rotated)[0], value, rtol=1e-9)
    np.testing.assert_allclose(gradient[:, 0, 1], 0, atol=1e-9)


def test_batched_naturalness_equals_that_of_one_pose(naturalness):
    local = draw_rotations(600)
    for many, alone in zip(naturalness.evaluate(local), naturalness.evaluate(local[550:551]), strict=True):
        np.testing.assert_allclose(many[550:551], alone, rtol=1e-9)


def test_naturalness_sd_is_that_of_a_sum_of_squares(naturalness):
    residuals = RNG.normal(0, 0.1 / 2, (20_000, 93))  # the standard deviation is 0.1, inflated by two
    assert naturalness.naturalness_sd == pytest.approx((residuals**2).sum(1).std(), rel=0.02)


def test_naturalness_requires_euler_features():
    with pytest.raises(ValueError, match="Euler"):
        NaturalnessModel(draw_model("continuous", "silu"))


TREE = KinematicTree(SKELETON.parents, SKELETON.offsets, np.ones(31, bool))
ROOT = np.zeros((4, 3))
START = ROOT + 0.02, np.tile(REFERENCE, (4, 1, 1, 1))
LOCAL = draw_rotations(4)
HANDS_AND_FEET = np.array([0, 5, 10, 16, 22, 29])


@pytest.fixture(scope="module")
def measure():
    return NaturalnessModel(replace(draw_model("euler", "relu"), residual_sd_rad=np.full(31, 0.5)))


def points(joints, places) -> PointTerm:
    return given(np.random.default_rng(0), TREE, ROOT, LOCAL, joints, places=places)


def costs(measure, term, root, local, scale=1.0):
    """Return (T,) half the squares of points and number over their deviations"""
    frames = [term._replace(measured=term.measured[[t]], weight=term.weight[[t]]) for t in range(len(root))]
    away = [
        dense_oracle.compute_residual(each, dense_oracle.compute_world(TREE, root[t], local[t])) for t, each in enumerate(frames)
    ]
    return (
        np.array([(each**2).sum() / 2 for each in away]) + (measure.evaluate(local)[0] / measure.naturalness_sd / scale) ** 2 / 2
    )


def solve(measure, term, start=START, scale=1.0):
    return minimise(TREE, (term, NaturalnessTerm(measure, scale)), start, SolverSettings(max_iterations=30))


def test_cost_decreases_monotonically(measure, monkeypatch):
    term, states = points(HANDS_AND_FEET, 1), record_rounds(monkeypatch)
    solve(measure, term, scale=0.1)
    changes = np.diff([costs(measure, term, *each[:2], scale=0.1) for each in [START, *states]], axis=0)
    assert (changes <= 1e-6).all()
    assert (changes[1:] < -0.05).any()


def test_stronger_prior_gives_more_natural_poses(measure):
    term = points(HANDS_AND_FEET, 1)
    found = [solve(measure, term, scale=scale) for scale in (0.1, 1e6)]
    natural, free = (measure.evaluate(each.local_rotations)[0] for each in found)
    assert (natural < free).all()


def test_complete_observations_change_little(measure):
    found = solve(measure, points(np.arange(31), 4))
    np.testing.assert_allclose(found.local_rotations[:, 1:], LOCAL[:, 1:], atol=0.05)
    assert found.codes.shape == (4, 0)


def test_batches_and_frame_order_are_irrelevant(measure, monkeypatch):
    term = points(HANDS_AND_FEET, 1)
    found = solve(measure, term)
    order = np.array([2, 0, 3, 1])
    monkeypatch.setattr(model_terms, "MAX_BATCH_FRAMES", 3)
    turned = term._replace(measured=term.measured[order], weight=term.weight[order])
    again = solve(measure, turned, tuple(each[order] for each in START))
    np.testing.assert_allclose(again.local_rotations, found.local_rotations[order], atol=1e-4)
