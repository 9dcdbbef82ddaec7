"""Matching of detected and injected faults, and the table, on known faults."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from mocapfix.lab import fault_detection
from mocapfix.lab.fault_detection import (
    DamagedTake,
    FaultScore,
    compute_fault_overlap,
    compute_repair_errors,
    is_same_kind,
    merge_label_exchanges,
    score_take,
    summarise_fault_scores,
)
from mocapfix.model.faults import Fault, Faults, Fragment
from mocapfix.model.take import Take
from mocapfix.synthetic import compose_take

ALL_VISIBLE = np.ones((100, 8), bool)


def fault(kind, first, last, *markers):
    return Fault(kind, markers[0], first, last, 0.1, "", other_markers=markers[1:])


# matching


def test_exact_detection_has_full_overlap():
    assert compute_fault_overlap(fault("spike", 10, 19, 2), [fault("spike", 10, 19, 2)], ALL_VISIBLE) == 1.0


def test_overlap_is_intersection_over_union():
    injected = fault("jitter", 10, 19, 2)
    assert compute_fault_overlap(injected, [fault("jitter", 10, 14, 2)], ALL_VISIBLE) == 0.5
    assert compute_fault_overlap(injected, [fault("jitter", 10, 29, 2)], ALL_VISIBLE) == 0.5
    assert compute_fault_overlap(injected, [fault("spike", 10, 12, 2), fault("ghost", 15, 16, 2)], ALL_VISIBLE) == 0.5


def test_other_place_marker_or_kind_does_not_match():
    injected = fault("spike", 10, 19, 2)
    for other in (fault("spike", 20, 29, 2), fault("spike", 10, 19, 3), fault("swap", 10, 19, 2, 3), fault("gap", 10, 19, 2)):
        assert np.isnan(compute_fault_overlap(injected, [other], ALL_VISIBLE))


def test_cycle_needs_all_its_markers_and_no_other():
    injected = fault("swap", 10, 19, 2, 3, 4)
    assert compute_fault_overlap(injected, [fault("swap", 10, 19, 3, 4, 2)], ALL_VISIBLE) == 1.0
    assert compute_fault_overlap(injected, [fault("swap", 10, 19, 2, 3), fault("swap", 10, 19, 3, 4)], ALL_VISIBLE) == 1.0
    assert np.isnan(compute_fault_overlap(injected, [fault("swap", 10, 19, 2, 3)], ALL_VISIBLE))
    assert np.isnan(compute_fault_overlap(injected, [fault("swap", 10, 19, 2, 3, 4, 5)], ALL_VISIBLE))


def test_missing_samples_do_not_count_for_exchanges():
    injected, visible = fault("swap", 10, 19, 2, 3), ALL_VISIBLE.copy()
    visible[5:10, 2:4] = False
    assert compute_fault_overlap(injected, [fault("swap", 5, 19, 2, 3)], visible) == 1.0
    assert compute_fault_overlap(injected, [fault("swap", 5, 19, 2, 3)], ALL_VISIBLE) == pytest.approx(2 / 3)


def test_missing_samples_count_for_gaps():
    visible = ALL_VISIBLE.copy()
    visible[10:20, 2] = False
    assert compute_fault_overlap(fault("gap", 10, 19, 2), [fault("flicker", 10, 19, 2)], visible) == 1.0


def test_fragment_of_no_marker_does_not_match():
    injected, other, joined = (
        Fragment("fragment", 2, 10, 19, 0.0, "", relation=how) for how in ("continues", "other", "replaces")
    )
    assert is_same_kind(joined, injected)
    assert not is_same_kind(other, injected)
    assert not is_same_kind(fault("moved", 0, 9, 2), fault("drift", 0, 9, 2))


# scores of a take


@dataclass
class Result:
    """The fields of a result that the benchmark needs."""

    input_take: Take
    relabelled_take: Take
    take: Take
    faults: Faults


@pytest.fixture
def damaged_take():
    truth = compose_take(seed=2, seconds=2.0)
    sound = replace(truth, damaged_positions=truth.marker_positions, missing_mask=np.zeros_like(truth.missing_mask))
    damaged_take = DamagedTake(sound, np.random.default_rng(0))
    damaged_take.hide_samples(4, 50, 59, is_main=True)
    damaged_take.hide_samples(6, 100, 109)
    return damaged_take


def build_result(damaged_take, *items) -> Any:
    """Return a result with gaps filled with an error of 3 mm along x and a standard deviation of 1 mm per axis."""
    take = Take(damaged_take.markers, damaged_take.labels, damaged_take.rate_hz)
    filled = np.where(np.isnan(damaged_take.markers), damaged_take.true_markers + [0.003, 0.0, 0.0], damaged_take.markers)
    relabelled = take
    for each in Faults(items).select_kinds("swap", "mislabelled"):
        relabelled = relabelled.exchange_labels(each.markers, each.first, each.last)
    return Result(take, relabelled, take.replace_markers(filled, np.where(take.visible, np.nan, 0.001)), Faults(items))


def test_exchanges_are_merged_to_their_net_effect(damaged_take):
    always, part, spike = fault("mislabelled", 0, 239, 2, 3), fault("swap", 0, 29, 3, 2), fault("spike", 5, 6, 1)
    ring, back = fault("swap", 10, 39, 4, 5, 6), fault("swap", 20, 29, 6, 5, 4)
    left = merge_label_exchanges(build_result(damaged_take, spike, always, part, ring, back)).items
    rows = [(min(each.markers), each.first, each.last) for each in left]
    assert rows == [(1, 5, 6), (2, 30, 239), (4, 10, 19), (4, 30, 39)]


def test_injected_and_secondary_faults_are_not_false_alarms(damaged_take):
    score = score_take(
        damaged_take, build_result(damaged_take, fault("gap", 50, 59, 4), fault("gap", 100, 109, 6), fault("ghost", 55, 70, 4))
    )
    assert score.false_alarms == []
    assert score.overlap == [1.0]


def test_fault_of_another_marker_or_time_is_a_false_alarm(damaged_take):
    wrong = (fault("swap", 50, 59, 4, 5), fault("spike", 60, 61, 4), fault("spike", 50, 51, 7))
    score = score_take(damaged_take, build_result(damaged_take, *wrong))
    assert score.false_alarms == list(wrong)
    assert np.isnan(score.overlap).all()
    assert summarise_fault_scores([score])["false_alarms_per_minute"] == pytest.approx(90.0)


def test_repair_errors_are_of_changed_samples_within_injected_faults(damaged_take):
    predicted, true = compute_repair_errors(damaged_take, build_result(damaged_take))
    np.testing.assert_allclose(predicted, np.full(10, 0.001 * np.sqrt(3)))
    np.testing.assert_allclose(true, np.full(10, 0.003))


def test_summary_of_several_takes():
    scores = [
        FaultScore(np.array([1.0, 0.5]), [fault("spike", 1, 2, 3)], 0.5, np.array([0.003]), np.array([0.004])),
        FaultScore(np.array([np.nan, np.nan]), [], 1.5, np.zeros(0), np.zeros(0)),
    ]
    summary = summarise_fault_scores(scores)
    assert (summary["recall"], summary["overlap"], summary["false_alarms_per_minute"]) == (0.5, 0.75, 0.5)
    assert (summary["predicted_mm"], summary["true_mm"]) == (pytest.approx(3.0), pytest.approx(4.0))
    nothing = summarise_fault_scores([FaultScore(np.zeros(0), [], 1.0, np.zeros(0), np.zeros(0))])
    assert nothing == {"recall": None, "overlap": None, "false_alarms_per_minute": 0.0, "predicted_mm": None, "true_mm": None}


def test_every_kind_has_a_row_and_sound_takes_give_the_alarms(monkeypatch):
    def return_unchanged(truth, options):
        take = Take(truth.damaged_positions, truth.labels, truth.rate)
        return Result(take, take, take, Faults(() if truth.missing_mask.any() else (fault("spike", 1, 2, 0),)))

    truth = compose_take(seed=2, seconds=10.0)
    sound = replace(truth, damaged_positions=truth.marker_positions, missing_mask=np.zeros_like(truth.missing_mask))
    monkeypatch.setattr(fault_detection, "iterate_sound_takes", lambda motion_folder, take_count: [("it", sound)])
    monkeypatch.setattr(fault_detection, "FAULT_INJECTIONS", {"gap": fault_detection.FAULT_INJECTIONS["gap"]})
    monkeypatch.setattr(fault_detection, "clean_composed_take", return_unchanged)
    rows = fault_detection.measure_fault_detection(None, 1)
    assert list(rows) == ["gap", "all"]
    assert rows["gap"]["recall"] == 0.0
    assert rows["gap"]["false_alarms_per_minute"] == 0.0
    assert rows["all"]["false_alarms_per_minute"] == pytest.approx(6.0)


def test_the_short_version_injects_every_kind_of_its_mixes(monkeypatch):
    cleaned_truths = []

    def return_unchanged(truth, options):
        cleaned_truths.append(truth)
        take = Take(truth.damaged_positions, truth.labels, truth.rate)
        return Result(take, take, take, Faults((fault("spike", 1, 2, 0),)))

    injected_kinds = set()
    record_fault = DamagedTake.record_fault

    def record(damaged_take, injected, *, is_main=True):
        record_fault(damaged_take, injected, is_main=is_main)
        injected_kinds.update([injected.kind] if is_main else [])

    monkeypatch.setattr(DamagedTake, "record_fault", record)
    monkeypatch.setattr(fault_detection, "clean_composed_take", return_unchanged)
    rows = fault_detection.measure_mixed_faults()
    assert list(rows) == [*fault_detection.FAULT_MIXES, "all"]
    assert injected_kinds == {
        "gap", "spike", "jitter", "stuck", "straight", "ghost", "swap", "fragment", "moved", "drift", "mislabelled"
    }  # fmt: skip
    sound = [truth for truth in cleaned_truths if np.array_equal(truth.damaged_positions, truth.marker_positions)]
    assert (len(cleaned_truths), len(sound)) == (len(rows), 1)
    assert rows["all"]["false_alarms_per_minute"] == pytest.approx(60.0 / fault_detection.MIXED_TAKE_S)
    assert (rows["all"]["recall"] or 0.0) < 0.1  # only what the one reported spike happens to overlap


def test_pipeline_finds_and_fills_flickers(damaged_take):
    score = score_take(damaged_take, fault_detection.clean_composed_take(damaged_take.damaged_truth))
    assert score.overlap == [1.0]
    assert len(score.true_error) == 10
    assert score.true_error.max() < 0.02
