"""A slice of the fuzzing, and the harness itself."""

import time
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from mocapfix.errors import ReadError
from mocapfix.lab import fuzz_process
from mocapfix.lab.fuzz_c3d import build_c3d_case
from mocapfix.lab.fuzz_files import choose_mutations, list_seed_files
from mocapfix.lab.fuzz_process import FuzzLimits, is_whole, run_cases, try_case
from mocapfix.lab.fuzz_readers import CLEAN_FUZZ_LIMITS, READER_FUZZ_LIMITS, build_clean_case, build_reader_case, mutate

READER_CASES = 400
C3D_CASES = 300
FOUND_READER_SEEDS = (7685, 12797, 100060, 105195, 178060)
"""a hang in a regular expression, a crash in libyaml, two of aliases, a name that no file can have"""
FOUND_CLEAN_SEEDS = (13, 113, 191, 1084)
"""rates of 0.01 to 10,000 Hz, and an animation without known frames near a gap"""


@dataclass(frozen=True)
class FakeCase:
    """A case that does what its number says."""

    number: int
    size_bytes: int = 0

    def save(self, folder: Path) -> None:
        (folder / "case.txt").write_text(str(self.number), encoding="utf-8")

    def run(self, folder: Path) -> str:
        match self.number:
            case 1:
                raise ReadError("no file; check the name.")
            case 2:
                raise ReadError("two\nlines")
            case 3:
                raise KeyError("bug")
            case 4:
                return f"{len(bytearray(10**11))}"
            case 5:
                time.sleep(60)
            case 6:
                import os

                os.abort()
            case _:
                pass
        return "read"


def test_findings_are_counted_and_written(tmp_path: Path) -> None:
    tally = run_cases(FakeCase, range(8), FuzzLimits(timeout_s=3.0), tmp_path)
    assert {each.seed: each.kind for each in tally.findings} == {
        2: "message", 3: "exception", 4: "memory", 5: "timeout", 6: "crash",
    }  # fmt: skip
    assert dict(tally.outcomes) == {"read": 2, "refused": 2, "exception": 1, "memory": 1, "timeout": 1, "crash": 1}
    assert (tmp_path / "crash-6" / "case.txt").read_text(encoding="utf-8") == "6"
    assert "bug" in (tmp_path / "exception-3" / "finding.json").read_text(encoding="utf-8")


@pytest.mark.parametrize("file", list_seed_files(), ids=lambda file: file.name)
def test_seed_files_are_read_and_damaged_differently(file, tmp_path):
    from mocapfix.lab.fuzz_readers import ReaderCase

    assert ReaderCase(file).run(tmp_path) == "read"
    damaged = {mutate(file.name, file.data, 2, np.random.default_rng(seed)) for seed in range(20)}
    assert len(damaged) > 10
    assert mutate(file.name, file.data, 2, np.random.default_rng(0)) in damaged
    assert len(choose_mutations(file.name)) >= 5


def test_damaged_files_are_read_or_refused(tmp_path: Path) -> None:
    for seed in (*range(READER_CASES), *FOUND_READER_SEEDS):
        _, _, finding = try_case(build_reader_case(seed), seed, READER_FUZZ_LIMITS, tmp_path)
        assert finding is None


@pytest.mark.parametrize("seed", FOUND_CLEAN_SEEDS)
def test_strange_takes_are_cleaned_or_refused(seed: int, tmp_path: Path) -> None:
    _, _, finding = try_case(build_clean_case(seed), seed, CLEAN_FUZZ_LIMITS, tmp_path, is_limited=False)
    assert finding is None


def test_cases_are_the_same_for_the_same_seed() -> None:
    assert build_clean_case(5) == build_clean_case(5)
    assert build_reader_case(5) == build_reader_case(5)
    assert build_reader_case(5) != build_reader_case(6)


def test_memory_limit_is_lifted_again(tmp_path: Path) -> None:
    _, _, finding = try_case(FakeCase(4), 4, FuzzLimits(), tmp_path)
    assert finding is not None
    assert finding.kind == "memory"
    assert len(bytearray(fuzz_process.HEAP_ALLOWANCE_BYTES // 10)) > 0


def test_incomplete_outputs_are_recognised(tmp_path: Path) -> None:
    path = tmp_path / "out"
    path.write_text('{"a": 1', encoding="utf-8")
    assert not is_whole("report.json", path, {})
    assert not is_whole("report.html", path, {})
    assert not is_whole("rrd", path, {})
    assert not is_whole("c3d", path, {"c3d": b"x"})
    path.write_text('{"a": 1}', encoding="utf-8")
    assert is_whole("report.json", path, {})


def test_generated_c3d_files_are_read_as_by_ezc3d(tmp_path: Path) -> None:
    outcomes = Counter(build_c3d_case(seed).run(tmp_path) for seed in range(C3D_CASES))
    assert outcomes["odd, refused"] < 0.15 * (outcomes["odd, read"] + outcomes["odd, refused"])
    assert min(outcomes["equal"], outcomes["equal; ezc3d refuses SGI"], outcomes["odd, read"]) > 0.1 * C3D_CASES


def test_the_comparison_finds_other_samples_and_analog_values(tmp_path: Path) -> None:
    case = next(each for each in map(build_c3d_case, range(100)) if each.content.analog_words.size and not each.oddity)
    for field in ("counts", "residual_words", "analog_words"):
        content = replace(case.content, **{field: getattr(case.content, field) + 1})
        with pytest.raises(AssertionError):
            replace(case, content=content).run(tmp_path)
