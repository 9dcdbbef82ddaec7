"""Rotation vectors and matrices, held against scipy where it hurts: near nothing, near half a turn and at half a turn."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.kernels import lie
from tests.kernels import dense_oracle, random_terms

ANGLES = [0.0, 1e-300, 1e-12, 1e-8, 1e-5, 9.9e-5, 1.01e-4, 1e-3, 0.3, 2.0, np.pi - 1e-3, np.pi - 1e-7, np.pi - 1e-12, np.pi]
AXES = [(1, 0, 0), (0, -1, 0), (0, 0, 1), (1, 1, 0), (1, -1, 1), (-0.2, 0.5, 3)]
vectors = st.tuples(st.sampled_from(ANGLES) | st.floats(0, np.pi), st.integers(0, 2**32 - 1))


def turned(vector):
    return np.reshape(lie.compute_exponential(*map(float, vector)), (3, 3))


def numbers(matrix):
    return tuple(map(float, np.ravel(matrix)))


def vector_of(matrix):
    return np.array(lie.compute_logarithm(numbers(matrix))[:3])


def jacobian_inverse(vector):
    """Return (3, 3) at the rotation of a vector no longer than half a turn"""
    return np.reshape(lie.compute_left_jacobian_inverse(*lie.compute_logarithm(numbers(turned(vector)))), (3, 3))


def of(angle, seed):
    axis = np.random.default_rng(seed).normal(size=3)
    return angle * axis / np.linalg.norm(axis)


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("angle", ANGLES)
def test_exponential_and_logarithm_equal_scipy(axis, angle):
    vector = angle * np.array(axis) / np.linalg.norm(axis)
    matrix = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(turned(vector), matrix, atol=1e-15)
    found = vector_of(matrix)
    np.testing.assert_allclose(turned(found), matrix, atol=2e-15)
    if angle < np.pi:  # at half a turn both senses are right
        np.testing.assert_allclose(found, Rotation.from_matrix(matrix).as_rotvec(), atol=1e-14, rtol=1e-9)


@given(vectors)
def test_logarithm_inverts_the_exponential(drawn):
    vector = of(*drawn)
    found = vector_of(turned(vector))
    assert np.linalg.norm(found) <= np.pi + 1e-15
    if drawn[0] > np.pi - 1e-6:
        np.testing.assert_allclose(turned(found), turned(vector), atol=2e-15)
    else:
        np.testing.assert_allclose(found, vector, atol=1e-14, rtol=1e-9)


@given(st.floats(0, 50), st.integers(0, 2**32 - 1))
def test_exponential_is_a_rotation_for_any_vector(angle, seed):
    matrix = turned(of(angle, seed))
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(matrix) == pytest.approx(1)


@pytest.mark.parametrize("matrix", [np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.diag([-1.0, -1, 1])])
def test_logarithm_of_a_half_turn(matrix):
    np.testing.assert_allclose(np.abs(vector_of(matrix)), np.pi * (np.diag(matrix) > 0))


@given(st.floats(0, 50), st.integers(0, 2**32 - 1))
def test_retraction_is_a_rotation_about_the_same_axis(length, seed):
    vector = of(length, seed)
    matrix = np.reshape(lie.compute_retraction(*map(float, vector)), (3, 3))
    about = 2 * np.arctan(length / 2) * vector / max(length, 1e-300)
    np.testing.assert_allclose(matrix, turned(about), atol=1e-13)


@given(st.integers(0, 2**32 - 1))
def test_retraction_agrees_with_the_exponential_to_second_order(seed):
    for length in (1e-2, 1e-3):
        vector = of(length, seed)
        difference = np.reshape(lie.compute_retraction(*map(float, vector)), (3, 3)) - turned(vector)
        assert np.abs(difference).max() < length**3 / 6


@given(st.sampled_from([0.0, 1e-6, 9e-4, 1.1e-3]) | st.floats(0, 3.0), st.integers(0, 2**32 - 1))
def test_left_jacobian_inverse_is_the_logarithms_derivative(angle, seed):
    vector = of(angle, seed)
    there = turned(vector)
    found = dense_oracle.compute_jacobian(lambda d: vector_of(turned(d) @ there), 3)
    np.testing.assert_allclose(jacobian_inverse(vector), found, atol=1e-8)


def test_left_jacobian_inverse_is_finite_at_a_half_turn():
    found = jacobian_inverse(np.array([np.pi, 0.0, 0.0]))
    np.testing.assert_allclose(found, [[1, 0, 0], [0, 0, np.pi / 2], [0, -np.pi / 2, 0]], atol=1e-12)


def test_orthonormalisation_corrects_a_drifted_rotation():
    drifted = random_terms.draw_rotations(np.random.default_rng(1), 1)[0]
    worse = drifted + np.random.default_rng(2).normal(0, 1e-4, (3, 3))
    corrected = np.reshape(lie.orthonormalise_rotation(numbers(worse)), (3, 3))
    np.testing.assert_allclose(corrected @ corrected.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(corrected, drifted, atol=1e-3)
    assert np.linalg.det(corrected) == pytest.approx(1)


def compute_tilt_and_slopes(vector):
    """Return x, z and the derivative (3, 3) of a tilt"""
    x, z, slopes = lie.compute_tilt(numbers(turned(vector)))
    return np.array([x, 0.0, z]), np.reshape(slopes, (3, 3))


@given(st.sampled_from([0.0, 1e-9, 9e-4, 1.1e-3, np.pi - 2e-3]) | st.floats(0, 3.1), st.integers(0, 2**32 - 1), st.floats(-3, 3))
def test_tilt_is_the_rotation_without_its_heading(angle, seed, heading):
    tilt = of(angle, seed) * [1, 0, 1]
    whole = turned(np.array([0, heading, 0])) @ turned(tilt)
    np.testing.assert_allclose(lie.compute_tilt(numbers(whole))[:2], tilt[[0, 2]], atol=1e-9)


@given(st.sampled_from([0.0, 1e-6, 9e-4, 1.1e-3]) | st.floats(0, 3.0), st.integers(0, 2**32 - 1))
def test_tilt_derivative_is_to_a_rotation_in_the_rotated_axes(angle, seed):
    axis = np.random.default_rng(seed).normal(size=3) * [1, 0, 1]
    there = turned(np.array([0, 0.4, 0])) @ turned(angle * axis / np.linalg.norm(axis))
    found = np.reshape(lie.compute_tilt(numbers(there))[2], (3, 3))

    def after(k):
        x, z, _ = lie.compute_tilt(numbers(there @ turned(k)))
        return np.array([x, 0.0, z])

    expected = dense_oracle.compute_jacobian(after, 3)
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("angle", [np.pi - 1e-2, np.pi - 1e-5, np.pi])
def test_upside_down_tilt_is_a_half_turn_with_finite_derivative(angle):
    vector, slopes = compute_tilt_and_slopes(np.array([0.0, 0.0, angle]))
    assert np.linalg.norm(vector) == pytest.approx(np.pi, abs=0.011)
    assert np.isfinite(slopes).all()
    np.testing.assert_allclose(slopes @ np.array([0.0, 0, 1]) if angle < 3.14 else [0, 0, 1], [0, 0, 1], atol=1e-6)
