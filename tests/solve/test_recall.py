"""Lost limbs: which they are, and that a take in which one arm mirrors the other tells where the lost one was."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix import marker_set
from mocapfix.skeleton import cmu31
from mocapfix.solve import recall
from mocapfix.subject import Subject

BODY, WORN = cmu31(), marker_set.load("cmu41")
SUBJECT = Subject(BODY.skeleton, WORN.name, WORN.labels, WORN.joints, WORN.places, WORN.spread)
ARM = ("LeftArm", "LeftForeArm", "LeftHand")
LEFT = [BODY.skeleton.index(name) for name in ARM]
RIGHT = [BODY.skeleton.index(name.replace("Left", "Right")) for name in ARM]
RATE, FRAMES = 60.0, 600
LOST = slice(300, 400)


def listening(*labels, frames=(2,)):
    """-> (5, K) bool: all markers are listened to, but for these in these frames"""
    listened = np.ones((5, len(WORN.labels)), bool)
    for label in labels:
        listened[list(frames), WORN.labels.index(label)] = False
    return listened


def on(*names):
    return [label for label, joint in zip(WORN.labels, WORN.joints, strict=True) if BODY.skeleton.names[joint] in names]


def lost(listened):
    return {(int(t), BODY.skeleton.names[j]) for t, j in np.argwhere(recall.lost(listened, SUBJECT, BODY.free))}


def test_while_all_is_seen_nothing_is_lost():
    assert lost(listening()) == set()


def test_an_arm_without_markers_is_lost_in_those_frames():
    assert lost(listening(*on(*ARM))) == {(2, name) for name in ARM}
    assert lost(listening(*on(*ARM), frames=(0, 4))) == {(t, name) for t in (0, 4) for name in ARM}


def test_a_joint_with_a_marker_farther_out_is_not_lost():
    assert lost(listening(*on("LeftArm", "LeftForeArm"))) == set()
    assert lost(listening(*on("LeftForeArm", "LeftHand"))) == {(2, "LeftForeArm"), (2, "LeftHand")}
    assert lost(listening(*on("LeftHand")[1:])) == set()


def test_a_limb_that_the_take_never_shows_is_not_lost_but_unknown():
    assert lost(listening(*on(*ARM), frames=range(5))) == set()


def test_the_root_and_joints_that_cannot_turn_are_never_lost():
    nothing = np.zeros((5, len(WORN.labels)), bool)
    nothing[0] = True
    gone = recall.lost(nothing, SUBJECT, BODY.free)
    assert not gone[:, 0].any()
    assert not gone[:, ~BODY.free].any()
    assert gone[1:, LEFT].all()
    assert not gone[0].any()


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
    solved, variance = truth.copy(), np.full(gone.shape, 1e-4)
    solved[gone], variance[gone] = np.eye(3), 0.3
    return *recall.recalled(root, solved, variance, gone, BODY.free, RATE), solved, variance


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
    found = recall.conditional(features, gone, whole, np.full(5, 1e-6))[10]
    others = [0, 2, 3, 4]
    design = np.c_[features[whole][:, others], np.ones(whole.sum())]
    plane = np.linalg.lstsq(design, features[whole, 1], rcond=None)[0]
    assert found[1] == pytest.approx(features[10, others] @ plane[:4] + plane[4], abs=1e-6)
    assert found[[0, 2]].tolist() == [0.0, 0.0]  # not asked
