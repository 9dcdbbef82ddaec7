import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mocapfix.solve.naturalness import NaturalnessModel
from mocapfix.solve.pose_prior import remove_heading
from tests.solve.test_autoencoder import REFERENCE, draw_model

RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def naturalness():
    """Return the measure of a small untrained network in double precision, for numerical derivatives."""
    model = draw_model("euler", "silu")
    model.network.double()
    return NaturalnessModel(model)


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
        change = (theta - naturalness.autoencoder.network(theta)).numpy()
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
