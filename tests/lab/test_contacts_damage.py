"""Damage to standing feet: losses while a foot stands, all markers of one foot, never both feet at once."""

import numpy as np

from mocapfix.contacts.contacts import CONTACT_JOINTS, FOOT_JOINTS
from mocapfix.lab.contacts import (
    LOSS_DURATION_S,
    MIN_SEEN_S,
    FootLoss,
    draw_foot_losses,
    find_all_true_contacts,
    find_foot_markers,
    lose_feet,
    lose_markers,
)
from mocapfix.lab.sound_takes import remove_damage
from mocapfix.synthetic import compose_take

TRUTH = remove_damage(compose_take(seed=1, seconds=10.0))


def test_feet_are_lost_while_they_stand_and_one_at_a_time():
    losses = draw_foot_losses(TRUTH, np.random.default_rng(0))
    is_contact = find_all_true_contacts(TRUTH)
    lost = np.zeros(len(is_contact), int)
    margin = round(MIN_SEEN_S * TRUTH.rate)
    assert {loss.side for loss in losses} == {"left", "right"}
    for side, first, last in losses:
        columns = [CONTACT_JOINTS.index(joint) for joint in FOOT_JOINTS[side]]
        assert is_contact[first - margin : last + margin + 1, columns].all()
        assert LOSS_DURATION_S[0] <= (last + 1 - first) / TRUTH.rate <= LOSS_DURATION_S[1]
        lost[first : last + 1] += 1
    assert lost.max() == 1


def test_the_same_seed_loses_the_same():
    assert draw_foot_losses(TRUTH, np.random.default_rng(3)) == draw_foot_losses(TRUTH, np.random.default_rng(3))


def test_all_markers_of_a_foot_are_lost_and_no_other():
    labels = {label for label, is_on_foot in zip(TRUTH.labels, find_foot_markers(TRUTH, "left"), strict=True) if is_on_foot}
    assert labels == {"LANK", "LHEE", "LTOE", "LMT5"}
    damaged = lose_feet(TRUTH, [FootLoss("left", 100, 160)])
    columns = [TRUTH.labels.index(label) for label in labels]
    assert damaged.missing_mask.sum() == 61 * len(labels)
    assert damaged.missing_mask[100:161, columns].all()
    assert np.isnan(damaged.damaged_positions[damaged.missing_mask]).all()
    assert not TRUTH.missing_mask.any()


def test_feet_can_be_lost_at_any_time():
    losses = [loss for seed in range(5) for loss in draw_foot_losses(TRUTH, np.random.default_rng(seed), at_any_time=True)]
    is_contact = find_all_true_contacts(TRUTH)
    feet = {side: [CONTACT_JOINTS.index(joint) for joint in joints] for side, joints in FOOT_JOINTS.items()}
    assert any(not is_contact[first : last + 1, feet[side]].any(1).all() for side, first, last in losses)


def test_gaps_take_all_markers_of_one_leg_together():
    lost = lose_markers(TRUTH, np.random.default_rng(0)).missing_mask
    joints = np.array(TRUTH.subject.skeleton.names)[TRUTH.subject.joints]
    legs = [np.isin(joints, [side + joint for joint in ("UpLeg", "Leg", "Foot", "ToeBase")]) for side in ("Left", "Right")]
    together = [lost[:, leg].all(1).sum() / TRUTH.rate for leg in legs]
    assert sorted(round(each, 1) for each in together) == [0.0, 1.5]
    assert 0.02 < lost.mean() < 0.12
