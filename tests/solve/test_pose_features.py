import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import mean_pose
from mocapfix.solve.pose_features import FEATURE_TYPES, compute_rotation_tensor, compute_rotation_vector_tensor

REFERENCE = torch.as_tensor(
    mean_pose.load_mean_pose_prior("mean-pose", load_cmu31_body().skeleton).mean_rotations, dtype=torch.float32
)
SEEDS = st.integers(0, 2**32 - 1)


def draw_vectors(seed, spread=0.5):
    vectors = np.random.default_rng(seed).normal(0, spread, (4, 31, 3))
    vectors[:, 0, 1] = 0
    return torch.as_tensor(vectors, dtype=torch.float32)


@pytest.mark.parametrize(("kind", "size"), [("continuous", 183), ("euler", 93)])
@given(seed=SEEDS)
def test_features_determine_the_pose(kind, size, seed):
    features, vectors = FEATURE_TYPES[kind](REFERENCE), draw_vectors(seed)
    assert features.feature_count == size
    assert features.compute_features(vectors).shape == (4, size)
    torch.testing.assert_close(features.compute_vectors(features.compute_features(vectors)), vectors, atol=2e-4, rtol=0)


def test_euler_features_are_zyx_angles():
    vectors = draw_vectors(0)
    rotations = Rotation.from_matrix((compute_rotation_tensor(vectors) @ REFERENCE).reshape(-1, 3, 3).numpy())
    angles = FEATURE_TYPES["euler"](REFERENCE).compute_features(vectors).reshape(-1, 3).numpy()
    np.testing.assert_allclose(angles, rotations.as_euler("ZYX"), atol=1e-4)


def test_continuous_features_are_rotation_columns_and_the_up_vector():
    vectors = draw_vectors(1)
    rotations = (compute_rotation_tensor(vectors) @ REFERENCE).numpy()
    features = FEATURE_TYPES["continuous"](REFERENCE).compute_features(vectors).numpy()
    np.testing.assert_allclose(features[:, 6:9], rotations[:, 2, :, 0], atol=1e-6)
    np.testing.assert_allclose(features[:, 9:12], rotations[:, 2, :, 1], atol=1e-6)
    np.testing.assert_allclose(features[:, -3:], np.swapaxes(rotations[:, 0], 1, 2) @ [0, 1, 0], atol=1e-6)


@given(SEEDS)
def test_any_features_give_a_valid_pose(seed):
    raw = torch.as_tensor(np.random.default_rng(seed).normal(size=(3, 183)), dtype=torch.float32)
    features = FEATURE_TYPES["continuous"](REFERENCE)
    vectors = features.compute_vectors(raw)
    assert vectors.isfinite().all()
    assert (vectors.norm(dim=-1) <= np.pi + 1e-5).all()
    again = features.compute_features(features.compute_vectors(features.compute_features(vectors)))
    # the tolerance allows for single precision close to a half turn
    torch.testing.assert_close(again, features.compute_features(vectors), atol=1e-2, rtol=0)


def test_zero_features_give_a_finite_pose():
    assert FEATURE_TYPES["continuous"](REFERENCE).compute_vectors(torch.zeros(1, 183)).isfinite().all()


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, 3.1])
def test_rotations_and_rotation_vectors_agree_with_scipy(angle):
    vectors = np.array([[0.6, 0.0, -0.8], [0, 1, 0]]) * angle
    rotations = compute_rotation_tensor(torch.as_tensor(vectors))
    np.testing.assert_allclose(rotations.numpy(), Rotation.from_rotvec(vectors).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(compute_rotation_vector_tensor(rotations).numpy(), vectors, atol=1e-9)


def test_derivative_at_the_identity_is_finite():
    zero = torch.zeros(3, requires_grad=True, dtype=torch.float64)
    slope = torch.autograd.functional.jacobian(lambda v: compute_rotation_vector_tensor(compute_rotation_tensor(v)), zero)
    torch.testing.assert_close(slope, torch.eye(3, dtype=torch.float64))
