"""Poses under a mixture: each frame is solved in its cheapest component."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix.model.motion import FrameStatus
from mocapfix.solve import model_terms
from mocapfix.solve.pose_prior import GaussianModel, MixtureModel, compute_pose_vectors
from tests.solve.test_model_terms import CODE, JOINTS, body, build_linear_model, given, posed, solve


def mixed(rng, count=2) -> MixtureModel:
    """Return a mixture of well separated components; a pose has a tilt, but no heading"""
    model = build_linear_model(rng)
    axes = rng.normal(size=(CODE, JOINTS, 3))
    axes[:, 0, 1] = 0.0
    axes = np.linalg.qr(axes.reshape(CODE, -1).T)[0].T.reshape(axes.shape)
    centres = np.zeros((count, CODE))
    centres[:, 0] = 1.5 * np.arange(count)
    spreads = np.tril(rng.uniform(0.1, 0.2, (count, CODE, CODE)))
    return MixtureModel(
        model.joint_names,
        model.reference_rotations,
        model.residual_sd_rad,
        model.mean_vectors,
        axes,
        np.full(count, 1 / count),
        centres,
        spreads,
        np.zeros(1, int),
    )


def component(model: MixtureModel, c: int) -> GaussianModel:
    """Return one component as a model of its own"""
    mean = model.mean_vectors + np.tensordot(model.component_means[c], model.principal_axes, 1)
    return GaussianModel(
        model.joint_names,
        model.reference_rotations,
        model.residual_sd_rad,
        mean,
        np.tensordot(model.component_cholesky[c].T, model.principal_axes, 1),
        0.1,
    )


def case(rng, model, chosen):
    """Return a body, rough points on its joints in poses of the chosen components, a start in the first component"""
    tree, codes = body(rng), rng.normal(0, 0.7, (len(chosen), CODE))
    local, root = posed(replace(model, component_index=np.array(chosen)), codes), rng.normal(size=(len(chosen), 3))
    start = root + 0.05, np.repeat(posed(model, np.zeros((1, CODE))), len(chosen), 0)
    return tree, given(rng, tree, root, local, np.arange(JOINTS), sd=0.05), start


def test_poses_end_in_their_component_as_under_it_alone():
    rng = np.random.default_rng(0)
    model, chosen = mixed(rng), [0, 1, 1, 0]
    tree, points, start = case(rng, model, chosen)
    found = solve(tree, points, model, start)
    assert (found.status == FrameStatus.CONVERGED).all()
    assert (
        model.select_components(compute_pose_vectors(found.local_rotations, model.reference_rotations)).component_index.tolist()
        == chosen
    )
    for c in (0, 1):
        alone = solve(tree, points, component(model, c), start)
        own = np.array(chosen) == c
        np.testing.assert_allclose(found.local_rotations[own], alone.local_rotations[own], atol=5e-3)
        np.testing.assert_allclose(found.codes[own], alone.codes[own], atol=5e-2)


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_mixture_of_one_equals_a_gaussian(scale):
    rng = np.random.default_rng(2)
    model = mixed(rng, 1)
    tree, points, start = case(rng, model, [0, 0, 0])
    found = solve(tree, points, model, start, prior_scale=scale)
    expected = solve(tree, points, component(model, 0), start, prior_scale=scale)
    np.testing.assert_allclose(found.local_rotations, expected.local_rotations, atol=5e-3)
    np.testing.assert_allclose(found.codes, expected.codes, atol=5e-2)


def test_likelier_component_costs_less():
    rng = np.random.default_rng(4)
    model = replace(mixed(rng), component_weights=np.array([0.9, 0.1]))
    model = replace(model, component_cholesky=model.component_cholesky[[0, 0]])
    tree, (one, other) = body(rng), (posed(replace(model, component_index=np.array([c])), np.zeros((1, CODE))) for c in (0, 1))
    local, root = np.concatenate([one, other]), np.zeros((2, 3))
    points = given(rng, tree, root, local, np.arange(JOINTS), sd=0.05)
    found = solve(tree, points, model, (root, local))
    assert found.cost[1] - found.cost[0] == pytest.approx(np.log(9), abs=1e-6)


def test_batches_and_frame_order_are_irrelevant(monkeypatch):
    rng = np.random.default_rng(3)
    model = mixed(rng)
    tree, points, start = case(rng, model, [0, 1, 1, 0, 1])
    found = solve(tree, points, model, start)
    order = rng.permutation(5)
    turned = points._replace(measured=points.measured[order], weight=points.weight[order])
    monkeypatch.setattr(model_terms, "MAX_BATCH_FRAMES", 2)
    again = solve(tree, turned, model, tuple(each[order] for each in start))
    np.testing.assert_allclose(again.local_rotations, found.local_rotations[order], atol=1e-9)
