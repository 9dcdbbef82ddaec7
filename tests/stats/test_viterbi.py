"""Viterbi's algorithm against exhaustive search."""

from itertools import pairwise, product

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mocapfix.stats.sequences import find_cheapest_states


@given(st.integers(0, 2**32 - 1), st.integers(1, 5))
def test_cheapest_sequence_equals_exhaustive_search(seed, frames):
    rng = np.random.default_rng(seed)
    state_cost, step_cost = rng.uniform(size=(frames, 3)), rng.uniform(size=(frames - 1, 3, 3))

    def compute_total(states):
        steps = sum(step_cost[t, a, b] for t, (a, b) in enumerate(pairwise(states)))
        return sum(state_cost[t, s] for t, s in enumerate(states)) + steps

    best = min(product(range(3), repeat=frames), key=compute_total)
    assert np.isclose(compute_total(find_cheapest_states(step_cost, state_cost)), compute_total(best))


def test_state_changes_only_if_it_saves_more_than_the_steps_cost():
    state_cost = np.tile([0.0, 1.0], (10, 1))
    state_cost[3:7] = [1.0, 0.0]  # changing the state and back saves 4
    for step_price, expected in ((1.9, [0, 0, 0, 1, 1, 1, 1, 0, 0, 0]), (2.1, [0] * 10)):
        step_cost = np.tile(step_price * (1 - np.eye(2)), (9, 1, 1))
        assert find_cheapest_states(step_cost, state_cost).tolist() == expected
