import numpy as np
import pytest

from mocapfix.detect import loop
from mocapfix.model.faults import Fault
from mocapfix.model.take import Take
from mocapfix.options import DetectOptions
from tests.captures import CAPTURES, needs_captures


def standing(frames=480, markers=3):
    """Build a take of markers at rest with a millimetre of sway, at 120 Hz."""
    t = np.arange(frames)[:, None, None] / 120
    places = np.random.default_rng(2).normal(size=(markers, 3))
    return Take(places + 0.001 * np.sin(3 * t + places), tuple(f"M{m}" for m in range(markers)), 120.0)


def damaged():
    take = standing()
    markers, rng = take.markers.copy(), np.random.default_rng(3)
    markers[100:110, 0] = np.nan
    markers[50, 0] += 0.1
    markers[300:360, 0] += rng.normal(scale=0.012, size=(60, 3))
    markers[330, 0] += 0.3  # a spike within the burst
    markers[20:22, 2] += [0.0, 0.05, 0.0]
    markers[:4, 2] = np.nan
    return take.replace_markers(markers)


def test_faults_are_ordered_by_marker_and_first_frame():
    faults = loop.detect_sample_faults(damaged()).items
    assert list(faults) == sorted(faults, key=lambda f: (f.marker, f.first))
    lone = [(f.marker, f.first, f.kind) for f in faults if not 300 <= f.first < 360]
    assert lone == [(0, 50, "spike"), (0, 100, "gap"), (2, 0, "leading gap"), (2, 20, "spike")]


def test_spike_within_a_burst_is_part_of_the_burst():
    over = [f for f in loop.detect_sample_faults(damaged()).items if f.marker == 0 and f.first <= 330 <= f.last]
    assert [f.kind for f in over] == ["jitter"]


def test_faulty_mask_covers_the_damaged_samples():
    take = damaged()
    is_faulty = loop.detect_sample_faults(take).compute_faulty_mask(take)
    assert np.flatnonzero(is_faulty[:, 2]).tolist() == [20, 21]
    assert is_faulty[[50, 330], 0].all()
    assert not is_faulty[:, 1].any()
    assert not (is_faulty & ~take.visible).any()


def test_sound_take_has_no_faults():
    assert loop.detect_sample_faults(standing()).items == ()


def test_options_move_the_thresholds():
    options = DetectOptions(min_spike_m=0.2, min_jitter_m=0.1)
    faults = loop.detect_sample_faults(damaged(), options=options)
    assert {fault.kind for fault in faults.items} == {"gap", "leading gap", "spike"}
    assert all(f.severity >= 0.2 for f in faults.items if f.kind == "spike")


def test_empty_take_has_no_faults():
    assert loop.detect_sample_faults(Take(np.zeros((10, 0, 3)), (), 120.0)).items == ()
    assert loop.detect_sample_faults(Take(np.zeros((0, 2, 3)), ("a", "b"), 120.0)).items == ()


@needs_captures
@pytest.mark.parametrize(("name", "glitches"), [("02_05", 1), ("85_02", 0), ("06_01", 0)])
def test_captures_of_fast_motion(name, glitches):
    """LBHD really jumps by 30 mm once in 02_05; everything else is motion."""
    ezc3d = pytest.importorskip("ezc3d")
    points = ezc3d.c3d(str(CAPTURES / "cmu" / f"{name}.c3d"))["data"]["points"][:3].transpose(2, 1, 0) / 1000
    points[(points == 0).all(-1)] = np.nan
    take = Take(points, tuple(f"P{m}" for m in range(points.shape[1])), 120.0)
    judged: list[Fault] = [f for f in loop.detect_sample_faults(take).items if f.kind in ("spike", "jitter")]
    assert len(judged) == glitches
