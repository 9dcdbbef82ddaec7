"""Injected faults: each is of its kind and recorded at its place, and nothing else is changed."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix.lab import fault_detection
from mocapfix.lab.fault_detection import FAULT_INJECTIONS, DamagedTake, FaultPlace
from mocapfix.model.faults import build_fault_mask
from mocapfix.solve import kinematics
from mocapfix.synthetic import compose_take

PLACE = FaultPlace((7,), 100, 139)


@pytest.fixture(scope="module")
def sound():
    truth = compose_take(seed=1, seconds=10.0)
    return replace(truth, damaged_positions=truth.marker_positions, missing_mask=np.zeros_like(truth.missing_mask))


@pytest.fixture
def damaged_take(sound):
    return DamagedTake(sound, np.random.default_rng(3))


@pytest.mark.parametrize("kind", FAULT_INJECTIONS)
def test_only_recorded_samples_are_changed(kind, damaged_take):
    FAULT_INJECTIONS[kind](damaged_take)
    assert damaged_take.injected_faults
    has_fault = build_fault_mask(
        [*damaged_take.injected_faults, *damaged_take.secondary_faults], damaged_take.true_markers.shape[:2]
    )
    same = (damaged_take.markers[:, : damaged_take.marker_count] == damaged_take.sound_truth.marker_positions).all(-1)
    assert (same | has_fault).all()
    assert not same[build_fault_mask(damaged_take.injected_faults, has_fault.shape)].all()


@pytest.mark.parametrize("kind", FAULT_INJECTIONS)
def test_injection_is_reproducible(kind, sound):
    one, same, other = (DamagedTake(sound, np.random.default_rng(seed)) for seed in (1, 1, 2))
    for each in (one, same, other):
        FAULT_INJECTIONS[kind](each)
    np.testing.assert_array_equal(one.markers, same.markers)
    assert one.markers.shape != other.markers.shape or not np.array_equal(one.markers, other.markers, equal_nan=True)


@pytest.mark.parametrize("kind", ["gap", "flicker", "spike", "jitter", "stuck", "straight", "swap", "ring", "ghost", "fragment"])
def test_faults_do_not_overlap(kind, damaged_take):
    FAULT_INJECTIONS[kind](damaged_take)
    assert len(damaged_take.injected_faults) > 1
    assert not any(
        one.overlaps(other) for n, one in enumerate(damaged_take.injected_faults) for other in damaged_take.injected_faults[:n]
    )


def test_flicker_has_one_or_two_frames(damaged_take):
    FAULT_INJECTIONS["flicker"](damaged_take)
    assert {fault.last - fault.first + 1 for fault in damaged_take.injected_faults} == {1, 2}


def test_frozen_samples_repeat_the_previous_one(damaged_take):
    fault_detection.inject_frozen(damaged_take, PLACE)
    np.testing.assert_array_equal(damaged_take.markers[100:140, 7], np.tile(damaged_take.markers[99, 7], (40, 1)))


def test_polynomial_fill_is_a_line_or_a_smooth_cubic(sound):
    is_cubic = []
    for seed in range(8):
        damaged_take = DamagedTake(sound, np.random.default_rng(seed))
        fault_detection.inject_polynomial_fill(damaged_take, PLACE)
        path = damaged_take.markers[99:141, 7]
        np.testing.assert_allclose(np.diff(path, n=4, axis=0), 0, atol=1e-9)
        is_cubic.append(np.abs(np.diff(path, n=2, axis=0)).max() > 1e-6)
        if is_cubic[-1]:  # in the first of 41 frames the velocity hardly changes
            np.testing.assert_allclose(path[1] - path[0], path[0] - damaged_take.markers[98, 7], atol=0.01 * np.ptp(path))
    assert 0 < sum(is_cubic) < 8


def test_spike_has_its_severity(damaged_take):
    fault_detection.inject_spike(damaged_take, FaultPlace((7,), 100, 101))
    off = np.linalg.norm(damaged_take.markers[100:102, 7] - damaged_take.true_markers[100:102, 7], axis=-1)
    np.testing.assert_allclose(off, damaged_take.injected_faults[0].severity)
    assert 0.03 <= damaged_take.injected_faults[0].severity <= 0.3


def test_ghost_is_stationary_or_moves_along(sound):
    is_stationary = []
    for seed in range(8):
        damaged_take = DamagedTake(sound, np.random.default_rng(seed))
        fault_detection.inject_ghost(damaged_take, PLACE)
        there, true = damaged_take.markers[100:140, 7], damaged_take.true_markers[100:140, 7]
        assert np.linalg.norm(there[0] - true[0]) > 0.04
        world, along = np.ptp(there, axis=0).max(), np.ptp(there - true, axis=0).max()
        assert min(world, along) < 0.005
        is_stationary.append(world < along)
    assert 0 < sum(is_stationary) < 8


def test_labels_are_exchanged_cyclically(damaged_take):
    fault_detection.exchange_labels(damaged_take, [3, 5, 9], 50, 59, "swap")
    for own, under in ((3, 5), (5, 9), (9, 3)):
        np.testing.assert_array_equal(damaged_take.markers[50:60, under], damaged_take.true_markers[50:60, own])
    fault = damaged_take.injected_faults[0]
    assert (fault.markers, fault.first, fault.last) == ((3, 5, 9), 50, 59)


def test_exchanges_may_be_hidden_or_permanent(sound):
    hidden, last = set(), set()
    damaged_take = DamagedTake(sound, np.random.default_rng(0))
    for seed in range(20):
        damaged_take = DamagedTake(sound, np.random.default_rng(seed))
        fault_detection.inject_label_exchange(damaged_take, FaultPlace((3, 5), 400, 459))
        hidden.add(len(damaged_take.secondary_faults))
        last.add(damaged_take.injected_faults[0].last)
        for gap in damaged_take.secondary_faults:
            assert gap.last == 399
    assert hidden == {0, 2}
    assert last == {459, damaged_take.frame_count - 1}


def test_fragment_moves_samples_to_another_label(sound):
    names, pauses = set(), set()
    damaged_take = DamagedTake(sound, np.random.default_rng(0))
    for seed in range(12):
        damaged_take = DamagedTake(sound, np.random.default_rng(seed))
        fault_detection.inject_fragment(damaged_take, PLACE)
        np.testing.assert_array_equal(damaged_take.markers[100:140, -1], damaged_take.true_markers[100:140, 7])
        assert np.isnan(damaged_take.markers[[*range(100), *range(140, damaged_take.frame_count)], -1]).all()
        missing = np.isnan(damaged_take.markers[:, 7, 0])
        assert missing[100:140].all()
        pauses.add(int(missing.sum()) - 40)
        names.add(damaged_take.labels[-1])
    assert names == {f"{damaged_take.labels[7]}-1", "*1", "C_1"}
    assert min(pauses) == 0 < max(pauses)


@pytest.mark.parametrize("kind", ["moved", "drift"])
def test_shifted_marker_has_another_offset_to_the_end(kind, damaged_take):
    FAULT_INJECTIONS[kind](damaged_take)
    _, rotation = kinematics.compute_world_poses(damaged_take.sound_truth.subject.skeleton, damaged_take.sound_truth.motion)
    for fault in damaged_take.injected_faults:
        turn = rotation[:, damaged_take.sound_truth.subject.joints[fault.marker]]
        off = np.einsum(
            "tba,tb->ta",
            turn,
            damaged_take.true_markers[:, fault.marker] - damaged_take.sound_truth.marker_positions[:, fault.marker],
        )
        np.testing.assert_allclose(off[: fault.first], 0, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(off[fault.settled_frame :], axis=1), fault.severity)
        assert np.linalg.norm(off[fault.first]) > 0
        assert (fault.settled_frame > fault.first) == (kind == "drift")
        assert any(gap.marker == fault.marker and gap.first > fault.settled_frame for gap in damaged_take.secondary_faults)


def test_mirrored_limb_has_exchanged_sides(sound):
    found = set()
    for seed in range(12):
        damaged_take = DamagedTake(sound, np.random.default_rng(seed))
        FAULT_INJECTIONS["mirrored"](damaged_take)
        pairs = {tuple(damaged_take.labels[m] for m in fault.markers) for fault in damaged_take.injected_faults}
        assert all(left == "L" + right[1:] and right[0] == "R" for left, right in pairs)
        found.add(frozenset(pairs))
    arms, legs = ({each for each in found if (("L" + at, "R" + at) in each) and len(each) < 18} for at in ("WRA", "ANK"))
    assert len(arms) == len(legs) == 1
    assert not arms & legs
    assert found - arms - legs == {max(found, key=len)}
    assert len(max(found, key=len)) == 18  # of 41 markers all but the five in the middle
