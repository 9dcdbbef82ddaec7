import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mocapfix.detect import noise
from mocapfix.model.faults import Fault
from mocapfix.model.take import Take


def swinging(rate=120.0, seconds=4.0, noise=0.0005):
    """Return (T, 1, 3) a hand on a swinging arm, with camera noise (metres)."""
    t = np.arange(round(rate * seconds)) / rate
    path = np.stack([0.6 * np.sin(9 * t), 0.3 * np.cos(13 * t), 1.5 * t], -1)[:, None]
    return path + np.random.default_rng(0).normal(scale=noise, size=path.shape)


def found(markers, rate=120.0):
    take = Take(markers, ("LWRA",), rate)
    return noise.detect_jitter(take, take.visible, min_amplitude_m=0.005)


def add_jitter(markers, first, last, size, seed=0):
    noisy = markers.copy()
    noisy[first : last + 1] += np.random.default_rng(seed).normal(scale=size, size=noisy[first : last + 1].shape)
    return noisy


@settings(deadline=None, max_examples=40)
@given(
    rate=st.sampled_from([100.0, 120.0, 200.0, 250.0]),
    start=st.floats(0.5, 2.5),
    seconds=st.floats(0.3, 1.0),
    seed=st.integers(0, 999),
)
def test_burst_of_12_mm_is_found_to_a_few_frames(rate, start, seconds, seed):
    first, last = round(start * rate), round((start + seconds) * rate)
    bursts = found(add_jitter(swinging(rate), first, last, 0.012, seed), rate)
    assert {f.kind for f in bursts} == {"jitter"}
    is_detected = np.zeros(1000 + last, bool)
    for f in bursts:
        is_detected[f.first : f.last + 1] = True
    assert is_detected[first : last + 1].mean() > 0.85
    assert is_detected[: first - 6].sum() + is_detected[last + 7 :].sum() == 0


def test_severity_is_that_of_the_noise():
    """Normal noise of 12 mm per axis has a median length of 12 mm times that of a chi with three degrees of freedom."""
    (burst,) = found(add_jitter(swinging(seconds=20), 1200, 1300, 0.012))
    assert 0.012 * 1.54 * 0.9 < burst.severity < 0.012 * 1.54 * 1.8  # the largest of the medians over a tenth of a second
    assert burst.reason.startswith(f"LWRA has jitter of {burst.severity * 1e3:.0f} mm for 0.8")
    assert burst.reason.endswith("s; its usual noise is 0.8 mm.")


@pytest.mark.parametrize("rate", [30.0, 50.0, 60.0, 120.0, 250.0])
def test_fast_motion_is_no_jitter(rate):
    t = np.arange(round(4 * rate)) / rate - 2
    punches = 0.3 * np.sin(2 * np.pi * 4 * t) * np.exp(-((t / 0.4) ** 2))  # four a second, amid rest
    dead_stop = 3.0 * np.minimum(t, 0)
    assert found((punches + dead_stop)[:, None, None] * [0.6, 0.0, 0.8], rate) == []


def test_permanent_noise_is_no_jitter():
    assert found(swinging(noise=0.012)) == []


def test_short_or_small_bursts_are_no_jitter():
    assert found(add_jitter(swinging(), 200, 206, 0.012)) == []
    assert found(add_jitter(swinging(), 200, 260, 0.002)) == []


def test_displacement_is_no_jitter():
    markers = swinging()
    markers[200:260] += [0.2, 0.0, 0.0]
    assert found(markers) == []


def test_burst_continues_across_short_pauses_and_ends_at_a_gap():
    markers, calm = add_jitter(swinging(), 200, 420, 0.012), swinging()
    markers[230:233] = np.nan
    markers[260:269] = calm[260:269]
    markers[320:360] = np.nan
    before, after = found(markers)
    ends = [before.first, before.last, after.first, after.last]
    np.testing.assert_allclose(ends, [200, 319, 360, 420], rtol=0, atol=5)


def test_burst_includes_spikes_at_its_ends_but_none_farther_away():
    take = Take(add_jitter(swinging(), 200, 260, 0.012), ("LWRA",), 120.0)
    (plain,) = noise.detect_jitter(take, take.visible, min_amplitude_m=0.005)
    frames = plain.first - 2, plain.last + 2, plain.last + 5, plain.last + 15
    spikes = [Fault("spike", 0, frame, frame, 0.03, "") for frame in frames]
    (burst,) = noise.detect_jitter(take, take.visible, min_amplitude_m=0.005, spikes=spikes)
    assert (burst.first, burst.last) == (plain.first - 2, plain.last + 5)


def test_noisy_samples_at_the_ends_of_a_burst_belong_to_it():
    sound, largest_m = swinging(noise=0.0003), []
    for seed in range(20):
        noisy = add_jitter(sound, 200, 260, 0.008, seed)
        is_kept = np.ones(len(sound), bool)
        for burst in found(noisy):
            is_kept[burst.first : burst.last + 1] = False
        largest_m.append(np.linalg.norm(noisy - sound, axis=-1)[is_kept].max())
        assert is_kept[:197].all()
        assert is_kept[264:].all()
    assert np.quantile(largest_m, 0.8) < 0.008  # without those at the ends 20 mm


@pytest.mark.parametrize("rate", [30.0, 60.0, 120.0])
def test_single_sample_is_no_jitter(rate):
    markers = np.zeros((100, 1, 3))
    markers[50] = 0.3
    assert found(markers, rate) == []


@pytest.mark.parametrize("seen", [0, 1, 5, 11])
def test_takes_with_few_samples(seen):
    markers = swinging()
    markers[seen:] = np.nan
    assert found(markers) == []
