import numpy as np
import pytest

from mocapfix.detect import jitter, shared_motion, spikes
from mocapfix.take import Take

RATE = 120.0
LABELS = ("ELB", "FRM", "WRA", "WRB", "FIN", "UPA", "SHO")
# Positions on a forearm whose elbow is the origin, then two markers that stand still.
FOREARM = np.array([[0.0, 0.0, 0.03], [0.14, 0.03, 0.0], [0.26, 0.03, 0.0], [0.26, -0.03, 0.0], [0.36, 0.0, 0.02]])
STILL = np.array([[-0.1, 0.2, 0.0], [-0.15, 0.4, 0.0]])


def build_take(angle_rad, shift=0.0):
    """Return a take of a forearm that turns about the vertical axis, with noise of 0.3 mm."""
    zero, one = np.zeros_like(angle_rad), np.ones_like(angle_rad)
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    rotation = np.stack([np.stack([c, zero, s], -1), np.stack([zero, one, zero], -1), np.stack([-s, zero, c], -1)], -2)
    markers = np.concatenate([np.einsum("tab,mb->tma", rotation, FOREARM), np.tile(STILL, (len(angle_rad), 1, 1))], 1)
    markers = markers + np.random.default_rng(0).normal(scale=0.0003, size=markers.shape) + np.reshape(shift, (-1, 1, 1))
    return Take(markers, LABELS, RATE)


def strike():
    """Return a blow: the hand reaches 12 m/s within 60 ms, hits something in frame 120, and rebounds at 8 m/s."""
    speed_m_per_s = np.interp(np.arange(240), [105, 112, 120, 120.01, 135], [0, 12, 12, -8, 0])
    return build_take(np.cumsum(speed_m_per_s) / RATE / FOREARM[-1, 0])


def detect_spikes(take):
    return [(take.labels[f.marker], f.first, f.last) for f in spikes.detect_spikes(take, 0.02, 0.05)]


def test_blow_is_no_spike(monkeypatch):
    take = strike()
    assert detect_spikes(take) == []
    # the marker's own path alone would make spikes of it
    monkeypatch.setattr(
        spikes, "_find_shared_excursions", lambda take, excursion, partners: np.zeros(len(excursion.frames), bool)
    )
    assert len(detect_spikes(take)) >= 2


@pytest.mark.parametrize("frame", [60, 108, 112, 115, 124, 180])
@pytest.mark.parametrize("label", ["FRM", "WRA"])
def test_spike_within_a_blow_is_detected(frame, label):
    take = strike()
    markers = take.markers.copy()
    markers[frame, LABELS.index(label)] += [0.0, 0.03, 0.0]
    assert (label, frame, frame) in detect_spikes(Take(markers, LABELS, RATE))


def test_jump_of_all_markers_for_a_frame_is_no_motion():
    """A body part would need 10,000 m/s2 for it: the cameras were shaken."""
    take = build_take(np.zeros(100))
    markers = take.markers.copy()
    markers[50] += [0.0, 0.35, 0.0]
    assert detect_spikes(Take(markers, LABELS, RATE)) == [(label, 50, 50) for label in LABELS]


def test_vibrating_limb_has_no_jitter():
    t = np.arange(600) / RATE
    vibration = 0.15 * np.sin(2 * np.pi * 28 * t) * (np.abs(t - 2.5) < 0.25)  # a limb that is shaken at 28 Hz
    take = build_take(vibration)
    assert detect_jitter(take) == []
    markers = take.markers.copy()
    markers[400:440, LABELS.index("FRM")] += np.random.default_rng(1).normal(scale=0.02, size=(40, 3))
    ((label, first, last),) = detect_jitter(Take(markers, LABELS, RATE))
    assert label == "FRM"
    assert [first, last] == pytest.approx([400, 439], abs=6)


def detect_jitter(take):
    faults = jitter.detect_jitter(take, take.visible, 0.004, 5.0, 0.1)
    return [(take.labels[f.marker], f.first, f.last) for f in faults]


def test_shared_deviations():
    own = np.tile([0.1, 0.0, 0.0], (5, 1))
    missing = [np.nan] * 3
    neighbours = np.array(
        [
            [[0.05, 0.0, 0.0], [0.08, 0.02, 0.0], [0.0, 0.0, 0.0]],  # two alike
            [[0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.0]],  # one alike: it may be a fault as well
            [[0.1, 0.0, 0.01], missing, missing],  # the only one, almost equal
            [[0.05, 0.0, 0.0], missing, missing],  # the only one, not equal
            [[-0.1, 0.0, 0.0], [-0.1, 0.0, 0.0], [0.01, 0.0, 0.0]],  # opposite, or too short
        ]
    )
    assert shared_motion.find_shared_deviations(own, neighbours).tolist() == [True, False, True, False, False]


def test_shared_noise_is_removed():
    rng = np.random.default_rng(0)
    common, own_noise = rng.normal(size=(60, 3)), 0.1 * rng.normal(size=(60, 3))
    neighbours = np.stack([0.5 * common, np.full((60, 3), np.nan), rng.normal(size=(60, 3))], 1)
    rest = shared_motion.remove_shared_noise(2 * common + own_noise, neighbours)
    np.testing.assert_allclose(rest, own_noise, atol=0.1)
    independent = rng.normal(size=(60, 3))
    assert np.linalg.norm(shared_motion.remove_shared_noise(independent, neighbours)) > 0.9 * np.linalg.norm(independent)
