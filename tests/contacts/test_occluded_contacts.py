"""Hidden feet: which frames are known, and where a foot must have stood all the time."""

import numpy as np
import pytest

from mocapfix.contacts.find_contacts import BORDER_S, find_certain_occlusions, find_known_frames

RATE = 100.0
HIDDEN = slice(100, 180)


def infer(
    place_change_m: float = 0.0,
    hidden: slice = HIDDEN,
    other_steps: int = 0,
    is_standing_before: bool = True,
    is_other_known: bool = True,
) -> np.ndarray:
    """Return the certain frames of a foot that stands, is hidden, and stands again."""
    position, is_known, is_standing = np.zeros((300, 3)), np.ones(300, bool), np.ones(300, bool)
    is_known[hidden] = False
    position[hidden.stop :, 0] = place_change_m
    position[hidden] = np.nan
    is_standing[: hidden.start] = is_standing_before
    other_standing = np.ones(300, bool)
    for step in range(other_steps):
        other_standing[hidden.start + 5 + 20 * step : hidden.start + 15 + 20 * step] = False
    return find_certain_occlusions(is_standing, position, is_known, other_standing, np.full(300, is_other_known), RATE)


def test_a_foot_at_the_same_place_before_and_after_stood_between():
    assert np.flatnonzero(infer()).tolist() == list(range(100, 180))


def test_a_foot_at_another_place_stepped():
    assert not infer(place_change_m=0.1).any()


def test_a_foot_that_moved_before_may_have_stepped():
    assert not infer(is_standing_before=False).any()


def test_steps_of_the_other_foot_make_a_long_gap_uncertain():
    assert infer(other_steps=1).any()
    assert not infer(other_steps=3).any()


def test_a_short_gap_is_certain_whatever_the_other_foot_does():
    assert infer(hidden=slice(100, 148), other_steps=2).any()


@pytest.mark.parametrize("hidden", [slice(0, 80), slice(220, 300)])
def test_at_the_ends_of_a_take_a_foot_stands_if_the_person_stands_still(hidden):
    assert np.flatnonzero(infer(hidden=hidden)).tolist() == list(range(hidden.start, hidden.stop))
    assert not infer(hidden=hidden, other_steps=1).any()
    assert not infer(hidden=hidden, is_other_known=False).any()


def test_at_the_ends_of_a_take_long_gaps_and_short_stances_are_uncertain():
    assert not infer(hidden=slice(0, 210)).any()
    assert not infer(hidden=slice(95, 300), is_standing_before=False).any()
    assert not infer(hidden=slice(0, 300)).any()


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
