"""A segment's pose from registration statistics: Horn's solution, with the information of a Gaussian."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.kernels.belief_propagation import (
    BODY_CENTROID_INDEX,
    INFORMATION_INDEX,
    ROTATION_INDEX,
    SEGMENT_POSE_SIZE,
    STATISTICS_SIZE,
    WEIGHT_INDEX,
    WORLD_CENTROID_INDEX,
    RegistrationWorkspace,
    add_point,
    add_rotation_information,
    compute_point_variance,
    fit_segment_pose,
    propagate_rotation_information,
    transform_point,
)
from tests.kernels import random_terms

seeds = st.integers(0, 2**32 - 1)
NOTHING = np.zeros((3, 3))
WORKSPACE = RegistrationWorkspace(np.empty((3, 3)), np.empty((3, 3)), np.empty((4, 4)), np.empty((4, 4)), np.empty((1, 3, 3)))


def fit(points, places, weight, fisher=NOTHING):
    """Return the pose (POSE,) that points (K, 3) at places (K, 3) and `fisher` tell"""
    row, pose = np.zeros(STATISTICS_SIZE), np.empty(SEGMENT_POSE_SIZE)
    for w, x, p in zip(weight, points, places, strict=True):
        add_point(row, w, x, p)
    add_rotation_information(row, 1.0, tuple(fisher.ravel()))
    fit_segment_pose(row, pose, WORKSPACE)
    return pose


def turn(pose):
    return pose[ROTATION_INDEX : ROTATION_INDEX + 9].reshape(3, 3)


def information(pose):
    return pose[INFORMATION_INDEX:].reshape(3, 3)


def moved(rng, count):
    """Return places (K, 3), where a random motion carries them (K, 3), its rotation, weights (K,)"""
    places, rotation = rng.normal(0, 0.1, (count, 3)), random_terms.draw_rotations(rng, 1)[0]
    return places, places @ rotation.T + rng.normal(0, 3, 3), rotation, rng.uniform(1e3, 1e5, count)


@given(seeds, st.integers(3, 6))
def test_moved_cloud_recovers_its_motion(seed, count):
    rng = np.random.default_rng(seed)
    places, points, rotation, weight = moved(rng, count)
    pose = fit(points, places, weight)
    np.testing.assert_allclose(turn(pose), rotation, atol=1e-7)
    np.testing.assert_allclose([transform_point(pose, p) for p in places], points, atol=1e-9)
    np.testing.assert_allclose(pose[WEIGHT_INDEX], weight.sum())


@given(seeds)
def test_two_points_determine_centroid_and_line(seed):
    rng = np.random.default_rng(seed)
    places, points, _, weight = moved(rng, 2)
    pose = fit(points, places, weight)
    np.testing.assert_allclose([transform_point(pose, p) for p in places], points, atol=1e-7)
    on_line, beside = places[0] + 2 * (places[1] - places[0]), places[0] + [0.0, 0.1, 0.05]
    assert compute_point_variance(pose, on_line, 0.0, WORKSPACE) < 1e-2
    assert compute_point_variance(pose, beside, 0.0, WORKSPACE) > 0.1  # nothing tells the turn about the line


@given(seeds)
def test_information_is_the_moment_of_inertia_plus_the_prior(seed):
    rng = np.random.default_rng(seed)
    places, points, rotation, weight = moved(rng, 4)
    known = random_terms.draw_spd(rng, 1, 3, 1e3)[0]
    fisher = rotation @ (np.trace(known) / 2 * np.eye(3) - known)
    pose, arm = fit(points, places, weight, fisher), places - weight @ places / weight.sum()
    inertia = np.einsum("k,kab->ab", weight, (arm**2).sum(1)[:, None, None] * np.eye(3) - arm[:, :, None] * arm[:, None])
    np.testing.assert_allclose(information(pose), inertia + known, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(pose[WORLD_CENTROID_INDEX : WORLD_CENTROID_INDEX + 3], weight @ points / weight.sum())
    np.testing.assert_allclose(pose[BODY_CENTROID_INDEX : BODY_CENTROID_INDEX + 3], weight @ places / weight.sum())


def test_variance_equals_the_scatter_of_random_draws():
    rng, sd, place = np.random.default_rng(5), 0.005, np.array([0.1, -0.2, 0.3])
    places, points, _, _ = moved(rng, 4)
    weight = np.full(4, sd**-2)
    found = [transform_point(fit(points + rng.normal(0, sd, points.shape), places, weight), place) for _ in range(4000)]
    predicted = compute_point_variance(fit(points, places, weight), place, 0.0, WORKSPACE)
    np.testing.assert_allclose(np.var(found, axis=0).mean(), predicted, rtol=0.1)


@given(seeds)
def test_covariances_add_through_a_joint(seed):
    rng = np.random.default_rng(seed)
    known, joint_information = random_terms.draw_spd(rng, 2, 3, 100.0)
    fisher = np.reshape(propagate_rotation_information(tuple(known.ravel()), tuple(joint_information.ravel()), WORKSPACE), (3, 3))
    both = np.trace(fisher) * np.eye(3) - fisher
    np.testing.assert_allclose(both, np.linalg.inv(np.linalg.inv(known) + np.linalg.inv(joint_information)), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(
        propagate_rotation_information((0.0,) * 9, tuple(joint_information.ravel()), WORKSPACE), 0.0, atol=1e-9
    )


def test_no_information_gives_infinite_variance():
    pose = fit(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    assert np.isfinite(pose).all()
    assert compute_point_variance(pose, np.zeros(3), 1.0, WORKSPACE) == np.inf


def test_rotation_information_alone_is_kept():
    rotation = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix()
    np.testing.assert_allclose(turn(fit(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), 7 * rotation)), rotation, atol=1e-12)
