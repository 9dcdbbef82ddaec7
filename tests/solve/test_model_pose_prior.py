import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import mean_pose
from mocapfix.solve.pose_prior import GaussianModel, compute_pose_vectors, remove_heading

SKELETON = load_cmu31_body().skeleton
REFERENCE = mean_pose.load_mean_pose_prior("mean-pose", SKELETON).mean_rotations
SEEDS = st.integers(0, 2**32 - 1)


def build_rotations(vectors):
    """Return the local rotations (N, J, 3, 3) of rotation vectors (N, J, 3) from the reference pose."""
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3) @ REFERENCE


@given(SEEDS)
def test_pose_vectors_do_not_depend_on_heading(seed):
    rng = np.random.default_rng(seed)
    rotations = Rotation.random(62, rng=rng).as_matrix().reshape(2, 31, 3, 3)
    turned = rotations.copy()
    turned[:, 0] = Rotation.from_euler("y", rng.uniform(-np.pi, np.pi)).as_matrix() @ turned[:, 0]
    np.testing.assert_allclose(compute_pose_vectors(turned, REFERENCE), compute_pose_vectors(rotations, REFERENCE), atol=1e-7)


@given(SEEDS)
def test_rotation_without_heading_keeps_the_up_vector_and_has_a_horizontal_axis(seed):
    rotations = Rotation.random(5, rng=np.random.default_rng(seed)).as_matrix()
    tilt = remove_heading(rotations)
    np.testing.assert_allclose(tilt[:, 1], rotations[:, 1], atol=1e-12)  # the up vector in the root's axes
    np.testing.assert_allclose(Rotation.from_matrix(tilt).as_rotvec()[:, 1], 0, atol=1e-7)


def test_pose_vectors_rotate_the_reference_pose_to_the_pose():
    vectors = np.random.default_rng(0).normal(0, 0.5, (3, 31, 3))
    vectors[:, 0, 1] = 0
    np.testing.assert_allclose(compute_pose_vectors(build_rotations(vectors), REFERENCE), vectors, atol=1e-9)


def test_heading_of_an_upside_down_rotation_is_finite():
    assert np.isfinite(remove_heading(np.diag([1.0, -1.0, -1.0])[None])).all()


def test_residual_information_is_the_inverse_square_of_the_standard_deviation():
    residual_sd = np.linspace(0.1, 0.4, 31)
    model = GaussianModel(SKELETON.names, REFERENCE, residual_sd, np.zeros((31, 3)), np.zeros((2, 31, 3)), 0.1)
    np.testing.assert_allclose(
        model.residual_information[[0, 4]], [np.eye(3) / residual_sd[0] ** 2, np.eye(3) / residual_sd[4] ** 2]
    )
