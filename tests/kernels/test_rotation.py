"""Rotation vectors and matrices, held against scipy where it hurts: near nothing, near half a turn and at half a turn."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.kernels import rotation
from tests.kernels import dense

ANGLES = [0.0, 1e-300, 1e-12, 1e-8, 1e-5, 9.9e-5, 1.01e-4, 1e-3, 0.3, 2.0, np.pi - 1e-3, np.pi - 1e-7, np.pi - 1e-12, np.pi]
AXES = [(1, 0, 0), (0, -1, 0), (0, 0, 1), (1, 1, 0), (1, -1, 1), (-0.2, 0.5, 3)]
vectors = st.tuples(st.sampled_from(ANGLES) | st.floats(0, np.pi), st.integers(0, 2**32 - 1))


def turned(vector):
    out = np.empty((3, 3))
    rotation.exponential(float(vector[0]), float(vector[1]), float(vector[2]), out)
    return out


def vector_of(matrix):
    out = np.empty(3)
    rotation.logarithm(np.ascontiguousarray(matrix), out)
    return out


def of(angle, seed):
    axis = np.random.default_rng(seed).normal(size=3)
    return angle * axis / np.linalg.norm(axis)


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("angle", ANGLES)
def test_exponential_and_logarithm_are_scipys(axis, angle):
    vector = angle * np.array(axis) / np.linalg.norm(axis)
    matrix = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(turned(vector), matrix, atol=1e-15)
    found = vector_of(matrix)
    np.testing.assert_allclose(turned(found), matrix, atol=2e-15)
    if angle < np.pi:  # at half a turn both senses are right
        np.testing.assert_allclose(found, Rotation.from_matrix(matrix).as_rotvec(), atol=1e-14, rtol=1e-9)


@given(vectors)
def test_the_logarithm_undoes_the_exponential(drawn):
    vector = of(*drawn)
    found = vector_of(turned(vector))
    assert np.linalg.norm(found) <= np.pi + 1e-15
    if drawn[0] > np.pi - 1e-6:
        np.testing.assert_allclose(turned(found), turned(vector), atol=2e-15)
    else:
        np.testing.assert_allclose(found, vector, atol=1e-14, rtol=1e-9)


@given(st.floats(0, 50), st.integers(0, 2**32 - 1))
def test_the_exponential_is_a_rotation_for_any_vector(angle, seed):
    matrix = turned(of(angle, seed))
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(matrix) == pytest.approx(1)


@pytest.mark.parametrize("matrix", [np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.diag([-1.0, -1, 1])])
def test_half_a_turn_about_an_axis_has_length_pi_along_it(matrix):
    np.testing.assert_allclose(np.abs(vector_of(matrix)), np.pi * (np.diag(matrix) > 0))


@given(st.sampled_from([0.0, 1e-6, 9e-4, 1.1e-3]) | st.floats(0, 3.0), st.integers(0, 2**32 - 1))
def test_left_jacobian_inverse_is_the_logarithms_derivative(angle, seed):
    vector, found = of(angle, seed), np.empty((3, 3))
    rotation.left_jacobian_inverse(vector, found)
    there = turned(vector)
    np.testing.assert_allclose(found, dense.jacobian(lambda d: vector_of(turned(d) @ there), 3), atol=1e-8)


def test_left_jacobian_inverse_stays_finite_at_half_a_turn():
    found = np.empty((3, 3))
    rotation.left_jacobian_inverse(np.array([np.pi, 0.0, 0.0]), found)
    np.testing.assert_allclose(found, [[1, 0, 0], [0, 0, np.pi / 2], [0, -np.pi / 2, 0]], atol=1e-12)


def test_orthonormalise_mends_a_rotation_that_has_drifted():
    drifted = dense.rotations(np.random.default_rng(1), 1)[0]
    mended = drifted + np.random.default_rng(2).normal(0, 1e-4, (3, 3))
    rotation.orthonormalise(mended)
    np.testing.assert_allclose(mended @ mended.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(mended, drifted, atol=1e-3)
    assert np.linalg.det(mended) == pytest.approx(1)


def test_multiply_is_the_matrix_product():
    a, b, out = *np.random.default_rng(0).normal(size=(2, 3, 3)), np.empty((3, 3))
    rotation.multiply(a, b, out)
    np.testing.assert_allclose(out, a @ b)
