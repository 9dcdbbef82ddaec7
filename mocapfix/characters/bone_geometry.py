"""Segments of a body by the shape of the skeleton alone: the tree of its bones and their positions in the rest pose.

Legs are a pair of alike chains that lead down to the floor. Arms are a pair of alike chains of about that length that a bone
above carries and that do not reach the floor. The pelvis is the bone from which legs and arms go, the spine leads from it to the
bone that carries the arms, and neck and head lead up from there. Left and right follow from the direction of the toes.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

from mocapfix.characters.limb_geometry import SAME_PLACE_SHARE, LimbJoints, find_arm_joints, find_leg_joints
from mocapfix.characters.segment_bones import find_common_ancestor, list_path

MAX_LENGTH_DIFFERENCE_SHARE = 0.1
"""difference of the lengths of a left and a right chain"""
MAX_HEIGHT_DIFFERENCE_SHARE = 0.05
"""difference of the heights of left and right joints, as a share of the skeleton's height"""
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
HANDLESS_ARM_COST, HANGING_CHAIN_COST = 0.3, 0.5
"""costs of pairs of chains without fingers and of those that hang from the head, in units of the logarithm of the length"""
END_BONE_RATIO = 1.5
"""length of the last bone over that of the bone before, from which it is the top of the head"""
MAX_NECK_DISTANCE_SHARE = 0.4
"""horizontal distance of the bones of the neck from the middle between the shoulders, as a share of their distance"""
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


class _Tree:
    """Children, longest paths and symmetric pairs of chains of a skeleton."""

    def __init__(self, parents: Int[np.ndarray, " J"], positions: Float[np.ndarray, "J 3"]) -> None:
        self.parents, self.positions = parents, positions
        self.children: list[list[int]] = [[] for _ in parents]
        self.reach = np.zeros(len(parents))  # length of the longest path below each bone
        self.path_child = np.full(len(parents), -1)
        self.top, self.bottom = positions[:, 1].copy(), positions[:, 1].copy()
        for bone in range(len(parents) - 1, -1, -1):
            parent = int(parents[bone])
            if parent < 0:
                continue
            self.children[parent].insert(0, bone)
            reach = self.reach[bone] + np.linalg.norm(positions[bone] - positions[parent])
            if reach >= self.reach[parent]:
                self.reach[parent], self.path_child[parent] = reach, bone
            self.top[parent] = max(self.top[parent], self.top[bone])
            self.bottom[parent] = min(self.bottom[parent], self.bottom[bone])

    def find_longest_path(self, bone: int) -> list[int]:
        """Return the bones of the longest path down from a bone."""
        path = [bone]
        while self.path_child[path[-1]] >= 0:
            path.append(int(self.path_child[path[-1]]))
        return path

    def list_pairs(self) -> list[tuple[int, int]]:
        """Return the pairs of sisters whose longest paths have equal lengths and lead to equal heights on two sides."""
        pairs: list[tuple[int, int]] = []
        for sisters in self.children:
            lengths = {bone: self.reach[bone] for bone in sisters if self.reach[bone] > 0}
            for a, b in combinations(lengths, 2):
                if abs(lengths[a] - lengths[b]) <= MAX_LENGTH_DIFFERENCE_SHARE * max(lengths[a], lengths[b]):
                    pairs.append((a, b))
        return pairs


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
    tree = _Tree(parents, positions)
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


def _find_legs(tree: _Tree) -> tuple[LimbJoints, LimbJoints]:
    positions = tree.positions
    found: list[tuple[LimbJoints, LimbJoints]] = []
    for a, b in tree.list_pairs():
        left, right = (find_leg_joints(tree.find_longest_path(bone), positions) for bone in (a, b))
        if left and right and _are_mirrored(left, right, tree):
            found.append((left, right))
    floor = min((positions[list(limb.path), 1].min() for pair in found for limb in pair), default=0.0)
    height = positions[:, 1].max() - floor
    standing = [
        pair
        for pair in found
        if _measure_limb(pair[0], positions) > MIN_LEG_HEIGHT_SHARE * height
        and positions[list(pair[0].path), 1].min() - floor < MAX_FLOOR_DISTANCE_SHARE * _measure_limb(pair[0], positions)
    ]
    if not standing:
        raise ValueError("no two legs lead down to the floor")
    with_feet = [pair for pair in standing if pair[0].end is not None] or standing
    best = max(with_feet, key=lambda pair: _measure_limb(pair[0], positions))
    hips = _find_centre(best, positions)
    for pair in standing:
        between = (_find_centre(pair, positions) - hips)[[0, 2]]
        if np.linalg.norm(between) > MIN_FRONT_DISTANCE_SHARE * _measure_limb(best[0], positions):
            raise ValueError("it stands on four legs")
    return best


