"""What counts as found, and what the table makes of it, on faults whose answer is known."""

import json
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from mocapfix import synthetic
from mocapfix.bench import faults
from mocapfix.bench.faults import Score, alike, errors, net, overlapping, row, scored
from mocapfix.bench.stage import Stage
from mocapfix.faults import Fault, Faults, Fragment
from mocapfix.take import Take

SEEN = np.ones((100, 8), bool)


def fault(kind, first, last, *markers):
    return Fault(kind, markers[0], first, last, 0.1, "", others=markers[1:])


# what is found


def test_what_is_found_to_the_frame_overlaps_wholly():
    assert overlapping(fault("spike", 10, 19, 2), [fault("spike", 10, 19, 2)], SEEN) == 1.0


def test_half_of_it_is_half_and_twice_as_much_is_half():
    put = fault("jitter", 10, 19, 2)
    assert overlapping(put, [fault("jitter", 10, 14, 2)], SEEN) == 0.5
    assert overlapping(put, [fault("jitter", 10, 29, 2)], SEEN) == 0.5
    assert overlapping(put, [fault("spike", 10, 12, 2), fault("ghost", 15, 16, 2)], SEEN) == 0.5


def test_what_is_elsewhere_or_of_another_marker_or_kind_is_not_it():
    put = fault("spike", 10, 19, 2)
    for other in (fault("spike", 20, 29, 2), fault("spike", 10, 19, 3), fault("swap", 10, 19, 2, 3), fault("gap", 10, 19, 2)):
        assert np.isnan(overlapping(put, [other], SEEN))


def test_a_ring_is_found_when_all_of_its_markers_are_and_no_other():
    put = fault("swap", 10, 19, 2, 3, 4)
    assert overlapping(put, [fault("swap", 10, 19, 3, 4, 2)], SEEN) == 1.0
    assert overlapping(put, [fault("swap", 10, 19, 2, 3), fault("swap", 10, 19, 3, 4)], SEEN) == 1.0
    assert np.isnan(overlapping(put, [fault("swap", 10, 19, 2, 3)], SEEN))
    assert np.isnan(overlapping(put, [fault("swap", 10, 19, 2, 3, 4, 5)], SEEN))


def test_missing_samples_say_nothing_of_where_an_exchange_began():
    put, seen = fault("swap", 10, 19, 2, 3), SEEN.copy()
    seen[5:10, 2:4] = False
    assert overlapping(put, [fault("swap", 5, 19, 2, 3)], seen) == 1.0
    assert overlapping(put, [fault("swap", 5, 19, 2, 3)], SEEN) == pytest.approx(2 / 3)


def test_a_gap_is_about_what_is_missing():
    seen = SEEN.copy()
    seen[10:20, 2] = False
    assert overlapping(fault("gap", 10, 19, 2), [fault("flicker", 10, 19, 2)], seen) == 1.0


def test_a_fragment_that_is_no_markers_is_not_joined():
    put, other, joined = (Fragment("fragment", 2, 10, 19, 0.0, "", relation=how) for how in ("continues", "other", "replaces"))
    assert alike(joined, put)
    assert not alike(other, put)
    assert not alike(fault("moved", 0, 9, 2), fault("drift", 0, 9, 2))


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
    truth = synthetic.take(seed=2, seconds=2.0)
    sound = replace(truth, damaged=truth.markers, struck=np.zeros_like(truth.struck))
    stage = Stage(sound, np.random.default_rng(0))
    stage.hide(4, 50, 59, main=True)
    stage.hide(6, 100, 109)
    return stage


def found(stage, *items) -> Any:
    """-> a result with the gaps filled 3 mm off along x, as sure as 1 mm an axis"""
    take = Take(stage.markers, stage.labels, stage.rate)
    filled = np.where(np.isnan(stage.markers), stage.true + [0.003, 0.0, 0.0], stage.markers)
    labelled = take
    for each in Faults(items).of("swap", "mislabelled"):
        labelled = labelled.exchanged(each.markers, each.first, each.last)
    return Found(take, labelled, take.with_markers(filled, np.where(take.seen, np.nan, 0.001)), Faults(items))


