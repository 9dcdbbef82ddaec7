"""The dense direction and the sweep's, beside one from finite differences; SCOPE's trees and courses."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mocapfix.bench import mocapfix_solver as own
from mocapfix.bench import mocapfix_solver as sparse
from mocapfix.bench import scope_scenes
from mocapfix.bench.common_task import build_common_task
from mocapfix.bench.dense_solver import DenseSolver
from mocapfix.bench.scope_scenes import ScopeScene
from tests.kernels.dense_oracle import Frame, compute_quadratic


def numeric(scene: ScopeScene) -> np.ndarray:
    """-> the Gauss-Newton step x (6 + 3 K + P,) from derivatives by finite differences."""
    pose = scene.pose
    _, gradient, curvature = compute_quadratic(Frame(scene.tree, scene.terms, pose.root, pose.local, pose.shared))
    return -np.linalg.solve(curvature, gradient)


def swept(scene: ScopeScene) -> np.ndarray:
    """-> the sweep's step, in the dense one's order."""
    return sparse.compute_sparse_direction(scene, sparse.build_workspace(scene))


@pytest.mark.parametrize(("points", "each", "shapes"), [(40, False, 0), (40, False, 3), (0, True, 0), (5, True, 3)])
def test_the_dense_direction_is_the_one_of_finite_differences(points, each, shapes):
    scene = scope_scenes.build_scope_scene(23, points, each, shapes, seed=4)
    expected = numeric(scene)
    np.testing.assert_allclose(DenseSolver(scene).compute_direction(), expected, atol=1e-6 * np.abs(expected).max())


@settings(max_examples=12)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from(scope_scenes.SCOPE_JOINT_COUNTS),
    st.integers(0, 200),
    st.booleans(),
    st.integers(0, 10),
)
def test_the_sweeps_direction_is_the_dense_one(seed, joints, points, each, shapes):
    if not points:
        each = True
    scene = scope_scenes.build_scope_scene(joints, points, each, shapes, seed)
    expected = DenseSolver(scene).compute_direction()
    np.testing.assert_allclose(swept(scene), expected, atol=1e-9 * np.abs(expected).max())


def test_the_common_tasks_first_direction_is_the_same_by_both():
    scene = own.build_task_scene(build_common_task())
    expected = DenseSolver(scene).compute_direction()
    assert expected.shape == (6 + 3 * 30,)
    np.testing.assert_allclose(swept(scene), expected, atol=1e-9 * np.abs(expected).max())


def test_a_second_direction_of_the_same_scene_is_the_first():
    scene = scope_scenes.build_scope_scene(23, 10, True, 2)
    work, dense = sparse.build_workspace(scene), DenseSolver(scene)
    step = sparse.compute_sparse_direction(scene, work)
    once = dense.compute_direction()
    np.testing.assert_array_equal(sparse.compute_sparse_direction(scene, work), step)
    np.testing.assert_array_equal(dense.compute_direction(), once)


@pytest.mark.parametrize(("hands", "joints"), [(False, 23), (True, 51)])
def test_the_trees_have_their_joints_parents_first(hands, joints):
    tree = scope_scenes.build_scope_parents(hands)
    assert len(tree) == joints + 1
    assert tree[0] == -1
    assert ((tree[1:] >= 0) & (tree[1:] < np.arange(1, len(tree)))).all()


def test_with_hands_each_wrist_carries_five_fingers_of_three_joints():
    tree = scope_scenes.build_scope_parents(True)
    for wrist in scope_scenes.WRIST_JOINTS:
        first = np.flatnonzero(tree == wrist)
        assert len(first) == 5
        assert all(tree[finger + 1] == finger and tree[finger + 2] == finger + 1 for finger in first)


def test_the_experiments_run_over_what_the_paper_says():
    rows = [row for row, _ in scope_scenes.build_scope_experiments()]
    course = {n: {(r["measured"], r["shapes"]) for r in rows if r["experiment"] == n and r["joints"] == 51} for n in (1, 2, 3)}
    assert course[1] == {(n, 0) for n in (120, 240, 360, 480, 600)}
    assert course[2] == {(n, 10) for n in (120, 240, 360, 480, 600)}
    assert course[3] == {(8 * 52, p) for p in range(11)}
    assert {row["joints"] for row in rows} == {23, 51}


def test_a_row_counts_the_numbers_that_its_scene_measures():
    for row, scene in scope_scenes.build_scope_experiments():
        assert row["measured"] == scene.measurement_count == len(DenseSolver(scene).residual)
        assert (row["joints"], row["shapes"]) == (len(scene.tree.parents) - 1, len(scene.tree.shape_basis))
