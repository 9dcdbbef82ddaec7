import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.detect import ghosts
from mocapfix.io import capture
from mocapfix.model.take import Take
from tests.captures import CAPTURES, needs_captures
from tests.detect.bodies import exchanged, hidden, turning


def add_ghost(take: Take, marker: int, first: int, last: int, away=(0.0, 0.25, 0.0)) -> Take:
    """Keep the label over first..last at its first position plus `away` (3,)."""
    markers = take.markers.copy()
    markers[first : last + 1, marker] = markers[first, marker] + np.array(away)
    return take.replace_markers(markers)


def where(found):
    return [(ghost.marker, ghost.first, ghost.last) for ghost in found]


@given(seed=st.integers(0, 20), marker=st.integers(0, 9), first=st.integers(1, 300), length=st.integers(10, 90))
def test_ghost_that_comes_back_is_found_to_the_frame(seed, marker, first, length):
    (ghost,) = ghosts.detect_ghosts(add_ghost(turning(seed=seed), marker, first, first + length - 1))
    assert where([ghost]) == [(marker, first, first + length - 1)]
    assert ghost.confidence > 0.6


def test_ghost_between_gaps_and_persistent_ghost():
    between = hidden(hidden(add_ghost(turning(), 3, 150, 200), 3, 120, 149), 3, 201, 240)
    assert where(ghosts.detect_ghosts(between)) == [(3, 150, 200)]
    assert where(ghosts.detect_ghosts(add_ghost(turning(), 3, 410, 479))) == [(3, 410, 479)]


def test_shift_on_the_segment_is_no_ghost():
    take = turning(seconds=4.0)
    markers = take.markers.copy()
    markers[420:, 3] = markers[420:, [0, 1, 2]].mean(1)  # rides on the segment as before
    assert ghosts.detect_ghosts(take.replace_markers(markers)) == []


def test_spikes_gaps_and_a_sound_take_are_no_ghosts():
    take = turning()
    assert ghosts.detect_ghosts(take) == []
    assert ghosts.detect_ghosts(hidden(add_ghost(take, 2, 100, 104), 2, 200, 290)) == []


def test_reason_names_label_duration_and_distance():
    (ghost,) = ghosts.detect_ghosts(add_ghost(turning(), 4, 100, 159))
    assert ghost.reason.startswith(f"M4 is {ghost.severity * 1e3:.0f} mm off its segment for 0.50 s (60 frames), ")
    assert ghost.reason.endswith("and returns.")
    assert ghost.severity > 0.05


def test_takes_without_frames_or_markers_have_no_ghosts():
    for shape in [(0, 3, 3), (1, 3, 3), (10, 0, 3)]:
        assert ghosts.detect_ghosts(Take(np.zeros(shape), ("A", "B", "C")[: shape[1]], 100.0)) == []
    assert ghosts.detect_ghosts(Take(np.full((50, 3, 3), np.nan), ("A", "B", "C"), 100.0)) == []


def test_swapped_labels_look_like_ghosts():
    assert {ghost.marker for ghost in ghosts.detect_ghosts(exchanged(turning(), (1, 7), 100, 160))} == {1, 7}


@needs_captures
@pytest.mark.parametrize("name", ["cmu/02_05", "cmu/85_02", "c3d/tennis_serve_motive", "c3d/squat"])
def test_captures_have_no_ghosts(name):
    assert ghosts.detect_ghosts(capture.read_take(CAPTURES / f"{name}.c3d")) == []


def test_return_in_small_steps_is_no_ghost():
    """After a gap a marker is displaced on its segment, and slides back while the whole body is thrown."""
    take = hidden(turning(), 3, 100, 149)
    markers = take.markers.copy()
    slide = np.interp(np.arange(len(markers)), [149, 150, 186, 198], [0, 0.08, 0.08, 0])
    markers[:, 3, 1] += slide
    markers[192:] += [0.0, 0.0, 0.03]
    assert ghosts.detect_ghosts(take.replace_markers(markers)) == []
    markers[192:, 3, 1] -= slide[192:]  # the same, but the rest of the way in a frame
    assert where(ghosts.detect_ghosts(take.replace_markers(markers))) == [(3, 150, 191)]


def test_bent_joint_is_no_ghost():
    """After a gap a marker and its neighbour lie elsewhere, with one another, and then all of them are missing."""
    markers = turning(segments=1, each=4).markers.copy()
    markers[330:420, :2] += 0.2 * np.sin(np.linspace(0, 3, 90))[:, None, None] * [1.0, 0.3, 0.0]
    markers[300:350, :2] = markers[400:430] = np.nan
    take = Take(markers, ("A", "B", "C", "D"), 120.0)
    assert ghosts.detect_ghosts(take) == []
    markers[350:400, 1] = turning(segments=1, each=4).markers[350:400, 1]  # the neighbour stays: the marker alone has gone
    assert where(ghosts.detect_ghosts(take.replace_markers(markers))) == [(0, 350, 399)]
