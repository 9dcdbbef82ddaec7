from typing import get_args

import pytest

from mocapfix.errors import join_words
from mocapfix.model.faults import MISSING_KINDS, FaultKind
from mocapfix.report.terms import FAULT_GROUPS, FAULT_KIND_NAMES, format_fault_counts, get_fault_group


def test_fault_counts_start_with_labels():
    assert format_fault_counts(["gap", "spike", "absent", "swap", "flicker", "spike"]) == "1 label swap, 3 gaps and 2 spikes"
    assert format_fault_counts(["stuck"]) == "1 frozen interval"
    assert format_fault_counts([]) == ""
    assert format_fault_counts(["gap"] * 1200) == "1,200 gaps"


@pytest.mark.parametrize("kind", get_args(FaultKind))
def test_every_kind_has_a_name_and_a_group_with_a_legend(kind):
    assert kind in FAULT_KIND_NAMES or kind in MISSING_KINDS
    assert format_fault_counts([kind]).startswith("1 ")
    assert get_fault_group(kind) in dict(FAULT_GROUPS)


def test_words_are_joined_by_commas_and_and():
    assert [join_words(words) for words in ([], ["a"], ["a", "b"], ["a", "b", "c"])] == ["", "a", "a and b", "a, b and c"]
