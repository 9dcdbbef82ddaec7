import numpy as np
import pytest

from mocapfix.detect import gaps
from mocapfix.take import Take


@pytest.fixture
def take():
    """Four markers at 100 Hz that go along x at 1 m/s: one whole, one with three gaps, one never seen, one island."""
    markers = np.zeros((50, 4, 3))
    markers[..., 0] = np.arange(50)[:, None] / 100
    markers[:5, 1] = markers[20:30, 1] = markers[48:, 1] = np.nan
    markers[:, 2] = np.nan
    markers[np.arange(50) != 7, 3] = np.nan
    return Take(markers, ("LFHD", "Jim:RFHD", "C7", "T10"), 100.0)


def test_every_gap_is_named_with_its_frames(take):
    assert [(f.kind, f.marker, f.first, f.last) for f in gaps.found(take)] == [
        ("leading gap", 1, 0, 4),
        ("gap", 1, 20, 29),
        ("trailing gap", 1, 48, 49),
        ("absent", 2, 0, 49),
        ("leading gap", 3, 0, 6),
        ("trailing gap", 3, 8, 49),
    ]


def test_severity_is_the_way_between_the_edges_where_there_are_two(take):
    severity = [f.severity for f in gaps.found(take)]
    np.testing.assert_allclose(severity, [np.nan, 0.11, np.nan, np.nan, np.nan, np.nan])


def test_reasons_are_sentences_with_the_bare_label_and_seconds(take):
    assert [f.reason for f in gaps.found(take)][:4] == [
        "RFHD is not seen for the take's first 0.05 s.",
        "RFHD is not seen for 0.10 s and moves 110 mm meanwhile.",
        "RFHD is not seen for the take's last 0.02 s.",
        "C7 is never seen in this take.",
    ]
