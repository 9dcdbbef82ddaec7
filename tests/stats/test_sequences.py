"""Statistics of sequences: rows that differ most."""

import numpy as np

from mocapfix.stats import sequences


def test_farthest_rows_begin_at_the_mean_and_do_not_repeat() -> None:
    values = np.array([[0.0], [10.0], [4.9], [5.1], [10.0]])
    assert sequences.select_farthest_rows(values, 3) == [3, 0, 1]
    assert sorted(sequences.select_farthest_rows(values, 5)) == [0, 1, 2, 3, 4]
    assert len(set(sequences.select_farthest_rows(np.zeros((4, 2)), 4))) == 4
