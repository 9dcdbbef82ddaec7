"""The 31-joint skeleton of a subject as a character, which is the source of retargeted motion."""

import numpy as np

from mocapfix.characters.character import SIDES, BoneMapping, Character, CharacterMotion
from mocapfix.motion import Motion
from mocapfix.skeleton import Skeleton

SEGMENT_JOINTS = {
    "clavicle": "Shoulder", "upper_arm": "Arm", "forearm": "ForeArm", "hand": "Hand",
    "thigh": "UpLeg", "shin": "Leg", "foot": "Foot", "toe": "ToeBase",
}  # fmt: skip
"""The joint of each segment of a side, without the side."""
TRUNK_JOINTS = {"pelvis": ("Hips",), "spine": ("LowerBack", "Spine", "Spine1"), "neck": ("Neck", "Neck1"), "head": ("Head",)}


def build_cmu31_character(skeleton: Skeleton) -> Character:
    """Return the 31-joint skeleton as a character. Its joints have the axes of the world in the rest pose."""
    bones = {segment: tuple(map(skeleton.find_joint, joints)) for segment, joints in TRUNK_JOINTS.items()}
    for side in SIDES:
        for segment, joint in SEGMENT_JOINTS.items():
            bones[f"{side}_{segment}"] = (skeleton.find_joint(side.capitalize() + joint),)
    count = len(skeleton.names)
    return Character(
        name="cmu31",
        names=skeleton.names,
        parents=skeleton.parents,
        rest_positions=skeleton.offsets,
        rest_rotations=np.tile(np.eye(3), (count, 1, 1)),
        tails=_find_tails(skeleton),
        mapping=BoneMapping(bones, reason="the 31 joints of the solved body"),
        scales=np.ones(count),
        has_feet_flat=False,
    )


def convert_motion(motion: Motion, rate: float) -> CharacterMotion:
    """Return the motion of the 31-joint skeleton as that of its character; `rate` in frames per second."""
    return CharacterMotion(motion.root_position, motion.local_rotations, rate)


def _find_tails(skeleton: Skeleton) -> np.ndarray:
    """Return the end of each joint's bone in its axes: the mean of its children, or its end site."""
    tails = skeleton.ends.copy()
    for joint in range(len(skeleton.names)):
        if len(children := np.flatnonzero(skeleton.parents == joint)):
            tails[joint] = skeleton.offsets[children].mean(0)
    return tails
