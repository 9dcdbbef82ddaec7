"""The baseline: comparison with tolerances, the form of its file, and the repetition of slow cleans."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.errors import SceneError
from mocapfix.lab import baseline
from mocapfix.lab.baseline import BaselineEntry, compare_with_baseline, read_baseline, write_baseline
from mocapfix.lab.clean_speed import CLEAN_SCENES
from mocapfix.lab.sound_takes import find_bench_file


def entry(value: float, tolerance_percent: float = 5.0, is_higher_better: bool = False, tolerance: float = 0.0) -> BaselineEntry:
    return BaselineEntry(value=value, tolerance_percent=tolerance_percent, tolerance=tolerance, is_higher_better=is_higher_better)


@given(st.floats(0.1, 1e3), st.floats(0.5, 2.0), st.booleans())
def test_only_changes_for_the_worse_beyond_the_tolerance_are_reported(
    value: float, factor: float, is_higher_better: bool
) -> None:
    known = {"quantity": entry(value, 5.0, is_higher_better)}
    (row,) = compare_with_baseline({"quantity": entry(value * factor, 5.0, is_higher_better)}, known)
    worse = 1 - factor if is_higher_better else factor - 1
    assert row.change_percent == pytest.approx(100 * worse, abs=1e-6)
    assert row.is_worse == (row.change_percent > 5.0)


def test_a_quantity_that_is_no_longer_measured_counts_as_worse() -> None:
    (row,) = compare_with_baseline({"new": entry(1.0)}, {"old": entry(1.0)})
    assert (row.name, row.is_worse) == ("old", True)
    assert (row.to_json()["value"], row.to_json()["baseline"]) == (None, 1.0)


def test_an_absolute_tolerance_holds_where_the_baseline_is_zero() -> None:
    known = {"lost": entry(0.0), "alarms": entry(0.0, tolerance=6.0)}
    for lost, alarms in ((0.0, 6.0), (1.0, 6.1)):
        rows = compare_with_baseline({"lost": entry(lost), "alarms": entry(alarms)}, known)
        assert [row.is_worse for row in rows] == [lost > 0, alarms > 6]


def cost(over_solver: float) -> dict[str, float]:
    return {"over_solver": over_solver, "peak_mb": 400.0}


def test_a_ratio_that_is_a_third_worse_fails_and_one_that_is_a_quarter_worse_does_not() -> None:
    known = baseline.build_clean_entries({"sound": cost(30.0), "animation": cost(30.0)})
    measured = baseline.build_clean_entries({"sound": cost(43.4), "animation": cost(43.6)})
    rows = [row for row in compare_with_baseline(measured, known) if "time" in row.name]
    assert [row.is_worse for row in rows] == [False, True]


@pytest.mark.parametrize(("repeats", "is_worse"), [((31.0, 52.0), False), ((44.0, 45.0), True)])
def test_a_slow_clean_is_repeated_and_the_fastest_run_counts(monkeypatch, repeats: tuple[float, float], is_worse: bool) -> None:
    known = baseline.build_clean_entries({"sound": cost(30.0), "animation": cost(30.0)})
    measured = baseline.build_clean_entries({"sound": cost(29.0), "animation": cost(46.0)})
    values = iter(repeats)

    def measure(run_count, progress, names, warm_up):
        assert (run_count, list(names), warm_up) == (1, ["animation"], False)
        return {"animation": cost(next(values))}

    monkeypatch.setattr(baseline, "measure_clean_speed", measure)
    repeated = baseline.repeat_slow_cleans(measured, known, lambda _: None)
    assert list(repeated) == list(measured)
    assert [row.is_worse for row in compare_with_baseline(repeated, known)] == [False, False, is_worse, False]


def test_a_part_that_became_slow_is_named_and_small_parts_may_vary() -> None:
    known = baseline.build_clean_entries({"sound": cost(30.0) | {"over_solver, fill": 6.0, "over_solver, read": 0.2}})
    measured = baseline.build_clean_entries({"sound": cost(31.0) | {"over_solver, fill": 9.0, "over_solver, read": 0.9}})
    worse = [row.name for row in compare_with_baseline(measured, known) if row.is_worse]
    assert worse == ["clean, sound, fill: time relative to the solver"]


def test_cleans_that_are_fast_enough_are_not_repeated() -> None:
    entries = baseline.build_clean_entries({"sound": cost(30.0)})
    assert baseline.repeat_slow_cleans(entries, entries, lambda _: None) == entries


def test_coverage_is_held_as_its_distance_from_that_of_a_normal_distribution(monkeypatch) -> None:
    summary = {"error_mm": 9.0, "within_1_sigma": 0.6027, "within_2_sigma": 0.9745}
    for name in ("compose_take", "clean_composed_take", "gather_joint_errors", "gather_fill_errors"):
        monkeypatch.setattr(baseline, name, lambda *_, **__: None)
    monkeypatch.setattr(baseline, "compute_fill_errors", lambda *_: {"mocapfix": {"spikes": 0.5}})
    monkeypatch.setattr(baseline, "summarise_error_groups", lambda _: summary)
    entries = baseline.measure_accuracy_entries(lambda _: None)
    assert {name: each.value for name, each in entries.items()} == {
        "demo: spikes, mm": 0.5,
        "joints: error, mm": 9.0,
        "joints: within one predicted SD, points from 68 %": 8.0,
        "joints: within two predicted SD, points from 95 %": 2.0,
        "filled markers: error, mm": 9.0,
        "filled markers: within one predicted SD, points from 68 %": 8.0,
        "filled markers: within two predicted SD, points from 95 %": 2.0,
    }
    assert entries["joints: within one predicted SD, points from 68 %"].allowed_change == 2.0


def test_the_committed_baseline_holds_time_and_memory_of_every_clean() -> None:
    committed = read_baseline(find_bench_file("baseline.json"))
    for name in CLEAN_SCENES:
        assert committed[f"clean, {name}: time relative to the solver"].allowed_change > 0
        assert committed[f"clean, {name}: peak memory, MB"].allowed_change > 0


def test_the_committed_baseline_can_be_read_and_written(tmp_path: Path) -> None:
    committed = read_baseline(find_bench_file("baseline.json"))
    assert any("solver" in name for name in committed)
    write_baseline(tmp_path / "baseline.json", committed)
    assert read_baseline(tmp_path / "baseline.json") == committed


@pytest.mark.parametrize("text", ["", "[]", json.dumps({"a": {"value": "fast"}})])
def test_a_malformed_baseline_is_refused_with_its_name(tmp_path: Path, text: str) -> None:
    path = tmp_path / "baseline.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SceneError, match=r"baseline\.json"):
        read_baseline(path)


def test_the_command_fails_if_something_became_worse_and_updates_on_request(mocapfix, monkeypatch, tmp_path: Path) -> None:
    path, run_counts = tmp_path / "baseline.json", list[int]()
    write_baseline(path, {"error, mm": entry(10.0, 2.0)})
    now = {"error, mm": entry(10.1, 2.0), "new": entry(1.0)}
    monkeypatch.setattr(baseline, "measure_baseline", lambda _, run_count: run_counts.append(run_count) or now)
    status, out, _ = mocapfix("bench", "--baseline", "--file", path)
    assert (status, "Worse: error" in out, "Not in the baseline: new." in out) == (0, False, True)
    now["error, mm"] = entry(10.3, 2.0)
    assert mocapfix("bench", "baseline", "--file", path)[0] == 1
    status, out, _ = mocapfix("bench", "baseline", "--file", path, "--json")
    (row,) = json.loads(out)
    assert (status, row["name"], row["is_worse"]) == (1, "error, mm", True)
    assert (row["change"], row["change_percent"]) == (pytest.approx(0.3), pytest.approx(3.0))
    status, _, _ = mocapfix("bench", "baseline", "--file", path, "--update")
    assert (status, read_baseline(path), run_counts) == (0, now, [1, 1, 1, 3])
