"""The shipped characters: names, trees, proportions and conventions of the programs' standard figures."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mocapfix.characters.character import SIDES, Character
from mocapfix.characters.load_character import load_character_preset
from mocapfix.errors import SceneError
from mocapfix.options import CHARACTER_PRESETS

# The limb chains as the programs name them, for the left side, from the pelvis outwards.
ARM_CHAINS = {
    "daz-g8": "chestUpper lCollar lShldrBend lShldrTwist lForearmBend lForearmTwist lHand lCarpal1 lIndex1",
    "daz-g9": "spine4 l_shoulder l_upperarm l_forearm l_hand l_indexmetacarpal l_index1",
    "humanik": "Spine2 LeftShoulder LeftArm LeftForeArm LeftHand LeftHandIndex1",
    "metahuman": "spine_05 clavicle_l upperarm_l lowerarm_l hand_l index_metacarpal_l index_01_l",
    "mixamo": "mixamorig:Spine2 mixamorig:LeftShoulder mixamorig:LeftArm mixamorig:LeftForeArm mixamorig:LeftHand",
    "rigify": "DEF-spine.003 DEF-shoulder.L DEF-upper_arm.L DEF-upper_arm.L.001 DEF-forearm.L DEF-forearm.L.001 DEF-hand.L",
    "smpl": "spine3 left_collar left_shoulder left_elbow left_wrist left_hand",
    "smplx": "spine3 left_collar left_shoulder left_elbow left_wrist left_index1 left_index2 left_index3",
    "unreal": "spine_05 clavicle_l upperarm_l lowerarm_l hand_l middle_metacarpal_l middle_01_l",
    "vrm": "upperChest leftShoulder leftUpperArm leftLowerArm leftHand leftThumbMetacarpal leftThumbProximal leftThumbDistal",
}
LEG_CHAINS = {
    "daz-g8": "hip pelvis lThighBend lThighTwist lShin lFoot lMetatarsals lToe",
    "daz-g9": "hip pelvis l_thigh l_shin l_foot l_metatarsal l_toes",
    "humanik": "Hips LeftUpLeg LeftLeg LeftFoot LeftToeBase",
    "metahuman": "root pelvis thigh_l calf_l foot_l ball_l",
    "mixamo": "mixamorig:Hips mixamorig:LeftUpLeg mixamorig:LeftLeg mixamorig:LeftFoot mixamorig:LeftToeBase",
    "rigify": "DEF-spine DEF-thigh.L DEF-thigh.L.001 DEF-shin.L DEF-shin.L.001 DEF-foot.L DEF-toe.L",
    "smpl": "pelvis left_hip left_knee left_ankle left_foot",
    "smplx": "pelvis left_hip left_knee left_ankle left_foot",
    "unreal": "root pelvis thigh_l calf_l foot_l ball_l",
    "vrm": "hips leftUpperLeg leftLowerLeg leftFoot leftToes",
}
SPINE_AND_NECK_COUNTS = {
    "daz-g8": (4, 2), "daz-g9": (4, 2), "humanik": (3, 1), "metahuman": (5, 2), "mixamo": (3, 1), "rigify": (3, 2),
    "smpl": (3, 1), "smplx": (3, 1), "unreal": (5, 2), "vrm": (3, 1),
}  # fmt: skip
T_POSES = ("humanik", "mixamo", "smpl", "smplx", "vrm")
UNITS_M = {"rigify": 1.0, "smpl": 1.0, "smplx": 1.0, "vrm": 1.0}
Z_UP = ("metahuman", "rigify", "unreal")
WORLD_AXES = ("humanik", "smpl", "smplx", "vrm")
MIN_HEIGHT_M, MAX_HEIGHT_M = 1.65, 1.85


@pytest.fixture(params=CHARACTER_PRESETS)
def preset(request: pytest.FixtureRequest) -> Character:
    return load_character_preset(request.param)


def test_unknown_preset_lists_the_presets():
    with pytest.raises(SceneError, match="daz-g8, daz-g9, humanik"):
        load_character_preset("maya")


def test_bones_are_unique_and_below_their_parents(preset: Character):
    assert len(set(preset.skeleton.names)) == len(preset.skeleton.names)
    assert all(parent < bone for bone, parent in enumerate(preset.skeleton.parents))
    assert (preset.skeleton.parents < 0).sum() == 1
    assert preset.name in CHARACTER_PRESETS
    assert preset.source
    assert preset.source.kind == "yaml"


@pytest.mark.parametrize("chains", [ARM_CHAINS, LEG_CHAINS], ids=["arms", "legs"])
def test_chains_have_the_names_of_the_program(preset: Character, chains: dict[str, str]):
    for upper, lower in pairwise(chains[preset.name].split()):
        assert preset.skeleton.names[preset.skeleton.parents[preset.skeleton.find_joint(lower)]] == upper


def test_spine_and_neck_counts_are_those_of_the_program(preset: Character):
    bones = preset.mapping.bones
    assert (len(bones["spine"]), len(bones["neck"])) == SPINE_AND_NECK_COUNTS[preset.name]
    assert not preset.mapping.missing_segments


def test_left_and_right_are_mirrored(preset: Character):
    positions, _ = preset.skeleton.compute_rest_pose()
    for group in (preset.mapping.bones, preset.mapping.twists):
        for segment, bones in group.items():
            if segment.startswith("left_"):
                right = positions[list(group[segment.replace("left_", "right_")])]
                assert np.allclose(positions[list(bones)], right * [-1, 1, 1], atol=1e-6)
    mirrored = positions * [-1, 1, 1]
    distances = np.linalg.norm(positions[:, None] - mirrored[None], axis=-1)
    assert distances.min(1).max() < 1e-6


def test_figure_stands_on_the_floor_and_faces_forward(preset: Character):
    positions, rotations = preset.skeleton.compute_rest_pose()
    tails = positions + np.einsum("jab,jb->ja", rotations, preset.skeleton.ends)
    height_m = np.nanmax(np.r_[positions[:, 1], tails[:, 1]])
    assert MIN_HEIGHT_M < height_m < MAX_HEIGHT_M
    bones = preset.mapping.bones
    for side, sign in zip(SIDES, (1, -1), strict=True):
        thigh, shin, foot, toe = (positions[bones[f"{side}_{name}"][0]] for name in ("thigh", "shin", "foot", "toe"))
        assert 0.06 < foot[1] < 0.12
        assert 0.0 <= toe[1] < 0.04
        assert 0.08 < toe[2] - foot[2] < 0.2
        assert sign * thigh[0] > 0.05
        assert (shin - thigh)[1] / np.linalg.norm(shin - thigh) < -0.97
        assert (foot - shin)[1] / np.linalg.norm(foot - shin) < -0.97
        assert 0.9 < np.linalg.norm(foot - shin) / np.linalg.norm(shin - thigh) < 1.15
        arm, forearm, hand = (positions[bones[f"{side}_{name}"][0]] for name in ("upper_arm", "forearm", "hand"))
        drop = -(hand - arm)[1] / np.linalg.norm(hand - arm)
        assert abs(drop) < 0.05 if preset.name in T_POSES else 0.4 < drop < 0.8
        assert 0.5 < np.linalg.norm(hand - forearm) + np.linalg.norm(forearm - arm) < 0.62


def test_units_and_up_axes_are_those_of_the_program(preset: Character):
    assert preset.root_scale == UNITS_M.get(preset.name, 0.01)
    assert (preset.scales == preset.root_scale).all()
    up_y_up = preset.rotation_y_up_file @ ([0, 0, 1] if preset.name in Z_UP else [0, 1, 0])
    assert np.allclose(up_y_up, [0, 1, 0])
    assert np.isclose(np.linalg.det(preset.rotation_y_up_file), 1)


def test_axes_are_right_handed_and_follow_the_convention(preset: Character):
    positions, rotations = preset.skeleton.compute_rest_pose()
    assert np.allclose(rotations @ rotations.swapaxes(-1, -2), np.eye(3), atol=1e-8)
    assert np.allclose(np.linalg.det(rotations), 1)
    if preset.name in WORLD_AXES:
        assert np.allclose(rotations, np.eye(3))
        return
    bones = preset.mapping.bones
    own_directions = {
        "mixamo": ([0, 1, 0], [0, 1, 0]), "rigify": ([0, 1, 0], [0, 1, 0]),
        "unreal": ([1, 0, 0], [-1, 0, 0]), "metahuman": ([1, 0, 0], [-1, 0, 0]),
        "daz-g8": ([1, 0, 0], [-1, 0, 0]), "daz-g9": ([1, 0, 0], [-1, 0, 0]),
    }[preset.name]  # fmt: skip
    for side, own in zip(SIDES, own_directions, strict=True):
        arm, forearm = bones[f"{side}_upper_arm"][0], bones[f"{side}_forearm"][0]
        direction = (positions[forearm] - positions[arm]) / np.linalg.norm(positions[forearm] - positions[arm])
        assert np.allclose(rotations[arm] @ own, direction, atol=1e-3)


def test_unreal_right_side_is_the_left_mirrored_and_negated():
    unreal = load_character_preset("unreal")
    _, rotations = unreal.skeleton.compute_rest_pose()
    for left, name in enumerate(unreal.skeleton.names):
        if name.endswith("_l"):
            right = rotations[unreal.skeleton.find_joint(f"{name[:-2]}_r")]
            assert np.allclose(right, -np.diag([-1, 1, 1]) @ rotations[left], atol=1e-6)


def test_limits_contain_the_rest_pose_and_bend_the_right_way(preset: Character):
    positions, rotations = preset.skeleton.compute_rest_pose()
    bones = preset.mapping.bones
    limits_rad = preset.skeleton.limits_rad
    limited = set(np.flatnonzero(np.isfinite(limits_rad).all((1, 2))).tolist())
    assert {bones[f"{side}_{name}"][0] for side in SIDES for name in ("forearm", "shin", "foot", "toe")} <= limited
    assert (limits_rad[..., 0] <= 0).all()
    assert (limits_rad[..., 1] >= 0).all()
    for side in SIDES:
        arm, forearm, hand = (bones[f"{side}_{name}"][0] for name in ("upper_arm", "forearm", "hand"))
        axis_elbow = np.cross(positions[hand] - positions[forearm], [0.0, 0.0, 1.0])
        for bone, axis in ((bones[f"{side}_shin"][0], np.array([1.0, 0, 0])), (forearm, axis_elbow / np.linalg.norm(axis_elbow))):
            axis_parent = rotations[preset.skeleton.parents[bone]].T @ axis
            limit = np.rad2deg(limits_rad[bone])
            assert is_inside(limit, 120 * axis_parent)
            assert not is_inside(limit, -40 * axis_parent)
        assert arm not in limited


def is_inside(limit_deg: np.ndarray, rotation_vector_deg: np.ndarray) -> bool:
    return bool(((limit_deg[:, 0] <= rotation_vector_deg) & (rotation_vector_deg <= limit_deg[:, 1])).all())


def test_bent_knee_moves_the_foot_backwards_and_bent_elbow_the_hand_forwards(preset: Character):
    """The limits' greatest angle of the hinge, applied as the rotation vector says, bends the joint anatomically."""
    positions, rotations = preset.skeleton.compute_rest_pose()
    for name, end, sign in (("left_shin", "left_foot", -1), ("left_forearm", "left_hand", 1)):
        bone, last = preset.mapping.bones[name][0], preset.mapping.bones[end][0]
        limit = np.rad2deg(preset.skeleton.limits_rad[bone])
        hinge = int(np.abs(limit).max(1).argmax())
        angle = limit[hinge][np.abs(limit[hinge]).argmax()]
        vector_parent = np.eye(3)[hinge] * np.deg2rad(np.sign(angle) * 90)
        turn_world = rotations[preset.skeleton.parents[bone]] @ Rotation.from_rotvec(vector_parent).as_matrix()
        moved = turn_world @ rotations[preset.skeleton.parents[bone]].T @ (positions[last] - positions[bone])
        assert sign * moved[2] > 0.7 * np.linalg.norm(moved)


def test_twist_bones_lie_between_the_ends_of_their_segment(preset: Character):
    positions, _ = preset.skeleton.compute_rest_pose()
    following = {"upper_arm": "forearm", "forearm": "hand", "thigh": "shin", "shin": "foot"}
    for segment, twists in preset.mapping.twists.items():
        side, _, name = segment.partition("_")
        start = positions[preset.mapping.bones[segment][0]]
        end = positions[preset.mapping.bones[f"{side}_{following[name]}"][0]]
        shares = [(positions[bone] - start) @ (end - start) / ((end - start) @ (end - start)) for bone in twists]
        assert shares == sorted(shares)
        assert 0 < shares[0] < shares[-1] < 1
    assert bool(preset.mapping.twists) == (preset.name in ("unreal", "metahuman", "daz-g9"))
