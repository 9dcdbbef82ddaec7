import numpy as np
import pytest

from mocapfix.detect import gaps
from mocapfix.model.take import Take


@pytest.fixture
def take():
    """Four markers at 100 Hz that move along x at 1 m/s: one complete, one with three gaps, one absent, one visible once."""
    markers = np.zeros((50, 4, 3))
    markers[..., 0] = np.arange(50)[:, None] / 100
    markers[:5, 1] = markers[20:30, 1] = markers[48:, 1] = np.nan
    markers[:, 2] = np.nan
    markers[np.arange(50) != 7, 3] = np.nan
    return Take(markers, ("LFHD", "Jim:RFHD", "C7", "T10"), 100.0)


def test_every_gap_is_reported_with_its_frames(take):
    assert [(f.kind, f.marker, f.first, f.last) for f in gaps.detect_gaps(take)] == [
        ("leading gap", 1, 0, 4),
        ("gap", 1, 20, 29),
        ("trailing gap", 1, 48, 49),
        ("absent", 2, 0, 49),
        ("leading gap", 3, 0, 6),
        ("trailing gap", 3, 8, 49),
    ]


def test_severity_is_the_distance_between_the_edges(take):
    severity = [f.severity for f in gaps.detect_gaps(take)]
    np.testing.assert_allclose(severity, [np.nan, 0.11, np.nan, np.nan, np.nan, np.nan])


def test_reasons_are_sentences_with_the_bare_label_and_seconds(take):
    assert [f.reason for f in gaps.detect_gaps(take)][:4] == [
        "RFHD is missing for the first 0.05 s of the take.",
        "RFHD is missing for 0.10 s and moves by 110 mm across the gap.",
        "RFHD is missing for the last 0.02 s of the take.",
        "C7 is missing in the whole take.",
    ]


def flickering(rate, *gaps):
    """One marker over 200 frames that is missing in the gaps (first, last)."""
    markers = np.zeros((200, 1, 3))
    for first, last in gaps:
        markers[first : last + 1] = np.nan
    return Take(markers, ("LFIN",), rate)


@pytest.mark.parametrize(("rate", "longest"), [(30.0, 1), (50.0, 1), (100.0, 2), (120.0, 2), (250.0, 5)])
def test_longest_flicker_is_a_fiftieth_of_a_second_or_one_frame(rate, longest):
    for length, kind in ((longest, "flicker"), (longest + 1, "gap")):
        (fault,) = gaps.detect_gaps(flickering(rate, (50, 50 + length - 1)))
        assert (fault.kind, fault.first, fault.last) == (kind, 50, 50 + length - 1)


def test_short_gaps_at_the_ends_are_no_flickers():
    assert [f.kind for f in gaps.detect_gaps(flickering(100.0, (0, 0), (199, 199)))] == ["leading gap", "trailing gap"]


def test_each_flicker_states_how_many_there_are():
    found = gaps.detect_gaps(flickering(100.0, (10, 10), (50, 80), (100, 101)))
    assert [f.reason for f in found] == [
        "LFIN is missing for 1 frame (one of its 2 flickers) and moves by 0 mm across the gap.",
        "LFIN is missing for 0.31 s and moves by 0 mm across the gap.",
        "LFIN is missing for 2 frames (one of its 2 flickers) and moves by 0 mm across the gap.",
    ]
    (only,) = gaps.detect_gaps(flickering(100.0, (10, 10)))
    assert only.reason == "LFIN is missing for 1 frame (its only flicker) and moves by 0 mm across the gap."
