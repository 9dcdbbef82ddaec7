"""Gait events of feet whose strikes and offs are known, at all rates, on stairs, and after smoothing by the laboratory."""

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

from mocapfix.contacts.floor import Floor
from mocapfix.contacts.foot_points import FootPoints
from mocapfix.contacts.gait_events import detect_gait_events, find_foot_near_floor, find_rise
from tests.contacts.walking_feet import find_true_stances, make_path, walk

SECONDS = 5.5
FLAT = Floor(0.0, 0.0, (0.0,))
TO_HEEL = np.array([0.0, 0.0, -0.2])


def make_points(stances, rate: float, seconds: float = SECONDS) -> FootPoints:
    """Return heel and toes of a flat foot."""
    toe = make_path(stances, seconds, rate)
    return FootPoints(toe + TO_HEEL, toe)


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
    smooth = FootPoints(*(sosfiltfilt(sections, path, axis=0) for path in make_points(left, 120.0)))
    events = detect_gait_events({"left": smooth}, FLAT, 120.0)
    true = list_true_events(left, "left")
    assert [event.kind for event in events] == [kind for _, kind, _ in true]
    assert np.abs(compute_errors(events, true, "foot strike")).max() < 0.02
    assert 0 < compute_errors(events, true, "foot off").max() < MAX_OFF_DELAY_S


def test_a_foot_that_stands_has_no_events():
    assert detect_gait_events({"left": make_points([(0.0, 9.0, (0.0, 0.02, 0.0))], 100.0)}, FLAT, 100.0) == ()


def test_takes_of_a_few_frames_have_no_events():
    for frames in (0, 1, 5, 29):
        points = FootPoints(np.zeros((frames, 3)), np.zeros((frames, 3)))
        assert detect_gait_events({"left": points}, FLAT, 120.0) == ()


def test_frames_near_the_floor_are_those_of_stances():
    left, _ = walk()
    is_near = find_foot_near_floor(make_points(left, 120.0), FLAT, 120.0)
    true = find_true_stances(left, SECONDS, 120.0)
    assert not (true & ~is_near).any()
    assert (is_near & ~true).sum() < 0.15 * true.sum()


def test_the_rise_of_a_peak_is_between_frames():
    signal = np.array([0.0, 0.0, 0.5, 1.0, 0.0])
    assert find_rise(signal, 3) == pytest.approx(2.8)
    assert find_rise(np.ones(4), 2) == 1.0
    assert find_rise(np.array([5.0, 1.0, 2.0, 1.0]), 2) == pytest.approx(1.8)
