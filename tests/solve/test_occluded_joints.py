"""Occluded joints: a lost arm that mirrors the other is inferred from the take."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.skeleton import load_cmu31_body
from mocapfix.solve import occluded_joints
from mocapfix.solve.prior_conditioner import PriorConditioner

BODY = load_cmu31_body()
ARM = ("LeftArm", "LeftForeArm", "LeftHand")
LEFT = [BODY.skeleton.find_joint(name) for name in ARM]
RIGHT = [BODY.skeleton.find_joint(name.replace("Left", "Right")) for name in ARM]
RATE, FRAMES = 60.0, 600
LOST = slice(300, 400)


def mirroring(rng, frames=FRAMES):
    """Return root (T, 3) and local (T, J, 3, 3) of somebody who stands and whose left arm does what the right one does"""
    t = np.arange(frames) / RATE
    local = np.tile(np.eye(3), (frames, len(BODY.skeleton.names), 1, 1))
    for left, right in zip(LEFT, RIGHT, strict=True):
        frequency, phase = rng.uniform(0.2, 0.9, (3, 3)), rng.uniform(0, 2 * np.pi, (3, 3))
        turns = 0.25 * np.sin(2 * np.pi * t[:, None, None] * frequency + phase).sum(1)
        local[:, right] = Rotation.from_rotvec(turns).as_matrix()
        local[:, left] = Rotation.from_rotvec(turns * [1, -1, -1]).as_matrix()
    return np.tile([0.0, 1.0, 0.0], (frames, 1)), local


def recalled(root, truth, gone):
    """Return rotations and variances after recalling, and before"""
    solved, unsure = truth.copy(), np.full(gone.shape, 1e-4)
    solved[gone], unsure[gone] = np.eye(3), 0.3
    found, variance = solved.copy(), unsure.copy()
    occluded_joints.infer_occluded_joints(root, found, variance, gone, BODY.free_joints, RATE)
    return found, variance, solved, unsure


def away(a, b):
    """Return the angle between rotations (N, 3, 3), radians"""
    return Rotation.from_matrix(np.swapaxes(a, 1, 2) @ b).magnitude()


@pytest.mark.parametrize("seed", range(4))
def test_arm_that_mirrors_the_other_is_inferred(seed):
    root, truth = mirroring(np.random.default_rng(seed))
    gone = np.zeros(truth.shape[:2], bool)
    gone[LOST, LEFT] = True
    found, variance, solved, _ = recalled(root, truth, gone)
    for j in LEFT:
        off, guessed = away(found[LOST, j], truth[LOST, j]), away(solved[LOST, j], truth[LOST, j])
        assert off.mean() < 0.25 * guessed.mean()
        assert off.max() < 0.3
        assert ((variance[LOST, j] > 0) & (variance[LOST, j] < 0.3)).all()
        assert variance[LOST.start, j] < 0.2 * variance[(LOST.start + LOST.stop) // 2, j]  # surest at its edges


def test_inferred_arm_is_continuous_at_the_edges():
    root, truth = mirroring(np.random.default_rng(2))
    gone = np.zeros(truth.shape[:2], bool)
    gone[LOST, LEFT] = True
    found = recalled(root, truth, gone)[0]
    for j in LEFT:
        step = away(found[LOST.start - 2 : LOST.stop + 1, j], found[LOST.start - 1 : LOST.stop + 2, j])
        assert step.max() < 1.5 * away(truth[:-1, j], truth[1:, j]).max()


def test_observed_joints_are_bit_identical():
    root, truth = mirroring(np.random.default_rng(0))
    gone = np.zeros(truth.shape[:2], bool)
    gone[LOST, LEFT] = True
    found, variance, solved, was = recalled(root, truth, gone)
    assert found[~gone].tobytes() == solved[~gone].tobytes()
    assert variance[~gone].tobytes() == was[~gone].tobytes()
    np.testing.assert_allclose(np.linalg.det(found), 1.0)


def test_nearby_frames_count_more_where_mirroring_ends():
    root, truth = mirroring(np.random.default_rng(1))
    bent = Rotation.from_rotvec([0.3, 0.0, 0.0]).as_matrix()
    truth[250:450, LEFT[1]] = truth[250:450, LEFT[1]] @ bent  # it stops mirroring a while before it is lost
    gone = np.zeros(truth.shape[:2], bool)
    gone[LOST, LEFT] = True
    off = away(recalled(root, truth, gone)[0][LOST, LEFT[1]], truth[LOST, LEFT[1]])
    assert off[[0, -1]].max() < 0.08


def test_arm_learns_from_frames_that_lost_the_leg_alone():
    root, truth = mirroring(np.random.default_rng(3))
    leg = [BODY.skeleton.find_joint(name) for name in ("LeftUpLeg", "LeftLeg", "LeftFoot")]
    gone = np.zeros(truth.shape[:2], bool)
    gone[LOST, LEFT] = True
    gone[250:500][:, leg] = True
    off = away(recalled(root, truth, gone)[0][LOST, LEFT[1]], truth[LOST, LEFT[1]])
    assert off[[0, -1]].max() < 0.03


def test_nothing_is_inferred_if_most_of_the_body_is_lost():
    root, truth = mirroring(np.random.default_rng(0))
    gone = np.zeros(truth.shape[:2], bool)
    gone[LOST, 1:] = BODY.free_joints[1:]
    found, variance, solved, was = recalled(root, truth, gone)
    np.testing.assert_array_equal(found, solved)
    np.testing.assert_array_equal(variance, was)


def test_rarely_observed_arm_is_not_inferred():
    root, truth = mirroring(np.random.default_rng(0), frames=200)
    gone = np.zeros(truth.shape[:2], bool)
    gone[occluded_joints.MIN_TRAINING_FRAMES - 1 :, LEFT] = True
    found, variance, solved, was = recalled(root, truth, gone)
    np.testing.assert_array_equal(found, solved)
    np.testing.assert_array_equal(variance, was)


def test_nothing_unobserved_changes_nothing():
    root, truth = mirroring(np.random.default_rng(0))
    found, variance, solved, was = recalled(root, truth, np.zeros(truth.shape[:2], bool))
    np.testing.assert_array_equal(found, solved)
    np.testing.assert_array_equal(variance, was)


class Oracle(PriorConditioner):
    """A conditioner that knows the lost arm, apart from a constant rotation of its elbow, and counts its calls."""

    rotations: np.ndarray
    calls: list[np.ndarray]

    def __init__(self, truth, scale=1.0):
        def load_nothing():
            raise AssertionError("no model is loaded")

        super().__init__(load_nothing, scale)
        biased = truth.copy()
        biased[:, LEFT[1]] = biased[:, LEFT[1]] @ Rotation.from_rotvec([0.2, 0.1, 0.0]).as_matrix()
        object.__setattr__(self, "rotations", biased)
        object.__setattr__(self, "calls", [])

    def predict_rotations(self, local_rotations, observed_joints, occluded_joints, frames, reference):
        self.calls.append(frames)
        rotations = self.rotations[frames][:, occluded_joints].reshape(-1, 3, 3)
        quaternions = Rotation.from_matrix(rotations).as_quat().reshape(len(frames), -1, 4)
        is_opposite = (quaternions * reference.reshape(quaternions.shape)).sum(-1, keepdims=True) < 0
        return (2 * np.where(is_opposite, -quaternions, quaternions)).reshape(reference.shape)


@pytest.mark.parametrize(("scale", "better"), [(1.0, 0.95), (0.2, 0.6), (0.05, 0.4)])
def test_pose_model_innovation_is_used_and_its_bias_ignored(scale, better):
    root, truth = mirroring(np.random.default_rng(4))
    own = mirroring(np.random.default_rng(5))[1]
    truth[:, LEFT] = own[:, LEFT]  # it does not mirror: nothing in the take tells of it
    gone = np.zeros(truth.shape[:2], bool)
    gone[LOST, LEFT] = True
    oracle = Oracle(truth, scale)
    found, variance = truth.copy(), np.full(gone.shape, 1e-4)
    found[gone] = np.eye(3)
    occluded_joints.infer_occluded_joints(root, found, variance, gone, BODY.free_joints, RATE, conditioner=oracle)
    alone = recalled(root, truth, gone)[0]
    assert len(oracle.calls) == 1
    for j in LEFT:
        assert away(found[LOST, j], truth[LOST, j]).mean() < better * away(alone[LOST, j], truth[LOST, j]).mean()


def test_pose_model_is_not_used_for_certain_gaps():
    root, truth = mirroring(np.random.default_rng(0))
    gone = np.zeros(truth.shape[:2], bool)
    gone[300:306, LEFT] = True
    oracle = Oracle(truth)
    occluded_joints.infer_occluded_joints(
        root, truth.copy(), np.full(gone.shape, 1e-4), gone, BODY.free_joints, RATE, conditioner=oracle
    )
    assert not oracle.calls
