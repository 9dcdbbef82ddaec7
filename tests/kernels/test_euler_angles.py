from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.kernels.euler_angles import compute_continuous_euler_angles, compute_euler_matrices

ORDERS = ["".join(order) for order in permutations("XYZ")]
ANGLE = st.floats(-180, 180)


def axes_of(order):
    return np.array(["XYZ".index(letter) for letter in order])


def rotations(order, degrees):
    return Rotation.from_euler(order, degrees, degrees=True).as_matrix()


@given(st.sampled_from(ORDERS), st.tuples(ANGLE, ANGLE, ANGLE))
def test_euler_matrices_equal_scipy_with_the_first_axis_outermost(order, degrees):
    found = compute_euler_matrices(np.radians([degrees]), axes_of(order))
    np.testing.assert_allclose(found, rotations(order, [degrees]), atol=1e-14)


@given(st.sampled_from(ORDERS), st.tuples(ANGLE, st.sampled_from([-90.0, 90.0, 89.9999, -90.0001, 0.0, 45.0, 170.0]), ANGLE))
def test_angles_reproduce_the_rotation_at_gimbal_lock_too(order, degrees):
    turned = rotations(order, [degrees])
    angles = compute_continuous_euler_angles(turned, axes_of(order), np.zeros(3))
    np.testing.assert_allclose(compute_euler_matrices(angles, axes_of(order)), turned, atol=1e-7)


@given(st.sampled_from(ORDERS), st.tuples(ANGLE, st.floats(-85, 85), ANGLE), st.tuples(*[st.integers(-3, 3)] * 3), st.booleans())
def test_nearest_equivalent_triple_is_chosen(order, degrees, whole_turns, other):
    triple = np.array(degrees) + 360.0 * np.array(whole_turns)
    if other:
        triple = triple * [1, -1, 1] + 180
    near = np.radians(triple) + 0.01
    found = compute_continuous_euler_angles(rotations(order, [degrees]), axes_of(order), near)
    np.testing.assert_allclose(np.degrees(found[0]), triple, atol=1e-9)


@pytest.mark.parametrize("order", ORDERS)
def test_angles_of_continued_rotation_are_continuous(order):
    degrees = np.zeros((400, 3))
    degrees[:, 0] = np.arange(400) * 5.0
    degrees[:, 1] = 60 * np.sin(np.arange(400) / 30)
    found = compute_continuous_euler_angles(rotations(order, degrees), axes_of(order), np.zeros(3))
    np.testing.assert_allclose(np.degrees(found), degrees, atol=1e-9)


@pytest.mark.parametrize("order", ORDERS)
def test_outer_angles_share_the_rotation_in_gimbal_lock(order):
    degrees = np.c_[np.arange(0, 180, 2.0), np.full(90, 90.0), np.zeros(90)]
    found = np.degrees(compute_continuous_euler_angles(rotations(order, degrees), axes_of(order), np.radians([0, 90.0, 0])))
    np.testing.assert_allclose(np.abs(np.diff(found[:, [0, 2]], axis=0)), 1, atol=1e-6)
    np.testing.assert_allclose(compute_euler_matrices(np.radians(found), axes_of(order)), rotations(order, degrees), atol=1e-9)


@given(st.sampled_from(["X", "ZX", "YX", "XZ"]), st.lists(st.floats(-170, 170), min_size=2, max_size=2))
def test_angles_of_fewer_axes_are_recovered(order, degrees):
    own = np.array(degrees[: len(order)])
    turned = rotations(order, own[None] if len(order) > 1 else own)
    found = compute_continuous_euler_angles(np.ascontiguousarray(turned.reshape(1, 3, 3)), axes_of(order), np.radians(own) * 0.9)
    np.testing.assert_allclose(compute_euler_matrices(found, axes_of(order)), turned.reshape(1, 3, 3), atol=1e-6)


@given(st.tuples(ANGLE, st.floats(-60, 60), st.floats(-60, 60)))
def test_hinge_angle_gives_the_nearest_rotation(degrees):
    turned = rotations("XYZ", [degrees])
    best = compute_continuous_euler_angles(turned, axes_of("X"), np.zeros(1))[0]
    around = np.linspace(-np.pi, np.pi, 721)[:, None]
    distances = np.linalg.norm(compute_euler_matrices(around, axes_of("X")) - turned, axis=(1, 2))
    assert np.linalg.norm(compute_euler_matrices(best[None], axes_of("X")) - turned) <= distances.min() + 1e-9


def test_no_axes_give_no_angles_and_the_identity():
    none = np.zeros(0, int)
    np.testing.assert_array_equal(compute_euler_matrices(np.empty((2, 0)), none), np.tile(np.eye(3), (2, 1, 1)))
    assert compute_continuous_euler_angles(np.tile(np.eye(3), (2, 1, 1)), none, np.empty(0)).shape == (2, 0)
