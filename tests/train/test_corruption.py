import torch

from mocapfix.skeleton import load_cmu31_body
from mocapfix.train.autoencoder import (
    CORRUPTED_LIMB_SHARE,
    CORRUPTED_POSE_SHARE,
    MAX_JOINT_NOISE_SD_RAD,
    build_limb_masks,
    corrupt_poses,
)

NAMES = load_cmu31_body().skeleton.names
POSES = torch.full((4000, 31, 3), 0.0) + torch.rand(4000, 1, 1, generator=torch.Generator().manual_seed(1)) + 1.0


def test_limbs_are_arms_legs_and_head_each_with_what_hangs_on_it():
    rows = build_limb_masks()
    named = [{NAMES[j] for j in row.nonzero().flatten()} for row in rows]
    assert {"LeftShoulder", "LeftHand", "LThumb", "LeftHandIndex1"} < named[0]
    assert {"RHipJoint", "RightFoot", "RightToeBase"} < named[3]
    assert named[4] == {"Neck", "Neck1", "Head"}
    assert int(rows.sum(0).max()) == 1
    assert not rows[:, 0].any()


def test_poses_are_shaken_and_limbs_lost_as_often_as_said():
    shaken = corrupt_poses(POSES, build_limb_masks(), torch.Generator().manual_seed(0))
    lost = (shaken == 0).all(-1)[:, build_limb_masks()[0]].all(1)  # the way that gives the middle pose, one of four
    assert abs(float(lost.float().mean()) - CORRUPTED_POSE_SHARE * CORRUPTED_LIMB_SHARE / 4) < 0.01
    trunk = (shaken - POSES)[:, NAMES.index("Spine")]
    assert (
        abs(float(trunk.square().mean().sqrt()) - MAX_JOINT_NOISE_SD_RAD / 3**0.5) < 0.01
    )  # the deviation is drawn evenly from nought


def test_another_poses_limb_is_whole_and_real():
    shaken = corrupt_poses(POSES, build_limb_masks(), torch.Generator().manual_seed(0))[:, build_limb_masks()[1]]
    same = (shaken == shaken[:, :1, :1]).all(-1).all(-1) & (shaken[:, 0, 0] != 0)
    others = shaken[same][:, 0, 0]
    taken = torch.isin(others, POSES[:, 0, 0]).float().mean()
    assert same.sum() > 50
    assert 0.3 < float(taken) < 0.7  # the other half is drawn towards the middle


def test_the_same_seed_spoils_alike_and_the_poses_given_stay_as_they_are():
    before = POSES.clone()
    first, again = (corrupt_poses(POSES, build_limb_masks(), torch.Generator().manual_seed(5)) for _ in range(2))
    assert torch.equal(first, again)
    assert torch.equal(POSES, before)
