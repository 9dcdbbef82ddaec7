"""One segment's pose from sums: what Horn's registration says, with the information that a Gaussian has there."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.kernels.moments import (
    HERE,
    INFORMATION,
    MOMENTS,
    POSE,
    THERE,
    TURN,
    WEIGHT,
    Room,
    add_point,
    add_turn,
    carried,
    lay,
    through,
    variance,
)  # fmt: skip
from tests.kernels import drawn

seeds = st.integers(0, 2**32 - 1)
NOTHING = np.zeros((3, 3))
ROOM = Room(np.empty((3, 3)), np.empty((3, 3)), np.empty((4, 4)), np.empty((4, 4)), np.empty((1, 3, 3)))


def laid(points, places, weight, fisher=NOTHING):
    """-> the pose (POSE,) that points (K, 3) at places (K, 3) and `fisher` tell"""
    row, pose = np.zeros(MOMENTS), np.empty(POSE)
    for w, x, p in zip(weight, points, places, strict=True):
        add_point(row, w, x, p)
    add_turn(row, 1.0, tuple(fisher.ravel()))
    lay(row, pose, ROOM)
    return pose


def turn(pose):
    return pose[TURN : TURN + 9].reshape(3, 3)


def information(pose):
    return pose[INFORMATION:].reshape(3, 3)


def moved(rng, count):
    """-> places (K, 3), where a random motion carries them (K, 3), its rotation, weights (K,)"""
    places, rotation = rng.normal(0, 0.1, (count, 3)), drawn.rotations(rng, 1)[0]
    return places, places @ rotation.T + rng.normal(0, 3, 3), rotation, rng.uniform(1e3, 1e5, count)


@given(seeds, st.integers(3, 6))
def test_a_moved_cloud_gives_its_motion_back_wherever_it_is(seed, count):
    rng = np.random.default_rng(seed)
    places, points, rotation, weight = moved(rng, count)
    pose = laid(points, places, weight)
    np.testing.assert_allclose(turn(pose), rotation, atol=1e-7)
    np.testing.assert_allclose([carried(pose, p) for p in places], points, atol=1e-9)
    np.testing.assert_allclose(pose[WEIGHT], weight.sum())


@given(seeds)
def test_two_points_keep_their_middle_and_their_line(seed):
    rng = np.random.default_rng(seed)
    places, points, _, weight = moved(rng, 2)
    pose = laid(points, places, weight)
    np.testing.assert_allclose([carried(pose, p) for p in places], points, atol=1e-7)
    on_line, beside = places[0] + 2 * (places[1] - places[0]), places[0] + [0.0, 0.1, 0.05]
    assert variance(pose, on_line, 0.0, ROOM) < 1e-2
    assert variance(pose, beside, 0.0, ROOM) > 0.1  # nothing tells the turn about the line


@given(seeds)
def test_the_information_is_the_clouds_moment_of_inertia_and_the_prior_adds_its_own(seed):
    rng = np.random.default_rng(seed)
    places, points, rotation, weight = moved(rng, 4)
    known = drawn.spd(rng, 1, 3, 1e3)[0]
    fisher = rotation @ (np.trace(known) / 2 * np.eye(3) - known)
    pose, arm = laid(points, places, weight, fisher), places - weight @ places / weight.sum()
    inertia = np.einsum("k,kab->ab", weight, (arm**2).sum(1)[:, None, None] * np.eye(3) - arm[:, :, None] * arm[:, None])
    np.testing.assert_allclose(information(pose), inertia + known, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(pose[HERE : HERE + 3], weight @ points / weight.sum())
    np.testing.assert_allclose(pose[THERE : THERE + 3], weight @ places / weight.sum())


def test_the_variance_is_how_far_drawn_points_scatter_the_place():
    rng, sd, place = np.random.default_rng(5), 0.005, np.array([0.1, -0.2, 0.3])
    places, points, _, _ = moved(rng, 4)
    weight = np.full(4, sd**-2)
    found = [carried(laid(points + rng.normal(0, sd, points.shape), places, weight), place) for _ in range(4000)]
    foretold = variance(laid(points, places, weight), place, 0.0, ROOM)
    np.testing.assert_allclose(np.var(found, axis=0).mean(), foretold, rtol=0.1)


@given(seeds)
def test_through_a_joint_covariances_add(seed):
    rng = np.random.default_rng(seed)
    known, habit = drawn.spd(rng, 2, 3, 100.0)
    fisher = np.reshape(through(tuple(known.ravel()), tuple(habit.ravel()), ROOM), (3, 3))
    both = np.trace(fisher) * np.eye(3) - fisher
    np.testing.assert_allclose(both, np.linalg.inv(np.linalg.inv(known) + np.linalg.inv(habit)), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(through((0.0,) * 9, tuple(habit.ravel()), ROOM), 0.0, atol=1e-9)


def test_nothing_known_is_nowhere():
    pose = laid(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    assert np.isfinite(pose).all()
    assert variance(pose, np.zeros(3), 1.0, ROOM) == np.inf


def test_a_turn_alone_is_kept():
    rotation = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix()
    np.testing.assert_allclose(turn(laid(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), 7 * rotation)), rotation, atol=1e-12)
