"""What counts as found, and what the table makes of it, on faults whose answer is known."""

import json
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from mocapfix import synthetic
from mocapfix.bench import fault_detection
from mocapfix.bench.damaged_take import DamagedTake
from mocapfix.bench.fault_detection import (
    FaultScore,
    compute_fault_overlap,
    compute_repair_errors,
    is_same_kind,
    merge_label_exchanges,
    score_take,
    summarise_fault_scores,
)
from mocapfix.faults import Fault, Faults, Fragment
from mocapfix.take import Take

SEEN = np.ones((100, 8), bool)


def fault(kind, first, last, *markers):
    return Fault(kind, markers[0], first, last, 0.1, "", other_markers=markers[1:])


# what is found


def test_what_is_found_to_the_frame_overlaps_wholly():
    assert compute_fault_overlap(fault("spike", 10, 19, 2), [fault("spike", 10, 19, 2)], SEEN) == 1.0


def test_half_of_it_is_half_and_twice_as_much_is_half():
    put = fault("jitter", 10, 19, 2)
    assert compute_fault_overlap(put, [fault("jitter", 10, 14, 2)], SEEN) == 0.5
    assert compute_fault_overlap(put, [fault("jitter", 10, 29, 2)], SEEN) == 0.5
    assert compute_fault_overlap(put, [fault("spike", 10, 12, 2), fault("ghost", 15, 16, 2)], SEEN) == 0.5


def test_what_is_elsewhere_or_of_another_marker_or_kind_is_not_it():
    put = fault("spike", 10, 19, 2)
    for other in (fault("spike", 20, 29, 2), fault("spike", 10, 19, 3), fault("swap", 10, 19, 2, 3), fault("gap", 10, 19, 2)):
        assert np.isnan(compute_fault_overlap(put, [other], SEEN))


def test_a_ring_is_found_when_all_of_its_markers_are_and_no_other():
    put = fault("swap", 10, 19, 2, 3, 4)
    assert compute_fault_overlap(put, [fault("swap", 10, 19, 3, 4, 2)], SEEN) == 1.0
    assert compute_fault_overlap(put, [fault("swap", 10, 19, 2, 3), fault("swap", 10, 19, 3, 4)], SEEN) == 1.0
    assert np.isnan(compute_fault_overlap(put, [fault("swap", 10, 19, 2, 3)], SEEN))
    assert np.isnan(compute_fault_overlap(put, [fault("swap", 10, 19, 2, 3, 4, 5)], SEEN))


def test_missing_samples_say_nothing_of_where_an_exchange_began():
    put, seen = fault("swap", 10, 19, 2, 3), SEEN.copy()
    seen[5:10, 2:4] = False
    assert compute_fault_overlap(put, [fault("swap", 5, 19, 2, 3)], seen) == 1.0
    assert compute_fault_overlap(put, [fault("swap", 5, 19, 2, 3)], SEEN) == pytest.approx(2 / 3)


def test_a_gap_is_about_what_is_missing():
    seen = SEEN.copy()
    seen[10:20, 2] = False
    assert compute_fault_overlap(fault("gap", 10, 19, 2), [fault("flicker", 10, 19, 2)], seen) == 1.0


def test_a_fragment_that_is_no_markers_is_not_joined():
    put, other, joined = (Fragment("fragment", 2, 10, 19, 0.0, "", relation=how) for how in ("continues", "other", "replaces"))
    assert is_same_kind(joined, put)
    assert not is_same_kind(other, put)
    assert not is_same_kind(fault("moved", 0, 9, 2), fault("drift", 0, 9, 2))


# of a take


@dataclass
class Found:
    """As much of a result as the bench looks at."""

    before: Take
    labelled: Take
    take: Take
    faults: Faults


@pytest.fixture
def stage():
    truth = synthetic.compose_take(seed=2, seconds=2.0)
    sound = replace(truth, damaged_positions=truth.marker_positions, missing_mask=np.zeros_like(truth.missing_mask))
    stage = DamagedTake(sound, np.random.default_rng(0))
    stage.hide_samples(4, 50, 59, is_main=True)
    stage.hide_samples(6, 100, 109)
    return stage


def found(stage, *items) -> Any:
    """-> a result with the gaps filled 3 mm off along x, as sure as 1 mm an axis"""
    take = Take(stage.markers, stage.labels, stage.rate)
    filled = np.where(np.isnan(stage.markers), stage.true + [0.003, 0.0, 0.0], stage.markers)
    labelled = take
    for each in Faults(items).select_kinds("swap", "mislabelled"):
        labelled = labelled.exchange_labels(each.markers, each.first, each.last)
    return Found(take, labelled, take.replace_markers(filled, np.where(take.visible, np.nan, 0.001)), Faults(items))


