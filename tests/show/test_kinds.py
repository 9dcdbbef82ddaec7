from typing import get_args

import pytest

from mocapfix.faults import MISSING, Kind
from mocapfix.show.kinds import GROUPS, WORDS, counted, group, listed


def test_faults_are_counted_in_words_labels_first():
    assert counted(["gap", "spike", "absent", "swap", "flicker", "spike"]) == "1 exchange of labels, 3 gaps and 2 spikes"
    assert counted(["stuck"]) == "1 stretch held at one value"
    assert counted([]) == ""
    assert counted(["gap"] * 1200) == "1,200 gaps"


@pytest.mark.parametrize("kind", get_args(Kind))
def test_every_kind_has_words_and_a_group_with_a_meaning(kind):
    assert kind in WORDS or kind in MISSING
    assert counted([kind]).startswith("1 ")
    assert group(kind) in dict(GROUPS)


def test_a_list_of_words_reads_well():
    assert [listed(words) for words in ([], ["a"], ["a", "b"], ["a", "b", "c"])] == ["", "a", "a and b", "a, b and c"]
