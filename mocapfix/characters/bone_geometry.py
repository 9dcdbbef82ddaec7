"""Segments of a body by the shape of the skeleton alone: the tree of its bones and their positions in the rest pose.

Legs are a pair of alike chains that lead down to the floor. Arms are a pair of alike chains of about that length that a bone
above carries and that do not reach the floor. The pelvis is the bone from which legs and arms go, the spine leads from it to the
bone that carries the arms, and neck and head lead up from there. Left and right follow from the direction of the toes.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mocapfix.characters.limb_geometry import SAME_PLACE_SHARE, LimbJoints, find_arm_joints, find_leg_joints
from mocapfix.characters.segment_bones import find_common_ancestor, list_path
from mocapfix.characters.skeleton_tree import SkeletonTree

LimbPair = tuple[LimbJoints, LimbJoints]

MIN_LIMB_DISTANCE_SHARE = 0.03
"""horizontal distance between the left and the right knee or elbow, as a share of the skeleton's height"""
MIN_LEG_HEIGHT_SHARE = 0.25
"""height of the hips, as a share of the skeleton's height"""
MAX_FLOOR_DISTANCE_SHARE = 0.1
"""height of the lowest bone of a leg above that of the lowest leg, as a share of the leg's length"""
MIN_FRONT_DISTANCE_SHARE = 0.3
"""horizontal distance between two pairs of legs of an animal on four legs, as a share of the leg's length"""
ARM_LEG_RATIO = 0.65
"""length from shoulder to wrist over that from hip to ankle of an adult"""
MAX_ARM_LEG_FACTOR = 2.2
"""factor between that ratio and the one of a figure"""
MIN_SHOULDER_HEIGHT_SHARE = 0.25
"""height of the shoulders above the hips, as a share of the leg's length"""
HANDLESS_ARM_COST, HANGING_CHAIN_COST, SIDEWAYS_COST = 0.5, 0.5, 0.4
"""costs of pairs of chains without fingers, of those that hang from the head, and of those that do not lead sideways, in units
of the logarithm of the length"""
MIN_FINGER_RATIO = 0.3
"""length of the shortest chain of a hand over that of the second longest; the longest may be a weapon"""
END_BONE_RATIO = 1.5
"""length of the last bone over that of the bone before, from which it is the top of the head"""
MAX_NECK_DISTANCE_SHARE = 0.15
"""distance of the bones of the neck from the plane in the middle between the shoulders, as a share of their distance"""
MIN_FACE_DISTANCE_SHARE = 0.5
"""distance of eyes or a jaw from the head, as a share of that of its end"""
MIN_FORWARD_SHARE = 1e-3
"""horizontal length of the feet, as a share of the legs' length, below which it shows no direction"""


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
    legs = _find_legs(tree)
    arms = _find_arms(tree, legs)
    pelvis = find_common_ancestor([each.path[0] for each in (*legs, *arms)], parents)
    chest = int(parents[arms[0].path[0]])
    forward, faces_forward = _find_forward(legs, positions)
    left_axis = np.array([forward[2], 0.0, -forward[0]])
    bones: dict[str, tuple[int, ...]] = {"pelvis": (pelvis,), "spine": tuple(list_path(chest, pelvis, parents))}
    bones["neck"], bones["head"] = _find_neck(tree, chest, arms)
    for pair, is_leg in ((legs, True), (arms, False)):
        for side, limb in zip(("left", "right"), sorted(pair, key=lambda each: -positions[each.first] @ left_axis), strict=True):
            bones |= {f"{side}_{segment}": chain for segment, chain in _list_limb_segments(limb, is_leg).items()}
    return ShapeSegments({segment: chain for segment, chain in bones.items() if chain}, faces_forward)


def _list_limb_segments(limb: LimbJoints, is_leg: bool) -> dict[str, tuple[int, ...]]:
    upper, lower = limb.list_between(limb.first, limb.middle), limb.list_between(limb.middle, limb.last)
    end = () if limb.end is None else (limb.end,)
    if is_leg:
        return {"thigh": upper, "shin": lower, "foot": (limb.last,), "toe": end}
    before = () if limb.before is None else (limb.before,)
    return {"clavicle": before, "upper_arm": upper, "forearm": lower, "hand": (limb.last,)}


