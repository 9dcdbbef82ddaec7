"""Poses under mixtures: each in the component in which it costs least, as under that component alone."""

from dataclasses import replace

import numpy as np
import pytest

from mocapfix.kernels.levenberg import CONVERGED
from mocapfix.prior.contract import from_middle
from mocapfix.prior.linear import Linear
from mocapfix.prior.mixture import Mixture
from mocapfix.solve import poses
from tests.solve.test_poses import CODE, JOINTS, body, given, posed, unbent


def mixed(rng, count=2) -> Mixture:
    """-> a mixture of well separated components; a pose has a tilt, but no heading"""
    model = unbent(rng)
    axes = rng.normal(size=(CODE, JOINTS, 3))
    axes[:, 0, 1] = 0.0
    axes = np.linalg.qr(axes.reshape(CODE, -1).T)[0].T.reshape(axes.shape)
    centres = np.zeros((count, CODE))
    centres[:, 0] = 1.5 * np.arange(count)
    spreads = np.tril(rng.uniform(0.1, 0.2, (count, CODE, CODE)))
    return Mixture(
        model.joints, model.middle, model.sigma, model.mean, axes, np.full(count, 1 / count), centres, spreads, np.zeros(1, int)
    )


def component(model: Mixture, c: int) -> Linear:
    """-> one component as a model of its own"""
    mean = model.mean + np.tensordot(model.centres[c], model.axes, 1)
    return Linear(model.joints, model.middle, model.sigma, mean, np.tensordot(model.spreads[c].T, model.axes, 1), 0.1)


def case(rng, model, chosen):
    """-> a body, rough points on its joints in poses of the chosen components, a start in the first component"""
    tree, codes = body(rng), rng.normal(0, 0.7, (len(chosen), CODE))
    local, root = posed(replace(model, chosen=np.array(chosen)), codes), rng.normal(size=(len(chosen), 3))
    start = root + 0.05, np.repeat(posed(model, np.zeros((1, CODE))), len(chosen), 0)
    return tree, given(rng, tree, root, local, np.arange(JOINTS), sd=0.05), start


def test_each_pose_ends_in_its_component_as_under_that_alone():
    rng = np.random.default_rng(0)
    model, chosen = mixed(rng), [0, 1, 1, 0]
    tree, points, start = case(rng, model, chosen)
    found = poses.under(tree, (points,), model, *start)
    assert (found.status == CONVERGED).all()
    assert model.near(from_middle(found.rotations, model.middle)).chosen.tolist() == chosen
    for c in (0, 1):
        alone = poses.under(tree, (points,), component(model, c), *start)
        own = np.array(chosen) == c
        np.testing.assert_allclose(found.rotations[own], alone.rotations[own], atol=5e-3)
        np.testing.assert_allclose(found.codes[own], alone.codes[own], atol=5e-2)


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_a_mixture_of_one_is_a_gaussian(scale):
    rng = np.random.default_rng(2)
    model = mixed(rng, 1)
    tree, points, start = case(rng, model, [0, 0, 0])
    found = poses.under(tree, (points,), model, *start, scale=scale)
    expected = poses.under(tree, (points,), component(model, 0), *start, scale=scale)
    np.testing.assert_allclose(found.rotations, expected.rotations, atol=5e-3)
    np.testing.assert_allclose(found.codes, expected.codes, atol=5e-2)


def test_of_poses_that_fit_alike_the_one_in_the_likelier_component_costs_less():
    rng = np.random.default_rng(4)
    model = replace(mixed(rng), weights=np.array([0.9, 0.1]))
    model = replace(model, spreads=model.spreads[[0, 0]])
    tree, (one, other) = body(rng), (posed(replace(model, chosen=np.array([c])), np.zeros((1, CODE))) for c in (0, 1))
    local, root = np.concatenate([one, other]), np.zeros((2, 3))
    points = given(rng, tree, root, local, np.arange(JOINTS), sd=0.05)
    found = poses.under(tree, (points,), model, root, local)
    assert found.cost[1] - found.cost[0] == pytest.approx(np.log(9), abs=1e-6)


def test_frames_neither_know_their_batch_nor_their_order(monkeypatch):
    rng = np.random.default_rng(3)
    model = mixed(rng)
    tree, points, start = case(rng, model, [0, 1, 1, 0, 1])
    found = poses.under(tree, (points,), model, *start)
    order = rng.permutation(5)
    turned = points._replace(seen=points.seen[order], weight=points.weight[order])
    monkeypatch.setattr(poses, "BATCH", 2)
    again = poses.under(tree, (turned,), model, *(each[order] for each in start))
    np.testing.assert_allclose(again.rotations, found.rotations[order], atol=1e-9)
