"""Map the bones of a character to the segments of a body: by their names, otherwise by the shape of the skeleton.

Names are those of the shipped characters and naming conventions. Twist bones beside the chain of a limb are children that lie on
its axis and carry a share of its twist.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from mocapfix.characters.bone_geometry import MAX_AXIS_DISTANCE_SHARE, MIN_TWIST_SHARE, find_segments_by_shape
from mocapfix.characters.bone_names import find_segments_by_name
from mocapfix.characters.character import (
    SIDES,
    TWISTING_SEGMENTS,
    BoneMapping,
    Character,
    get_next_segment,
)
from mocapfix.errors import SceneError

MIN_HAND_HEIGHT_SHARE = 0.2
"""height of the wrists above the ankles, as a share of the legs' length; an animal on four legs has less"""
CONTROL_BONE_PREFIXES = ("MCH-", "ORG-")  # of the bones between Rigify's controls and its deform bones


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
    positions, _ = character.skeleton.compute_rest_pose()
    source = character.source.path if character.source else character.name
    named = find_segments_by_name(character.skeleton.names, character.skeleton.parents)
    if named is not None:
        if _stands_on_hands(positions, named.bones):
            raise SceneError(
                f"{source}: its hands are at the height of its feet in the rest pose: it stands on four legs, and only a "
                "character on two legs can take a person's motion."
            )
        return _build_mapping(character, positions, dict(named.bones), f"{named.title} names")
    if any(name.startswith(CONTROL_BONE_PREFIXES) for name in character.skeleton.names):
        raise SceneError(
            f"{source}: has the controls of a rig that Rigify generated, which move its other bones; export the deform bones "
            "alone, or give the metarig."
        )
    try:
        shape = find_segments_by_shape(character.skeleton.parents, positions)
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
    twists = find_side_twists(character.skeleton.names, character.skeleton.parents, positions, bones)
    count = sum(map(len, (*bones.values(), *twists.values())))
    return BoneMapping(bones, twists, f"{how}: {count} of {len(character.skeleton.names)} bones.")


MAX_TWIST_SHARE = 0.98
"""position along the segment up to which a bone without a telling name is a twist bone; others are helpers of the joints"""
NAMED_TWIST_MARGIN = 0.1  # share of the segment by which a bone named as a twist bone may lie outside it
TWIST_WORDS = ("twist", "roll")
CORRECTIVE_WORDS = ("cor", "corrective", "drv")  # ends of the names of bones that correct the skin at a twist bone


def find_side_twists(
    names: Sequence[str],
    parents: Int[np.ndarray, " J"],
    positions: Float[np.ndarray, "J 3"],
    bones: Mapping[str, tuple[int, ...]],
) -> dict[str, tuple[int, ...]]:
    """Find the twist bones beside the chains of the limbs.

    Args:
        names: Names of the bones; those with "twist" or "roll" may lie a little outside their segment.
        parents: (J,) index of each bone's parent.
        positions: (J, 3) m, world, in the rest pose.
        bones: Segment to the bones of its chain.

    Returns:
        Segment to its twist bones, from near to far; segments without any are missing.
    """
    used = {bone for chain in bones.values() for bone in chain}
    found: dict[str, tuple[int, ...]] = {}
    for segment in TWISTING_SEGMENTS:
        chain, following = bones.get(segment, ()), bones.get(get_next_segment(segment), ())
        if not chain or not following:
            continue
        start, axis = positions[chain[0]], positions[following[0]] - positions[chain[0]]
        length = float(np.linalg.norm(axis))
        shares: dict[int, float] = {}
        for bone in np.flatnonzero(np.isin(parents, chain)).tolist():
            if bone in used or length == 0.0:
                continue
            share = float((positions[bone] - start) @ axis) / length**2
            distance = float(np.linalg.norm(positions[bone] - start - share * axis))
            if distance <= MAX_AXIS_DISTANCE_SHARE * length and _is_twist(names[bone], share):
                shares[bone] = share
        if shares:
            found[segment] = tuple(sorted(shares, key=shares.__getitem__))
    return found


def _is_twist(name: str, share: float) -> bool:
    name = name.lower()
    if any(word in name for word in TWIST_WORDS):
        stem = name.removesuffix(")").rstrip("_.0123456789lr")
        is_corrective = any(stem.endswith(word) for word in CORRECTIVE_WORDS) or "twistcor" in name
        return not is_corrective and -NAMED_TWIST_MARGIN < share < 1 + NAMED_TWIST_MARGIN
    return MIN_TWIST_SHARE < share < MAX_TWIST_SHARE
