from collections import Counter

import numpy as np
import pytest

from mocapfix.lab import training_poses
from mocapfix.lab.training_poses import TrainingPoses, add_mirrored_poses, mirror_pose_vectors
from mocapfix.model.skeleton import load_cmu31_skeleton

NAMES = load_cmu31_skeleton().names
WRISTS = [NAMES.index(name) for name in training_poses.MATCHED_JOINTS]
HIDDEN = [i for i, name in enumerate(NAMES) if name.endswith(training_poses.UNOBSERVED_JOINT_ENDINGS)]
FRAMES = 1000  # of each person


def draw_people(seed=0):
    """Return poses of four people, in which toes follow the knees; the last two lack toes and have turned wrists."""
    rng = np.random.default_rng(seed)
    poses = rng.normal(0, 0.3, (4 * FRAMES, 31, 3))
    for side in ("Left", "Right"):
        poses[:, NAMES.index(f"{side}ToeBase")] = 0.5 * poses[:, NAMES.index(f"{side}Leg")]
    subject_index = np.repeat(np.arange(4), FRAMES)
    poses[2 * FRAMES :, HIDDEN] = 0.1
    for wrist in WRISTS:
        poses[:, wrist] += np.array([-0.1, 0.1, 0.5, 1.5])[subject_index, None] * [1.0, 0.0, 0.0]
    return poses.astype(np.float32), subject_index


def conform(poses, subject_index):
    is_retargeted = subject_index >= 2
    return training_poses.conform_retargeted_poses(poses, subject_index, is_retargeted, np.ones(len(poses)), NAMES)


def test_observed_joints_and_sums_are_unchanged():
    poses, subject_index = draw_people()
    conformed = conform(poses, subject_index)
    np.testing.assert_array_equal(conformed[: 2 * FRAMES], poses[: 2 * FRAMES])
    chains = [[NAMES.index(name) for name in chain] for chain in training_poses.REDIVIDED_CHAINS]
    for chain in chains:
        np.testing.assert_allclose(conformed[:, chain].sum(1), poses[:, chain].sum(1), atol=1e-4)
    others = np.setdiff1d(np.arange(31), [*WRISTS, *HIDDEN, *chains[0], *chains[1]])
    np.testing.assert_allclose(conformed[:, others], poses[:, others], atol=1e-5)


def test_hidden_joints_follow_the_others_as_in_the_reference():
    poses, subject_index = draw_people()
    conformed = conform(poses, subject_index)[2 * FRAMES :]
    toe, knee = (conformed[:, NAMES.index(f"Left{name}")].ravel() for name in ("ToeBase", "Leg"))
    assert np.polyfit(knee, toe, 1)[0] == pytest.approx(0.5, abs=0.05)
    assert np.abs(toe - 0.5 * knee).std() < 0.05


def test_mean_wrists_are_distributed_as_in_the_reference():
    poses, subject_index = draw_people()
    conformed = conform(poses, subject_index)
    means = np.array([conformed[subject_index == person][:, WRISTS, 0].mean() for person in range(4)])
    assert means[2:] == pytest.approx(means[:2], abs=0.03)


def test_motion_without_retargeted_people_is_unchanged():
    poses, subject_index = draw_people()
    is_retargeted, weights = np.zeros(len(poses), bool), np.ones(len(poses))
    result = training_poses.conform_retargeted_poses(poses, subject_index, is_retargeted, weights, NAMES)
    np.testing.assert_array_equal(result, poses)


def test_training_and_held_out_poses_are_conformed_and_mirrored():
    poses, subject_index = draw_people()
    is_held_out = subject_index == 3
    training, held_out = (add_mirrored_poses(poses[part], NAMES) for part in (~is_held_out, is_held_out))
    training_index, held_out_index = (np.tile(subject_index[part], 2) for part in (~is_held_out, is_held_out))
    is_retargeted = np.array([False, False, True, True])
    gathered = TrainingPoses(training, held_out, training_index, held_out_index, is_retargeted, Counter(), 0)
    conformed = training_poses.conform_training_poses(gathered, NAMES, 0.5)
    assert conformed.training_vectors.shape == training.shape
    assert conformed.held_out_vectors[:, HIDDEN].std() > 0.05
    np.testing.assert_allclose(
        mirror_pose_vectors(conformed.held_out_vectors[:FRAMES], NAMES), conformed.held_out_vectors[FRAMES:], atol=1e-6
    )
