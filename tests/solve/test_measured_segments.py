"""What an inferred term may do to segments in sight: growth in windows, the share that is kept, and bodies with lost limbs."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mocapfix.contacts.body_contacts import LEGS, compute_held_displacements, displace_feet, hold_measured_feet, move_body
from mocapfix.contacts.contacts import CONTACT_JOINTS, NO_FLOOR, BodyContacts
from mocapfix.model.body_fit import BodyFit
from mocapfix.model.skeleton import is_below
from mocapfix.model.take import Take
from mocapfix.solve.kinematics import compute_joint_and_marker_positions
from mocapfix.solve.measured_segments import (
    MAX_RESIDUAL_GROWTH_M,
    RESIDUAL_WINDOW_S,
    compute_allowed_share,
    measure_residual_growth,
    smooth_share,
    yield_to_markers,
)
from mocapfix.synthetic import compose_take

RATE = 120.0
TAKE = compose_take(seed=3, seconds=3.0, rate=RATE)
NAMES = TAKE.subject.skeleton.names
FRAMES = TAKE.motion.frame_count
MOVING_JOINTS = [  # those that move a marker, without the root
    joint
    for joint in range(1, len(NAMES))
    if any(joint == each or is_below(each, joint, TAKE.subject.skeleton.parents) for each in TAKE.subject.joints.tolist())
]


def test_growth_is_the_change_of_the_mean_distance_in_each_window():
    markers, before = np.zeros((30, 2, 3)), np.zeros((30, 2, 3))
    before[..., 0] = 0.01
    after = before.copy()
    after[10:, 0, 0] = 0.016
    markers[:, 1] = np.nan
    growth = measure_residual_growth(np.array([4, 4]), markers, before, after, 60.0)[4]
    assert len(growth) == 30 + 1 - round(60 * RESIDUAL_WINDOW_S)
    np.testing.assert_allclose(growth[[0, 4, 7, 10]], [0.0, 0.0, 0.003, 0.006], atol=1e-12)


@given(st.lists(st.floats(-0.01, 0.05), min_size=20, max_size=60), st.integers(1, 12))
def test_a_kept_share_brings_every_window_within_the_limit(frame_growth, length):
    growth = np.abs(np.array(frame_growth))
    windows = np.convolve(growth, np.full(length, 1 / length), "valid")
    share = smooth_share(compute_allowed_share(windows, len(growth)), RATE)
    kept = np.convolve(share * growth, np.full(length, 1 / length), "valid")
    assert kept.max() <= MAX_RESIDUAL_GROWTH_M + 1e-12
    assert ((share >= 0) & (share <= 1)).all()


def test_what_is_within_the_limit_is_kept_whole():
    np.testing.assert_array_equal(compute_allowed_share(np.full(20, MAX_RESIDUAL_GROWTH_M), 31), np.ones(31))


@pytest.mark.parametrize("is_locked", [False, True])
@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_contacts_of_lost_legs_move_no_segment_in_sight(is_locked, seed):
    """Random legs are lost for random times and taken to stand, rightly or wrongly; markers have errors of 5 mm."""
    rng = np.random.default_rng(seed)
    markers = TAKE.marker_positions + 0.005 * rng.standard_normal(TAKE.marker_positions.shape[1:])
    is_contact, is_known = np.zeros((FRAMES, len(CONTACT_JOINTS)), bool), np.ones((FRAMES, len(CONTACT_JOINTS)), bool)
    for foot, chain in enumerate(LEGS):
        first, length = rng.integers(20, FRAMES - 220), rng.integers(30, 200)
        lost = slice(first, first + length)
        columns = np.flatnonzero(np.isin(TAKE.subject.joints, [NAMES.index(joint) for joint in chain[rng.integers(0, 3) :]]))
        markers[lost, columns] = np.nan
        is_contact[first - 15 : first + length + 15, 2 * foot : 2 * foot + 2] = True
        is_known[lost, 2 * foot : 2 * foot + 2] = False
    contacts = BodyContacts(CONTACT_JOINTS, is_contact, is_contact * 0.9, is_known, NO_FLOOR, RATE)
    columns = np.arange(len(TAKE.subject.joints))
    body_markers = TAKE.marker_positions
    take = Take(markers, TAKE.labels, RATE)
    body = BodyFit(TAKE.subject, TAKE.subject, columns, take, TAKE.motion, TAKE.joint_positions, body_markers, None)
    body = move_body(body, TAKE.motion)
    held = hold_measured_feet(body, markers, contacts, is_locked=is_locked).body
    displacement = compute_held_displacements(TAKE.subject.skeleton, body.joint_positions, contacts, is_locked=is_locked)
    in_full = move_body(body, displace_feet(TAKE.subject.skeleton, body.motion, body.joint_positions, displacement, RATE))
    assert np.linalg.norm(in_full.joint_positions - body.joint_positions, axis=-1).max() > 0.001
    growth = measure_residual_growth(TAKE.subject.joints, markers, body.marker_positions, held.marker_positions, RATE)
    locked = {joint for chain in LEGS for joint in chain[1:]} if is_locked else set[str]()
    for joint, windows in growth.items():
        if NAMES[joint] not in locked:
            assert windows.max() <= MAX_RESIDUAL_GROWTH_M, NAMES[joint]


@given(seed=st.integers(0, 10_000))
@settings(max_examples=10, deadline=None)
def test_inferred_rotations_yield_to_visible_markers(seed):
    """Random joints turn by up to half a radian for random times, although their markers are visible."""
    rng = np.random.default_rng(seed)
    local_rotations = TAKE.motion.local_rotations.copy()
    for joint in rng.choice(MOVING_JOINTS, 4, replace=False):
        first = int(rng.integers(0, FRAMES - 60))
        span = slice(first, first + int(rng.integers(1, 60)))
        local_rotations[span, joint] = local_rotations[span, joint] @ Rotation.from_rotvec(rng.uniform(-0.3, 0.3, 3)).as_matrix()
    inferred = replace(TAKE.motion, local_rotations=local_rotations)
    before, raw = (compute_joint_and_marker_positions(TAKE.subject, each)[1] for each in (TAKE.motion, inferred))
    markers = before + 0.004 * rng.standard_normal(before.shape[1:])
    motion = yield_to_markers(TAKE.subject, markers, TAKE.motion, inferred, RATE)
    after = compute_joint_and_marker_positions(TAKE.subject, motion)[1]
    for windows in measure_residual_growth(TAKE.subject.joints, markers, before, after, RATE).values():
        assert windows.max() <= MAX_RESIDUAL_GROWTH_M
    hidden = yield_to_markers(TAKE.subject, np.full(before.shape, np.nan), TAKE.motion, inferred, RATE)
    np.testing.assert_array_equal(hidden.local_rotations, local_rotations)
    assert np.linalg.norm(raw - before, axis=-1).max() > 0
