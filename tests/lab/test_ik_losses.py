"""The differentiable correction equals the compiled one, and the losses are zero for the truth."""

import numpy as np
import torch

from mocapfix.lab import learned_ik_training
from mocapfix.lab.learned_ik_training import PoseTensors, TransferTensors, TreeLevels
from mocapfix.lab.networks import compute_rotation_tensor
from mocapfix.solve.learned_ik import build_transfer_tree, correct_poses, transfer_poses
from tests.solve.ik_cases import JOINTS, SKELETON, draw_poses, place


def to_tensor(values):
    return torch.as_tensor(np.array(values), dtype=torch.float32)


def transfer_with_losses(sd=0.02):
    start, (positions, _) = draw_poses(0), place(draw_poses(1))
    positions[:4, SKELETON.find_joint("LeftHand")] = np.nan
    positions[4:8, [SKELETON.find_joint(name) for name in ("Neck", "Neck1", "LeftArm", "RightArm")]] = np.nan
    tree = build_transfer_tree(SKELETON)
    transferred, _ = transfer_poses(tree, (np.zeros((12, 3)), start), positions, np.full((12, JOINTS), sd))
    return tree, start, transferred


def test_differentiable_correction_equals_the_compiled_one():
    tree, start, transferred = transfer_with_losses()
    corrections = np.random.default_rng(0).normal(0, 0.4, (12, 3 * JOINTS + 3)).astype(np.float32)
    root, local = correct_poses(tree, start, transferred, corrections)
    fields = (start, *(getattr(transferred, n) for n in ("rotation", "direction", "authority", "root", "root_unit")))
    tensors = TransferTensors(*map(to_tensor, fields))
    poses = learned_ik_training.correct_pose_tensors(
        tree, TreeLevels.build(SKELETON.parents), tensors, torch.as_tensor(corrections)
    )
    positions, rotations = place(local, root)
    np.testing.assert_allclose(poses.position.numpy(), positions, atol=2e-5)
    np.testing.assert_allclose(poses.rotation.numpy(), rotations, atol=2e-5)


def test_gradients_are_finite_at_the_closed_form():
    tree, start, transferred = transfer_with_losses(1e-4)
    fields = (start, *(getattr(transferred, n) for n in ("rotation", "direction", "authority", "root", "root_unit")))
    corrections = torch.zeros((12, 3 * JOINTS + 3), requires_grad=True)
    levels = TreeLevels.build(SKELETON.parents)
    poses = learned_ik_training.correct_pose_tensors(tree, levels, TransferTensors(*map(to_tensor, fields)), corrections)
    true = PoseTensors(*map(to_tensor, place(draw_poses(1))))
    learned_ik_training.compute_ik_loss(poses, true, (5.0, 1.0, 1.0)).backward()
    assert corrections.grad is not None
    assert torch.isfinite(corrections.grad).all()
    assert corrections.grad.abs().max() > 0


def test_loss_of_the_truth_is_zero_and_weights_scale_its_parts():
    true = PoseTensors(*map(to_tensor, place(draw_poses(1))))
    assert float(learned_ik_training.compute_ik_loss(true, true, (5.0, 1.0, 1.0))) < 1e-3
    moved = PoseTensors(true.position + torch.tensor([0.1, 0.0, 0.0]), true.rotation)
    np.testing.assert_allclose(float(learned_ik_training.compute_ik_loss(moved, true, (5.0, 0.0, 0.0))), 0.5, rtol=1e-3)
    np.testing.assert_allclose(float(learned_ik_training.compute_ik_loss(moved, true, (0.0, 0.0, 2.0))), 0.2, rtol=1e-3)


def test_angles_are_geodesic():
    turned = compute_rotation_tensor(torch.tensor([[0.0, 0.7, 0.0], [1.0, 0.0, 0.0]]))
    np.testing.assert_allclose(learned_ik_training.compute_angles(turned, torch.eye(3)).numpy(), [0.7, 1.0], atol=1e-5)
