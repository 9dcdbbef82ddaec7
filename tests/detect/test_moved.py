from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from mocapfix import read
from mocapfix.detect import moved
from mocapfix.take import Take

CAPTURES = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "captures"
RATE, FRAMES = 100.0, 2000
LABELS = ("A", "B", "C", "D", "E", "F")


def segment(seed=0):
    """-> a take of six markers on one soft segment (2 mm of skin), and its rotation (T, 3, 3)."""
    rng, t = np.random.default_rng(seed), np.arange(FRAMES) / RATE
    turn = Rotation.from_euler("zyx", np.stack([0.6 * np.sin(3 * t), 0.4 * np.cos(2 * t), 0.3 * t], -1)).as_matrix()
    skin = gaussian_filter1d(rng.normal(size=(FRAMES, 6, 3)), 20, axis=0)
    places = rng.normal(0, 0.15, (6, 3)) + 0.002 * skin / skin.std()
    path = np.stack([0.5 * t, 1 + 0.05 * np.sin(9 * t), 0 * t], -1)
    return Take(path[:, None] + np.einsum("tab,tkb->tka", turn, places), LABELS, RATE), turn


def elsewhere(take, turn, marker, way, share):
    """-> the take with a marker moved by `way` (3,) metres on its segment, to the part `share` (T,)."""
    markers = take.markers.copy()
    markers[:, marker] += share[:, None] * (turn @ way)
    return take.with_markers(markers)


def ways(smallest):
    return st.tuples(st.floats(smallest, 0.1), st.integers(0, 99)).map(
        lambda drawn: drawn[0] * Rotation.random(rng=np.random.default_rng(drawn[1])).apply([0.0, 0.0, 1.0])
    )


@settings(max_examples=15)
@given(first=st.integers(200, FRAMES - 200), marker=st.integers(0, 5), way=ways(0.02))
def test_a_knock_is_found_to_the_frame_and_its_size_to_millimetres(first, marker, way):
    take, turn = segment()
    (fault,) = moved.found(elsewhere(take, turn, marker, way, np.arange(FRAMES) >= first))
    assert (fault.marker, fault.last) == (marker, FRAMES - 1)
    assert abs(fault.first - first) <= 1
    assert fault.settled == fault.first
    np.testing.assert_allclose(fault.severity, np.linalg.norm(way), atol=0.004)


@settings(max_examples=10)
@given(first=st.integers(100, 800), seconds=st.floats(6.0, 10.0), marker=st.integers(0, 5), way=ways(0.03))
def test_a_slide_is_found_to_a_second_or_two(first, seconds, marker, way):
    take, turn = segment()
    share = np.clip((np.arange(FRAMES) - first) / (seconds * RATE), 0, 1)
    (fault,) = moved.found(elsewhere(take, turn, marker, way, share))
    assert fault.marker == marker
    np.testing.assert_allclose([fault.first, fault.settled], [first, first + seconds * RATE], rtol=0, atol=200)
    np.testing.assert_allclose(fault.severity, np.linalg.norm(way), rtol=0.15, atol=0.004)


def test_a_marker_that_comes_back_elsewhere_from_a_gap():
    take, turn = segment()
    markers = elsewhere(take, turn, 2, np.array([0.04, 0.0, 0.02]), np.arange(FRAMES) >= 1000).markers
    markers[950:1040, 2] = np.nan
    (fault,) = moved.found(take.with_markers(markers))
    assert (fault.marker, fault.first) == (2, 1040)


def test_two_markers_of_one_segment_and_one_of_them_twice():
    take, turn = segment()
    frames = np.arange(FRAMES)
    take = elsewhere(take, turn, 1, np.array([0.05, 0.0, 0.0]), frames >= 500)
    take = elsewhere(take, turn, 1, np.array([0.0, 0.04, 0.0]), frames >= 1300)
    take = elsewhere(take, turn, 4, np.array([0.0, 0.0, 0.03]), frames >= 900)
    faults = [(f.marker, f.first) for f in moved.found(take)]
    assert [m for m, _ in faults] == [1, 1, 4]
    np.testing.assert_allclose([at for _, at in faults], [500, 1300, 900], rtol=0, atol=1)


def test_what_is_said():
    take, turn = segment()
    (fault,) = moved.found(elsewhere(take, turn, 0, np.array([0.05, 0.0, 0.0]), np.arange(FRAMES) >= 500))
    assert fault.reason.startswith(f"A is knocked by {fault.severity * 1e3:.0f} mm and stays there, as ")
    assert all(label in fault.reason for label in "BCDEF")
    assert 0.5 < fault.confidence < 1
    share = np.clip((np.arange(FRAMES) - 500) / 1000, 0, 1)
    (fault,) = moved.found(elsewhere(take, turn, 0, np.array([0.05, 0.0, 0.0]), share))
    assert fault.reason.startswith(f"A slides {fault.severity * 1e3:.0f} mm in ")


@pytest.mark.parametrize("seconds", [0.05, 0.3, 1.5])
def test_a_marker_that_comes_back_is_not_moved(seconds):
    take, turn = segment()
    frames = np.arange(FRAMES)
    away = (frames >= 900) & (frames < 900 + seconds * RATE)
    faults = moved.found(elsewhere(take, turn, 3, np.array([0.05, 0.0, 0.0]), away))
    assert [f.marker for f in faults if f.last - f.first > 1500] == []


def test_a_joint_that_bends_is_not_moved():
    """Three markers beyond a joint turn to and fro by half a radian, at last for good: their distances to the others change."""
    take, turn = segment()
    t = np.arange(FRAMES) / RATE
    bend = 0.5 * np.where(t < 15, np.sin(1.3 * t), np.sin(1.3 * 15))
    beyond = Rotation.from_rotvec(bend[:, None] * [1.0, 0.0, 0.0]).as_matrix()
    centre = take.markers.mean(1, keepdims=True)
    own = np.einsum("tba,tkb->tka", turn, take.markers - centre)
    own[:, 3:] = np.einsum("tab,tkb->tka", beyond, own[:, 3:])
    assert moved.found(take.with_markers(centre + np.einsum("tab,tkb->tka", turn, own))) == []


def test_sound_short_and_empty_takes():
    assert moved.found(segment()[0]) == []
    take = segment()[0]
    assert moved.found(take.with_markers(take.markers[:50])) == []
    assert moved.found(take.with_markers(np.full_like(take.markers, np.nan))) == []
    assert moved.found(Take(np.zeros((10, 0, 3)), (), RATE)) == []
    assert moved.found(Take(np.zeros((0, 2, 3)), ("a", "b"), RATE)) == []
    assert moved.found(Take(np.zeros((500, 4, 3)), ("a", "b", "c", "d"), RATE)) == []


@pytest.mark.skipif(not CAPTURES.is_dir(), reason="no captures beside the repository")
@pytest.mark.parametrize("name", ["cmu/06_01", "c3d/tennis_serve_motive", "c3d/PiG_Motion-FlatFoot-Hole", "c3d/Vicon"])
def test_nothing_moves_on_sound_captures(name):
    assert moved.found(read.take(CAPTURES / f"{name}.c3d")) == []
