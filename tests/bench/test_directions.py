"""The dense direction and the sweep's, beside one from finite differences; SCOPE's trees and courses."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mocapfix.bench import own, scope, sparse
from mocapfix.bench.common_task import make
from mocapfix.bench.dense import Dense
from mocapfix.bench.scene import Scene
from tests.kernels.dense import Frame, quadratic


def numeric(scene: Scene) -> np.ndarray:
    """-> the Gauss-Newton step x (6 + 3 K + P,) from derivatives by finite differences."""
    pose = scene.pose
    _, gradient, curvature = quadratic(Frame(scene.tree, scene.terms, pose.root, pose.local, pose.shared))
    return -np.linalg.solve(curvature, gradient)


def swept(scene: Scene) -> np.ndarray:
    """-> the sweep's step, in the dense one's order."""
    return sparse.direction(scene, sparse.work(scene))


@pytest.mark.parametrize(("points", "each", "shapes"), [(40, False, 0), (40, False, 3), (0, True, 0), (5, True, 3)])
def test_the_dense_direction_is_the_one_of_finite_differences(points, each, shapes):
    scene = scope.scene(23, points, each, shapes, seed=4)
    expected = numeric(scene)
    np.testing.assert_allclose(Dense(scene).direction(), expected, atol=1e-6 * np.abs(expected).max())


@settings(max_examples=12)
@given(st.integers(0, 2**32 - 1), st.sampled_from(scope.JOINTS), st.integers(0, 200), st.booleans(), st.integers(0, 10))
def test_the_sweeps_direction_is_the_dense_one(seed, joints, points, each, shapes):
    if not points:
        each = True
    scene = scope.scene(joints, points, each, shapes, seed)
    expected = Dense(scene).direction()
    np.testing.assert_allclose(swept(scene), expected, atol=1e-9 * np.abs(expected).max())


def test_the_common_tasks_first_direction_is_the_same_by_both():
    scene = own.scene(make())
    expected = Dense(scene).direction()
    assert expected.shape == (6 + 3 * 30,)
    np.testing.assert_allclose(swept(scene), expected, atol=1e-9 * np.abs(expected).max())


def test_a_second_direction_of_the_same_scene_is_the_first():
    scene = scope.scene(23, 10, True, 2)
    work, dense = sparse.work(scene), Dense(scene)
    step = sparse.direction(scene, work)
    once = dense.direction()
    np.testing.assert_array_equal(sparse.direction(scene, work), step)
    np.testing.assert_array_equal(dense.direction(), once)


@pytest.mark.parametrize(("hands", "joints"), [(False, 23), (True, 51)])
def test_the_trees_have_their_joints_parents_first(hands, joints):
    tree = scope.parents(hands)
    assert len(tree) == joints + 1
    assert tree[0] == -1
    assert ((tree[1:] >= 0) & (tree[1:] < np.arange(1, len(tree)))).all()


def test_with_hands_each_wrist_carries_five_fingers_of_three_joints():
    tree = scope.parents(True)
    for wrist in scope.WRISTS:
        first = np.flatnonzero(tree == wrist)
        assert len(first) == 5
        assert all(tree[finger + 1] == finger and tree[finger + 2] == finger + 1 for finger in first)


def test_the_experiments_run_over_what_the_paper_says():
    rows = [row for row, _ in scope.experiments()]
    course = {n: {(r["measured"], r["shapes"]) for r in rows if r["experiment"] == n and r["joints"] == 51} for n in (1, 2, 3)}
    assert course[1] == {(n, 0) for n in (120, 240, 360, 480, 600)}
    assert course[2] == {(n, 10) for n in (120, 240, 360, 480, 600)}
    assert course[3] == {(8 * 52, p) for p in range(11)}
    assert {row["joints"] for row in rows} == {23, 51}


def test_a_row_counts_the_numbers_that_its_scene_measures():
    for row, scene in scope.experiments():
        assert row["measured"] == scene.numbers == len(Dense(scene).residual)
        assert (row["joints"], row["shapes"]) == (len(scene.tree.parents) - 1, len(scene.tree.shape))