def _find_arms(tree: _Tree, legs: tuple[LimbJoints, LimbJoints]) -> tuple[LimbJoints, LimbJoints]:
    positions, leg_length = tree.positions, _measure_limb(legs[0], tree.positions)
    hip_height, floor = positions[legs[0].first, 1], positions[list(legs[0].path), 1].min()
    used = {bone for leg in legs for bone in leg.path}
    best: tuple[float, tuple[LimbJoints, LimbJoints]] | None = None
    for a, b in tree.list_pairs():
        if used & {a, b} or positions[[a, b], 1].min() < hip_height:
            continue
        left, right = (_find_arm(tree, bone, ARM_LEG_RATIO * leg_length) for bone in (a, b))
        if not left or not right or not _are_mirrored(left, right, tree):
            continue
        ratio = abs(np.log(_measure_limb(left, positions) / leg_length / ARM_LEG_RATIO))
        reaches_floor = tree.bottom[left.first] - floor < MAX_FLOOR_DISTANCE_SHARE * leg_length
        if ratio > np.log(MAX_ARM_LEG_FACTOR) or reaches_floor:
            continue
        has_hand = len(_list_finger_bones(tree, left.last)) >= 2
        is_above = all(
            tree.top[sister] <= positions[a, 1] for sister in tree.children[int(tree.parents[a])] if sister not in (a, b)
        )
        cost = ratio + (0.0 if has_hand else HANDLESS_ARM_COST) + (HANGING_CHAIN_COST if is_above else 0.0)
        if best is None or cost < best[0]:
            best = cost, (left, right)
    if best is None:
        raise ValueError("no two arms go from a bone above the hips")
    return best[1]


def _find_arm(tree: _Tree, bone: int, expected_length: float) -> LimbJoints | None:
    path = tree.find_longest_path(bone)
    with_fingers = [each for each in path if len(_list_finger_bones(tree, each)) >= 2]
    wrist = with_fingers[-1] if with_fingers else None
    return find_arm_joints(path, wrist, tree.positions, expected_length)


def _list_finger_bones(tree: _Tree, bone: int) -> list[int]:
    """Return the children of a bone that begin chains of their own, of similar lengths, as fingers do."""
    chains = [child for child in tree.children[bone] if tree.reach[child] > 0]
    longest = max((tree.reach[child] for child in chains), default=0.0)
    return [child for child in chains if tree.reach[child] > 0.3 * longest]


def _find_neck(tree: _Tree, chest: int, arms: tuple[LimbJoints, LimbJoints]) -> tuple[tuple[int, ...], tuple[int, ...]]:
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


def _choose_upward(tree: _Tree, bone: int, arms: tuple[LimbJoints, LimbJoints]) -> int | None:
    """Return the child of a bone that leads up, near the middle between the arms, to the highest bone."""
    positions, centre = tree.positions, _find_centre(arms, tree.positions)
    width = np.linalg.norm((positions[arms[0].first] - positions[arms[1].first])[[0, 2]])
    upward = [
        child
        for child in tree.children[bone]
        if child not in (arms[0].path[0], arms[1].path[0])
        and tree.top[child] > positions[bone, 1]
        and np.linalg.norm((positions[child] - centre)[[0, 2]]) < MAX_NECK_DISTANCE_SHARE * width
    ]
    return max(upward, key=lambda child: tree.top[child], default=None)


def _carries_face(tree: _Tree, bone: int, following: int) -> bool:
    """Return whether a bone carries several chains, or several bones at distances of the same order, as heads do."""
    others = [child for child in tree.children[bone] if child != following]
    if any(tree.children[other] for other in others):
        return True
    distances = np.linalg.norm(tree.positions[[following, *others]] - tree.positions[bone], axis=1)
    return not tree.children[following] and bool((distances[1:] > MIN_FACE_DISTANCE_SHARE * distances[0]).any())


def _find_forward(legs: tuple[LimbJoints, LimbJoints], positions: Float[np.ndarray, "J 3"]) -> tuple[np.ndarray, bool]:
    """Return the horizontal direction (3,) to which the feet point, and whether they show one; +Z otherwise."""
    across = (positions[legs[0].first] - positions[legs[1].first]) * [1, 0, 1]
    across /= float(np.linalg.norm(across))
    feet = sum(positions[leg.path[-1] if leg.end is None else leg.end] - positions[leg.last] for leg in legs) * np.array(
        [1, 0, 1]
    )
    forward = feet - across * (feet @ across)
    length = float(np.linalg.norm(forward))
    if length < MIN_FORWARD_SHARE * _measure_limb(legs[0], positions):
        return np.array([0.0, 0.0, 1.0]), False
    return forward / length, True


def _are_mirrored(left: LimbJoints, right: LimbJoints, tree: _Tree) -> bool:
    """Return whether the joints of two limbs are at equal heights, and apart."""
    positions = tree.positions
    height = positions[:, 1].max() - positions[:, 1].min()
    joints = [(getattr(left, name), getattr(right, name)) for name in ("first", "middle", "last")]
    differences = [abs(positions[a, 1] - positions[b, 1]) for a, b in joints]
    apart = np.linalg.norm((positions[left.middle] - positions[right.middle])[[0, 2]])
    lengths = [_measure_limb(limb, positions) for limb in (left, right)]
    return (
        max(differences) < MAX_HEIGHT_DIFFERENCE_SHARE * height
        and apart > MAX_HEIGHT_DIFFERENCE_SHARE * height
        and abs(lengths[0] - lengths[1]) <= MAX_LENGTH_DIFFERENCE_SHARE * max(lengths)
    )


def _measure_limb(limb: LimbJoints, positions: Float[np.ndarray, "J 3"]) -> float:
    """Return the length from hip to ankle or from shoulder to wrist, over knee or elbow."""
    steps = positions[[limb.middle, limb.last]] - positions[[limb.first, limb.middle]]
    return float(np.linalg.norm(steps, axis=1).sum())


def _find_centre(pair: tuple[LimbJoints, LimbJoints], positions: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, " 3"]:
    return positions[[pair[0].first, pair[1].first]].mean(0)
