"""Gait events of feet whose strikes and offs are known, at all rates, on stairs, and after smoothing by the laboratory."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import butter, sosfiltfilt

from mocapfix.contacts.contacts import CONTACT_JOINTS, Floor
from mocapfix.contacts.find_contacts import find_foot_contacts
from mocapfix.contacts.gait_events import (
    FootPoints,
    build_foot_points,
    detect_gait_events,
    find_foot_near_floor,
    find_rise,
    remove_repeated_contacts,
)
from mocapfix.synthetic import STEP_SCHEDULE, compose_take
from tests.contacts.walking_feet import find_true_stances, make_path, walk

SECONDS = 5.5
FLAT = Floor(0.0, 0.0, (0.0,))
TO_HEEL = np.array([0.0, 0.0, -0.2])


def make_points(stances, rate: float, seconds: float = SECONDS) -> FootPoints:
    """Return heel and toes of a flat foot."""
    toe = make_path(stances, seconds, rate)
    return make_seen_points(toe + TO_HEEL, toe)


def make_seen_points(heel: np.ndarray, toe: np.ndarray) -> FootPoints:
    """Return points that markers show."""
    return FootPoints(heel, toe, np.ones((len(heel), 2), bool))


def list_true_events(stances, side: str, seconds: float = SECONDS):
    """Return (side, kind, second) of the events inside a take."""
    events = []
    for first, last, _ in stances:
        if first > 0:
            events.append((side, "foot strike", first))
        if last < seconds:
            events.append((side, "foot off", last))
    return events


MAX_OFF_DELAY_S = 0.07
"""A foot that begins its swing with the least jerk accelerates most 0.07 s later, which slow or smoothed files show alone."""


def compute_errors(events, true, kind: str) -> np.ndarray:
    """Return by how many seconds the events of one kind are late."""
    return np.array([event.time_s - each[2] for event, each in zip(events, true, strict=True) if event.kind == kind])


@pytest.mark.parametrize(("rate", "tolerance_s"), [(50.0, 0.02), (100.0, 0.012), (120.0, 0.01), (250.0, 0.01), (500.0, 0.01)])
def test_strikes_and_offs_of_a_walk(rate, tolerance_s):
    left, right = walk()
    events = detect_gait_events({"left": make_points(left, rate), "right": make_points(right, rate)}, FLAT, rate)
    true = sorted(list_true_events(left, "left") + list_true_events(right, "right"), key=lambda event: event[2])
    assert [(event.side, event.kind) for event in events] == [event[:2] for event in true]
    assert np.abs(compute_errors(events, true, "foot strike")).max() < tolerance_s
    late_s = compute_errors(events, true, "foot off")
    assert -tolerance_s < late_s.min() <= late_s.max() < (MAX_OFF_DELAY_S if rate < 100 else tolerance_s)
    assert {event.source for event in events} == {"markers"}


@pytest.mark.parametrize("step_height_m", [0.17, -0.17])
def test_events_on_stairs(step_height_m):
    left, _ = walk(step_height_m)
    floor = Floor(0.0, 0.0, tuple(sorted(place[1] - 0.025 for _, _, place in left)))
    events = detect_gait_events({"left": make_points(left, 120.0)}, floor, 120.0)
    true = list_true_events(left, "left")
    assert [event.kind for event in events] == [kind for _, kind, _ in true]
    assert np.abs([event.time_s - each[2] for event, each in zip(events, true, strict=True)]).max() < 0.03


def test_smoothed_markers_keep_their_events():
    left, _ = walk()
    sections = butter(2, 6.0 / 60.0, output="sos")
    smooth = make_seen_points(*(sosfiltfilt(sections, path, axis=0) for path in make_points(left, 120.0).paths))
    events = detect_gait_events({"left": smooth}, FLAT, 120.0)
    true = list_true_events(left, "left")
    assert [event.kind for event in events] == [kind for _, kind, _ in true]
    assert np.abs(compute_errors(events, true, "foot strike")).max() < 0.02
    assert 0 < compute_errors(events, true, "foot off").max() < MAX_OFF_DELAY_S


def test_a_foot_that_stands_has_no_events():
    assert detect_gait_events({"left": make_points([(0.0, 9.0, (0.0, 0.02, 0.0))], 100.0)}, FLAT, 100.0) == ()


def test_takes_of_a_few_frames_have_no_events():
    for frames in (0, 1, 5, 29):
        points = make_seen_points(np.zeros((frames, 3)), np.zeros((frames, 3)))
        assert detect_gait_events({"left": points}, FLAT, 120.0) == ()


def test_frames_near_the_floor_are_those_of_stances():
    left, _ = walk()
    is_near = find_foot_near_floor(make_points(left, 120.0), FLAT, 120.0)
    true = find_true_stances(left, SECONDS, 120.0)
    assert not (true & ~is_near).any()
    assert (is_near & ~true).sum() < 0.15 * true.sum()


def test_the_rise_of_a_peak_is_between_frames():
    signal = np.array([0.0, 0.0, 0.5, 1.0, 0.0])
    assert find_rise(signal, 3) == pytest.approx(2.86)
    assert find_rise(np.ones(4), 2) == 1.0
    assert find_rise(np.array([5.0, 1.0, 2.0, 1.0]), 2) == pytest.approx(1.86)


def test_no_event_is_at_the_end_of_a_take_before_its_contact_is_seen():
    left, _ = walk()
    strikes = [first for first, _, _ in left if first > 0]
    points = make_points(left, 120.0)
    for before_s, count in ((0.15, 1), (0.02, 1), (-0.02, 1), (-0.1, 2)):
        stop = round((strikes[1] - before_s) * 120)
        cut = FootPoints(points.heel[:stop], points.toe[:stop], points.is_seen[:stop])
        events = [event for event in detect_gait_events({"left": cut}, FLAT, 120.0) if event.kind == "foot strike"]
        assert len(events) == count, before_s


def test_feet_that_no_marker_shows_have_no_events():
    left, _ = walk()
    points = make_points(left, 120.0)
    points.is_seen[round(1.2 * 120) :] = False
    events = detect_gait_events({"left": points}, FLAT, 120.0)
    assert [event.kind for event in events] == ["foot off", "foot strike"][: len(events)]
    assert all(event.time_s < 1.2 for event in events)
    points.is_seen[:] = False
    assert detect_gait_events({"left": points}, FLAT, 120.0) == ()


def make_heel_first_foot(rate: float, glide_s: float) -> tuple[FootPoints, float]:
    """Return a foot that stands, swings and lands on its heel, and when its heel stops.

    The heel comes down before it stops: for `glide_s` it is as low as it will be. The toes follow 0.1 s later, with more force.
    """
    time_s = np.arange(round(3.0 * rate)) / rate
    heel, toe = np.zeros((2, len(time_s), 3))
    swing = np.clip((time_s - 1.0) / 0.5, 0, 1)
    forward = 1.3 * (2 * swing - swing**2)  # the speed falls steadily from 5.2 m/s to 0
    lift = np.clip((time_s - 1.0) / (0.5 - glide_s), 0, 1)
    heel[:, 1] = 0.03 + 0.25 * np.sin(np.pi * lift) ** 2
    heel[:, 2], toe[:, 2] = forward, forward + 0.25
    toe[:, 1] = 0.03 + 0.1 * np.sin(np.pi * np.clip((time_s - 1.0) / 0.6, 0, 1))
    return make_seen_points(heel, toe), 1.5


@pytest.mark.parametrize("glide_s", [0.06, 0.09, 0.12])
def test_a_heel_that_glides_to_its_place_strikes_when_it_stops(glide_s):
    points, stop_s = make_heel_first_foot(100.0, glide_s)
    [strike] = [event for event in detect_gait_events({"left": points}, FLAT, 100.0) if event.kind == "foot strike"]
    speed = np.linalg.norm(np.gradient(points.heel, 0.01, axis=0), axis=1)
    assert np.interp(strike.time_s, np.arange(len(speed)) / 100.0, speed) < 0.8
    assert abs(strike.time_s - stop_s) < 0.05


def test_small_slow_steps_have_events():
    stances = [(0.0, 1.0, (0.1, 0.03, 0.0)), (1.5, 2.3, (0.1, 0.03, 0.12)), (2.8, np.inf, (0.1, 0.03, 0.24))]
    toe = make_path(stances, 4.0, 120.0, lift_m=0.02)
    events = detect_gait_events({"left": make_seen_points(toe + TO_HEEL, toe)}, FLAT, 120.0)
    assert [event.kind for event in events] == ["foot off", "foot strike", "foot off", "foot strike"]


def test_a_foot_between_two_levels_is_on_neither():
    toe = make_path([(0.0, 1.0, (0.1, 0.43, 0.0)), (1.5, np.inf, (0.1, 0.03, 0.4))], 3.0, 120.0)
    is_near = find_foot_near_floor(make_seen_points(toe + TO_HEEL, toe), Floor(0.0, 0.0, (0.0, 0.2, 0.4)), 120.0)
    assert not is_near[round(1.15 * 120) : round(1.4 * 120)].any()
    assert is_near[:120].all()
    assert is_near[round(1.55 * 120) :].all()


def test_contacts_within_half_a_step_are_one():
    steady = [(np.nan, 0.6), (1.0, 1.6), (2.0, 2.6), (3.0, 3.6), (4.0, np.nan)]
    assert remove_repeated_contacts(steady) == steady
    split = [(np.nan, 0.6), (1.0, 1.1), (1.2, 1.6), *steady[2:]]
    np.testing.assert_equal(remove_repeated_contacts(split), steady)
    split = [*steady[:3], (3.0, 3.5), (3.51, 3.6), *steady[4:]]
    np.testing.assert_equal(remove_repeated_contacts(split), steady)


@pytest.mark.parametrize("seed", [0, 1])
def test_steps_of_a_walk_that_turns_and_stops_are_found_once(seed):
    seconds = 9.9
    take = compose_take(seed=seed, seconds=seconds)
    joints = [take.subject.skeleton.find_joint(joint) for joint in CONTACT_JOINTS]
    position = take.joint_positions[:, joints]
    floor = find_foot_contacts(position, np.full(position.shape[:2], 0.001), take.rate).floor
    is_known = np.ones(position.shape[:2], bool)
    feet = build_foot_points(take.subject, take.motion, take.marker_positions, take.marker_positions, is_known)
    events = detect_gait_events(feet, floor, take.rate)
    found: dict[str, int] = {"foot strike": 0, "foot off": 0}
    for foot, start_s, swing_s, _, _ in STEP_SCHEDULE:
        for kind, time_s in (("foot strike", start_s + swing_s), ("foot off", start_s)):
            side = ("left", "right")[foot]
            near = [e for e in events if (e.side, e.kind) == (side, kind) and abs(e.time_s - time_s) < 0.3]
            assert len(near) <= 1
            found[kind] += len(near)
    assert min(found.values()) >= len(STEP_SCHEDULE) - 2  # the smallest are turns on the spot
    assert len(events) == sum(found.values())


@settings(max_examples=25, deadline=None)
@given(
    cycle_s=st.floats(0.7, 2.2),
    stance_share=st.floats(0.5, 0.75),
    rate=st.sampled_from([60.0, 100.0, 250.0]),
    seed=st.integers(0, 99),
)
def test_no_foot_has_two_events_of_a_kind_within_half_a_step(cycle_s, stance_share, rate, seed):
    left, _ = walk(stance_s=stance_share * cycle_s, swing_s=(1 - stance_share) * cycle_s)
    toe = make_path(left, 6.0, rate) + np.random.default_rng(seed).normal(0, 0.0005, (round(6.0 * rate), 3))
    events = detect_gait_events({"left": make_seen_points(toe + TO_HEEL, toe)}, FLAT, rate)
    for kind in ("foot strike", "foot off"):
        times = [event.time_s for event in events if event.kind == kind]
        assert np.diff(times).min(initial=np.inf) > 0.25 * cycle_s
