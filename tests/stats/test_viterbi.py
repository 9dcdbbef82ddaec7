"""Viterbi's algorithm against exhaustive search."""

from itertools import pairwise, product

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.stats.viterbi import find_cheapest_states


@given(st.integers(0, 2**32 - 1), st.integers(1, 5))
def test_cheapest_sequence_equals_exhaustive_search(seed, frames):
    rng = np.random.default_rng(seed)
    state_cost, step_cost = rng.uniform(size=(frames, 3)), rng.uniform(size=(frames - 1, 3, 3))

    def compute_total(states):
        steps = sum(step_cost[t, a, b] for t, (a, b) in enumerate(pairwise(states)))
        return sum(state_cost[t, s] for t, s in enumerate(states)) + steps

    best = min(product(range(3), repeat=frames), key=compute_total)
    assert np.isclose(compute_total(find_cheapest_states(step_cost, state_cost)), compute_total(best))