def test_exchanges_that_undo_one_another_are_none(stage):
    always, part, spike = fault("mislabelled", 0, 239, 2, 3), fault("swap", 0, 29, 3, 2), fault("spike", 5, 6, 1)
    ring, back = fault("swap", 10, 39, 4, 5, 6), fault("swap", 20, 29, 6, 5, 4)
    left = merge_label_exchanges(found(stage, spike, always, part, ring, back)).items
    told = [(min(each.markers), each.first, each.last) for each in left]
    assert told == [(1, 5, 6), (2, 30, 239), (4, 10, 19), (4, 30, 39)]


def test_what_was_put_in_or_came_with_it_is_no_false_alarm(stage):
    score = score_take(stage, found(stage, fault("gap", 50, 59, 4), fault("gap", 100, 109, 6), fault("ghost", 55, 70, 4)))
    assert score.false_alarms == []
    assert score.overlap == [1.0]


def test_what_touches_another_marker_or_another_moment_is_one(stage):
    wrong = (fault("swap", 50, 59, 4, 5), fault("spike", 60, 61, 4), fault("spike", 50, 51, 7))
    score = score_take(stage, found(stage, *wrong))
    assert score.false_alarms == list(wrong)
    assert np.isnan(score.overlap).all()
    assert summarise_fault_scores([score])["false_alarms_per_minute"] == pytest.approx(90.0)


def test_errors_are_distances_of_the_samples_changed_within_what_was_put_in(stage):
    predicted, true = compute_repair_errors(stage, found(stage))
    np.testing.assert_allclose(predicted, np.full(10, 0.001 * np.sqrt(3)))
    np.testing.assert_allclose(true, np.full(10, 0.003))


def test_a_table_of_several_takes():
    scores = [
        FaultScore(np.array([1.0, 0.5]), [fault("spike", 1, 2, 3)], 0.5, np.array([0.003]), np.array([0.004])),
        FaultScore(np.array([np.nan, np.nan]), [], 1.5, np.zeros(0), np.zeros(0)),
    ]
    said = summarise_fault_scores(scores)
    assert (said["recall"], said["overlap"], said["false_alarms_per_minute"]) == (0.5, 0.75, 0.5)
    assert (said["predicted_mm"], said["true_mm"]) == (pytest.approx(3.0), pytest.approx(4.0))
    nothing = summarise_fault_scores([FaultScore(np.zeros(0), [], 1.0, np.zeros(0), np.zeros(0))])
    assert nothing == {"recall": None, "overlap": None, "false_alarms_per_minute": 0.0, "predicted_mm": None, "true_mm": None}


def test_every_kind_has_its_row_and_sound_takes_have_their_alarms(monkeypatch):
    def as_it_was(truth, options):
        take = Take(truth.damaged_truth, truth.labels, truth.rate)
        return Found(take, take, take, Faults(() if truth.missing_mask.any() else (fault("spike", 1, 2, 0),)))

    truth = synthetic.compose_take(seed=2, seconds=10.0)
    sound = replace(truth, damaged_positions=truth.marker_positions, missing_mask=np.zeros_like(truth.missing_mask))
    monkeypatch.setattr(fault_detection.sound_takes, "sound", lambda data, takes: [("it", sound)])
    monkeypatch.setattr(fault_detection, "INJECTIONS", {"gap": fault_detection.FAULT_INJECTIONS["gap"]})
    monkeypatch.setattr(fault_detection, "cleaned", as_it_was)
    told = fault_detection.measure_fault_detection(None, 1)
    assert list(told) == ["gap", "all"]
    assert told["gap"]["recall"] == 0.0
    assert told["gap"]["false_alarms_per_minute"] == 0.0
    assert told["all"]["false_alarms_per_minute"] == pytest.approx(6.0)


def test_flickers_are_found_and_filled_by_the_whole_pipeline(stage):
    score = score_take(stage, fault_detection.clean_composed_take(stage.damaged_truth))
    assert score.overlap == [1.0]
    assert len(score.true_error) == 10
    assert score.true_error.max() < 0.02


def test_the_command_prints_what_was_measured(mocapfix, monkeypatch):
    nothing = {"recall": None, "overlap": None, "false_alarms_per_minute": 0.0, "predicted_mm": None, "true_mm": None}
    said = {"gap": nothing | {"recall": 0.5, "overlap": 0.8, "true_mm": 3.21}, "all": nothing}
    asked = []
    monkeypatch.setattr(fault_detection, "measure", lambda data, takes, progress: asked.append((data, takes)) or said)
    status, out, _ = mocapfix("bench", "faults", "--takes", "2", "--json")
    assert (status, json.loads(out), asked) == (0, said, [(None, 2)])
    status, out, _ = mocapfix("bench", "faults")
    assert status == 0
    assert "50%" in out
    assert "3.2" in out
    assert "None" not in out
