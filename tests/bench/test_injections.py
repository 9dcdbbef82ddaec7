"""Faults put into a take: each is what its name says, is remembered where it is, and nothing else is touched."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix import synthetic
from mocapfix.bench import fault_injection as injected_labels
from mocapfix.bench import fault_injection as injected_samples
from mocapfix.bench.damaged_take import DamagedTake, FaultPlace
from mocapfix.bench.fault_injection import FAULT_INJECTIONS
from mocapfix.faults import build_fault_mask
from mocapfix.solve import kinematics

PLACE = FaultPlace((7,), 100, 139)


@pytest.fixture(scope="module")
def sound():
    truth = synthetic.compose_take(seed=1, seconds=10.0)
    return replace(truth, damaged_positions=truth.marker_positions, missing_mask=np.zeros_like(truth.missing_mask))


@pytest.fixture
def stage(sound):
    return DamagedTake(sound, np.random.default_rng(3))


@pytest.mark.parametrize("kind", FAULT_INJECTIONS)
def test_nothing_but_what_is_remembered_is_touched(kind, stage):
    FAULT_INJECTIONS[kind](stage)
    assert stage.injected_faults
    struck = build_fault_mask([*stage.injected_faults, *stage.secondary_faults], stage.true_markers.shape[:2])
    same = (stage.markers[:, : stage.count] == stage.sound_truth.markers).all(-1)
    assert (same | struck).all()
    assert not same[build_fault_mask(stage.injected_faults, struck.shape)].all()


@pytest.mark.parametrize("kind", FAULT_INJECTIONS)
def test_the_same_numbers_make_the_same_faults(kind, sound):
    one, same, other = (DamagedTake(sound, np.random.default_rng(seed)) for seed in (1, 1, 2))
    for each in (one, same, other):
        FAULT_INJECTIONS[kind](each)
    np.testing.assert_array_equal(one.markers, same.markers)
    assert one.markers.shape != other.markers.shape or not np.array_equal(one.markers, other.markers, equal_nan=True)


@pytest.mark.parametrize("kind", ["gap", "flicker", "spike", "jitter", "stuck", "straight", "swap", "ring", "ghost", "fragment"])
def test_faults_do_not_touch_one_another(kind, stage):
    FAULT_INJECTIONS[kind](stage)
    assert len(stage.injected_faults) > 1
    assert not any(one.overlaps(other) for n, one in enumerate(stage.injected_faults) for other in stage.injected_faults[:n])


def test_a_flicker_is_one_or_two_frames(stage):
    FAULT_INJECTIONS["flicker"](stage)
    assert {fault.last - fault.first + 1 for fault in stage.injected_faults} == {1, 2}


def test_stuck_is_the_value_before(stage):
    injected_samples.inject_frozen(stage, PLACE)
    np.testing.assert_array_equal(stage.markers[100:140, 7], np.tile(stage.markers[99, 7], (40, 1)))


def test_straight_is_a_line_or_a_cubic_that_goes_on_as_what_is_about_it_goes(sound):
    bent = []
    for seed in range(8):
        stage = DamagedTake(sound, np.random.default_rng(seed))
        injected_samples.inject_polynomial_fill(stage, PLACE)
        path = stage.markers[99:141, 7]
        np.testing.assert_allclose(np.diff(path, n=4, axis=0), 0, atol=1e-9)
        bent.append(np.abs(np.diff(path, n=2, axis=0)).max() > 1e-6)
        if bent[-1]:  # in the first frame of 41 it has left the way it came by little
            np.testing.assert_allclose(path[1] - path[0], path[0] - stage.markers[98, 7], atol=0.01 * np.ptp(path))
    assert 0 < sum(bent) < 8


def test_a_spike_is_off_by_what_it_says(stage):
    injected_samples.inject_spike(stage, FaultPlace((7,), 100, 101))
    off = np.linalg.norm(stage.markers[100:102, 7] - stage.true_markers[100:102, 7], axis=-1)
    np.testing.assert_allclose(off, stage.injected_faults[0].severity)
    assert 0.03 <= stage.injected_faults[0].severity <= 0.3


def test_a_ghost_stays_or_goes_along(sound):
    stays = []
    for seed in range(8):
        stage = DamagedTake(sound, np.random.default_rng(seed))
        injected_samples.inject_ghost(stage, PLACE)
        there, true = stage.markers[100:140, 7], stage.true_markers[100:140, 7]
        assert np.linalg.norm(there[0] - true[0]) > 0.04
        world, along = np.ptp(there, axis=0).max(), np.ptp(there - true, axis=0).max()
        assert min(world, along) < 0.005
        stays.append(world < along)
    assert 0 < sum(stays) < 8


def test_labels_go_round_the_ring(stage):
    injected_labels.exchange_labels(stage, [3, 5, 9], 50, 59, "swap")
    for own, under in ((3, 5), (5, 9), (9, 3)):
        np.testing.assert_array_equal(stage.markers[50:60, under], stage.true_markers[50:60, own])
    fault = stage.injected_faults[0]
    assert (fault.markers, fault.first, fault.last) == ((3, 5, 9), 50, 59)


def test_exchanges_begin_in_sight_or_hidden_and_some_are_for_good(sound):
    hidden, last = set(), set()
    for seed in range(20):
        stage = DamagedTake(sound, np.random.default_rng(seed))
        injected_labels.inject_label_exchange(stage, FaultPlace((3, 5), 400, 459))
        hidden.add(len(stage.secondary_faults))
        last.add(stage.injected_faults[0].last)
        for gap in stage.secondary_faults:
            assert gap.last == 399
    assert hidden == {0, 2}
    assert last == {459, stage.frame_count - 1}


def test_a_fragments_samples_are_under_another_label_and_nowhere_else(sound):
    names, pauses = set(), set()
    for seed in range(12):
        stage = DamagedTake(sound, np.random.default_rng(seed))
        injected_labels.inject_fragment(stage, PLACE)
        np.testing.assert_array_equal(stage.markers[100:140, -1], stage.true_markers[100:140, 7])
        assert np.isnan(stage.markers[[*range(100), *range(140, stage.frame_count)], -1]).all()
        missing = np.isnan(stage.markers[:, 7, 0])
        assert missing[100:140].all()
        pauses.add(int(missing.sum()) - 40)
        names.add(stage.labels[-1])
    assert names == {f"{stage.labels[7]}-1", "*1", "C_1"}
    assert min(pauses) == 0 < max(pauses)


@pytest.mark.parametrize("kind", ["moved", "drift"])
def test_a_moved_marker_has_another_place_on_its_segment_to_the_end(kind, stage):
    FAULT_INJECTIONS[kind](stage)
    _, rotation = kinematics.compute_world_poses(stage.sound_truth.subject.skeleton, stage.sound_truth.motion)
    for fault in stage.injected_faults:
        turn = rotation[:, stage.sound_truth.subject.joints[fault.marker]]
        off = np.einsum("tba,tb->ta", turn, stage.true_markers[:, fault.marker] - stage.sound_truth.markers[:, fault.marker])
        np.testing.assert_allclose(off[: fault.first], 0, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(off[fault.settled_frame :], axis=1), fault.severity)
        assert np.linalg.norm(off[fault.first]) > 0
        assert (fault.settled_frame > fault.first) == (kind == "drift")
        assert any(gap.marker == fault.marker and gap.first > fault.settled_frame for gap in stage.secondary_faults)


def test_a_mirrored_limb_has_its_sides_exchanged(sound):
    found = set()
    for seed in range(12):
        stage = DamagedTake(sound, np.random.default_rng(seed))
        FAULT_INJECTIONS["mirrored"](stage)
        pairs = {tuple(stage.labels[m] for m in fault.markers) for fault in stage.injected_faults}
        assert all(left == "L" + right[1:] and right[0] == "R" for left, right in pairs)
        found.add(frozenset(pairs))
    arms, legs = ({each for each in found if (("L" + at, "R" + at) in each) and len(each) < 18} for at in ("WRA", "ANK"))
    assert len(arms) == len(legs) == 1
    assert not arms & legs
    assert found - arms - legs == {max(found, key=len)}
    assert len(max(found, key=len)) == 18  # of 41 markers all but the five in the middle
