"""The network as published: rotations from six numbers, the partition of neighbours, and independence of the heading."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mocapfix.io.shipped import find_shipped_folder
from mocapfix.lab import graph_ik
from mocapfix.lab.frame_pairs import IkBatch
from mocapfix.lab.graph_ik import GraphModel
from mocapfix.lab.settings import read_ik_settings
from tests.solve.ik_cases import SKELETON, draw_poses, place


def build_model(**changes):
    settings = read_ik_settings(find_shipped_folder("priors") / "ik-published.yaml")
    torch.manual_seed(0)
    return GraphModel(settings.model_copy(update={"graph_widths": (8, 8), "hidden_widths": (16, 16)} | changes)).eval()


def build_batch(turn=None):
    start, target = draw_poses(0), draw_poses(1)
    if turn is not None:
        start[:, 0], target[:, 0] = turn @ start[:, 0], turn @ target[:, 0]
    root = np.zeros((12, 3))
    positions, _ = place(target)
    return IkBatch(SKELETON, (root, start), (root, target), positions, np.full((12, 31), 1e-3))


def predict(model, batch):
    with torch.no_grad():
        return model.predict(batch)


def test_rotations_from_columns():
    turn = Rotation.random(5, rng=np.random.default_rng(0)).as_matrix()
    columns = torch.as_tensor(np.swapaxes(turn, 1, 2)[:, :2].reshape(5, 6).copy())
    np.testing.assert_allclose(graph_ik.convert_columns_to_rotations(columns).numpy(), turn, atol=1e-9)


def test_untrained_residual_is_nearly_the_start():
    batch = build_batch()
    poses = predict(build_model(), batch)
    np.testing.assert_allclose(poses.rotation.numpy(), place(batch.start[1])[1], atol=0.3)


@pytest.mark.parametrize("is_residual", [True, False])
def test_normalised_network_does_not_depend_on_the_heading(is_residual):
    turn, model = Rotation.from_rotvec([0.2, 2.0, 0.1]).as_matrix(), build_model(is_residual=is_residual)
    straight, turned = predict(model, build_batch()), predict(model, build_batch(turn))
    np.testing.assert_allclose(turned.position.numpy(), straight.position.numpy() @ turn.T.astype(np.float32), atol=1e-4)


def test_network_without_normalisation_depends_on_the_heading():
    turn, model = Rotation.from_rotvec([0.2, 2.0, 0.1]).as_matrix(), build_model(is_normalised=False)
    straight, turned = predict(model, build_batch()), predict(model, build_batch(turn))
    assert np.abs(turned.position.numpy() - straight.position.numpy() @ turn.T.astype(np.float32)).max() > 1e-4


def test_adjacency_has_the_joint_its_parent_and_its_children():
    adjacency = graph_ik.build_adjacency(SKELETON.parents).numpy()
    knee, thigh, foot = (SKELETON.find_joint(f"Left{name}") for name in ("Leg", "UpLeg", "Foot"))
    np.testing.assert_array_equal(adjacency[0], np.eye(31))
    assert adjacency[1][thigh, knee] == 1
    assert adjacency[2][foot, knee] == 1
    np.testing.assert_allclose(adjacency[1:].sum((0, 1))[knee], 2)
