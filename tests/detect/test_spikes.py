import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mocapfix.detect import noise
from mocapfix.model.faults import Faults
from mocapfix.model.take import Take

SMALLEST, LONGEST = 0.02, 0.05


def swinging(rate=120.0, seconds=2.0, markers=1):
    """Return (T, M, 3) hands on swinging arms, up to 80 m/s2, with half a millimetre of camera noise."""
    t = np.arange(round(rate * seconds))[:, None] / rate
    phase = np.arange(markers)
    path = np.stack([0.6 * np.sin(9 * t + phase), 0.3 * np.cos(13 * t + phase), 1.5 * t + 0 * phase], -1)
    return path + np.random.default_rng(0).normal(scale=0.0005, size=path.shape)


def found(markers, rate=120.0):
    return noise.detect_spikes(Take(markers, tuple(f"M{m}" for m in range(markers.shape[1])), rate), SMALLEST, LONGEST)


def spans(faults):
    return [(f.marker, f.first, f.last) for f in faults]


@settings(deadline=None, max_examples=60)
@given(
    rate=st.sampled_from([100.0, 120.0, 200.0, 250.0]),
    frame=st.integers(4, 190),
    length=st.integers(1, 3),
    size=st.floats(0.05, 0.5),
    seed=st.integers(0, 999),
)
def test_spike_is_found_anywhere(rate, frame, length, size, seed):
    markers = swinging(rate)
    direction = np.random.default_rng(seed).normal(size=3)
    markers[frame : frame + length, 0] += size * direction / np.linalg.norm(direction)
    (spike,) = found(markers, rate)
    assert (spike.kind, spike.first, spike.last) == ("spike", frame, frame + length - 1)
    assert spike.severity == pytest.approx(size, abs=0.02)


def test_reason_names_distance_and_duration():
    markers = np.zeros((100, 1, 3))
    markers[40:42, 0, 1] = 0.084
    assert [f.reason for f in found(markers)] == ["M0 jumps 84 mm off its path for 2 frames and returns."]
    markers[41] = 0
    assert [f.reason for f in found(markers)] == ["M0 jumps 84 mm off its path for 1 frame and returns."]


@pytest.mark.parametrize("rate", [30.0, 50.0, 60.0, 120.0, 250.0])
def test_fast_motion_has_no_spikes(rate):
    t = np.arange(round(2 * rate)) / rate - 1
    punch = 0.5 / (1 + np.exp(-t / 0.016))  # 8 m/s, 190 m/s2
    strike = 3.0 * np.minimum(t, 0)  # a foot that falls at 3 m/s and stops dead
    bounce = 4.0 * np.abs(t)  # turned about within a frame
    markers = np.stack([punch, strike, bounce], -1)[..., None] * [0.6, 0.0, 0.8]
    assert found(markers, rate) == []


def test_displacement_is_no_spike():
    """Two markers whose labels are swapped for a third of a second: a later stage's task."""
    markers = swinging(markers=2)
    markers[60:100] = markers[60:100, ::-1]
    assert np.linalg.norm(markers[60, 0] - markers[59, 0]) > 0.1
    assert found(markers) == []


def test_long_excursion_is_no_spike():
    markers = swinging()
    markers[60:68] += 0.2  # 67 ms
    assert found(markers) == []


@pytest.mark.parametrize("frame", [59, 80])
def test_spike_next_to_a_gap(frame):
    markers = swinging()
    markers[60:80] = np.nan
    markers[frame] += [0.1, 0.0, 0.0]
    assert spans(found(markers)) == [(0, frame, frame)]


@pytest.mark.parametrize("island", [1, 2])
def test_samples_between_gaps_are_no_spikes(island):
    """One or two samples without neighbours are no faults, however fast the marker is."""
    markers = swinging(markers=3)
    markers[np.arange(len(markers)) % 12 >= island] = np.nan
    assert found(markers) == []


def test_spikes_in_a_fifth_of_all_samples():
    rng, markers = np.random.default_rng(5), swinging(seconds=5, markers=8)
    is_spike = rng.random(markers.shape[:2]) < 0.2
    markers[is_spike] += rng.uniform(-0.3, 0.3, (is_spike.sum(), 3))
    markers[rng.random(is_spike.shape) < 0.05] = np.nan
    take = Take(markers, tuple("abcdefgh"), 120.0)
    is_faulty = Faults(tuple(noise.detect_spikes(take, SMALLEST, LONGEST))).compute_faulty_mask(take)
    assert is_faulty[is_spike & take.visible].mean() > 0.97
    assert is_faulty[~is_spike & take.visible].mean() < 0.005


def test_result_does_not_depend_on_position_and_rotation():
    markers, turn = swinging(), np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    markers[[20, 50, 51, 200]] += [0.0, 0.12, 0.05]
    there = found(markers)
    here = found(markers @ turn + [30.0, -2.0, 7.0])
    assert spans(there) == spans(here) == [(0, 20, 20), (0, 50, 51), (0, 200, 200)]
    np.testing.assert_allclose([f.severity for f in there], [f.severity for f in here], rtol=1e-6)


@pytest.mark.parametrize("seen", [0, 1, 2, 3, 4])
def test_takes_with_few_samples(seen):
    markers = swinging()
    markers[seen:] = np.nan
    assert found(markers) == []


def test_local_fit_and_its_standard_deviation():
    times = np.arange(-10, 11) / 120
    times = times[times != 0]
    path = np.array([[1.0, 2.0, 3.0]]) + times[:, None] * [1.0, 0.0, -2.0] + times[:, None] ** 2 / 2 * [0.0, 50.0, -9.81]
    samples, weight, sd_m = noise._fit_locally(times, np.zeros(1))
    np.testing.assert_allclose(weight.sum(1), 1.0)
    np.testing.assert_allclose(np.einsum("ns,nsx->nx", weight, path[samples]), [[1.0, 2.0, 3.0]], atol=5e-4)
    assert sd_m < 0.003
    assert noise._fit_locally(times[abs(times) > 0.05], np.zeros(1))[2] > 0.05
