"""Map the bones of a character to the segments of a body: by their names, otherwise by the shape of the skeleton."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from mocapfix.characters.bone_geometry import find_segments_by_shape
from mocapfix.characters.bone_names import find_segments_by_name
from mocapfix.characters.character import SIDES, BoneMapping, Character
from mocapfix.characters.side_twists import find_side_twists
from mocapfix.errors import SceneError

MIN_HAND_HEIGHT_SHARE = 0.2
"""height of the wrists above the ankles, as a share of the legs' length; an animal on four legs has less"""
CONTROL_BONE_PREFIXES = ("MCH-", "ORG-")
"""of the bones between Rigify's controls and its deform bones"""


def map_bones(character: Character) -> BoneMapping:
    """Find the bones that form the segments of a body.

    The names of the shipped characters and naming conventions are tried first, without regard to case, separators, namespaces and
    prefixes. If they do not give a body, the tree and the positions of the bones in the rest pose are used alone; the character
    may face any direction, but must stand upright. Fingers and other bones have no segment and keep their rest pose.

    Args:
        character: Its own mapping is not used.

    Returns:
        The mapping, with a sentence on how it was found.

    Raises:
        SceneError: If the bones do not form a body with two arms and two legs. The message names the file.
    """
    positions, _ = character.compute_rest_pose()
    source = character.source.path if character.source else character.name
    named = find_segments_by_name(character.names, character.parents)
    if named is not None:
        if _stands_on_hands(positions, named.bones):
            raise SceneError(
                f"{source}: its hands are at the height of its feet in the rest pose: it stands on four legs, and only a "
                "character on two legs can take a person's motion."
            )
        return _build_mapping(character, positions, dict(named.bones), f"{named.title} names")
    if any(name.startswith(CONTROL_BONE_PREFIXES) for name in character.names):
        raise SceneError(
            f"{source}: has the controls of a rig that Rigify generated, which move its other bones; export the deform bones "
            "alone, or give the metarig."
        )
    try:
        shape = find_segments_by_shape(character.parents, positions)
    except ValueError as error:
        raise SceneError(
            f"{source}: the names of its bones are unknown, and their shape is no body with two arms and two legs in an upright "
            f"rest pose ({error}); give the bones of each segment in a file (--character-map)."
        ) from error
    how = "By the shape of the skeleton" if shape.faces_forward else "By the shape of the skeleton, taken to face +Z"
    return _build_mapping(character, positions, shape.bones, how)


def _stands_on_hands(positions: Float[np.ndarray, "J 3"], bones: Mapping[str, tuple[int, ...]]) -> bool:
    """Return whether both arms reach down to the feet."""
    feet = min(positions[bones[f"{side}_foot"][0], 1] for side in SIDES)
    hips = min(positions[bones[f"{side}_thigh"][0], 1] for side in SIDES)
    ends = [bones.get(f"{side}_hand", bones[f"{side}_forearm"])[-1] for side in SIDES]
    return all(positions[end, 1] < feet + MIN_HAND_HEIGHT_SHARE * (hips - feet) for end in ends)


def _build_mapping(
    character: Character, positions: Float[np.ndarray, "J 3"], bones: dict[str, tuple[int, ...]], how: str
) -> BoneMapping:
    twists = find_side_twists(character.names, character.parents, positions, bones)
    count = sum(map(len, (*bones.values(), *twists.values())))
    return BoneMapping(bones, twists, f"{how}: {count} of {len(character.names)} bones.")