def _find_legs(tree: SkeletonTree) -> LimbPair:
    positions = tree.positions
    found: list[LimbPair] = []
    for paths in tree.list_paired_paths():
        left, right = (find_leg_joints(path, positions) for path in (paths.first, paths.second))
        if left and right and _are_apart(left, right, tree):
            found.append((left, right))
    floor = min((positions[list(limb.path), 1].min() for pair in found for limb in pair), default=0.0)
    height = positions[:, 1].max() - floor
    standing: list[LimbPair] = []
    for pair in found:
        length = _measure_limb(pair[0], positions)
        rise = positions[list(pair[0].path), 1].min() - floor
        if length > MIN_LEG_HEIGHT_SHARE * height and rise < MAX_FLOOR_DISTANCE_SHARE * length:
            standing.append(pair)
    if not standing:
        raise ValueError("no two legs lead down to the floor")
    best = max(
        standing, key=lambda pair: (pair[0].end is not None, _measure_limb(pair[0], positions), _measure_foot(pair[0], positions))
    )
    hips = _find_centre(best, positions)
    for pair in standing:
        between = (_find_centre(pair, positions) - hips)[[0, 2]]
        if np.linalg.norm(between) > MIN_FRONT_DISTANCE_SHARE * _measure_limb(best[0], positions):
            raise ValueError("it stands on four legs")
    return best


def _find_arms(tree: SkeletonTree, legs: LimbPair) -> LimbPair:
    positions, leg_length = tree.positions, _measure_limb(legs[0], tree.positions)
    hips, floor = _find_centre(legs, positions), positions[list(legs[0].path), 1].min()
    across = _find_across(legs, positions)
    used = {bone for leg in legs for bone in leg.path}
    best: tuple[float, LimbPair] | None = None
    for paths in tree.list_paired_paths():
        a, b = paths.first[0], paths.second[0]
        if used & {a, b}:
            continue
        left, right = (_find_arm(tree, path, ARM_LEG_RATIO * leg_length) for path in (paths.first, paths.second))
        if not left or not right or not _are_apart(left, right, tree):
            continue
        if positions[left.first, 1] - hips[1] < MIN_SHOULDER_HEIGHT_SHARE * leg_length:
            continue
        ratio = abs(np.log(_measure_limb(left, positions) / leg_length / ARM_LEG_RATIO))
        if ratio > np.log(MAX_ARM_LEG_FACTOR) or positions[left.last, 1] - floor < MAX_FLOOR_DISTANCE_SHARE * leg_length:
            continue
        vectors = [positions[limb.last] - positions[limb.first] for limb in (left, right)]
        sideways = [float(vector @ across) / np.linalg.norm(vector) for vector in vectors]
        mirror_error = abs(sideways[0] + sideways[1])
        has_hand = len(_list_finger_bones(tree, left.last)) >= 2
        is_hanging = all(tree.top[each] <= positions[a, 1] for each in tree.children[int(tree.parents[a])] if each not in (a, b))
        cost = ratio + HANDLESS_ARM_COST * (not has_hand) + HANGING_CHAIN_COST * is_hanging
        cost += SIDEWAYS_COST * (1 - abs(sideways[0])) + mirror_error + _compare_bone_lengths(left, positions)
        if best is None or cost < best[0]:
            best = cost, (left, right)
    if best is None:
        raise ValueError("no two arms go from a bone above the hips")
    return best[1]


def _find_arm(tree: SkeletonTree, path: tuple[int, ...], expected_length: float) -> LimbJoints | None:
    hands = [bone for bone in path if len(_list_finger_bones(tree, bone)) >= 2]
    return find_arm_joints(path, hands, tree.positions, expected_length)


