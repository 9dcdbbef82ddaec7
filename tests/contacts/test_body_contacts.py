"""The stage of contacts in a clean: feet that stay where they stood while they are hidden, and bodies that have no feet."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix import pipeline
from mocapfix.contacts.contacts import CONTACT_JOINTS, NO_FLOOR
from mocapfix.lab.contacts import FootLoss, compute_drift, compute_slide, find_all_true_contacts, find_foot_markers, lose_feet
from mocapfix.lab.sound_takes import remove_damage
from mocapfix.synthetic import SyntheticTake, compose_take, write_synthetic_take

LOSS = FootLoss("left", 560, 640)
"""The left foot stands from frame 463 on."""


@pytest.fixture(scope="module")
def truth() -> SyntheticTake:
    return remove_damage(compose_take(seed=0, seconds=6.0))


@pytest.fixture(scope="module")
def results(truth, tmp_path_factory):
    """Results of the take with its left foot hidden for a while, by the way to hold feet."""
    path = tmp_path_factory.mktemp("contacts") / "hidden.c3d"
    write_synthetic_take(path, lose_feet(truth, [LOSS]))
    return {mode: pipeline.clean(path, feet=mode) for mode in ("off", "soft", "lock")}


def get_feet(position, truth):
    """Return the joints of the feet in the frames in which the left foot is hidden and stands."""
    return position[LOSS.first : LOSS.last + 1][:, [truth.subject.skeleton.find_joint(joint) for joint in CONTACT_JOINTS[:2]]]


def test_the_foot_truly_stands_while_it_is_hidden(truth):
    assert find_all_true_contacts(truth)[LOSS.first : LOSS.last + 1, :2].all()


@pytest.mark.parametrize("mode", ["soft", "lock"])
def test_a_hidden_foot_stays_where_it_stood(truth, results, mode):
    is_contact = np.ones((LOSS.last + 1 - LOSS.first, 2), bool)
    held, unheld = (get_feet(results[name].joint_position_world, truth) for name in (mode, "off"))
    share = 0.75 if mode == "soft" else 0.5  # soft yields to the markers of the shin, which are visible
    assert compute_slide(held, is_contact, truth.rate) < share * compute_slide(unheld, is_contact, truth.rate)
    true = get_feet(truth.joint_positions, truth)
    assert np.linalg.norm(held - true, axis=-1).mean() <= np.linalg.norm(unheld - true, axis=-1).mean() - 0.001
    if mode == "lock":
        assert compute_drift(held, is_contact) < 2.0  # the thigh moves by 2 mm at most


def test_filled_markers_follow_the_held_foot(truth, results):
    lost = find_foot_markers(truth, "left")
    error_mm = {}
    for mode in ("off", "soft"):
        columns = [results[mode].take.bare_labels.index(label) for label in truth.labels]
        error = np.linalg.norm(results[mode].take.markers[:, columns] - truth.marker_positions, axis=-1)
        error_mm[mode] = 1e3 * error[LOSS.first : LOSS.last + 1, lost].mean()
    assert error_mm["soft"] < error_mm["off"] + 0.5
    assert error_mm["soft"] < 12


def test_the_hidden_foot_is_reported_as_inferred(results):
    contacts = results["soft"].contacts
    inner = slice(LOSS.first, LOSS.last + 1)
    assert contacts.is_contact[inner, :2].all()
    assert not contacts.is_known[inner, :2].any()


def test_off_reports_contacts_and_changes_no_foot(results):
    assert results["off"].contacts.is_contact.any()
    assert results["off"].contacts.held_feet.largest_displacement_m == 0


def test_an_upper_body_has_no_contacts(truth, tmp_path):
    names = truth.subject.skeleton.names
    is_leg = np.array([names[joint].endswith(("UpLeg", "Leg", "Foot", "ToeBase")) for joint in truth.subject.joints])
    kept = np.flatnonzero(~is_leg)
    upper = replace(
        truth,
        marker_positions=truth.marker_positions[:, kept],
        damaged_positions=truth.damaged_positions[:, kept],
        missing_mask=truth.missing_mask[:, kept],
        spike_mask=truth.spike_mask[:, kept],
        labels=tuple(truth.labels[k] for k in kept),
    )
    path = tmp_path / "upper.c3d"
    write_synthetic_take(path, upper)
    result = pipeline.clean(path, feet="lock")
    if result.contacts is not None:
        assert not result.contacts.is_contact.any()
        assert result.contacts.floor is NO_FLOOR
        assert result.contacts.events == ()
