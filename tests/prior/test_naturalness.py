import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mocapfix.pose_prior.autoencoder import NaturalnessModel
from mocapfix.pose_prior.model import remove_heading
from tests.prior.test_autoencoder import MIDDLE, drawn

RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def exact():
    """-> a small untrained network, in double precision: its derivative can be told from its values"""
    model = drawn("euler", "silu")
    model.network.double()
    return NaturalnessModel(model)


def people(count):
    """-> (N, 31, 3, 3) local rotations, of any heading"""
    local = turned(RNG.normal(0, 0.3, (count, 31, 3))) @ MIDDLE
    local[:, 0] = Rotation.from_euler("YX", RNG.uniform(-2, 2, (count, 2)) * [1, 0.3]).as_matrix()
    return local


def turned(vectors):
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)


def test_it_is_the_squared_change_that_the_network_makes_to_the_angles(exact):
    local = people(4)
    tilted = np.concatenate([remove_heading(local[:, 0])[:, None], local[:, 1:]], 1)
    theta = torch.as_tensor(Rotation.from_matrix(tilted.reshape(-1, 3, 3)).as_euler("ZYX").reshape(4, 93))
    with torch.no_grad():
        change = (theta - exact.autoencoder.network(theta)).numpy()
    np.testing.assert_allclose(exact.evaluate(local)[0], (change**2).sum(1), rtol=1e-9)


def test_its_gradient_is_that_of_turning_each_joint_in_its_parents_axes(exact):
    local, step = people(5), 1e-5
    gradient = exact.evaluate(local)[1]
    for joint in (0, 1, 14, 30):
        for axis in range(3):
            turn = np.zeros((5, 31, 3))
            turn[:, joint, axis] = step
            numeric = (exact.evaluate(turned(turn) @ local)[0] - exact.evaluate(turned(-turn) @ local)[0]) / (2 * step)
            np.testing.assert_allclose(gradient[:, joint, axis], numeric, rtol=1e-4, atol=1e-4)
    assert np.abs(gradient[:, [1, 14, 30]]).min() > 1e-3


def test_heading_makes_no_difference(exact):
    local = people(3)
    elsewhere = local.copy()
    elsewhere[:, 0] = Rotation.from_euler("Y", 1.3).as_matrix() @ local[:, 0]
    value, gradient = exact.evaluate(local)
    np.testing.assert_allclose(exact.evaluate(elsewhere)[0], value, rtol=1e-9)
    np.testing.assert_allclose(gradient[:, 0, 1], 0, atol=1e-9)


def test_many_poses_are_judged_as_each_alone(exact):
    local = people(600)
    for many, alone in zip(exact.evaluate(local), exact.evaluate(local[550:551]), strict=True):
        np.testing.assert_allclose(many[550:551], alone, rtol=1e-9)


def test_its_deviation_is_that_of_the_sum_of_squares_of_what_people_stray(exact):
    strays = RNG.normal(0, 0.1 / 2, (20_000, 93))  # sigma is 0.1, with a margin of two
    assert exact.naturalness_sd == pytest.approx((strays**2).sum(1).std(), rel=0.02)


def test_other_features_are_refused():
    with pytest.raises(ValueError, match="Euler"):
        NaturalnessModel(drawn("continuous", "silu"))
