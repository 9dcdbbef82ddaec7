"""The features of gaps of motion: quaternions, interpolation, heading."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.solve import motion_prior
from mocapfix.stats.rigid_alignment import multiply_quaternions

JOINT_COUNT = len(motion_prior.build_motion_tree().joints)


def draw_windows(seed, count=3):
    """Return random smooth rotations and root positions in all moments of gaps of a second, and their times."""
    rng = np.random.default_rng(seed)
    times_s = motion_prior.compute_token_times(np.ones(count))
    phase, size = rng.uniform(0, 6, (count, 1, JOINT_COUNT, 3)), rng.uniform(0, 0.5, (count, 1, JOINT_COUNT, 3))
    vectors = size * np.sin(2 * times_s[..., None, None] + phase)
    quaternions = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_quat().reshape(*vectors.shape[:-1], 4)
    position = np.stack([times_s, 1 + 0 * times_s, np.sin(times_s)], -1)
    return quaternions.astype(np.float32), position.astype(np.float32), times_s


def hide_inside(count=3, joints=slice(None)):
    is_known = np.ones((count, motion_prior.TOKEN_COUNT, JOINT_COUNT), bool)
    is_known[:, motion_prior.INNER_TOKENS, joints] = False
    return is_known


def test_quaternion_functions_agree_with_scipy():
    rng = np.random.default_rng(0)
    a, b = (Rotation.from_rotvec(rng.normal(0, 1, (50, 3))) for _ in range(2))
    product = multiply_quaternions(a.as_quat().astype(np.float32), b.as_quat().astype(np.float32))
    np.testing.assert_allclose(motion_prior.compute_quaternion_matrices(product), (a * b).as_matrix(), atol=1e-5)
    vectors = motion_prior.compute_quaternion_vectors(a.as_quat().astype(np.float32))
    np.testing.assert_allclose(vectors, a.as_rotvec(), atol=1e-4)
    again = motion_prior.compute_quaternion_matrices(motion_prior.compute_vector_quaternions(vectors))
    np.testing.assert_allclose(again, a.as_matrix(), atol=1e-4)
    np.testing.assert_array_equal(motion_prior.compute_vector_quaternions(np.zeros((1, 3), np.float32)), [[0, 0, 0, 1]])


def test_times_are_known_at_the_edges_and_even_inside():
    times_s = motion_prior.compute_token_times(np.array([1.7]))[0]
    assert len(times_s) == motion_prior.TOKEN_COUNT
    assert times_s[motion_prior.INNER_TOKENS.start - 1] == 0
    assert times_s[motion_prior.INNER_TOKENS.stop] == pytest.approx(1.7)
    np.testing.assert_allclose(np.diff(times_s[motion_prior.INNER_TOKENS]), 0.1)


def test_constant_angular_velocity_is_interpolated_exactly():
    _, _, times_s = draw_windows(0)
    vectors = np.tile((times_s[..., None] * np.array([0.3, 0.5, -0.2]))[:, :, None], (1, 1, JOINT_COUNT, 1))
    true = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_quat().reshape(*vectors.shape[:-1], 4).astype(np.float32)
    position, is_known = np.stack([times_s] * 3, -1).astype(np.float32), hide_inside()
    hidden = np.where(is_known[..., None], true, np.array([0, 0, 0, 1], np.float32))
    hidden_position = np.where(is_known[:, :, :1], position, np.float32(0))
    filled = motion_prior.interpolate_missing_values(hidden, hidden_position, is_known, times_s)
    np.testing.assert_allclose(np.abs((filled.quaternions * true).sum(-1)), 1, atol=1e-5)
    np.testing.assert_allclose(filled.position, position, atol=1e-5)
    assert (filled.edge_s[is_known] == 0).all()
    np.testing.assert_allclose(filled.edge_s.max(), 0.25, atol=2e-3)


def test_values_are_held_beyond_the_last_known_moment():
    quaternions, position, times_s = draw_windows(1)
    is_known = np.ones(quaternions.shape[:3], bool)
    is_known[:, -3:] = False
    filled = motion_prior.interpolate_missing_values(quaternions, position, is_known, times_s)
    np.testing.assert_array_equal(filled.position[:, -1], position[:, -4])
    np.testing.assert_allclose(filled.quaternions[:, -1], quaternions[:, -4], atol=1e-6)


def test_features_do_not_depend_on_heading_and_place():
    quaternions, position, times_s = draw_windows(2)
    turn = Rotation.from_rotvec([0, 1.3, 0])
    turned, moved = quaternions.copy(), turn.apply(position.reshape(-1, 3)).reshape(position.shape) + [2, 0, -5]
    root = turn * Rotation.from_quat(quaternions[:, :, 0].reshape(-1, 4))
    turned[:, :, 0] = root.as_quat().reshape(*times_s.shape, 4)
    is_known, is_inside = hide_inside(joints=slice(1, 4)), np.ones(times_s.shape, bool)
    results = []
    for rotations, places in ((quaternions, position), (turned, moved.astype(np.float32))):
        filled = motion_prior.interpolate_missing_values(rotations, places, is_known, times_s)
        relative, _, _ = motion_prior.remove_window_heading(filled)
        results.append(motion_prior.compute_window_features(relative, is_known, is_inside, times_s))
    assert results[0].shape == (3, motion_prior.TOKEN_COUNT, motion_prior.count_features())
    np.testing.assert_allclose(results[0], results[1], atol=1e-4)


def test_output_scale_vanishes_at_the_edges():
    edge_s = np.array([0.0, motion_prior.EDGE_SOFTENING_S, 100.0], np.float32)
    np.testing.assert_allclose(motion_prior.compute_output_scale(edge_s), [0, 0.5, 1], atol=2e-3)


@pytest.mark.filterwarnings("error")
def test_far_features_have_finite_predictions_without_warnings():
    prior = motion_prior.load_shipped_motion_prior()
    far = np.full((1, motion_prior.TOKEN_COUNT, motion_prior.count_features()), -1e4, np.float32)
    assert np.isfinite(prior.evaluate(far)).all()
