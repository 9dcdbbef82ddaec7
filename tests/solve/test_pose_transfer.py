"""The closed form of learned inverse kinematics: what joints determine is exact, the rest is that of the start."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.solve.learned_ik import build_transfer_tree, correct_poses, transfer_poses
from tests.solve.ik_cases import JOINTS, SKELETON, draw_poses, place

TREE = build_transfer_tree(SKELETON)
EXACT_SD_M = 1e-3


def transfer(start, positions, sd=EXACT_SD_M, corrections=None, start_root=None):
    root = np.zeros((len(start), 3)) if start_root is None else start_root
    transferred, features = transfer_poses(TREE, (root, start), positions, np.full(positions.shape[:2], sd))
    zeros = np.zeros((len(start), 3 * JOINTS + 3), np.float32)
    poses = correct_poses(TREE, start, transferred, zeros if corrections is None else corrections)
    return poses, transferred, features


def test_all_given_joints_are_reached():
    start, target = draw_poses(0), draw_poses(1)
    root = np.random.default_rng(0).normal(size=(len(target), 3))
    positions, _ = place(target, root)
    poses, transferred, _ = transfer(start, positions)
    np.testing.assert_allclose(place(poses[1], poses[0])[0], positions, atol=1e-3)
    np.testing.assert_allclose(place(poses[1], poses[0])[0], transferred.position, atol=1e-9)


def test_pose_that_is_already_there_is_unchanged():
    target = draw_poses(1)
    positions, _ = place(target)
    poses, _, features = transfer(target, positions)
    np.testing.assert_allclose(poses[1], target, atol=1e-6)
    np.testing.assert_allclose(poses[0], 0, atol=1e-6)
    swings = features.reshape(len(target), JOINTS, -1)[..., 12:15]
    np.testing.assert_allclose(swings, 0, atol=1e-5)


def test_pose_without_given_joints_is_unchanged():
    start = draw_poses(0)
    root = np.random.default_rng(1).normal(size=(len(start), 3))
    poses, transferred, features = transfer(start, np.full((len(start), JOINTS, 3), np.nan), start_root=root)
    np.testing.assert_allclose(poses[1], start, atol=1e-9)
    np.testing.assert_allclose(poses[0], root, atol=1e-9)
    assert (transferred.authority[:, ~TREE.is_held] == 1).all()
    assert np.isfinite(features).all()


def test_missing_arm_keeps_its_rotations_relative_to_the_chest():
    start, target = draw_poses(0), draw_poses(1)
    positions, _ = place(target)
    arm = [SKELETON.find_joint(f"Left{name}") for name in ("ForeArm", "Hand", "FingerBase", "HandIndex1")]
    arm.append(SKELETON.find_joint("LThumb"))
    positions[:, arm] = np.nan
    poses, _, _ = transfer(start, positions)
    np.testing.assert_allclose(poses[1][:, arm], start[:, arm], atol=1e-9)
    seen = np.setdiff1d(np.arange(JOINTS), arm)
    np.testing.assert_allclose(place(poses[1], poses[0])[0][:, seen], positions[:, seen], atol=1e-3)


def test_inputs_do_not_depend_on_place_and_heading():
    start, target = draw_poses(0), draw_poses(1)
    positions, _ = place(target)
    turn, shift = Rotation.from_rotvec([0.3, 2.0, -0.4]).as_matrix(), np.array([1.0, -2.0, 3.0])
    turned = start.copy()
    turned[:, 0] = turn @ start[:, 0]
    shifted_root = np.broadcast_to(shift, (len(start), 3))
    _, _, features = transfer(start, positions)
    _, _, moved = transfer(turned, positions @ turn.T + shift, start_root=shifted_root)
    np.testing.assert_allclose(moved, features, atol=1e-5)


@pytest.mark.parametrize(("sd", "limit_m"), [(1e-4, 3e-3), (1e-2, 0.2)])
def test_corrections_move_measured_joints_by_little_more_than_their_deviation(sd, limit_m):
    start, target = draw_poses(0), draw_poses(1)
    positions, _ = place(target)
    corrections = np.random.default_rng(0).normal(0, 0.5, (len(start), 3 * JOINTS + 3)).astype(np.float32)
    poses, _, _ = transfer(start, positions, sd, corrections)
    error = np.linalg.norm(place(poses[1], poses[0])[0] - positions, axis=-1)
    leaves = [SKELETON.find_joint(name) for name in ("LeftHandIndex1", "RightHandIndex1", "LThumb", "RThumb")]
    assert error[:, leaves].max() < limit_m + 0.01  # thumbs follow the hand, whose twist is free
    assert np.delete(error, leaves, axis=1).max() < limit_m


def test_corrections_twist_bones_freely():
    start = draw_poses(0)
    positions, rotations = place(start)
    thigh = SKELETON.find_joint("LeftUpLeg")
    bone = SKELETON.offsets[SKELETON.find_joint("LeftLeg")]
    corrections = np.zeros((len(start), 3 * JOINTS + 3), np.float32)
    corrections[:, 3 * thigh : 3 * thigh + 3] = 0.5 * bone / np.linalg.norm(bone)
    poses, _, _ = transfer(start, positions, 1e-4, corrections)
    placed, placed_rotations = place(poses[1], poses[0])
    np.testing.assert_allclose(placed, positions, atol=1e-4)
    change = Rotation.from_matrix(np.swapaxes(rotations[:, thigh], 1, 2) @ placed_rotations[:, thigh]).magnitude()
    np.testing.assert_allclose(change, 0.5, atol=1e-3)


def test_root_follows_the_trunk_if_the_pelvis_is_missing():
    start = draw_poses(0)
    root = np.random.default_rng(1).normal(size=(len(start), 3))
    positions, _ = place(start, root)
    pelvis = [SKELETON.find_joint(n) for n in ("Hips", "LHipJoint", "RHipJoint", "LowerBack", "LeftUpLeg", "RightUpLeg")]
    positions[:, pelvis] = np.nan
    poses, _, _ = transfer(start, positions)
    np.testing.assert_allclose(poses[0], root, atol=1e-3)
    np.testing.assert_allclose(poses[1][:, 0], start[:, 0], atol=1e-2)
