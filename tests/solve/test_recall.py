"""Lost limbs: a take in which one arm mirrors the other tells where the lost one was."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.skeleton import cmu31
from mocapfix.solve import recall

BODY = cmu31()
ARM = ("LeftArm", "LeftForeArm", "LeftHand")
LEFT = [BODY.skeleton.index(name) for name in ARM]
RIGHT = [BODY.skeleton.index(name.replace("Left", "Right")) for name in ARM]
RATE, FRAMES = 60.0, 600
LOST = slice(300, 400)


def mirroring(rng, frames=FRAMES):
    """-> root (T, 3) and local (T, J, 3, 3) of somebody who stands and whose left arm does what the right one does"""
    t = np.arange(frames) / RATE
    local = np.tile(np.eye(3), (frames, len(BODY.skeleton.names), 1, 1))
    for left, right in zip(LEFT, RIGHT, strict=True):
        frequency, phase = rng.uniform(0.2, 0.9, (3, 3)), rng.uniform(0, 2 * np.pi, (3, 3))
        turns = 0.25 * np.sin(2 * np.pi * t[:, None, None] * frequency + phase).sum(1)
        local[:, right] = Rotation.from_rotvec(turns).as_matrix()
        local[:, left] = Rotation.from_rotvec(turns * [1, -1, -1]).as_matrix()
    return np.tile([0.0, 1.0, 0.0], (frames, 1)), local


def recalled(root, truth, gone):
    """-> rotations and variances after recalling, and before"""
    solved, unsure = truth.copy(), np.full(gone.shape, 1e-4)
    solved[gone], unsure[gone] = np.eye(3), 0.3
    found, variance = solved.copy(), unsure.copy()
    recall.lost_joints(root, found, variance, gone, BODY.free, RATE)
    return found, variance, solved, unsure


def away(a, b):
    """-> the angle between rotations (N, 3, 3), radians"""
    return Rotation.from_matrix(np.swapaxes(a, 1, 2) @ b).magnitude()


@pytest.mark.parametrize("seed", range(4))
def test_a_lost_arm_that_mirrors_the_other_is_found(seed):
    root, truth = mirroring(np.random.default_rng(seed))
    gone = np.zeros(truth.shape[:2], bool)
    gone[LOST, LEFT] = True
    found, variance, solved, _ = recalled(root, truth, gone)
    for j in LEFT:
        off, guessed = away(found[LOST, j], truth[LOST, j]), away(solved[LOST, j], truth[LOST, j])
        assert off.mean() < 0.25 * guessed.mean()
        assert off.max() < 0.3
    np.testing.assert_allclose(variance[gone], recall.UNSURE**2)


def test_what_was_not_lost_stays_bit_for_bit():
    root, truth = mirroring(np.random.default_rng(0))
    gone = np.zeros(truth.shape[:2], bool)
    gone[LOST, LEFT] = True
    found, variance, solved, was = recalled(root, truth, gone)
    assert found[~gone].tobytes() == solved[~gone].tobytes()
    assert variance[~gone].tobytes() == was[~gone].tobytes()
    np.testing.assert_allclose(np.linalg.det(found), 1.0)


def test_what_it_misses_at_the_edges_is_carried_in():
    rng = np.random.default_rng(1)
    root, truth = mirroring(rng)
    bent = Rotation.from_rotvec([0.3, 0.0, 0.0]).as_matrix()
    truth[250:450, LEFT[1]] = truth[250:450, LEFT[1]] @ bent  # it stops mirroring a while before it is lost
    gone = np.zeros(truth.shape[:2], bool)
    gone[LOST, LEFT] = True
    off = away(recalled(root, truth, gone)[0][LOST, LEFT[1]], truth[LOST, LEFT[1]])
    assert off[[0, -1]].max() < 0.08
    assert off[50] > 0.15  # in the middle, what happened at the edges is forgotten


def test_a_take_that_has_seen_too_little_is_not_asked():
    root, truth = mirroring(np.random.default_rng(0), frames=200)
    gone = np.zeros(truth.shape[:2], bool)
    gone[:, LEFT] = True
    gone[: round(recall.ENOUGH * RATE) - 1, LEFT] = False
    found, variance, solved, was = recalled(root, truth, gone)
    np.testing.assert_array_equal(found, solved)
    np.testing.assert_array_equal(variance, was)


def test_nothing_lost_is_nothing_changed():
    root, truth = mirroring(np.random.default_rng(0))
    found, variance, solved, was = recalled(root, truth, np.zeros(truth.shape[:2], bool))
    np.testing.assert_array_equal(found, solved)
    np.testing.assert_array_equal(variance, was)


def test_circumstances_are_those_of_the_moving_root():
    t = np.arange(120) / RATE
    turn = Rotation.from_euler("y", 0.5 * t[:, None]).as_matrix()
    root = np.stack([0 * t, 0.9 + 0.1 * t, 0 * t], 1) + 0.7 * np.stack([np.cos(0.5 * t), 0 * t, -np.sin(0.5 * t)], 1)
    said = recall.circumstances(root, turn, RATE)
    np.testing.assert_allclose(said[:, :3], np.tile([0, 1, 0], (120, 1)), atol=1e-12)  # upright
    np.testing.assert_allclose(said[:, 3], root[:, 1])
    np.testing.assert_allclose(said[5:-5, 4:7], np.tile([0, 0.1, -0.35], (110, 1)), atol=1e-4)  # 0.7 m about, at 0.5 rad/s
    np.testing.assert_allclose(said[:, 7:], np.tile([0, 0.5, 0], (120, 1)), atol=1e-9)


def test_the_expectation_is_the_gaussians_conditional_mean():
    rng = np.random.default_rng(5)
    mixing = rng.normal(size=(5, 5))
    features = rng.normal(size=(4000, 5)) @ mixing.T + rng.normal(size=5)
    gone, whole = np.zeros((4000, 3), bool), np.ones(4000, bool)
    gone[10, 1], whole[10] = True, False
    expected = recall.conditional(features, gone, whole, np.arange(5, 30), np.full(5, 1e-6))
    others = [0, 2, 3, 4]
    design = np.c_[features[whole][:, others], np.ones(whole.sum())]
    plane = np.linalg.lstsq(design, features[whole, 1], rcond=None)[0]
    np.testing.assert_allclose(expected[5:30, 1], features[5:30][:, others] @ plane[:4] + plane[4], atol=1e-6)
    assert not expected[:, [0, 2]].any()  # never lost
    assert not expected[:5].any()  # not asked
    assert not expected[30:].any()


def test_each_frame_is_asked_as_though_it_had_lost_what_the_nearest_loss_has():
    features = np.random.default_rng(6).normal(size=(200, 4)) + 5
    gone, whole = np.zeros((200, 2), bool), np.ones(200, bool)
    gone[50, 0], gone[60, 1], whole[[50, 60]] = True, True, False
    expected = recall.conditional(features, gone, whole, np.arange(40, 70), np.full(4, 1e-3))
    np.testing.assert_array_equal(expected[40:70] != 0, np.arange(40, 70)[:, None] // 55 == [0, 1])


@given(st.sets(st.integers(0, 50), min_size=1), st.sets(st.integers(0, 50), min_size=1))
def test_the_nearest_is_no_farther_than_any_other(among, frames):
    among, frames = np.array(sorted(among)), np.array(sorted(frames))
    found = recall.nearest(among, frames)
    assert np.isin(found, among).all()
    np.testing.assert_array_equal(np.abs(found - frames), np.abs(among[None] - frames[:, None]).min(1))
