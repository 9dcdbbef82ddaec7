"""The baseline: comparison with tolerances, and the form of its file."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.bench.baseline import BaselineEntry, compare_with_baseline, get_baseline_path, read_baseline, write_baseline
from mocapfix.errors import SceneError


def entry(value: float, tolerance_percent: float = 5.0, is_higher_better: bool = False) -> BaselineEntry:
    return BaselineEntry(value=value, tolerance_percent=tolerance_percent, is_higher_better=is_higher_better)


@given(st.floats(0.1, 1e3), st.floats(0.5, 2.0), st.booleans())
def test_only_changes_for_the_worse_beyond_the_tolerance_are_reported(
    value: float, factor: float, is_higher_better: bool
) -> None:
    known = {"quantity": entry(value, 5.0, is_higher_better)}
    (row,) = compare_with_baseline({"quantity": entry(value * factor, 5.0, is_higher_better)}, known)
    worse = 1 - factor if is_higher_better else factor - 1
    assert row.change_percent == pytest.approx(100 * worse, abs=1e-6)
    assert row.is_worse == (row.change_percent > 5.0)


def test_quantities_that_were_not_measured_are_left_out() -> None:
    assert compare_with_baseline({"new": entry(1.0)}, {"old": entry(1.0)}) == []


def test_the_committed_baseline_can_be_read_and_written(tmp_path: Path) -> None:
    committed = read_baseline(get_baseline_path())
    assert any("solver" in name for name in committed)
    write_baseline(tmp_path / "baseline.json", committed)
    assert read_baseline(tmp_path / "baseline.json") == committed


@pytest.mark.parametrize("text", ["", "[]", json.dumps({"a": {"value": "fast"}})])
def test_a_malformed_baseline_is_refused_with_its_name(tmp_path: Path, text: str) -> None:
    path = tmp_path / "baseline.json"
    path.write_text(text)
    with pytest.raises(SceneError, match=r"baseline\.json"):
        read_baseline(path)
