"""What the writers of characters ask of its bones: which move, how long the legs are, and the unit of a position."""

import numpy as np

from mocapfix.characters.character import Character, CharacterMotion

MIN_MOVED_ELEMENT = 1e-6
"""difference of an element of a rotation matrix from the rest pose, from which a bone without segment gets a curve"""
LEG_SEGMENTS = ("thigh", "shin")


def list_moving_bones(character: Character, motion: CharacterMotion) -> list[int]:
    """Return the bones of all segments, their twist bones, and others that the motion turns from their rest rotation."""
    mapped = {bone for group in (character.mapping.bones, character.mapping.twists) for chain in group.values() for bone in chain}
    difference = np.abs(motion.local_rotations - character.rest_rotations).max(axis=(0, 2, 3), initial=0.0)
    return sorted(mapped.union(np.flatnonzero(difference > MIN_MOVED_ELEMENT).tolist()))


def compute_leg_length(character: Character) -> float:
    """Return the length of the longer leg in metres, from hip to ankle along the bones of thigh and shin."""
    mapped, lengths = character.mapping.bones, [0.0]
    for side in ("left", "right"):
        chain = [bone for segment in LEG_SEGMENTS for bone in mapped.get(f"{side}_{segment}", ())]
        inner = [*chain[1:], *mapped.get(f"{side}_foot", ())]
        lengths.append(float(np.linalg.norm(character.rest_positions[inner], axis=1).sum()))
    return max(lengths)


def get_parent_scale(character: Character, bone: int) -> float:
    """Return the metres in a unit of the file in which the position of a bone is given."""
    parent = int(character.parents[bone])
    return float(character.scales[parent]) if parent >= 0 else character.root_scale
