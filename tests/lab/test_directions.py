"""The directions of dense solver and sweep, compared with finite differences; SCOPE's trees and experiments."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mocapfix.lab import scope_scenes
from mocapfix.lab.common_task import build_common_task
from mocapfix.lab.compared_solvers import DenseSolver, build_task_scene, build_workspace, compute_sparse_direction
from mocapfix.lab.scope_scenes import ScopeScene
from tests.kernels.dense_oracle import Frame, compute_quadratic


def compute_numeric_direction(scene: ScopeScene) -> np.ndarray:
    """Return the Gauss-Newton step (6 + 3 K + P,) from derivatives by finite differences."""
    pose = scene.pose
    _, gradient, curvature = compute_quadratic(Frame(scene.tree, scene.terms, pose.root, pose.local, pose.shared))
    return -np.linalg.solve(curvature, gradient)


def sweep(scene: ScopeScene) -> np.ndarray:
    """Return the step of the sweep, in the order of the dense one."""
    return compute_sparse_direction(scene, build_workspace(scene))


@pytest.mark.parametrize(("points", "each", "shapes"), [(40, False, 0), (40, False, 3), (0, True, 0), (5, True, 3)])
def test_dense_direction_agrees_with_finite_differences(points, each, shapes):
    scene = scope_scenes.build_scope_scene(23, points, shapes, measure_every_joint=each, seed=4)
    expected = compute_numeric_direction(scene)
    np.testing.assert_allclose(DenseSolver(scene).compute_direction(), expected, atol=1e-6 * np.abs(expected).max())


@settings(max_examples=12)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from(scope_scenes.SCOPE_JOINT_COUNTS),
    st.integers(0, 200),
    st.booleans(),
    st.integers(0, 10),
)
def test_sweep_direction_agrees_with_the_dense_one(seed, joints, points, each, shapes):
    if not points:
        each = True
    scene = scope_scenes.build_scope_scene(joints, points, shapes, measure_every_joint=each, seed=seed)
    expected = DenseSolver(scene).compute_direction()
    np.testing.assert_allclose(sweep(scene), expected, atol=1e-9 * np.abs(expected).max())


def test_directions_of_the_common_task_agree():
    scene = build_task_scene(build_common_task())
    expected = DenseSolver(scene).compute_direction()
    assert expected.shape == (6 + 3 * 30,)
    np.testing.assert_allclose(sweep(scene), expected, atol=1e-9 * np.abs(expected).max())


def test_repeated_direction_is_equal():
    scene = scope_scenes.build_scope_scene(23, 10, 2, measure_every_joint=True)
    workspace, dense = build_workspace(scene), DenseSolver(scene)
    step = compute_sparse_direction(scene, workspace)
    once = dense.compute_direction()
    np.testing.assert_array_equal(compute_sparse_direction(scene, workspace), step)
    np.testing.assert_array_equal(dense.compute_direction(), once)


@pytest.mark.parametrize(("hands", "joints"), [(False, 23), (True, 51)])
def test_trees_have_parents_before_children(hands, joints):
    tree = scope_scenes.build_scope_parents(with_hands=hands)
    assert len(tree) == joints + 1
    assert tree[0] == -1
    assert ((tree[1:] >= 0) & (tree[1:] < np.arange(1, len(tree)))).all()


def test_each_wrist_has_five_fingers_of_three_joints():
    tree = scope_scenes.build_scope_parents(with_hands=True)
    for wrist in scope_scenes.WRIST_JOINTS:
        first = np.flatnonzero(tree == wrist)
        assert len(first) == 5
        assert all(tree[finger + 1] == finger and tree[finger + 2] == finger + 1 for finger in first)


def test_experiments_have_the_settings_of_the_paper():
    rows = [row for row, _ in scope_scenes.build_scope_experiments()]
    settings_by_experiment = {
        n: {(r["measured"], r["shapes"]) for r in rows if r["experiment"] == n and r["joints"] == 51} for n in (1, 2, 3)
    }
    assert settings_by_experiment[1] == {(n, 0) for n in (120, 240, 360, 480, 600)}
    assert settings_by_experiment[2] == {(n, 10) for n in (120, 240, 360, 480, 600)}
    assert settings_by_experiment[3] == {(8 * 52, p) for p in range(11)}
    assert {row["joints"] for row in rows} == {23, 51}


def test_measurement_count_of_a_row_is_that_of_its_scene():
    for row, scene in scope_scenes.build_scope_experiments():
        assert row["measured"] == scene.measurement_count == len(DenseSolver(scene).residual)
        assert (row["joints"], row["shapes"]) == (len(scene.tree.parents) - 1, len(scene.tree.shape_basis))
