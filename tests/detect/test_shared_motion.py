import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.detect import noise
from mocapfix.model.take import Take

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
    return [(take.labels[f.marker], f.first, f.last) for f in noise.detect_spikes(take, 0.02, 0.05)]


def test_blow_is_no_spike(monkeypatch):
    take = strike()
    assert detect_spikes(take) == []
    # the marker's own path alone would make spikes of it
    monkeypatch.setattr(
        noise, "_find_shared_excursions", lambda take, marker, excursion, partners: np.zeros(len(excursion.frames), bool)
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


def push_rims(seed=0, rate=100.0):
    """Return a take of a glove with three markers that a wheelchair's rims strike once a second, with the frames of the strikes.

    A strike accelerates the hand by 230 to 370 m/s2 for one or two frames and turns it. The forearm's markers hardly follow.
    """
    random = np.random.default_rng(seed)
    time = np.arange(1000) / rate
    phase = 2 * np.pi * time
    wrist = np.stack([0.25 * np.sin(phase) + 0.8 * time, 0.7 + 0.12 * np.cos(phase), 0.3 + 0.02 * np.sin(2 * phase)], -1)
    turn = 0.5 * np.sin(phase)[:, None] * [0.2, 0.3, 1.0]
    forearm = wrist[:, None] + [[-0.1, 0.06, 0.03], [-0.12, 0.07, -0.03], [-0.2, 0.12, 0.0]]
    frames = np.arange(60, 980, 83)
    for frame in frames:
        direction = random.normal(size=3)
        distance_m = 0.8 * random.uniform(230, 370) / rate**2
        profile = np.zeros(len(time))
        profile[frame : frame + 2] = 1.0, random.choice([0.0, 0.6])
        wrist = wrist + distance_m * profile[:, None] * direction / np.linalg.norm(direction)
        turn = turn + 0.4 * profile[:, None] * random.normal(size=3)
    shape = np.array([[0.05, 0.03, 0.02], [0.09, -0.03, 0.02], [0.11, 0.02, 0.04]])
    glove = np.einsum("tij,mj->tmi", Rotation.from_rotvec(turn).as_matrix(), shape) + wrist[:, None]
    markers = np.concatenate([glove, forearm], 1)
    return Take(markers + random.normal(scale=0.0003, size=markers.shape), ("G1", "G2", "G3", "F1", "F2", "F3"), rate), frames


@pytest.mark.parametrize("seed", range(4))
def test_strike_that_turns_three_markers_rigidly_is_no_spike(seed, monkeypatch):
    take, _ = push_rims(seed)
    assert len(detect_spikes(take)) <= 1  # of 36 samples that leave their paths
    monkeypatch.setattr(noise, "MAX_RIGID_CHANGE_M", 0.0)
    assert len(detect_spikes(take)) >= 5


@pytest.mark.parametrize("marker", range(3))
def test_spikes_of_a_glove_between_and_in_impacts_are_detected(marker, monkeypatch):
    """Spikes in all directions, between the strikes and in them, are found as without regard to rigid motion."""
    random = np.random.default_rng(marker)
    take, strikes = push_rims()
    markers, frames = take.markers.copy(), np.r_[strikes, np.arange(80, 980, 25)]
    direction = random.normal(size=(len(frames), 3))
    markers[frames, marker] += 0.05 * direction / np.linalg.norm(direction, axis=1, keepdims=True)

    def find_missed():
        spikes_found = detect_spikes(Take(markers, take.labels, take.rate))
        return set(frames.tolist()) - {first for label, first, _ in spikes_found if label == take.labels[marker]}

    missed = find_missed()
    monkeypatch.setattr(noise, "MAX_RIGID_CHANGE_M", 0.0)
    assert len(missed - find_missed()) <= 1
    assert len(missed) <= 5  # a strike in the opposite direction hides a spike


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
    faults = noise.detect_jitter(take, take.visible, 0.004)
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
    assert noise.find_shared_deviations(own, neighbours).tolist() == [True, False, True, False, False]


def test_shared_noise_is_removed():
    rng = np.random.default_rng(0)
    common, own_noise = rng.normal(size=(60, 3)), 0.1 * rng.normal(size=(60, 3))
    neighbours = np.stack([0.5 * common, np.full((60, 3), np.nan), rng.normal(size=(60, 3))], 1)
    rest = noise.remove_shared_noise(2 * common + own_noise, neighbours)
    np.testing.assert_allclose(rest, own_noise, atol=0.1)
    independent = rng.normal(size=(60, 3))
    assert np.linalg.norm(noise.remove_shared_noise(independent, neighbours)) > 0.9 * np.linalg.norm(independent)
