from typing import get_args

import pytest

from mocapfix.faults import MISSING_KINDS, FaultKind
from mocapfix.report.terms import FAULT_GROUPS, FAULT_KIND_NAMES, format_fault_counts, get_fault_group, join_words


def test_faults_are_counted_in_words_labels_first():
    assert (
        format_fault_counts(["gap", "spike", "absent", "swap", "flicker", "spike"]) == "1 exchange of labels, 3 gaps and 2 spikes"
    )
    assert format_fault_counts(["stuck"]) == "1 stretch held at one value"
    assert format_fault_counts([]) == ""
    assert format_fault_counts(["gap"] * 1200) == "1,200 gaps"


@pytest.mark.parametrize("kind", get_args(FaultKind))
def test_every_kind_has_words_and_a_group_with_a_meaning(kind):
    assert kind in FAULT_KIND_NAMES or kind in MISSING_KINDS
    assert format_fault_counts([kind]).startswith("1 ")
    assert get_fault_group(kind) in dict(FAULT_GROUPS)


def test_a_list_of_words_reads_well():
    assert [join_words(words) for words in ([], ["a"], ["a", "b"], ["a", "b", "c"])] == ["", "a", "a and b", "a, b and c"]
