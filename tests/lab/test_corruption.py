import torch

from mocapfix.lab.autoencoder_training import (
    CORRUPTED_LIMB_SHARE,
    CORRUPTED_POSE_SHARE,
    MAX_JOINT_NOISE_SD_RAD,
    build_limb_masks,
    corrupt_poses,
)
from mocapfix.model.skeleton import load_cmu31_body

NAMES = load_cmu31_body().skeleton.names
POSES = torch.full((4000, 31, 3), 0.0) + torch.rand(4000, 1, 1, generator=torch.Generator().manual_seed(1)) + 1.0


def test_limbs_are_arms_legs_and_head_with_all_descendants():
    masks = build_limb_masks()
    limbs = [{NAMES[j] for j in row.nonzero().flatten()} for row in masks]
    assert {"LeftShoulder", "LeftHand", "LThumb", "LeftHandIndex1"} < limbs[0]
    assert {"RHipJoint", "RightFoot", "RightToeBase"} < limbs[3]
    assert limbs[4] == {"Neck", "Neck1", "Head"}
    assert int(masks.sum(0).max()) == 1
    assert not masks[:, 0].any()


def test_noise_and_corrupted_limbs_have_the_set_frequency():
    corrupted = corrupt_poses(POSES, build_limb_masks(), torch.Generator().manual_seed(0))
    lost = (corrupted == 0).all(-1)[:, build_limb_masks()[0]].all(1)  # replaced by the reference pose, one of four ways
    assert abs(float(lost.float().mean()) - CORRUPTED_POSE_SHARE * CORRUPTED_LIMB_SHARE / 4) < 0.01
    trunk = (corrupted - POSES)[:, NAMES.index("Spine")]
    assert (
        abs(float(trunk.square().mean().sqrt()) - MAX_JOINT_NOISE_SD_RAD / 3**0.5) < 0.01
    )  # the standard deviation is uniform from zero


def test_a_replaced_limb_comes_from_one_other_pose():
    corrupted = corrupt_poses(POSES, build_limb_masks(), torch.Generator().manual_seed(0))[:, build_limb_masks()[1]]
    same = (corrupted == corrupted[:, :1, :1]).all(-1).all(-1) & (corrupted[:, 0, 0] != 0)
    others = corrupted[same][:, 0, 0]
    taken = torch.isin(others, POSES[:, 0, 0]).float().mean()
    assert same.sum() > 50
    assert 0.3 < float(taken) < 0.7  # the other half is moved towards the reference pose


def test_corruption_is_reproducible_and_does_not_change_its_input():
    before = POSES.clone()
    first, again = (corrupt_poses(POSES, build_limb_masks(), torch.Generator().manual_seed(5)) for _ in range(2))
    assert torch.equal(first, again)
    assert torch.equal(POSES, before)
