"""A slice of the fuzzing of characters."""

from collections import Counter
from pathlib import Path

from mocapfix.lab.fuzz_characters import build_character_case, list_character_seeds
from mocapfix.lab.fuzz_process import FuzzLimits, try_case

CASES = 250
FOUND_SEEDS = (19, 1037, 20621)
"""names of animations that are lists or objects, a name of a bone with half of a surrogate pair"""


def test_valid_files_are_read_and_written(tmp_path: Path) -> None:
    assert [case.run(tmp_path) for case in list_character_seeds()] == ["written"] * 4


def test_damaged_characters_are_written_or_refused(tmp_path: Path) -> None:
    outcomes: Counter[str] = Counter()
    for seed in (*range(CASES), *FOUND_SEEDS):
        outcome, _, finding = try_case(build_character_case(seed), seed, FuzzLimits(), tmp_path)
        assert finding is None
        outcomes[outcome] += 1
    assert min(outcomes[kind] for kind in ("written", "refused")) > CASES // 50


def test_cases_are_the_same_for_the_same_seed() -> None:
    assert build_character_case(5) == build_character_case(5)
    assert build_character_case(5) != build_character_case(6)
