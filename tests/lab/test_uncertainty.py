"""The table of uncertainties on known errors."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from mocapfix.lab import uncertainty
from mocapfix.lab.sound_takes import remove_damage
from mocapfix.lab.uncertainty import (
    PredictedErrors,
    find_informative_markers,
    gather_errors_by_joint,
    gather_fill_errors,
    gather_joint_errors,
    summarise_error_groups,
    summarise_errors,
)
from mocapfix.model.motion import Motion
from mocapfix.model.take import Take
from mocapfix.synthetic import compose_take


def draw_errors(count, times=1.0, seed=0):
    rng = np.random.default_rng(seed)
    deviation = rng.uniform(0.001, 0.05, count)
    return PredictedErrors(times * rng.normal(size=(count, 3)) * deviation[:, None], deviation)


def test_fractions_within_the_standard_deviation_are_normal():
    exact, overconfident, underconfident = (summarise_errors(draw_errors(20000, times)) for times in (1.0, 2.0, 0.5))
    assert exact["within_1_sigma"] == pytest.approx(0.6827, abs=0.01)
    assert exact["within_2_sigma"] == pytest.approx(0.9545, abs=0.005)
    assert overconfident["within_2_sigma"] == pytest.approx(0.6827, abs=0.01)
    assert underconfident["within_1_sigma"] == pytest.approx(0.9545, abs=0.005)
    assert exact["error_mm"] == pytest.approx(exact["deviation_mm"], rel=0.02)
    assert overconfident["error_mm"] == pytest.approx(2 * overconfident["deviation_mm"], rel=0.02)
    assert exact["samples"] == 20000


def test_groups_of_takes_are_combined():
    empty = PredictedErrors(np.zeros((0, 3)), np.zeros(0))
    takes = [
        {"a": draw_errors(100), "b": empty, "c": draw_errors(50, 3.0)},
        {"a": draw_errors(60, seed=1), "b": empty, "c": empty},
    ]
    summary = summarise_error_groups(takes)
    assert {name: part["samples"] for name, part in summary["by"].items()} == {"a": 160, "c": 50}  # b has no samples
    assert summary["samples"] == 210
    share = (160 * summary["by"]["a"]["within_1_sigma"] + 50 * summary["by"]["c"]["within_1_sigma"]) / 210
    assert summary["within_1_sigma"] == pytest.approx(share)


def test_worst_groups_are_first_with_the_standard_error_over_takes():
    takes = [
        {"good": draw_errors(4000, seed=n), "bad": draw_errors(4000, times, seed=n)} for n, times in enumerate((0.5, 0.5, 2.0))
    ]
    rows = summarise_error_groups(takes)["by"]
    assert list(rows) == ["bad", "good"]
    assert rows["good"]["share_error"] < 0.01
    assert rows["bad"]["share_error"] == pytest.approx((0.954 - 0.383) / 3, abs=0.01)  # of two equal shares and a third
    assert np.isnan(summarise_error_groups(takes[:1])["by"]["bad"]["share_error"])


@pytest.fixture(scope="module")
def truth():
    return compose_take(seed=3, seconds=4.0)


@dataclass
class Result:
    """The fields of a result that the table needs."""

    joint_position_world: np.ndarray | None
    motion: Motion
    take: Take


@pytest.fixture
def result(truth):
    """Return a result whose joints and fills are 3 mm off along x, with a similar standard deviation."""
    off = np.array([0.003, 0.0, 0.0])
    motion = replace(truth.motion, joint_sd=np.full(truth.joint_positions.shape[:2], 0.0031))
    put = truth.missing_mask | truth.spike_mask
    take = Take(truth.marker_positions + off, truth.labels, truth.rate, sample_sd=np.where(put, 0.0029, np.nan))
    return Result(truth.joint_positions + off, motion, take)


def test_informative_markers_are_on_either_side_of_a_joint(truth):
    is_informative, names = find_informative_markers(truth.subject), truth.subject.skeleton.names
    labels = {name: {truth.labels[m] for m in np.flatnonzero(is_informative[names.index(name)])} for name in names}
    assert {"LKNE", "LTHI", "LSHN", "LANK"} <= labels["LeftLeg"]
    assert not {"RKNE", "LFHD"} & labels["LeftLeg"]
    assert labels["LeftHandIndex1"]  # fingers have no markers, so those of the hand count
    assert is_informative.any(1).all()


def test_joints_are_grouped_by_missing_markers(truth, result):
    parts = gather_joint_errors(truth, result)
    assert sum(len(part.predicted_sd_m) for part in parts.values()) == truth.joint_positions[..., 0].size
    assert all(len(part.predicted_sd_m) for part in parts.values())
    summary = summarise_errors(parts["all missing"])
    assert summary["within_1_sigma"] == 1.0
    assert summary["error_mm"] == pytest.approx(3 / np.sqrt(3))


def test_errors_by_joint_pool_left_and_right(truth, result):
    parts = gather_errors_by_joint(truth, result)
    frames = truth.motion.frame_count
    assert {"Hips", "Arm", "ForeArm", "Hand", "Thumb", "Leg", "HipJoint"} <= set(parts)
    assert len(parts["ForeArm"].predicted_sd_m) == 2 * frames
    assert len(parts["Spine1"].predicted_sd_m) == frames


def test_damage_of_a_sound_take(truth):
    damaged = uncertainty.damage_take(remove_damage(truth), np.random.default_rng(0))
    np.testing.assert_array_equal(np.isnan(damaged.damaged_positions[..., 0]), damaged.missing_mask)
    assert 0.01 < damaged.missing_mask.mean() < 0.5
    is_sound = ~damaged.missing_mask & ~damaged.spike_mask
    np.testing.assert_array_equal(damaged.damaged_positions[is_sound], truth.marker_positions[is_sound])


def test_fills_are_grouped_by_gap_duration(truth, result):
    parts = gather_fill_errors(truth, result)
    assert sum(len(part.predicted_sd_m) for part in parts.values()) == (truth.missing_mask | truth.spike_mask).sum()
    assert len(parts["spikes and other faulty samples"].predicted_sd_m) == (truth.spike_mask & ~truth.missing_mask).sum()
    arm = len(parts["a whole arm lost"].predicted_sd_m)
    assert arm >= 6 * 1.4 * truth.rate  # some gaps join gaps before and after
    summary = summarise_errors(parts["gaps under 0.2 s"])
    assert summary["within_1_sigma"] == pytest.approx(2 / 3)  # two axes are exact, the third is slightly outside
    assert summary["within_2_sigma"] == 1.0


def test_result_without_a_body_raises(truth, result):
    result.joint_position_world = None
    with pytest.raises(ValueError, match="marker set"):
        gather_joint_errors(truth, result)


def test_composed_take_is_cleaned_and_measured():
    summary = uncertainty.measure_uncertainty(seeds=[0], is_subject_known=True)
    assert set(summary) == {"joints", "filled_markers"}
    assert len(summary["joints"]["by_joint"]) == 19
    for part in summary.values():
        assert 0.4 < part["within_1_sigma"] < 0.95
        assert 0.8 < part["within_2_sigma"] <= 1.0
