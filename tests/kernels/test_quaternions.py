"""Quaternions over time against scipy, and their continuity."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.kernels import lie

seeds = st.integers(0, 2**32 - 1)
HALF_TURNS = [(np.pi, 0, 0), (0, np.pi, 0), (0, 0, -np.pi), (np.pi / np.sqrt(2), 0, np.pi / np.sqrt(2))]


def of(matrices, known=None):
    """Return (T, 4) quaternions of one joint's matrices (T, 3, 3), beside another joint's"""
    both = np.stack([np.tile(np.eye(3), (len(matrices), 1, 1)), matrices], axis=1)
    return lie.extract_joint_quaternions(both, 1, np.ones(len(matrices), bool) if known is None else known)


def about(axis, angle):
    return Rotation.from_rotvec(np.asarray(angle)[:, None] * [axis])


@given(seeds)
def test_quaternions_and_matrices_round_trip(seed):
    rng = np.random.default_rng(seed)
    was = Rotation.random(24, rng).as_matrix().reshape(8, 3, 3, 3)
    now = was.copy()
    stretched = (
        lie.extract_joint_quaternions(was, 1, rng.random(8) < 0.5) * rng.uniform(0.5, 2.0, (8, 1)) * rng.choice([-1, 1], (8, 1))
    )
    now[:, 1] = 0.0
    lie.store_joint_quaternions(stretched, 1, now)
    np.testing.assert_allclose(now, was, atol=1e-14)
    np.testing.assert_array_equal(now[:, [0, 2]], was[:, [0, 2]])


@pytest.mark.parametrize("vector", [(0, 0, 0), (1e-9, 0, 0), (3, 0.5, -0.5), *HALF_TURNS])
def test_quaternions_equal_scipy(vector):
    turn = Rotation.from_rotvec(vector)
    found = of(turn.as_matrix()[None])[0]
    assert abs(found @ turn.as_quat()) == pytest.approx(1.0, abs=1e-15)
    assert np.linalg.norm(found) == pytest.approx(1.0, abs=1e-15)


def test_no_sign_flips_over_two_full_turns():
    angle = np.linspace(0, 4 * np.pi, 200)
    found = of(about([0, 1, 0], angle).as_matrix())
    expected = np.c_[np.zeros(200), np.sin(angle / 2), np.zeros(200), np.cos(angle / 2)]
    np.testing.assert_allclose(found * np.sign(found[0, 3]), expected, atol=1e-12)


def test_no_sign_flips_without_known_frames():
    found = of(about([0, 1, 0], np.linspace(0, 4 * np.pi, 200)).as_matrix(), np.zeros(200, bool))
    assert ((found[1:] * found[:-1]).sum(1) > 0.9).all()


@pytest.mark.parametrize("unknown", [slice(8, 12), slice(0, 4)])
def test_unknown_frames_do_not_flip_later_ones(unknown):
    angle = np.linspace(0, 1, 20)
    angle[unknown] += np.pi  # nonsense
    known = np.ones(20, bool)
    known[unknown] = False
    found = of(about([1, 0, 0], angle).as_matrix(), known)[known]
    assert ((found[1:] * found[:-1]).sum(1) > 0.9).all()
