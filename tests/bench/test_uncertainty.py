"""The table of deviations, on errors whose size is known."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from mocapfix import synthetic
from mocapfix.bench import uncertainty
from mocapfix.bench.uncertainty import (
    PredictedErrors,
    find_informative_markers,
    gather_fill_errors,
    gather_joint_errors,
    summarise_error_groups,
    summarise_errors,
)
from mocapfix.motion import Motion
from mocapfix.take import Take


def normal(count, times=1.0, seed=0):
    rng = np.random.default_rng(seed)
    deviation = rng.uniform(0.001, 0.05, count)
    return PredictedErrors(times * rng.normal(size=(count, 3)) * deviation[:, None], deviation)


def test_errors_as_large_as_foretold_lie_within_as_often_as_normal_ones():
    honest, bold, timid = (summarise_errors(normal(20000, times)) for times in (1.0, 2.0, 0.5))
    assert honest["within_1_sigma"] == pytest.approx(0.6827, abs=0.01)
    assert honest["within_2_sigma"] == pytest.approx(0.9545, abs=0.005)
    assert bold["within_2_sigma"] == pytest.approx(0.6827, abs=0.01)
    assert timid["within_1_sigma"] == pytest.approx(0.9545, abs=0.005)
    assert honest["error_mm"] == pytest.approx(honest["deviation_mm"], rel=0.02)
    assert bold["error_mm"] == pytest.approx(2 * bold["deviation_mm"], rel=0.02)
    assert honest["samples"] == 20000


def test_takes_are_put_together_by_part_and_as_a_whole():
    nothing = PredictedErrors(np.zeros((0, 3)), np.zeros(0))
    takes = [{"a": normal(100), "b": nothing, "c": normal(50, 3.0)}, {"a": normal(60, seed=1), "b": nothing, "c": nothing}]
    said = summarise_error_groups(takes)
    assert {name: part["samples"] for name, part in said["by"].items()} == {"a": 160, "c": 50}  # of b there is none
    assert said["samples"] == 210
    share = (160 * said["by"]["a"]["within_1_sigma"] + 50 * said["by"]["c"]["within_1_sigma"]) / 210
    assert said["within_1_sigma"] == pytest.approx(share)


@pytest.fixture(scope="module")
def truth():
    return synthetic.compose_take(seed=3, seconds=4.0)


@dataclass
class Found:
    """As much of a result as the table looks at."""

    joints: np.ndarray
    motion: Motion
    take: Take


@pytest.fixture
def found(truth):
    """-> joints and fills 3 mm off along x, as sure as that"""
    off = np.array([0.003, 0.0, 0.0])
    motion = replace(truth.motion, joint_sd=np.full(truth.joints.shape[:2], 0.0031))
    put = truth.missing_mask | truth.moved
    take = Take(truth.markers + off, truth.labels, truth.rate, sample_sd=np.where(put, 0.0029, np.nan))
    return Found(truth.joints + off, motion, take)


def test_joints_are_told_by_the_markers_on_either_side_of_them(truth):
    tell, names = find_informative_markers(truth.subject), truth.subject.skeleton.names
    labels = {name: {truth.labels[m] for m in np.flatnonzero(tell[names.index(name)])} for name in names}
    assert {"LKNE", "LTHI", "LSHN", "LANK"} <= labels["LeftLeg"]
    assert not {"RKNE", "LFHD"} & labels["LeftLeg"]
    assert labels["LeftHandIndex1"]  # there are none on the fingers: the hand's tell
    assert tell.any(1).all()


def test_joints_fall_into_parts_by_what_is_missing(truth, found):
    parts = gather_joint_errors(truth, found)
    assert sum(len(part.predicted_sd_m) for part in parts.values()) == truth.joints[..., 0].size
    assert all(len(part.predicted_sd_m) for part in parts.values())
    said = summarise_errors(parts["all missing"])
    assert said["within_1_sigma"] == 1.0
    assert said["error_mm"] == pytest.approx(3 / np.sqrt(3))


def test_fills_fall_into_parts_by_how_long_their_gap_is(truth, found):
    parts = gather_fill_errors(truth, found)
    assert sum(len(part.predicted_sd_m) for part in parts.values()) == (truth.missing_mask | truth.moved).sum()
    assert len(parts["spikes and doubted"].predicted_sd_m) == (truth.moved & ~truth.missing_mask).sum()
    arm = len(parts["a whole arm lost"].predicted_sd_m)
    assert arm >= 6 * 1.4 * truth.rate  # some of it joins gaps of its markers before and after
    said = summarise_errors(parts["gaps under 0.2 s"])
    assert said["within_1_sigma"] == pytest.approx(2 / 3)  # two axes are right, the third is a little farther off
    assert said["within_2_sigma"] == 1.0


def test_a_bodiless_result_is_no_measurement(truth, found):
    found.joints = None
    with pytest.raises(ValueError, match="marker set"):
        gather_joint_errors(truth, found)


def test_a_take_that_no_constant_was_set_on_is_cleaned_and_measured():
    said = uncertainty.measure_uncertainty(seeds=[0])
    assert set(said) == {"joints", "filled_markers"}
    for part in said.values():
        assert 0.4 < part["within_1_sigma"] < 0.95
        assert 0.8 < part["within_2_sigma"] <= 1.0
