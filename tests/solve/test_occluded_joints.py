"""Occluded joints: a lost arm that mirrors the other is inferred from the take."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve import occluded_joints
from mocapfix.solve.prior_conditioner import PriorConditioner

BODY = load_cmu31_body()
ARM = ("LeftArm", "LeftForeArm", "LeftHand")
LEFT = [BODY.skeleton.find_joint(name) for name in ARM]
RIGHT = [BODY.skeleton.find_joint(name.replace("Left", "Right")) for name in ARM]
RATE, FRAMES = 60.0, 600
LOST = slice(300, 400)


def draw_mirrored_motion(rng, frames=FRAMES):
    """Return root (T, 3) and local (T, J, 3, 3) of a standing person whose left arm mirrors the right one."""
    t = np.arange(frames) / RATE
    local = np.tile(np.eye(3), (frames, len(BODY.skeleton.names), 1, 1))
    for left, right in zip(LEFT, RIGHT, strict=True):
        frequency, phase = rng.uniform(0.2, 0.9, (3, 3)), rng.uniform(0, 2 * np.pi, (3, 3))
        rotation_vectors = 0.25 * np.sin(2 * np.pi * t[:, None, None] * frequency + phase).sum(1)
        local[:, right] = Rotation.from_rotvec(rotation_vectors).as_matrix()
        local[:, left] = Rotation.from_rotvec(rotation_vectors * [1, -1, -1]).as_matrix()
    return np.tile([0.0, 1.0, 0.0], (frames, 1)), local


def infer_joints(root, rotations, variance, is_unobserved, conditioner=None):
    """Overwrite unobserved rotations and their variance."""
    joints = np.flatnonzero(BODY.free_joints)[1:]
    motion = occluded_joints.KnownMotion(root, rotations, variance, is_unobserved, joints, RATE)
    occluded_joints.infer_occluded_joints(motion, conditioner)


def infer(root, truth, is_unobserved):
    """Return rotations and variances after the inference, and before it."""
    solved, variance_before = truth.copy(), np.full(is_unobserved.shape, 1e-4)
    solved[is_unobserved], variance_before[is_unobserved] = np.eye(3), 0.3
    inferred, variance = solved.copy(), variance_before.copy()
    infer_joints(root, inferred, variance, is_unobserved)
    return inferred, variance, solved, variance_before


def compute_angles(a, b):
    """Return the angles between rotations (N, 3, 3) in radians."""
    return Rotation.from_matrix(np.swapaxes(a, 1, 2) @ b).magnitude()


@pytest.mark.parametrize("seed", range(4))
def test_arm_that_mirrors_the_other_is_inferred(seed):
    root, truth = draw_mirrored_motion(np.random.default_rng(seed))
    is_unobserved = np.zeros(truth.shape[:2], bool)
    is_unobserved[LOST, LEFT] = True
    inferred, variance, solved, _ = infer(root, truth, is_unobserved)
    for j in LEFT:
        error, error_before = compute_angles(inferred[LOST, j], truth[LOST, j]), compute_angles(solved[LOST, j], truth[LOST, j])
        assert error.mean() < 0.25 * error_before.mean()
        assert error.max() < 0.3
        assert ((variance[LOST, j] > 0) & (variance[LOST, j] < 0.3)).all()
        assert variance[LOST.start, j] < 0.2 * variance[(LOST.start + LOST.stop) // 2, j]  # smallest at the edges


def test_inferred_arm_is_continuous_at_the_edges():
    root, truth = draw_mirrored_motion(np.random.default_rng(2))
    is_unobserved = np.zeros(truth.shape[:2], bool)
    is_unobserved[LOST, LEFT] = True
    inferred = infer(root, truth, is_unobserved)[0]
    for j in LEFT:
        step = compute_angles(inferred[LOST.start - 2 : LOST.stop + 1, j], inferred[LOST.start - 1 : LOST.stop + 2, j])
        assert step.max() < 1.5 * compute_angles(truth[:-1, j], truth[1:, j]).max()


def test_observed_joints_are_bit_identical():
    root, truth = draw_mirrored_motion(np.random.default_rng(0))
    is_unobserved = np.zeros(truth.shape[:2], bool)
    is_unobserved[LOST, LEFT] = True
    inferred, variance, solved, variance_before = infer(root, truth, is_unobserved)
    assert inferred[~is_unobserved].tobytes() == solved[~is_unobserved].tobytes()
    assert variance[~is_unobserved].tobytes() == variance_before[~is_unobserved].tobytes()
    np.testing.assert_allclose(np.linalg.det(inferred), 1.0)


def test_nearby_frames_count_more_where_mirroring_ends():
    root, truth = draw_mirrored_motion(np.random.default_rng(1))
    bent = Rotation.from_rotvec([0.3, 0.0, 0.0]).as_matrix()
    truth[250:450, LEFT[1]] = truth[250:450, LEFT[1]] @ bent  # the arms stop mirroring each other 0.8 s before the gap
    is_unobserved = np.zeros(truth.shape[:2], bool)
    is_unobserved[LOST, LEFT] = True
    error = compute_angles(infer(root, truth, is_unobserved)[0][LOST, LEFT[1]], truth[LOST, LEFT[1]])
    assert error[[0, -1]].max() < 0.08


def test_arm_learns_from_frames_that_lost_the_leg_alone():
    root, truth = draw_mirrored_motion(np.random.default_rng(3))
    leg = [BODY.skeleton.find_joint(name) for name in ("LeftUpLeg", "LeftLeg", "LeftFoot")]
    is_unobserved = np.zeros(truth.shape[:2], bool)
    is_unobserved[LOST, LEFT] = True
    is_unobserved[250:500][:, leg] = True
    error = compute_angles(infer(root, truth, is_unobserved)[0][LOST, LEFT[1]], truth[LOST, LEFT[1]])
    assert error[[0, -1]].max() < 0.03


def test_nothing_is_inferred_if_most_of_the_body_is_lost():
    root, truth = draw_mirrored_motion(np.random.default_rng(0))
    is_unobserved = np.zeros(truth.shape[:2], bool)
    is_unobserved[LOST, 1:] = BODY.free_joints[1:]
    inferred, variance, solved, variance_before = infer(root, truth, is_unobserved)
    np.testing.assert_array_equal(inferred, solved)
    np.testing.assert_array_equal(variance, variance_before)


def test_rarely_observed_arm_is_not_inferred():
    root, truth = draw_mirrored_motion(np.random.default_rng(0), frames=200)
    is_unobserved = np.zeros(truth.shape[:2], bool)
    is_unobserved[occluded_joints.MIN_TRAINING_FRAMES - 1 :, LEFT] = True
    inferred, variance, solved, variance_before = infer(root, truth, is_unobserved)
    np.testing.assert_array_equal(inferred, solved)
    np.testing.assert_array_equal(variance, variance_before)


def test_nothing_unobserved_changes_nothing():
    root, truth = draw_mirrored_motion(np.random.default_rng(0))
    inferred, variance, solved, variance_before = infer(root, truth, np.zeros(truth.shape[:2], bool))
    np.testing.assert_array_equal(inferred, solved)
    np.testing.assert_array_equal(variance, variance_before)


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


@pytest.mark.parametrize(("scale", "max_ratio"), [(1.0, 0.95), (0.2, 0.6), (0.05, 0.4)])
def test_pose_model_innovation_is_used_and_its_bias_ignored(scale, max_ratio):
    root, truth = draw_mirrored_motion(np.random.default_rng(4))
    other = draw_mirrored_motion(np.random.default_rng(5))[1]
    truth[:, LEFT] = other[:, LEFT]  # the arms do not mirror each other, so the take has no information on the lost one
    is_unobserved = np.zeros(truth.shape[:2], bool)
    is_unobserved[LOST, LEFT] = True
    oracle = Oracle(truth, scale)
    inferred, variance = truth.copy(), np.full(is_unobserved.shape, 1e-4)
    inferred[is_unobserved] = np.eye(3)
    infer_joints(root, inferred, variance, is_unobserved, oracle)
    without_model = infer(root, truth, is_unobserved)[0]
    assert len(oracle.calls) == 1
    for j in LEFT:
        assert (
            compute_angles(inferred[LOST, j], truth[LOST, j]).mean()
            < max_ratio * compute_angles(without_model[LOST, j], truth[LOST, j]).mean()
        )


def test_pose_model_is_not_used_for_certain_gaps():
    root, truth = draw_mirrored_motion(np.random.default_rng(0))
    is_unobserved = np.zeros(truth.shape[:2], bool)
    is_unobserved[300:306, LEFT] = True
    oracle = Oracle(truth)
    infer_joints(root, truth.copy(), np.full(is_unobserved.shape, 1e-4), is_unobserved, oracle)
    assert not oracle.calls
