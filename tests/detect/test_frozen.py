import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.detect import external_fills
from mocapfix.io import capture
from mocapfix.model.take import Take
from tests.captures import CAPTURES, needs_captures
from tests.detect.filled import LABELS, as_floats, walking


def freeze(take, marker, first, last):
    markers = take.markers.copy()
    markers[first : last + 1, marker] = markers[first - 1, marker]
    return take.replace_markers(markers)


@given(
    rate=st.sampled_from([60.0, 120.0, 250.0]), start=st.floats(0.5, 2.5), seconds=st.floats(0.12, 1.4), marker=st.integers(0, 3)
)
def test_frozen_marker_is_found_to_the_frame(rate, start, seconds, marker):
    first, last = round(start * rate), round((start + seconds) * rate)
    (fault,) = external_fills.detect_frozen(freeze(walking(rate), marker, first, last))
    assert (fault.marker, fault.first, fault.last) == (marker, first, last)


def test_reason_severity_and_confidence():
    take = freeze(walking(), 2, 200, 259)
    (fault,) = external_fills.detect_frozen(take)
    assert fault.reason == f"C keeps one value for 0.50 s while its neighbours move by {fault.severity * 1e3:.0f} mm."
    travel_m = np.linalg.norm(take.markers[199:260] - take.markers[199], axis=-1).max(0)
    np.testing.assert_allclose(fault.severity, np.median(np.delete(travel_m, 2)), rtol=0.02)
    assert fault.confidence > 0.9


def test_frozen_at_both_ends_of_the_take():
    take = freeze(walking(), 1, 400, 479)
    markers = take.markers.copy()
    markers[:60, 0] = markers[60, 0]
    faults = external_fills.detect_frozen(take.replace_markers(markers))
    assert [(f.marker, f.first, f.last) for f in faults] == [(0, 0, 60), (1, 400, 479)]


def test_body_at_rest_is_not_frozen():
    take = walking()
    markers = take.markers.copy()
    markers[100:200] = markers[100]
    assert external_fills.detect_frozen(take.replace_markers(markers)) == []


def test_body_almost_at_rest_in_a_file_of_coarse_integers():
    """With a millimetre of sway in steps of half a millimetre, values repeat for long."""
    t = np.arange(960)[:, None, None] / 120
    places = np.random.default_rng(5).normal(0, 0.1, (1, 4, 3))
    coarse = np.rint((places + 0.001 * np.sin(t * [1.0, 1.3, 0.7] + np.arange(4)[:, None])) / 5e-4) * 5e-4
    assert external_fills.detect_frozen(Take(coarse, LABELS, 120.0)) == []


def test_missing_neighbours_are_ignored():
    take = freeze(walking(), 0, 200, 259)
    markers = take.markers.copy()
    markers[195:265, 1] = np.nan
    assert len(external_fills.detect_frozen(take.replace_markers(markers))) == 1
    markers[195:265, 2:] = np.nan
    assert external_fills.detect_frozen(take.replace_markers(markers)) == []


def test_short_stretch_is_no_fault():
    assert external_fills.detect_frozen(freeze(walking(), 0, 200, 206)) == []
    assert len(external_fills.detect_frozen(freeze(walking(), 0, 200, 212))) == 1


def test_sound_and_empty_takes():
    assert external_fills.detect_frozen(walking()) == []
    assert external_fills.detect_frozen(Take(np.zeros((10, 0, 3)), (), 120.0)) == []
    assert external_fills.detect_frozen(Take(np.zeros((0, 2, 3)), ("a", "b"), 120.0)) == []
    assert external_fills.detect_frozen(Take(np.full((50, 2, 3), np.nan), ("a", "b"), 120.0)) == []


@needs_captures
@pytest.mark.parametrize("name", ["cmu/05_13", "cmu/85_02", "c3d/walkingOptiTrack", "c3d/PiG_Motion-FlatFoot-Hole"])
def test_captures_have_no_frozen_markers(name):
    take = capture.read_take(CAPTURES / f"{name}.c3d")
    assert external_fills.detect_frozen(take) == []
    moving = np.linalg.norm(np.diff(take.markers, axis=0), axis=-1)
    frame, marker = np.unravel_index(np.nan_to_num(moving)[60:-60].argmax(), moving[60:-60].shape)
    damaged = freeze(take, marker, frame + 45, frame + 75)
    assert [f.marker for f in external_fills.detect_frozen(damaged)] == [marker]


def test_32_bit_floats():
    assert len(external_fills.detect_frozen(as_floats(freeze(walking(), 0, 200, 259)))) == 1
