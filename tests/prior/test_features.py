import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.pose_prior import mean_pose
from mocapfix.pose_prior.pose_features import FEATURE_TYPES, compute_rotation_tensor, compute_rotation_vector_tensor
from mocapfix.skeleton import load_cmu31_body

MIDDLE = torch.as_tensor(
    mean_pose.load_mean_pose_prior("mean-pose", load_cmu31_body().skeleton).mean_rotations, dtype=torch.float32
)
SEEDS = st.integers(0, 2**32 - 1)


def people(seed, spread=0.5):
    vectors = np.random.default_rng(seed).normal(0, spread, (4, 31, 3))
    vectors[:, 0, 1] = 0
    return torch.as_tensor(vectors, dtype=torch.float32)


@pytest.mark.parametrize(("kind", "size"), [("continuous", 183), ("euler", 93)])
@given(seed=SEEDS)
def test_features_are_of_one_pose_only(kind, size, seed):
    features, vectors = FEATURE_TYPES[kind](MIDDLE), people(seed)
    assert features.size == size
    assert features.compute_features(vectors).shape == (4, size)
    torch.testing.assert_close(features.vectors(features.compute_features(vectors)), vectors, atol=2e-4, rtol=0)


def test_euler_angles_are_those_of_a_bvh():
    vectors = people(0)
    turned = Rotation.from_matrix((compute_rotation_tensor(vectors) @ MIDDLE).reshape(-1, 3, 3).numpy())
    angles = FEATURE_TYPES["euler"](MIDDLE).compute_features(vectors).reshape(-1, 3).numpy()
    np.testing.assert_allclose(angles, turned.as_euler("ZYX"), atol=1e-4)


def test_continuous_features_are_columns_of_the_rotations_and_where_up_is():
    vectors = people(1)
    turned = (compute_rotation_tensor(vectors) @ MIDDLE).numpy()
    features = FEATURE_TYPES["continuous"](MIDDLE).compute_features(vectors).numpy()
    np.testing.assert_allclose(features[:, 6:9], turned[:, 2, :, 0], atol=1e-6)
    np.testing.assert_allclose(features[:, 9:12], turned[:, 2, :, 1], atol=1e-6)
    np.testing.assert_allclose(features[:, -3:], np.swapaxes(turned[:, 0], 1, 2) @ [0, 1, 0], atol=1e-6)


@given(SEEDS)
def test_whatever_a_network_says_is_some_pose(seed):
    said = torch.as_tensor(np.random.default_rng(seed).normal(size=(3, 183)), dtype=torch.float32)
    features = FEATURE_TYPES["continuous"](MIDDLE)
    vectors = features.vectors(said)
    assert vectors.isfinite().all()
    assert (vectors.norm(dim=-1) <= np.pi + 1e-5).all()
    again = features.compute_features(features.vectors(features.compute_features(vectors)))
    torch.testing.assert_close(
        again, features.compute_features(vectors), atol=1e-2, rtol=0
    )  # near half a turn, in single precision


def test_nothing_said_is_still_a_pose():
    assert FEATURE_TYPES["continuous"](MIDDLE).vectors(torch.zeros(1, 183)).isfinite().all()


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, 3.1])
def test_rotations_and_logarithms_are_scipys(angle):
    vectors = np.array([[0.6, 0.0, -0.8], [0, 1, 0]]) * angle
    turned = compute_rotation_tensor(torch.as_tensor(vectors))
    np.testing.assert_allclose(turned.numpy(), Rotation.from_rotvec(vectors).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(compute_rotation_vector_tensor(turned).numpy(), vectors, atol=1e-9)


def test_no_turn_has_a_derivative():
    still = torch.zeros(3, requires_grad=True, dtype=torch.float64)
    slope = torch.autograd.functional.jacobian(lambda v: compute_rotation_vector_tensor(compute_rotation_tensor(v)), still)
    torch.testing.assert_close(slope, torch.eye(3, dtype=torch.float64))
