"""Segments of a body by the shape of the skeleton alone: the tree of its bones and their positions in the rest pose.

Legs are a pair of alike chains that lead down to the floor. Arms are a pair of alike chains of about that length that a bone
above carries and that do not reach the floor. The pelvis is the bone from which legs and arms go, the spine leads from it to the
bone that carries the arms, and neck and head lead up from there. Left and right follow from the direction of the toes.

The legs and the arms of a skeleton: pairs of alike chains, by their shape and by where they lead.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mocapfix.characters.character import SIDES, find_common_ancestor, list_path
from mocapfix.characters.limb_geometry import (
    MAX_AXIS_DISTANCE_SHARE,
    MIN_TWIST_SHARE,
    SAME_PLACE_SHARE,
    LimbPlaces,
    PairedPaths,
    SkeletonTree,
    find_arm_places,
    find_leg_places,
)

MIN_LIMB_DISTANCE_SHARE = 0.03
"""horizontal distance between the left and the right knee or elbow, as a share of the skeleton's height"""
MAX_LOWEST_SHARE = 0.35
"""height of the lowest bone of a leg above the lowest bone of all, as a share of the skeleton's height"""
MAX_MIRROR_ERROR_SHARE = 0.1
"""difference of the distances of both ends of the arms from the plane between the legs, as a share of the skeleton's height"""
MIN_LEG_HEIGHT_SHARE = 0.25
"""length of the legs, as a share of the skeleton's height"""
MAX_FLOOR_DISTANCE_SHARE = 0.1
"""height of the lowest bone of a limb that reaches the floor above that of the lowest leg, as a share of the leg's length"""
MIN_FRONT_DISTANCE_SHARE = 0.3
"""horizontal distance between two pairs of legs of an animal on four legs, as a share of the leg's length"""
ARM_LEG_RATIO = 0.65
"""length from shoulder to wrist over that from hip to ankle of an adult"""
MAX_ARM_LEG_FACTOR = 2.2
"""factor between that ratio and the one of a figure"""
MIN_SHOULDER_HEIGHT_SHARE = 0.25
"""height of the shoulders above the hips, as a share of the leg's length"""
MIN_FINGER_RATIO = 0.3
"""length of the shortest chain of a hand over that of the second longest; the longest may be a weapon"""
NESTED_HAND_COST, THUMB_HAND_COST, HANDLESS_ARM_COST = 0.1, 0.15, 0.5
"""costs of a wrist, in units of the logarithm of the ratio of two lengths: for each bone before it that carries several chains
too, of one that carries further bones but no fingers, and of one that does not"""
HANGING_CHAIN_COST, SIDEWAYS_COST = 0.5, 0.4
"""costs of chains below all their sisters, such as hair, and of chains that do not lead sideways, in the same units"""


@dataclass(frozen=True)
class LimbPair:
    """Two legs or two arms.

    paths   the bones of each from the trunk outwards
    places  of the joints on both paths
    """

    paths: PairedPaths
    places: LimbPlaces

    @property
    def first(self) -> list[int]:
        """The hips or the shoulders."""
        return self.select(self.places.first)

    @property
    def middle(self) -> list[int]:
        """The knees or the elbows."""
        return self.select(self.places.middle)

    @property
    def last(self) -> list[int]:
        """The ankles or the wrists."""
        return self.select(self.places.last)

    @property
    def end(self) -> list[int]:
        """The balls of the feet; without these the ankles or the wrists."""
        return self.last if self.places.end is None else self.select(self.places.end)

    def select(self, place: int) -> list[int]:
        """Return the two bones at a place of the paths."""
        return [self.paths.first[place], self.paths.second[place]]


def find_leg_pair(tree: SkeletonTree) -> LimbPair:
    """Find the legs: the longest pair of chains that lead down to the floor, with feet if any such pair has feet.

    Raises:
        ValueError: If there are none, or if further legs stand in front or behind. The message is the end of a sentence.
    """
    positions = tree.positions
    found: list[LimbPair] = []
    lowest = positions[:, 1].min() + MAX_LOWEST_SHARE * tree.height
    for paths in tree.paired_paths:
        points = _get_points(paths, positions)
        places = find_leg_places(points) if points[..., 1].min() < lowest else None
        if places is not None and _are_apart(LimbPair(paths, places), tree):
            found.append(LimbPair(paths, places))
    floor = min((_find_lowest(pair, positions) for pair in found), default=0.0)
    height = positions[:, 1].max() - floor
    standing: list[LimbPair] = []
    for pair in found:
        length = _measure_limb(pair, positions)
        rise = _find_lowest(pair, positions) - floor
        if length > MIN_LEG_HEIGHT_SHARE * height and rise < MAX_FLOOR_DISTANCE_SHARE * length:
            standing.append(pair)
    if not standing:
        raise ValueError("no two legs lead down to the floor")
    sizes = [(pair.places.end is not None, _measure_limb(pair, positions), _measure_foot(pair, positions)) for pair in standing]
    best = standing[sizes.index(max(sizes))]
    hips = find_pair_centre(best, positions)
    for pair in standing:
        between = (find_pair_centre(pair, positions) - hips)[[0, 2]]
        if np.linalg.norm(between) > MIN_FRONT_DISTANCE_SHARE * _measure_limb(best, positions):
            raise ValueError("it stands on four legs")
    return best


