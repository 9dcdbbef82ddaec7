"""Unknowns that frames share: damped steps towards the least cost."""

from typing import NamedTuple

import numpy as np
import pytest

from mocapfix.solve.minimise import minimise_shared


class State(NamedTuple):
    unknowns: np.ndarray
    cost: float
    gradient: np.ndarray


@pytest.mark.parametrize("overestimate", [1.0, 0.2])
def test_shared_unknowns_end_at_the_least_cost_even_if_the_curvature_is_too_small(overestimate):
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6))
    curvature, least = root @ root.T + np.eye(6), rng.normal(size=6)
    costs = []

    def fit(unknowns, _=None):
        away = unknowns - least
        costs.append(0.5 * away @ curvature @ away + 1.0)
        return State(unknowns, costs[-1], curvature @ away)

    found, _ = minimise_shared(fit, fit(np.zeros(6)), lambda state: overestimate * curvature, 200)
    assert found.cost == min(costs) < 1.01
    assert (np.array(costs[1:]) > costs[0]).any() == (overestimate < 1)  # rejected steps are damped


def test_the_search_ends_where_no_step_decreases_the_cost():
    trials = []

    def fit(unknowns, _=None):
        trials.append(unknowns)
        return State(unknowns, float(len(trials)), np.ones(2))

    found, _ = minimise_shared(fit, fit(np.zeros(2)), lambda state: np.eye(2), 1000)
    np.testing.assert_array_equal(found.unknowns, 0)
    assert len(trials) < 20
    sizes = np.linalg.norm(trials[1:], axis=1)
    assert (np.diff(sizes) < 0).all()
