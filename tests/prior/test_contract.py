import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.pose_prior import mean_pose
from mocapfix.pose_prior.gaussian import GaussianModel
from mocapfix.pose_prior.model import compute_pose_vectors, remove_heading
from mocapfix.skeleton import load_cmu31_body

SKELETON = load_cmu31_body().skeleton
MIDDLE = mean_pose.load_mean_pose_prior("mean-pose", SKELETON).mean_rotations
SEEDS = st.integers(0, 2**32 - 1)


def posed(vectors):
    """-> (N, J, 3, 3) the local rotations that vectors (N, J, 3) from the middle mean."""
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3) @ MIDDLE


@given(SEEDS)
def test_where_somebody_faces_is_no_part_of_his_pose(seed):
    rng = np.random.default_rng(seed)
    rotations = Rotation.random(62, rng=rng).as_matrix().reshape(2, 31, 3, 3)
    turned = rotations.copy()
    turned[:, 0] = Rotation.from_euler("y", rng.uniform(-np.pi, np.pi)).as_matrix() @ turned[:, 0]
    np.testing.assert_allclose(compute_pose_vectors(turned, MIDDLE), compute_pose_vectors(rotations, MIDDLE), atol=1e-7)


@given(SEEDS)
def test_a_tilt_is_a_turn_across_the_vertical_that_leans_the_body_as_it_leant(seed):
    rotations = Rotation.random(5, rng=np.random.default_rng(seed)).as_matrix()
    leant = remove_heading(rotations)
    np.testing.assert_allclose(leant[:, 1], rotations[:, 1], atol=1e-12)  # the up vector in the root's axes
    np.testing.assert_allclose(Rotation.from_matrix(leant).as_rotvec()[:, 1], 0, atol=1e-7)


def test_vectors_from_the_middle_turn_it_into_the_pose():
    vectors = np.random.default_rng(0).normal(0, 0.5, (3, 31, 3))
    vectors[:, 0, 1] = 0
    np.testing.assert_allclose(compute_pose_vectors(posed(vectors), MIDDLE), vectors, atol=1e-9)


def test_upside_down_is_a_tilt_too():
    assert np.isfinite(remove_heading(np.diag([1.0, -1.0, -1.0])[None])).all()


def test_information_is_the_inverse_square_of_sigma():
    sigma = np.linspace(0.1, 0.4, 31)
    model = GaussianModel(SKELETON.names, MIDDLE, sigma, np.zeros((31, 3)), np.zeros((2, 31, 3)), 0.1)
    np.testing.assert_allclose(model.residual_information[[0, 4]], [np.eye(3) / sigma[0] ** 2, np.eye(3) / sigma[4] ** 2])
