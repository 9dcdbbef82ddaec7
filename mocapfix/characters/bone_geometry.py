"""Segments of a body by the shape of the skeleton alone: the tree of its bones and their positions in the rest pose.

Legs are a pair of alike chains that lead down to the floor. Arms are a pair of alike chains of about that length that a bone
above carries and that do not reach the floor. The pelvis is the bone from which legs and arms go, the spine leads from it to the
bone that carries the arms, and neck and head lead up from there. Left and right follow from the direction of the toes.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mocapfix.characters.character import SIDES
from mocapfix.characters.limb_geometry import SAME_PLACE_SHARE, LimbPlaces
from mocapfix.characters.limb_pairs import LimbPair, find_across, find_arm_pair, find_leg_pair, find_pair_centre
from mocapfix.characters.segment_bones import find_common_ancestor, list_path
from mocapfix.characters.skeleton_tree import SkeletonTree

MIN_TRUNK_COSINE = 0.8
"""cosine between the vertical and the direction from the hips to the shoulders"""
END_BONE_RATIO = 1.5
"""length of the last bone over that of the bone before, from which it is the top of the head"""
MAX_NECK_DISTANCE_SHARE = 0.15
"""distance of the bones of the neck from the plane in the middle between the shoulders, as a share of their distance"""
MIN_FACE_DISTANCE_SHARE = 0.5
"""distance of eyes or a jaw from the head, as a share of that of its end"""
MIN_FORWARD_SHARE = 1e-3
"""horizontal length of the feet, as a share of the skeleton's height, below which it shows no direction"""


@dataclass(frozen=True)
class ShapeSegments:
    """The segments that the shape of a skeleton gives.

    bones          segment to its bones
    faces_forward  whether the feet show where the front is; otherwise the front is taken to be +Z
    """

    bones: dict[str, tuple[int, ...]]
    faces_forward: bool


def find_segments_by_shape(parents: Int[np.ndarray, " J"], positions: Float[np.ndarray, "J 3"]) -> ShapeSegments:
    """Find the bones of the segments by the tree and the positions of the bones. Names are not used.

    The number of bones of a neck is ambiguous where the head carries no face: the last bone that leads up is then the head,
    unless it is much farther from the bone before than that one from its own, as bones are that only end a head. Fingers and all
    other bones have no segment.

    Args:
        parents: (J,) index of each bone's parent, -1 for roots; parents come before children.
        positions: (J, 3) m, world, Y up, in a rest pose that stands upright and faces any direction.

    Raises:
        ValueError: If the skeleton is no body with two legs and two arms. The message is the end of a sentence that says why.
    """
    tree = SkeletonTree(parents, positions)
    legs = find_leg_pair(tree)
    arms = find_arm_pair(tree, legs)
    trunk = find_pair_centre(arms, positions) - find_pair_centre(legs, positions)
    if trunk[1] < MIN_TRUNK_COSINE * np.linalg.norm(trunk):
        raise ValueError("the trunk is not upright in the rest pose")
    pelvis = find_common_ancestor([*legs.select(0), *arms.select(0)], parents)
    if pelvis < 0:
        raise ValueError("legs and arms are below different roots")
    chest = int(parents[arms.paths.first[0]])
    forward, faces_forward = _find_forward(legs, tree)
    left_axis = np.array([forward[2], 0.0, -forward[0]])
    bones: dict[str, tuple[int, ...]] = {"pelvis": (pelvis,), "spine": tuple(list_path(chest, pelvis, parents))}
    bones["neck"], bones["head"] = _find_neck(tree, chest, arms)
    for pair, is_leg in ((legs, True), (arms, False)):
        is_first_left = (positions[pair.middle[0]] - positions[pair.middle[1]]) @ left_axis > 0
        for side, path in zip(SIDES if is_first_left else SIDES[::-1], (pair.paths.first, pair.paths.second), strict=True):
            bones |= {f"{side}_{segment}": chain for segment, chain in _list_limb_segments(path, pair.places, is_leg).items()}
    return ShapeSegments({segment: chain for segment, chain in bones.items() if chain}, faces_forward)


def _list_limb_segments(path: tuple[int, ...], places: LimbPlaces, is_leg: bool) -> dict[str, tuple[int, ...]]:
    upper, lower = path[places.first : places.middle], path[places.middle : places.last]
    if is_leg:
        end = () if places.end is None else (path[places.end],)
        return {"thigh": upper, "shin": lower, "foot": (path[places.last],), "toe": end}
    before = () if places.before is None else (path[places.before],)
    return {"clavicle": before, "upper_arm": upper, "forearm": lower, "hand": (path[places.last],)}


def _find_neck(tree: SkeletonTree, chest: int, arms: LimbPair) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the bones of the neck and that of the head, none where nothing leads up from the chest."""
    positions = tree.positions
    path: list[int] = []
    bone = _choose_upward(tree, chest, arms)
    while bone is not None:
        path.append(bone)
        following = _choose_upward(tree, bone, arms)
        bone = None if following is None or _carries_face(tree, bone, following) else following
    lengths = np.linalg.norm(np.diff(positions[[chest, *path]], axis=0), axis=1)
    while len(path) > 1 and lengths[len(path) - 1] <= SAME_PLACE_SHARE * lengths.sum():
        path.pop()
    if len(path) > 1 and not tree.children[path[-1]] and lengths[len(path) - 1] > END_BONE_RATIO * lengths[len(path) - 2]:
        path.pop()
    return tuple(path[:-1]), tuple(path[-1:])


def _choose_upward(tree: SkeletonTree, bone: int, arms: LimbPair) -> int | None:
    """Return the child of a bone that leads up, near the middle between the arms, to the highest bone."""
    positions, centre = tree.positions, find_pair_centre(arms, tree.positions)
    across = find_across(arms, positions)
    width = abs(float((positions[arms.first[0]] - positions[arms.first[1]]) @ across))
    upward = [
        child
        for child in tree.children[bone]
        if child not in arms.select(0)
        and tree.top[child] > positions[bone, 1]
        and abs((positions[child] - centre) @ across) <= MAX_NECK_DISTANCE_SHARE * width
    ]
    return max(upward, key=lambda child: tree.top[child], default=None)


def _carries_face(tree: SkeletonTree, bone: int, following: int) -> bool:
    """Return whether a bone carries several chains, or several bones at distances of the same order, as heads do."""
    others = [child for child in tree.children[bone] if child != following]
    if any(tree.children[other] for other in others):
        return True
    distances = np.linalg.norm(tree.positions[[following, *others]] - tree.positions[bone], axis=1)
    return not tree.children[following] and bool((distances[1:] > MIN_FACE_DISTANCE_SHARE * distances[0]).any())


def _find_forward(legs: LimbPair, tree: SkeletonTree) -> tuple[Float[np.ndarray, " 3"], bool]:
    """Return the horizontal direction to which the feet point, and whether they show one; +Z otherwise."""
    across = find_across(legs, tree.positions)
    feet = (tree.positions[legs.end] - tree.positions[legs.last]).sum(0) * [1, 0, 1]
    forward = feet - across * (feet @ across)
    length = float(np.linalg.norm(forward))
    if length < MIN_FORWARD_SHARE * tree.height:
        return np.array([0.0, 0.0, 1.0]), False
    return forward / length, True
