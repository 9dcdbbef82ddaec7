"""Standing by speed: known times at every rate, no contact from a moving joint, frames without evidence."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.contacts.find_contacts import (
    MIN_CONTACT_PROBABILITY,
    MIN_STANDING_S,
    STANDING_CHANGE_COST,
    STANDING_SPEED_M_S,
    compute_speed,
    compute_standing_logit,
    decode_contacts,
    remove_short_runs,
)
from mocapfix.stats.sequences import find_cheapest_states, find_runs
from tests.contacts.walking_feet import find_true_stances, make_path


def detect_standing(speed: np.ndarray, rate: float, is_ignored: np.ndarray | bool = False):
    return decode_contacts(compute_standing_logit(speed, rate, is_ignored)[:, None], rate)[0][:, 0]


def compute_probability(speed: np.ndarray, rate: float = 120.0, is_ignored: np.ndarray | bool = False):
    return decode_contacts(compute_standing_logit(speed, rate, is_ignored)[:, None], rate)[1][:, 0]


STANCES = [(0.0, 1.0, (0.0, 0.0, 0.0)), (1.4, 2.4, (0.0, 0.0, 0.7)), (2.8, 3.5, (0.0, 0.0, 1.4))]


@pytest.mark.parametrize("rate", [25.0, 30.0, 60.0, 120.0, 250.0, 500.0])
def test_stances_are_found_within_two_frames_and_a_fortieth_of_a_second(rate):
    path = make_path(STANCES, 3.5, rate)
    found = find_runs(detect_standing(compute_speed(path, rate), rate))
    true = find_runs(find_true_stances(STANCES, 3.5, rate))
    assert len(found) == len(true)
    assert np.abs(np.array(found) - np.array(true)).max() <= max(2, 0.025 * rate)


@pytest.mark.parametrize("speed_m_s", [0.0, 0.03, 0.06])
def test_a_slow_joint_stands(speed_m_s):
    assert detect_standing(np.full(100, speed_m_s), 120.0).all()


@pytest.mark.parametrize("speed_m_s", [0.15, 0.5, 3.0])
def test_a_moving_joint_does_not(speed_m_s):
    assert not detect_standing(np.full(100, speed_m_s), 120.0).any()


def test_one_fast_frame_is_no_step():
    speed = np.full(100, 0.01)
    speed[50] = 1.0
    assert detect_standing(speed, 120.0).all()


def test_ignored_frames_follow_the_frames_around_them():
    speed = np.full(200, 0.01)
    speed[60:140] = 1.0
    is_ignored = np.zeros(200, bool)
    is_ignored[60:140] = True
    assert not detect_standing(speed, 120.0)[60:140].any()
    assert detect_standing(speed, 120.0, is_ignored).all()


@given(st.lists(st.floats(0.04, 0.2), min_size=1, max_size=60))
def test_the_cheapest_sequence_stands_where_the_probability_is_that_of_a_contact(speeds):
    speed = np.repeat(speeds, 3)
    state_cost = np.stack([np.zeros(len(speed)), np.clip(np.log(speed / STANDING_SPEED_M_S) / 0.3, -3, 3)], axis=1)
    step_cost = np.zeros((len(speed) - 1, 2, 2))
    step_cost[:, 0, 1] = step_cost[:, 1, 0] = STANDING_CHANGE_COST
    stands = find_cheapest_states(step_cost, state_cost) == 1
    assert (detect_standing(speed, 120.0) == remove_short_runs(stands, 120.0)).mean() > 0.95  # but for sequences of equal cost


def test_the_probability_falls_with_the_speed_at_every_rate():
    for rate in (25.0, 120.0, 500.0):
        probability = [compute_probability(np.full(1000, speed), rate)[500] for speed in (0.05, 0.085, 0.1, 0.15)]
        assert np.all(np.diff(probability) < 0)
        assert probability[0] > 0.95
        assert probability[-1] < 0.03
    assert compute_probability(np.full(100, STANDING_SPEED_M_S))[50] <= 0.5
    assert compute_probability(np.full(100, STANDING_SPEED_M_S - 1e-7))[50] == pytest.approx(MIN_CONTACT_PROBABILITY, abs=1e-3)


def test_an_ignored_time_is_less_certain_the_longer_it_is_between_steps():
    speed, is_ignored = np.full(300, 0.02), np.zeros(300, bool)
    speed[200:], is_ignored[150:250] = 1.0, True
    probability = compute_probability(speed, is_ignored=is_ignored)
    assert probability[100] > probability[160] >= probability[200] >= probability[240] > probability[290]


def test_a_short_slow_time_is_no_contact_and_at_most_even():
    speed = np.full(120, 1.0)
    speed[50:56] = 0.01
    assert compute_probability(speed).max() <= 0.5


@pytest.mark.parametrize("frames", [0, 1, 2, 3])
def test_very_short_takes_have_no_contact(frames):
    path = np.zeros((frames, 3))
    assert compute_speed(path, 120.0).shape == (frames,)
    assert not detect_standing(compute_speed(path, 120.0), 120.0).any()


def test_speed_is_that_of_the_path():
    path = np.outer(np.arange(50) / 100.0, [0.3, 0.0, 0.4])
    np.testing.assert_allclose(compute_speed(path, 100.0), 0.5)


@given(st.lists(st.booleans(), max_size=80), st.floats(20, 500))
def test_remaining_runs_are_long_and_unchanged(values, rate):
    mask = np.array(values, bool)
    kept = remove_short_runs(mask, rate)
    assert set(find_runs(kept)) == {run for run in find_runs(mask) if run[1] + 1 - run[0] >= MIN_STANDING_S * rate - 1e-9}