def _list_finger_bones(tree: SkeletonTree, bone: int) -> list[int]:
    """Return the children of a bone that begin chains of their own, of similar lengths, as fingers do; one may be longer."""
    chains = [
        child
        for child in tree.children[bone]
        if tree.reach[child] > 0 and np.linalg.norm(tree.positions[child] - tree.positions[bone]) > SAME_PLACE_SHARE * tree.height
    ]
    lengths = sorted((tree.reach[child] for child in chains), reverse=True)
    return [child for child in chains if tree.reach[child] > MIN_FINGER_RATIO * lengths[min(1, len(lengths) - 1)]]


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
    positions, centre = tree.positions, _find_centre(arms, tree.positions)
    across = (positions[arms[0].first] - positions[arms[1].first]) * [1, 0, 1]
    width = float(np.linalg.norm(across))
    across /= width
    upward = [
        child
        for child in tree.children[bone]
        if child not in (arms[0].path[0], arms[1].path[0])
        and tree.top[child] > positions[bone, 1]
        and abs((positions[child] - centre) @ across) < MAX_NECK_DISTANCE_SHARE * width
    ]
    return max(upward, key=lambda child: tree.top[child], default=None)


def _carries_face(tree: SkeletonTree, bone: int, following: int) -> bool:
    """Return whether a bone carries several chains, or several bones at distances of the same order, as heads do."""
    others = [child for child in tree.children[bone] if child != following]
    if any(tree.children[other] for other in others):
        return True
    distances = np.linalg.norm(tree.positions[[following, *others]] - tree.positions[bone], axis=1)
    return not tree.children[following] and bool((distances[1:] > MIN_FACE_DISTANCE_SHARE * distances[0]).any())


def _find_forward(legs: LimbPair, positions: Float[np.ndarray, "J 3"]) -> tuple[np.ndarray, bool]:
    """Return the horizontal direction (3,) to which the feet point, and whether they show one; +Z otherwise."""
    across = _find_across(legs, positions)
    feet = sum(positions[leg.path[-1] if leg.end is None else leg.end] - positions[leg.last] for leg in legs) * np.array(
        [1, 0, 1]
    )
    forward = feet - across * (feet @ across)
    length = float(np.linalg.norm(forward))
    if length < MIN_FORWARD_SHARE * _measure_limb(legs[0], positions):
        return np.array([0.0, 0.0, 1.0]), False
    return forward / length, True


def _are_apart(left: LimbJoints, right: LimbJoints, tree: SkeletonTree) -> bool:
    """Return whether two limbs have their joints at the same places of their paths, and these apart."""
    places = [[limb.path.index(joint) for joint in (limb.first, limb.middle, limb.last)] for limb in (left, right)]
    between = (tree.positions[left.middle] - tree.positions[right.middle])[[0, 2]]
    return places[0] == places[1] and bool(np.linalg.norm(between) > MIN_LIMB_DISTANCE_SHARE * tree.height)


def _find_across(legs: LimbPair, positions: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, " 3"]:
    """Return the horizontal direction from hip to hip, or from knee to knee where the hips are at one place."""
    for joint in ("first", "middle"):
        across = (positions[getattr(legs[0], joint)] - positions[getattr(legs[1], joint)]) * [1, 0, 1]
        if np.linalg.norm(across) > MIN_FORWARD_SHARE * _measure_limb(legs[0], positions):
            break
    return across / np.linalg.norm(across)


def _measure_limb(limb: LimbJoints, positions: Float[np.ndarray, "J 3"]) -> float:
    """Return the length from hip to ankle or from shoulder to wrist, over knee or elbow."""
    steps = positions[[limb.middle, limb.last]] - positions[[limb.first, limb.middle]]
    return float(np.linalg.norm(steps, axis=1).sum())


def _compare_bone_lengths(limb: LimbJoints, positions: Float[np.ndarray, "J 3"]) -> float:
    """Return the absolute logarithm of the ratio of the lengths of the two parts of a limb."""
    steps = positions[[limb.middle, limb.last]] - positions[[limb.first, limb.middle]]
    lengths = np.linalg.norm(steps, axis=1)
    return float(abs(np.log(lengths[0] / lengths[1])))


def _measure_foot(leg: LimbJoints, positions: Float[np.ndarray, "J 3"]) -> float:
    """Return the horizontal length of a foot, 0 for one without a toe."""
    end = leg.last if leg.end is None else leg.end
    return float(np.linalg.norm((positions[end] - positions[leg.last])[[0, 2]]))


def _find_centre(pair: LimbPair, positions: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, " 3"]:
    return positions[[pair[0].first, pair[1].first]].mean(0)
