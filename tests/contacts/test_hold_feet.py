"""Legs that hold standing feet: ankles and toes at their targets, the rest of the body where it was, no jumps of the knees."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from mocapfix.contacts.body_contacts import (
    LEG_JOINTS,
    MAX_ROOT_DISPLACEMENT_M,
    MIN_HELD_PROBABILITY,
    build_foot_targets,
    compute_held_displacements,
    displace_feet,
    solve_legs,
)
from mocapfix.contacts.contacts import CONTACT_JOINTS, BodyContacts
from mocapfix.contacts.find_contacts import find_contacts
from mocapfix.model.motion import Motion
from mocapfix.solve import kinematics
from mocapfix.stats.sequences import find_runs
from mocapfix.synthetic import compose_take

RATE = 120.0
TAKE = compose_take(seed=3, seconds=6.0, rate=RATE)
SKELETON = TAKE.subject.skeleton
FEET = np.array([SKELETON.find_joint(joint) for joint in CONTACT_JOINTS])


def make_sliding_motion() -> tuple[Motion, np.ndarray, BodyContacts]:
    """Return the composed motion of a body that sways, so that its feet slide; its joints, and the contacts of the true ones."""
    time_s = np.arange(TAKE.motion.frame_count) / RATE
    sway = 0.004 * np.sin(2 * np.pi * 1.3 * time_s)
    root = TAKE.motion.root_position + np.stack([sway, 0 * sway, 0.5 * sway], axis=1)
    motion = Motion(
        root,
        TAKE.motion.local_rotations,
        *(getattr(TAKE.motion, name) for name in ("status", "iterations", "marker_sd", "joint_sd")),
    )
    contacts = find_contacts(SKELETON, TAKE.motion, TAKE.joint_positions, RATE)
    return motion, compute_joints(motion), contacts


def hold_feet(motion: Motion, before: np.ndarray, contacts: BodyContacts, *, is_locked: bool) -> Motion:
    displacement = compute_held_displacements(SKELETON, before, contacts, is_locked=is_locked)
    return displace_feet(SKELETON, motion, before, displacement, RATE)


def compute_joints(motion: Motion) -> np.ndarray:
    return kinematics.compute_joint_and_marker_positions(TAKE.subject, motion)[0]


def measure_drift(position: np.ndarray, contacts: BodyContacts) -> float:
    """Return the mean over contacts of the largest horizontal distance in metres from the mean place."""
    drifts = []
    for c, joint in enumerate(FEET):
        for first, last in find_runs(contacts.is_contact[:, c]):
            flat = position[first : last + 1, joint][:, [0, 2]]
            drifts.append(np.linalg.norm(flat - flat.mean(0), axis=1).max())
    return float(np.mean(drifts))


def test_locked_feet_do_not_slide_and_the_rest_stays():
    motion, before, contacts = make_sliding_motion()
    held = hold_feet(motion, before, contacts, is_locked=True)
    after = compute_joints(held)
    assert measure_drift(before, contacts) > 0.003
    assert measure_drift(after, contacts) < 0.001
    legs = [SKELETON.find_joint(joint) for joint in (*LEG_JOINTS, "LeftToeBase", "RightToeBase")]
    others = np.setdiff1d(np.arange(len(SKELETON.names)), legs)
    largest = np.linalg.norm(after - before, axis=-1)[:, others].max()
    displacement = np.linalg.norm(after - before, axis=-1)[:, FEET].max()
    assert largest < displacement


def test_hidden_feet_are_held_where_they_probably_stand_and_shown_feet_where_they_do():
    _, before, contacts = make_sliding_motion()
    nothing, is_shown = np.zeros_like(contacts.is_contact), np.ones_like(contacts.is_known)
    lock = partial(compute_held_displacements, SKELETON, before, is_locked=True)
    for difference, is_held in ((0.01, True), (-0.01, False)):
        probability = contacts.is_contact * (MIN_HELD_PROBABILITY + difference)
        probable = replace(contacts, is_contact=nothing, probability=probability)
        np.testing.assert_allclose(lock(replace(probable, is_known=is_shown)), 0, atol=1e-9)
        displacement = lock(replace(probable, is_known=~is_shown))
        assert (np.abs(displacement).max() > 0.005) == is_held
        after = before.copy()
        after[:, FEET] += displacement
        assert (measure_drift(after, contacts) < 0.001) == is_held


@pytest.mark.parametrize("is_locked", [False, True])
def test_nothing_pops_or_sinks(is_locked):
    motion, before, contacts = make_sliding_motion()
    after = compute_joints(hold_feet(motion, before, contacts, is_locked=is_locked))
    largest = [np.linalg.norm(np.diff(position, 2, axis=0), axis=-1).max(0) for position in (before, after)]
    assert largest[1].max() <= 1.2 * largest[0].max()
    assert (after[:, FEET, 1].min(0) > before[:, FEET, 1].min(0) - 0.0005).all()


def test_soft_slides_less_and_moves_less_than_lock():
    motion, before, contacts = make_sliding_motion()
    soft, locked = (compute_joints(hold_feet(motion, before, contacts, is_locked=is_locked)) for is_locked in (False, True))
    assert measure_drift(locked, contacts) < measure_drift(soft, contacts) < measure_drift(before, contacts)


def test_motion_without_contacts_is_returned_unchanged():
    motion, before, contacts = make_sliding_motion()
    contacts.is_contact[:] = False
    assert hold_feet(motion, before, contacts, is_locked=True) is motion


def test_the_given_motion_is_not_changed():
    motion, before, contacts = make_sliding_motion()
    root, local = motion.root_position.copy(), motion.local_rotations.copy()
    hold_feet(motion, before, contacts, is_locked=True)
    np.testing.assert_array_equal(motion.root_position, root)
    np.testing.assert_array_equal(motion.local_rotations, local)


def test_legs_reach_targets_exactly():
    frames = TAKE.motion.select_frames(np.arange(0, 100, 10))
    before = TAKE.joint_positions[::10][:10]
    target = before[:, FEET] + [0.004, 0.0, -0.003]
    poses = frames.root_position, frames.local_rotations[:, : max(FEET) + 1].copy()
    root, local = solve_legs(SKELETON, poses, build_foot_targets(FEET, target), poses)
    local = np.concatenate([local, frames.local_rotations[:, local.shape[1] :]], axis=1)
    moved = replace(frames, root_position=root, local_rotations=local)
    after = kinematics.compute_joint_and_marker_positions(TAKE.subject, moved)[0]
    np.testing.assert_allclose(after[:, FEET], target, atol=0.0003)


def test_a_place_out_of_reach_moves_the_body_no_farther_than_the_limit():
    frames = TAKE.motion.select_frames(np.arange(0, 100, 10))
    before = TAKE.joint_positions[::10][:10]
    displacement = np.zeros((10, len(FEET), 3))
    displacement[:, :2] = [0.1, -0.15, 0.1]
    after = compute_joints(displace_feet(SKELETON, frames, before, displacement, RATE))
    legs = [SKELETON.find_joint(joint) for joint in (*LEG_JOINTS, "LeftToeBase", "RightToeBase")]
    others = np.setdiff1d(np.arange(len(SKELETON.names)), legs)
    assert np.linalg.norm(after - before, axis=-1)[:, others].max() <= MAX_ROOT_DISPLACEMENT_M + 1e-6
    assert np.linalg.norm(after - before, axis=-1)[:, FEET[:2]].min() > 0.01
