"""The commands `mocapfix bench ...`: what they call, print and return. The measurements are replaced."""

import json
from pathlib import Path

import pytest

from mocapfix.lab import contacts, fault_detection, fuzz_process, label_recovery, retargeting, stress, uncertainty
from mocapfix.lab.label_recovery import LabelScore
from mocapfix.lab.results import format_heading, format_value


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("uncertainty", "--takes", "0"), "--takes must be at least 1, not 0"),
        (("clean", "--runs", "0"), "--runs must be at least 1"),
        (("contacts", "--takes", "0"), "--takes must be at least 1 without --plates"),
        (("session", "--people", "0"), "--people is 1 to"),
        (("fuzz", "c3d", "--count", "0"), "--count must be at least 1"),
    ],
)
def test_too_few_of_what_is_measured_is_a_usage_error(mocapfix, arguments, message):
    status, out, error = mocapfix("bench", *arguments)
    assert (status, out) == (2, "")
    assert message in " ".join(error.split())


def test_keys_and_values_are_words():
    assert format_heading("joint_error_mm") == "joint error, mm"
    assert format_heading("peak_mb") == "peak, mb"
    assert format_heading("slide_mm_s") == "slide, mm, s"
    assert format_value({"right": 3, "wrong": 1}) == "right 3, wrong 1"
    assert [format_value(each) for each in (None, float("nan"), 12345.6, 0.123456, True, (1, 2))] == [
        "", "", "12,346", "0.1235", "True", "1, 2",
    ]  # fmt: skip


def test_nested_results_are_tables_or_json(mocapfix, monkeypatch):
    part = {"samples": 3, "error_mm": 4.25, "within_1_sigma": 0.68}
    results = {what: {**part, "by": {"all missing": part}} for what in ("joints", "filled_markers")}
    monkeypatch.setattr(uncertainty, "measure_uncertainty", lambda *_, **__: results)
    status, out, _ = mocapfix("bench", "uncertainty", "--json")
    assert (status, json.loads(out)) == (0, results)
    status, out, _ = mocapfix("bench", "uncertainty")
    assert status == 0
    assert out.count("4.25") == 4
    assert "filled markers: by" in out
    assert "error, mm" in out


def test_rows_by_name_are_one_table(mocapfix, monkeypatch):
    nothing = {"recall": None, "overlap": None, "true_mm": None}
    summary = {"gap": nothing | {"recall": 0.5, "true_mm": 3.21}, "all": nothing}
    calls = []
    monkeypatch.setattr(fault_detection, "measure_fault_detection", lambda *arguments: calls.append(arguments[:2]) or summary)
    status, out, _ = mocapfix("bench", "faults", "--takes", "2")
    assert (status, calls, out.count("recall")) == (0, [(None, 2)], 1)
    assert "3.21" in out
    assert "None" not in out
    monkeypatch.setattr(fault_detection, "measure_mixed_faults", lambda progress: {"labels": nothing, "all": nothing})
    status, out, _ = mocapfix("bench", "faults", "--short", "--json")
    assert (status, list(json.loads(out)), len(calls)) == (0, ["labels", "all"], 1)


def test_labels_have_scores_by_kind_or_of_every_take(mocapfix, monkeypatch):
    scores = [LabelScore("tracks", "a", 1.0, 41, 0.99, 0.98, 0.985, 0.1)]
    monkeypatch.setattr(label_recovery, "measure_label_recovery", lambda *_: scores)
    status, out, _ = mocapfix("bench", "labels", "--json")
    assert (status, json.loads(out)[0]["f1"]) == (0, 0.985)
    status, out, _ = mocapfix("bench", "labels")
    assert status == 0
    assert "tracks" in out


def test_stress_fails_beyond_the_limits(mocapfix, monkeypatch):
    summary = {"lost_frames": 3, "limb_error_mm": 250.0, "within_limits": False}
    row = {"name": "punch, 120 Hz", "lost_in_sight": {"left arm": 3}, "joint_error_mm": 12.0}
    results = {"takes": [row], "ordinary_mm": {"composed": 10.0}, "all": summary, "skipped": "no data"}
    calls = []
    monkeypatch.setattr(stress, "measure_stress", lambda *arguments: calls.append(arguments) or results)
    status, out, _ = mocapfix("bench", "stress", "--json", "--quick", "--data", "motion", "more")
    assert (status, json.loads(out)) == (1, results)
    assert [str(folder) for folder in calls[0][0]] == ["motion", "more"]
    assert calls[0][1:3] == (("straight arm", "kick", "cartwheel"), (120.0,))
    summary["within_limits"] = True
    status, out, _ = mocapfix("bench", "stress")
    assert status == 0
    for part in ("250", "no data", "left arm 3", "Limits: no frame lost"):
        assert part in out


def test_contacts_are_summarised(mocapfix, monkeypatch):
    agreement = contacts.ContactAgreement("a", "whole", 100, 50, 50)
    calls = []
    monkeypatch.setattr(contacts, "measure_contacts", lambda *arguments: calls.append(arguments) or ([], [agreement]))
    status, out, _ = mocapfix("bench", "contacts", "--json", "--data", "a", "b", "--data", "c")
    assert [str(folder) for folder in calls[0][0]] == ["a", "b", "c"]
    assert (status, json.loads(out)["contacts"][0]["found_frames"]) == (0, 50)
    status, out, _ = mocapfix("bench", "contacts")
    assert status == 0
    assert "0.6667" in out


def test_characters_have_a_table_for_each_quantity(mocapfix, monkeypatch):
    row = {"mean": 1.5, "95 %": 4.0, "largest": 9.25, "where": "walk: left, frame 3"}
    results = {"forearm_deg": {"performer": row, "mixamo": row}, "frames_per_second": {"mixamo": {"median of motions": 9000.0}}}
    calls = []
    monkeypatch.setattr(retargeting, "load_bench_motions", lambda *arguments: [arguments])
    monkeypatch.setattr(retargeting, "measure_characters", lambda *arguments: calls.append(arguments[:2]) or results)
    status, out, _ = mocapfix("bench", "retarget", "--captures", "takes", "--characters", "mixamo", "hero.glb", "--feet", "lock")
    assert (status, out.count("9.25"), out.count("walk: left, frame 3")) == (0, 2, 2)
    assert "forearm, deg" in out
    assert calls == [([(None, Path("takes"), "lock")], ("mixamo", "hero.glb"))]


@pytest.mark.parametrize("kind", ["readers", "c3d", "characters", "cleans"])
def test_fuzzing_fails_with_findings(mocapfix, monkeypatch, kind):
    class Tally:
        def to_json(self):
            return {"cases": 7, "findings": [{"seed": 3, "kind": "slow", "text": "9 s"}]}

    ranges = []
    monkeypatch.setattr(fuzz_process, "run_cases", lambda build, seeds, *_: ranges.append(seeds) or Tally())
    status, out, _ = mocapfix("bench", "fuzz", kind, "--count", "7", "--seed", "2")
    assert (status, ranges) == (1, [range(2, 9)])
    assert "slow" in out