def test_exchanges_that_undo_one_another_are_none(stage):
    always, part, spike = fault("mislabelled", 0, 239, 2, 3), fault("swap", 0, 29, 3, 2), fault("spike", 5, 6, 1)
    ring, back = fault("swap", 10, 39, 4, 5, 6), fault("swap", 20, 29, 6, 5, 4)
    left = net(found(stage, spike, always, part, ring, back)).items
    told = [(min(each.markers), each.first, each.last) for each in left]
    assert told == [(1, 5, 6), (2, 30, 239), (4, 10, 19), (4, 30, 39)]


def test_what_was_put_in_or_came_with_it_is_no_false_alarm(stage):
    score = scored(stage, found(stage, fault("gap", 50, 59, 4), fault("gap", 100, 109, 6), fault("ghost", 55, 70, 4)))
    assert score.alarms == []
    assert score.overlap == [1.0]


def test_what_touches_another_marker_or_another_moment_is_one(stage):
    wrong = (fault("swap", 50, 59, 4, 5), fault("spike", 60, 61, 4), fault("spike", 50, 51, 7))
    score = scored(stage, found(stage, *wrong))
    assert score.alarms == list(wrong)
    assert np.isnan(score.overlap).all()
    assert row([score])["false_alarms_per_minute"] == pytest.approx(90.0)


def test_errors_are_distances_of_the_samples_changed_within_what_was_put_in(stage):
    predicted, true = errors(stage, found(stage))
    np.testing.assert_allclose(predicted, np.full(10, 0.001 * np.sqrt(3)))
    np.testing.assert_allclose(true, np.full(10, 0.003))


def test_a_table_of_several_takes():
    scores = [
        Score(np.array([1.0, 0.5]), [fault("spike", 1, 2, 3)], 0.5, np.array([0.003]), np.array([0.004])),
        Score(np.array([np.nan, np.nan]), [], 1.5, np.zeros(0), np.zeros(0)),
    ]
    said = row(scores)
    assert (said["recall"], said["overlap"], said["false_alarms_per_minute"]) == (0.5, 0.75, 0.5)
    assert (said["predicted_mm"], said["true_mm"]) == (pytest.approx(3.0), pytest.approx(4.0))
    nothing = row([Score(np.zeros(0), [], 1.0, np.zeros(0), np.zeros(0))])
    assert nothing == {"recall": None, "overlap": None, "false_alarms_per_minute": 0.0, "predicted_mm": None, "true_mm": None}


def test_every_kind_has_its_row_and_sound_takes_have_their_alarms(monkeypatch):
    def as_it_was(truth, options):
        take = Take(truth.damaged, truth.labels, truth.rate)
        return Found(take, take, take, Faults(() if truth.struck.any() else (fault("spike", 1, 2, 0),)))

    truth = synthetic.take(seed=2, seconds=10.0)
    sound = replace(truth, damaged=truth.markers, struck=np.zeros_like(truth.struck))
    monkeypatch.setattr(faults.sound_takes, "sound", lambda data, takes: [("it", sound)])
    monkeypatch.setattr(faults, "INJECTIONS", {"gap": faults.INJECTIONS["gap"]})
    monkeypatch.setattr(faults, "cleaned", as_it_was)
    told = faults.measure(None, 1)
    assert list(told) == ["gap", "all"]
    assert told["gap"]["recall"] == 0.0
    assert told["gap"]["false_alarms_per_minute"] == 0.0
    assert told["all"]["false_alarms_per_minute"] == pytest.approx(6.0)


def test_flickers_are_found_and_filled_by_the_whole_pipeline(stage):
    score = scored(stage, faults.cleaned(stage.damaged))
    assert score.overlap == [1.0]
    assert len(score.true) == 10
    assert score.true.max() < 0.02


def test_the_command_prints_what_was_measured(mocapfix, monkeypatch):
    nothing = {"recall": None, "overlap": None, "false_alarms_per_minute": 0.0, "predicted_mm": None, "true_mm": None}
    said = {"gap": nothing | {"recall": 0.5, "overlap": 0.8, "true_mm": 3.21}, "all": nothing}
    asked = []
    monkeypatch.setattr(faults, "measure", lambda data, takes, progress: asked.append((data, takes)) or said)
    status, out, _ = mocapfix("bench", "faults", "--takes", "2", "--json")
    assert (status, json.loads(out), asked) == (0, said, [(None, 2)])
    status, out, _ = mocapfix("bench", "faults")
    assert status == 0
    assert "50%" in out
    assert "3.2" in out
    assert "None" not in out
