"""HybrIK on tensors: the kernels' poses, and gradients that are right."""

import numpy as np
import pytest
import torch

from mocapfix import marker_sets
from mocapfix.bench import compared_priors, unseen_poses
from mocapfix.initialise import initial_motion
from mocapfix.initialise.hybrik import NO_TWIST_INFORMATION
from mocapfix.skeleton import load_cmu31_body
from mocapfix.subject import Subject
from mocapfix.train import hybrik

WORN = marker_sets.load_marker_set("cmu41")
SUBJECT = Subject(load_cmu31_body().skeleton, WORN.name, WORN.labels, WORN.joints, WORN.places, np.zeros(len(WORN.labels)))
NOTHING_SURE = torch.tensor([NO_TWIST_INFORMATION, 0.0])


@pytest.fixture(scope="module")
def given():
    """-> joints (200, J, 3) that lie 2 cm off, and twists (200, J, 2) for the bones."""
    rng = np.random.default_rng(0)
    rotations = unseen_poses.load_unseen_poses()[::5]
    joints = compared_priors.place_known_poses(SUBJECT.skeleton, np.zeros((200, 3)), rotations).joints + rng.uniform(
        -0.02, 0.02, (200, 31, 3)
    )
    angle = rng.uniform(-1, 1, (200, 31))
    return joints, 100 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


@pytest.mark.parametrize("way", ["naive", "adaptive", "x"])
def test_tensors_and_kernels_find_the_same_pose(given, way):
    joints, twists = given
    found = initial_motion.solve_hybrik(joints, SUBJECT, variant=way, twists=twists)
    place, local = hybrik.hybrik(torch.tensor(joints), torch.tensor(twists) + NOTHING_SURE, SUBJECT, way)
    assert np.abs(place.numpy() - found.root_position).max() < 1e-10
    assert np.abs(local.numpy() - found.rotations).max() < 1e-10


@pytest.mark.parametrize("way", ["naive", "adaptive", "x"])
def test_gradients_are_those_of_finite_differences(given, way):
    joints, twists = (torch.tensor(each[:2], requires_grad=True) for each in given)
    assert torch.autograd.gradcheck(lambda p, t: hybrik.hybrik(p, t, SUBJECT, way), (joints, twists), fast_mode=True)


def test_joints_can_be_trained_through_it(given):
    """A loss on the rotations moves the joints to where they give these (what the paper trains end to end)."""
    joints, twists = (torch.tensor(each[:4]) for each in given)
    wanted = hybrik.hybrik(joints, twists, SUBJECT)[1]
    moved = (joints + 0.01 * torch.randn(joints.shape, generator=torch.Generator().manual_seed(0))).requires_grad_()
    steps, losses = torch.optim.Adam([moved], lr=1e-3), []
    for _ in range(60):
        loss = (hybrik.hybrik(moved, twists, SUBJECT)[1] - wanted).square().sum()
        steps.zero_grad()
        loss.backward()
        steps.step()
        losses.append(loss.item())
    assert losses[-1] < 0.1 * losses[0]