def find_arm_pair(tree: SkeletonTree, legs: LimbPair) -> LimbPair:
    """Find the arms: the pair of chains above the hips that is the most like arms and does not reach the floor.

    Raises:
        ValueError: If there are none. The message is the end of a sentence.
    """
    positions, leg_length = tree.positions, _measure_limb(legs, tree.positions)
    hips, floor = find_pair_centre(legs, positions), _find_lowest(legs, positions)
    across = find_across(legs, positions)
    used = {*legs.paths.first, *legs.paths.second}
    best: tuple[float, LimbPair] | None = None
    for paths in tree.paired_paths:
        sisters = {paths.first[0], paths.second[0]}
        points = _get_points(paths, positions)
        offsets = (points[:, -1] - hips) @ across
        if used & sisters or abs(offsets.sum()) > MAX_MIRROR_ERROR_SHARE * tree.height:
            continue
        places = find_arm_places(points, _judge_hands(tree, paths), ARM_LEG_RATIO * leg_length)
        if places is None:
            continue
        pair = LimbPair(paths, places)
        ratio = abs(np.log(_measure_limb(pair, positions) / leg_length / ARM_LEG_RATIO))
        is_low = (
            find_pair_centre(pair, positions)[1] - hips[1] < MIN_SHOULDER_HEIGHT_SHARE * leg_length
            or positions[pair.last, 1].min() - floor < MAX_FLOOR_DISTANCE_SHARE * leg_length
        )
        if is_low or ratio > np.log(MAX_ARM_LEG_FACTOR) or not _are_apart(pair, tree):
            continue
        vectors = positions[pair.last] - positions[pair.first]
        sideways = vectors @ across / np.linalg.norm(vectors, axis=1)
        others = [child for child in tree.children[int(tree.parents[paths.first[0]])] if child not in sisters]
        is_hanging = all(tree.top[child] <= positions[paths.first[0], 1] for child in others)
        cost = places.cost + ratio + abs(float(sideways.sum())) + HANGING_CHAIN_COST * is_hanging
        cost += SIDEWAYS_COST * (1 - float(np.abs(sideways).mean()))
        if best is None or cost < best[0]:
            best = cost, pair
    if best is None:
        raise ValueError("no two arms go from a bone above the hips")
    return best[1]


def find_across(legs: LimbPair, positions: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, " 3"]:
    """Return the horizontal unit vector from one knee to the other; knees are apart, hips may be at one place."""
    across = (positions[legs.middle[1]] - positions[legs.middle[0]]) * [1, 0, 1]
    return across / np.linalg.norm(across)


def find_pair_centre(pair: LimbPair, positions: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, " 3"]:
    """Return the middle between the hips or between the shoulders, in metres."""
    return positions[pair.first].mean(0)


def _judge_hands(tree: SkeletonTree, paths: PairedPaths) -> list[float]:
    """Return how little each pair of bones of two paths looks like hands."""
    costs: list[float] = []
    hand_count = 0
    for place, bones in enumerate(zip(paths.first, paths.second, strict=True)):
        if all(_count_fingers(tree, bone) >= 2 for bone in bones):
            costs.append(NESTED_HAND_COST * hand_count)
            hand_count += 1
        else:
            is_last = place + 1 == len(paths.first)
            has_thumb = not is_last and _carries_thumb(tree, paths.first[place], paths.first[place + 1])
            costs.append(THUMB_HAND_COST if has_thumb else HANDLESS_ARM_COST)
    return costs


def _count_fingers(tree: SkeletonTree, bone: int) -> int:
    """Return how many chains of similar lengths begin at children of a bone, as fingers do."""
    heads = tree.positions[tree.children[bone]].reshape(-1, 3)
    distances = np.linalg.norm(heads - tree.positions[bone], axis=1)
    reach = tree.reach[tree.children[bone]][distances > SAME_PLACE_SHARE * tree.height]
    reach = np.sort(reach[reach > 0])[::-1]
    return int((reach > MIN_FINGER_RATIO * reach[min(1, len(reach) - 1)]).sum()) if len(reach) else 0


def _carries_thumb(tree: SkeletonTree, bone: int, following: int) -> bool:
    """Return whether a bone carries other bones than the next one of the path that do not lie between the two."""
    axis = tree.positions[following] - tree.positions[bone]
    length = max(float(np.linalg.norm(axis)), SAME_PLACE_SHARE * tree.height)
    for child in tree.children[bone]:
        vector = tree.positions[child] - tree.positions[bone]
        share = float(vector @ axis) / length**2
        is_between = MIN_TWIST_SHARE < share < 1 and np.linalg.norm(vector - share * axis) < MAX_AXIS_DISTANCE_SHARE * length
        if child != following and not is_between:
            return True
    return False


def _get_points(paths: PairedPaths, positions: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, "2 n 3"]:
    return positions[[list(paths.first), list(paths.second)]]


def _are_apart(pair: LimbPair, tree: SkeletonTree) -> bool:
    """Return whether the knees or elbows of two limbs are apart."""
    between = (tree.positions[pair.middle[0]] - tree.positions[pair.middle[1]])[[0, 2]]
    return bool(np.linalg.norm(between) > MIN_LIMB_DISTANCE_SHARE * tree.height)


def _find_lowest(pair: LimbPair, positions: Float[np.ndarray, "J 3"]) -> float:
    """Return the least height of the bones of two limbs."""
    return float(_get_points(pair.paths, positions)[..., 1].min())


def _measure_limb(pair: LimbPair, positions: Float[np.ndarray, "J 3"]) -> float:
    """Return the mean length from hip to ankle or from shoulder to wrist, over knee or elbow."""
    joints = positions[[pair.first, pair.middle, pair.last]]
    return float(np.linalg.norm(np.diff(joints, axis=0), axis=2).sum(0).mean())


def _measure_foot(legs: LimbPair, positions: Float[np.ndarray, "J 3"]) -> float:
    """Return the mean horizontal length of two feet, 0 for those without toes."""
    return float(np.linalg.norm((positions[legs.end] - positions[legs.last])[:, [0, 2]], axis=1).mean())


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
