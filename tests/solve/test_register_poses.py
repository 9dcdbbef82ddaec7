"""Initial poses by registration: exact with all markers, valid with few."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.solve import kinematics, mean_pose
from mocapfix.solve.initial_motion import register_poses
from mocapfix.subject.library import load_marker_set
from mocapfix.synthetic import compose_take
from tests.kernels import random_terms

BODY, MARKER_SET = load_cmu31_body(), load_marker_set("cmu41")
MEAN = mean_pose.load_mean_pose_prior("mean-pose", BODY.skeleton)
NOMINAL = Subject(
    BODY.skeleton, MARKER_SET.name, MARKER_SET.labels, MARKER_SET.joints, MARKER_SET.marker_offsets, MARKER_SET.marker_spread
)
CHEST = BODY.skeleton.find_joint("Spine1")
TRUNK = np.isin(MARKER_SET.joints, [0, CHEST])
seeds = st.integers(0, 2**32 - 1)


def simulate_standing(root, turn, subject=NOMINAL):
    """Return joints (T, J, 3), rotations (T, J, 3, 3) and markers (T, K, 3) of a person in the mean pose, moved rigidly."""
    local = np.tile(MEAN.mean_rotations, (len(root), 1, 1, 1))
    local[:, 0] = turn
    zeros = np.zeros(len(root), int)
    motion = Motion(root, local, zeros, zeros, np.zeros((len(root), 0)), np.zeros((len(root), 0)))
    return *kinematics.compute_world_poses(BODY.skeleton, motion), kinematics.compute_joint_and_marker_positions(subject, motion)[
        1
    ]


def register(markers):
    return register_poses(NOMINAL, BODY.free_joints, MEAN, markers)


@given(seeds)
def test_rigid_motion_is_recovered_exactly(seed):
    rng = np.random.default_rng(seed)
    position, rotation, markers = simulate_standing(rng.normal(0, 3, (4, 3)), random_terms.draw_rotations(rng, 4))
    found = register(markers)
    world = kinematics.compute_world_poses(BODY.skeleton, found)
    np.testing.assert_allclose(world[0], position, atol=1e-9)
    np.testing.assert_allclose(world[1], rotation, atol=1e-8)


def test_coplanar_trunk_is_not_reflected():
    flat = replace(NOMINAL, marker_offsets=np.where(TRUNK[:, None], NOMINAL.marker_offsets * [1, 1, 0], NOMINAL.marker_offsets))
    turn = random_terms.draw_rotations(np.random.default_rng(1), 1)
    position, _, markers = simulate_standing(np.ones((1, 3)), turn, flat)
    found = register_poses(flat, BODY.free_joints, MEAN, markers)
    np.testing.assert_allclose(np.linalg.det(found.local_rotations), 1.0)
    np.testing.assert_allclose(kinematics.compute_world_poses(BODY.skeleton, found)[0], position, atol=1e-6)


def test_frame_without_trunk_interpolates_the_root():
    rng = np.random.default_rng(2)
    root, turn = np.linspace([0, 1, 0], [1, 1, 2], 11), random_terms.draw_rotations(rng, 1).repeat(11, 0)
    turn[8:] = random_terms.draw_rotations(rng, 1)
    _, _, markers = simulate_standing(root, turn)
    markers[3:8, TRUNK] = np.nan
    markers[:2] = np.nan
    found = register(markers)
    np.testing.assert_allclose(found.root_position[2:], root[2:], atol=1e-9)  # along the straight line
    np.testing.assert_allclose(found.root_position[:2], root[[2, 2]], atol=1e-9)
    nearest = np.array([2, 2, 2, 2, 2, 2, 8, 8, 8, 9, 10])
    np.testing.assert_allclose(found.local_rotations[[4, 6, 7], 0], turn[nearest[[4, 6, 7]]], atol=1e-8)


@pytest.mark.parametrize("left", [0, 1, 2])
def test_few_markers_still_give_rotations(left):
    markers = simulate_standing(np.zeros((3, 3)), np.tile(np.eye(3), (3, 1, 1)))[2]
    markers[:, left:] = np.nan
    found = register(markers)
    assert np.isfinite(found.root_position).all()
    np.testing.assert_allclose(np.linalg.det(found.local_rotations), 1.0)


def test_marker_on_a_fixed_joint_is_ignored():
    toe = BODY.skeleton.find_joint("LeftToeBase")
    assert not BODY.free_joints[toe]
    with_toe = replace(
        NOMINAL,
        labels=(*NOMINAL.labels, "TOE"),
        joints=np.r_[NOMINAL.joints, toe],
        marker_offsets=np.r_[NOMINAL.marker_offsets, [[0, 0, 0.05]]],
        marker_spread=np.r_[NOMINAL.marker_spread, 0.01],
        marker_sd=np.r_[NOMINAL.marker_sd, 0.0],
    )
    position, _, markers = simulate_standing(np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1)), with_toe)
    found = register_poses(with_toe, BODY.free_joints, MEAN, markers)
    np.testing.assert_allclose(kinematics.compute_world_poses(BODY.skeleton, found)[0], position, atol=1e-6)


def test_walking_joints_are_accurate_and_fixed_joints_at_rest():
    truth = compose_take(seed=1, seconds=6.0, rate=30.0)
    markers = np.where(truth.spike_mask[..., None], np.nan, truth.damaged_positions)
    found = register_poses(truth.subject, BODY.free_joints, MEAN, markers)
    fixed = ~BODY.free_joints
    np.testing.assert_array_equal(
        found.local_rotations[:, fixed], np.tile(MEAN.mean_rotations[fixed], (truth.motion.frame_count, 1, 1, 1))
    )
    np.testing.assert_allclose(np.linalg.det(found.local_rotations), 1.0)
    distance = np.linalg.norm(kinematics.compute_world_poses(truth.subject.skeleton, found)[0] - truth.joint_positions, axis=-1)
    assert np.median(distance) < 0.03
    assert distance.mean() < 0.05
