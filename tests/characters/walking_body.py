"""A walk with gestures of the average body, and characters of other proportions, for the tests of retargeting."""

from dataclasses import replace
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from mocapfix.characters.character import (
    Character,
    CharacterMotion,
    build_cmu31_character,
    compute_character_poses,
    convert_motion,
    get_next_segment,
)
from mocapfix.contacts.contacts import BodyContacts
from mocapfix.contacts.find_contacts import find_contacts
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton
from mocapfix.synthetic import compose_take
from tests.characters.character_files import change_bones

SECONDS = 4.0
RATE = 60.0


@cache
def load_walk() -> tuple[Character, CharacterMotion]:
    """Return the source: a composed motion and its character."""
    take = compose_take(seed=2, seconds=SECONDS, rate=RATE)
    return build_cmu31_character(take.subject.skeleton), convert_motion(take.motion, RATE)


def scale_limbs(character: Character, legs: float = 1.0, arms: float = 1.0) -> Character:
    """Return the character with longer or shorter thighs and shins, upper arms and forearms."""
    bones, positions = character.mapping.bones, character.skeleton.offsets.copy()
    for side in ("left", "right"):
        for segment, factor in (("thigh", legs), ("shin", legs), ("upper_arm", arms), ("forearm", arms)):
            _, *others = bones[f"{side}_{segment}"]
            for bone in (*others, bones[get_next_segment(f"{side}_{segment}")][0]):
                positions[bone] *= factor
    return change_bones(character, offsets=positions)


def turn_axes(character: Character, rng: np.random.Generator) -> Character:
    """Return the same figure whose bones have other axes of their own."""
    turns = Rotation.random(len(character.skeleton.names), rng=rng).as_matrix()
    rotations, positions = character.skeleton.rest_rotations.copy(), character.skeleton.offsets.copy()
    for bone, parent in enumerate(character.skeleton.parents):
        above = turns[parent] if parent >= 0 else np.eye(3)
        rotations[bone] = above.T @ character.skeleton.rest_rotations[bone] @ turns[bone]
        positions[bone] = above.T @ character.skeleton.offsets[bone]
    tails = np.einsum("jba,jb->ja", turns, character.skeleton.ends)
    return change_bones(character, rest_rotations=rotations, offsets=positions, ends=tails)


def build_contacts(skeleton: Skeleton, motion: Motion, rate: float) -> BodyContacts:
    """Find the contacts of a motion without uncertainty."""
    position = compute_character_poses(build_cmu31_character(skeleton), convert_motion(motion, rate))[0]
    return find_contacts(skeleton, replace(motion, joint_sd=np.zeros(position.shape[:2])), position, rate)
