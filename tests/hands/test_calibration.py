"""The derivatives of the calibration of hands, against differences."""

import numpy as np
import pytest

from mocapfix.hands.calibration import _HandCalibration
from tests.hands.composed_hands import build_hand, carry_markers, compose_poses


@pytest.fixture(scope="module")
def solved():
    hand = build_hand("Right", ["THM3", "THM6", "IDX3", "IDX6", "MID6"])
    palm, poses = compose_poses(hand)
    frames = np.arange(0, 240, 20)
    markers = carry_markers(hand, poses)[frames] + np.random.default_rng(0).normal(0, 0.004, (len(frames), 5, 3))
    is_used = np.ones(markers.shape[:2], bool)
    is_used[3, 1] = False
    problem = _HandCalibration(hand, markers, is_used, palm.select_frames(frames), 0.5, 1e3)
    unknowns = np.random.default_rng(1).normal(0, 0.2, problem.size)
    state = problem.fit(unknowns, (poses[0][frames], poses[1][frames]))
    for _ in range(2):
        state = problem.fit(unknowns, state.poses)
    return problem, state


def test_the_gradient_is_that_of_the_cost_with_the_poses_solved(solved):
    problem, state = solved

    def measure_volume(state):
        return problem._measure_volume(problem.build_hand(state.unknowns), state.poses, state.points, state.rows)

    gradient = state.gradient - problem.frame_weight * measure_volume(state)[1]

    def compute_cost(unknowns):
        other = problem.fit(unknowns, state.poses)
        return other.cost - problem.frame_weight * measure_volume(other)[0]

    for unknown in [0, 1, 5, 9, 21, 26, 33, 36, 39, 42, 54, 65, *problem.splits[-1] + np.arange(4)]:
        step = 0.05 * np.eye(problem.size)[unknown]
        difference = (compute_cost(state.unknowns + step) - compute_cost(state.unknowns - step)) / 0.1
        assert gradient[unknown] == pytest.approx(difference, rel=0.05, abs=0.2)


def test_the_gradient_of_the_volume_is_that_with_the_poses_fixed(solved):
    problem, state = solved

    def measure(unknowns):
        hand = problem.build_hand(unknowns)
        points = problem._differentiate_points(hand, unknowns, state.poses)
        codes = state.rows.values[:, -hand.model.prior.code_size :]
        return problem._measure_volume(hand, state.poses, points, problem._linearise(hand, state.poses, codes, points))

    _, gradient = measure(state.unknowns)
    for unknown in [0, 2, 4, 10, 17, 19, 21, 25, 32, *problem.splits[-1] + np.arange(6)]:
        step = 1e-4 * np.eye(problem.size)[unknown]
        difference = (measure(state.unknowns + step)[0] - measure(state.unknowns - step)[0]) / 2e-4
        assert gradient[unknown] == pytest.approx(difference, rel=1e-3, abs=0.02)


def test_the_curvature_is_positive_and_that_of_the_prior_at_least(solved):
    problem, state = solved
    values = np.linalg.eigvalsh(problem.eliminate_poses(state)[0])
    assert values.min() > 1 - 1e-9
