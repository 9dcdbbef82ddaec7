"""Hidden feet: which frames are known, and the contacts that the network tells in the others."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from mocapfix.contacts.find_contacts import (
    BORDER_S,
    FEATURE_COUNT,
    FEATURE_RATE_HZ,
    compute_contact_features,
    find_foot_contacts,
    find_known_frames,
    find_shown_standing,
)
from tests.contacts.walking_feet import find_true_stances, make_feet, walk

RATE = 100.0
HIDDEN = slice(100, 180)
SECONDS = 5.5
SHOWN_SD_M, HIDDEN_SD_M, SOLVED_ERROR_M = 0.003, 0.03, 0.01
ERROR_S = 0.15  # duration of the kernel that makes errors of hidden feet as smooth as the solver's


def hide(hidden: slice, side: int = 0, rate: float = 120.0, error_m: float = SOLVED_ERROR_M, **steps):
    """Return the paths of the feet of a walk, one of which is hidden and solved with a smooth error, and their deviations."""
    stances = walk(**steps)
    feet, columns = make_feet(stances, SECONDS, rate), slice(2 * side, 2 * side + 2)
    sd = np.full(feet.shape[:2], SHOWN_SD_M)
    sd[hidden, columns] = HIDDEN_SD_M
    error = gaussian_filter1d(np.random.default_rng(0).normal(size=(len(feet), 1, 3)), ERROR_S * rate, axis=0)
    is_hidden = gaussian_filter1d((sd[:, 2 * side] == HIDDEN_SD_M) * 1.0, 0.05 * rate)[:, None, None]
    feet[:, columns] += error_m * error / error.std() * is_hidden
    true = np.repeat(np.stack([find_true_stances(foot, SECONDS, rate) for foot in stances], axis=1), 2, axis=1)
    return feet, sd, true


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("rate", [30.0, 60.0, 120.0, 250.0])
def test_steps_of_a_hidden_foot_are_found(rate, side):
    hidden = slice(round(1.2 * rate), round(3.2 * rate))
    feet, sd, true = hide(hidden, side, rate)
    contacts = find_foot_contacts(feet, sd, rate)
    columns = slice(2 * side, 2 * side + 2)
    found, expected = contacts.is_contact[hidden, columns], true[hidden, columns]
    assert not contacts.is_known[hidden, columns].any()
    assert 2 * (found & expected).sum() / (found.sum() + expected.sum()) > 0.85


@pytest.mark.parametrize("hidden", [slice(130, 250), slice(0, 100), slice(500, 660)])
@pytest.mark.parametrize("side", [0, 1])
def test_contacts_that_markers_show_do_not_change_when_another_foot_is_hidden(hidden, side):
    feet, sd, _ = hide(hidden, side)
    whole = find_foot_contacts(make_feet(walk(), SECONDS, 120.0), np.full(sd.shape, SHOWN_SD_M), 120.0)
    contacts = find_foot_contacts(feet, sd, 120.0)
    np.testing.assert_array_equal(contacts.is_contact[contacts.is_known], whole.is_contact[contacts.is_known])
    assert contacts.is_known[:, [2 - 2 * side, 3 - 2 * side]].all()
    assert contacts.floor.level_heights_m == pytest.approx(whole.floor.level_heights_m, abs=0.005)


def test_the_floor_is_where_markers_show_it():
    feet, sd, _ = hide(slice(130, 430))
    feet[130:430, :2, 1] -= 0.05
    assert find_foot_contacts(feet, sd, 120.0).floor.level_heights_m == pytest.approx((0.0,), abs=0.005)


def test_a_foot_in_the_air_is_on_no_level_while_the_foot_that_bears_the_weight_is_hidden():
    feet = np.tile([[0.1, 0.08, 0.0], [0.1, 0.025, 0.15], [-0.1, 0.08, 0.0], [-0.1, 0.025, 0.15]], (1200, 1, 1))
    lifted, hidden = slice(300, 900), slice(400, 800)
    feet[lifted, 2:, 1] += 0.3
    sd = np.full(feet.shape[:2], SHOWN_SD_M)
    sd[hidden, :2] = HIDDEN_SD_M
    contacts = find_foot_contacts(feet, sd, 120.0)
    assert len(contacts.floor.level_heights_m) == 1
    assert not contacts.is_contact[lifted, 2:].any()
    assert contacts.is_contact[hidden, :2].all()


def test_both_feet_are_judged_in_the_same_way():
    feet, sd, _ = hide(slice(150, 330))
    mirrored, swapped = feet[:, [2, 3, 0, 1]] * [-1.0, 1.0, 1.0], sd[:, [2, 3, 0, 1]]
    contacts, others = find_foot_contacts(feet, sd, 120.0), find_foot_contacts(mirrored, swapped, 120.0)
    np.testing.assert_array_equal(contacts.is_contact[:, [2, 3, 0, 1]], others.is_contact)


def test_place_and_heading_do_not_matter():
    feet, sd, _ = hide(slice(150, 330))
    moved = feet @ Rotation.from_euler("y", 70, degrees=True).as_matrix().T + [5.0, 0.3, -2.0]
    contacts, others = find_foot_contacts(feet, sd, 120.0), find_foot_contacts(moved, sd, 120.0)
    assert (contacts.is_contact == others.is_contact).mean() > 0.999


def test_feet_that_markers_never_show_have_no_contacts():
    feet, sd, _ = hide(slice(0, 660))
    sd[:] = 0.05
    assert not find_foot_contacts(feet, sd, 120.0).is_contact.any()


def test_features_of_a_foot_are_its_own_and_those_of_the_other():
    feet, sd, _ = hide(slice(150, 330))
    is_standing, is_known, _ = find_shown_standing(feet, sd, 120.0)
    features = compute_contact_features(feet, sd, is_standing & is_known, 120.0)
    assert features.shape == (2, round(SECONDS * FEATURE_RATE_HZ), FEATURE_COUNT)
    assert np.isfinite(features).all()
    swapped = compute_contact_features(
        feet[:, [2, 3, 0, 1]], sd[:, [2, 3, 0, 1]], (is_standing & is_known)[:, [2, 3, 0, 1]], 120.0
    )
    np.testing.assert_allclose(swapped[::-1], features, atol=1e-5)


def test_known_frames_are_those_of_usual_uncertainty_without_the_borders_of_others():
    sd = np.full(300, 0.005)
    sd[HIDDEN] = 0.015
    is_known = find_known_frames(sd, RATE)
    border = round(BORDER_S * RATE)
    assert np.flatnonzero(~is_known).tolist() == list(range(100 - border, 180 + border))


def test_a_joint_that_is_uncertain_all_the_time_is_never_known():
    assert not find_known_frames(np.full(50, 0.05), RATE).any()
    assert find_known_frames(np.full(50, 0.01), RATE).all()
    assert find_known_frames(np.zeros(0), RATE).shape == (0,)
