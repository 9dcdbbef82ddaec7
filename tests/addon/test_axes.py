"""Quaternions and axes of the add-on, compared with scipy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.addon.addon_modules import load_addon_module

axes = load_addon_module("axes")
seeds = st.integers(0, 2**32 - 1)


def draw_rotations(seed: int, count: int = 20) -> Rotation:
    return Rotation.from_quat(np.random.default_rng(seed).normal(size=(count, 4)))


@given(seeds)
def test_products_and_inverses_are_those_of_rotations(seed):
    a, b = draw_rotations(seed), draw_rotations(seed + 1)
    product = axes.multiply_quaternions(a.as_quat(), axes.conjugate_quaternions(b.as_quat()))
    np.testing.assert_allclose(Rotation.from_quat(product).as_matrix(), (a * b.inv()).as_matrix(), atol=1e-12)


@given(seeds)
def test_matrices_become_quaternions_and_matrices_again(seed):
    matrices = draw_rotations(seed).as_matrix()
    np.testing.assert_allclose(axes.make_matrices(axes.make_quaternions(matrices)), matrices, atol=1e-12)


@pytest.mark.parametrize("axis", range(3))
def test_half_turns_become_quaternions(axis):
    matrix = -np.eye(3)
    matrix[axis, axis] = 1.0
    np.testing.assert_allclose(np.abs(axes.make_quaternions(matrix)), np.eye(4)[axis], atol=1e-12)


@given(seeds)
def test_quaternions_in_other_axes_are_similar_rotations(seed):
    rotations, other = draw_rotations(seed), draw_rotations(seed + 1, 1)[0]
    changed = axes.rotate_quaternions(rotations.as_quat(), other.as_matrix())
    np.testing.assert_allclose(Rotation.from_quat(changed).as_matrix(), (other * rotations * other.inv()).as_matrix(), atol=1e-12)


def test_up_and_front_are_blenders():
    np.testing.assert_allclose(axes.convert_points(np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])), [[0, 0, 1], [0, -1, 0]])


@given(seeds)
def test_aligned_signs_keep_rotations_and_have_no_jumps(seed):
    rng = np.random.default_rng(seed)
    quaternions = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.2, (50, 3)), axis=0)).as_quat() * rng.choice([-1, 1], (50, 1))
    aligned = axes.align_signs(quaternions)
    np.testing.assert_allclose(np.abs(aligned), np.abs(quaternions))
    assert ((aligned[1:] * aligned[:-1]).sum(-1) > 0).all()
