"""Segments of a body by the shape of the skeleton alone: the tree of its bones and their positions in the rest pose.

Legs are a pair of alike chains that lead down to the floor. Arms are a pair of alike chains of about that length that a bone
above carries and that do not reach the floor. The pelvis is the bone from which legs and arms go, the spine leads from it to the
bone that carries the arms, and neck and head lead up from there. Left and right follow from the direction of the toes.

Chains of two sisters are followed together: at each step children are paired whose distances from their parents and heights are
equal. What is on one side only, such as a weapon in a hand, is in no pair. Both sides are judged together: lengths and heights
are means of the left and the right path.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

from mocapfix.characters.character import SIDES
from mocapfix.model.skeleton import find_common_joint, list_path

MAX_ANKLE_HEIGHT_SHARE = 0.2  # height of the ankle above the lowest bone of the leg, as a share of the height of its first bone
MIN_DOWNWARD_COSINE = 0.6  # cosine between a thigh or a shin and the vertical
MAX_LEG_COST = 1.0
"""deviation of a leg from what is expected, in units of the logarithm of the ratio of two lengths, from which it is none"""
HIP_DISTANCE_RATIO, SHOULDER_DISTANCE_RATIO = 0.2, 0.6
"""distance between the hips over the length of a leg, and between the shoulders over that of an arm to the wrist"""
NARROW_LIMB_COST = 0.3
"""cost of hips or shoulders whose distance is 1 / e of that ratio, relative to that of the parts of a limb in the ratio e"""
MIN_DISTANCE_RATIO = 0.01  # distance between hips or shoulders over the length of the limb, below which all are judged alike
SHORT_LIMB_COST = 0.5  # cost of a limb that begins at the end of the path, relative to that of its two parts in the ratio e
ARM_LENGTH_COST = 0.5  # cost of an arm that is e times as long as expected, relative to that of arm and forearm in the ratio e
MAX_TOE_HEIGHT_SHARE = 0.45  # height of the ball of the foot, as a share of that of the ankle
MIN_TOE_REACH_SHARE = 0.4  # horizontal distance of the ball of the foot from the ankle, as a share of that of the farthest toe
MIN_FOOT_LENGTH_SHARE = 0.04
"""horizontal length from the ankle to the farthest toe, as a share of the leg's length; less is no foot"""
COST_DECIMALS = 6  # costs that are equal to these decimals are alike; of bones at one place the first is chosen
MIN_COMPARED_LENGTH_M = 1e-12
SAME_PLACE_SHARE = 0.005
"""distance, as a share of a path's length or a skeleton's height, below which two bones are at the same place"""


@dataclass(frozen=True)
class LimbPlaces:
    """The places of joints on a path of bones."""

    first: int  # first, middle, last: hip, knee and ankle, or shoulder, elbow and wrist
    middle: int
    last: int
    end: int | None  # ball of the foot; None without one, and for arms
    before: int | None  # clavicle; None without one, and for legs
    cost: float  # deviation from what is expected, in units of the logarithm of the ratio of two lengths


def find_leg_places(points: Float[np.ndarray, "2 n 3"]) -> LimbPlaces | None:
    """Find hip, knee, ankle and ball of the foot on a pair of paths that lead down from the pelvis.

    The ankle is the first bone near the lowest one. Thigh and shin point down, are as long as each other, begin apart, and are
    together nearly as long as the path to the ankle; so neither a bone from the pelvis to the hip nor a part of a thigh is taken
    for the thigh.

    Returns:
        The places, or None if the paths are no legs.
    """
    heights = (points[..., 1] - points[..., 1].min(1, keepdims=True)).mean(0)
    low = np.flatnonzero(heights < MAX_ANKLE_HEIGHT_SHARE * heights[0])
    if len(heights) < 3 or heights[0] <= 0.0 or not len(low):
        return None
    ankle = int(low[0])
    way, between = _measure_way(points), _measure_distance_between(points)
    lengths = _measure_lengths(points)[: ankle + 1, : ankle + 1]
    upper, lower = lengths[:ankle, :ankle], lengths[None, :ankle, ankle]  # by hip and knee
    falls = heights[:ankle, None] - heights[None, :ankle]
    is_leg = (np.minimum(upper, lower) > SAME_PLACE_SHARE * way[-1]) & np.triu(np.ones((ankle, ankle), bool), 1)
    is_leg &= (falls >= MIN_DOWNWARD_COSINE * upper) & (heights[:ankle] - heights[ankle] >= MIN_DOWNWARD_COSINE * lower)
    if not is_leg.any():
        return None
    cost = _compare_lengths(upper, lower) + SHORT_LIMB_COST * way[:ankle, None] / way[ankle]
    cost += _judge_distance(between[:ankle, None], upper + lower, HIP_DISTANCE_RATIO)
    cost = np.where(is_leg, cost, np.inf).round(COST_DECIMALS)
    hip, knee = (int(index) for index in np.unravel_index(cost.argmin(), cost.shape))
    if cost[hip, knee] > MAX_LEG_COST:
        return None
    toe = _find_toe(points[:, ankle:], heights[ankle:], heights[hip])
    return LimbPlaces(hip, knee, ankle, None if toe is None else ankle + toe, None, float(cost[hip, knee]))


def find_arm_places(points: Float[np.ndarray, "2 n 3"], hand_costs: Sequence[float], expected_length: float) -> LimbPlaces | None:
    """Find clavicle, shoulder, elbow and wrist on a pair of paths that lead from the chest to the fingers.

    Upper arm and forearm are as long as each other, begin apart, and are together nearly as long as the path to the wrist, which
    is about as long as expected; the wrist is a bone that looks like a hand. The bones with the least total deviation are chosen.

    Args:
        points: (2, n, 3) m, world, the bones of both paths from the chest outwards.
        hand_costs: How little each bone of the path looks like a hand, in units of the logarithm of the ratio of two lengths.
        expected_length: Length from shoulder to wrist of an adult with the legs of the character.

    Returns:
        The places, or None if the paths are no arms.
    """
    way, between, lengths = _measure_way(points), _measure_distance_between(points), _measure_lengths(points)
    upper, lower = lengths[None], lengths.T[:, None]  # by wrist, shoulder and elbow
    is_later = np.triu(np.ones(lengths.shape, bool), 1)
    is_arm = is_later[None] & is_later.T[:, None] & (np.minimum(upper, lower) > SAME_PLACE_SHARE * way[-1])
    if not is_arm.any():
        return None
    cost = _compare_lengths(upper, lower) + ARM_LENGTH_COST * _compare_lengths(upper + lower, np.array(expected_length))
    cost += SHORT_LIMB_COST * way[None, :, None] / np.maximum(way, SAME_PLACE_SHARE * way[-1])[:, None, None]
    cost += _judge_distance(between, np.array(expected_length), SHOULDER_DISTANCE_RATIO)[None, :, None]
    cost += np.array(hand_costs)[:, None, None]
    cost = np.where(is_arm, cost, np.inf).round(COST_DECIMALS)
    last, first, middle = (int(index) for index in np.unravel_index(cost.argmin(), cost.shape))
    before = [place for place in range(first) if way[first] - way[place] > SAME_PLACE_SHARE * way[-1]]
    return LimbPlaces(first, middle, last, None, before[0] if before else None, float(cost[last, first, middle]))


def _find_toe(points: Float[np.ndarray, "2 n 3"], heights: Float[np.ndarray, " n"], leg_length: float) -> int | None:
    """Return the place of the ball of the foot on the paths from the ankles outwards."""
    reach = np.linalg.norm((points - points[:, :1])[..., [0, 2]], axis=2).mean(0)
    if len(reach) < 2 or reach.max() < MIN_FOOT_LENGTH_SHARE * leg_length:
        return None
    is_toe = (heights <= MAX_TOE_HEIGHT_SHARE * heights[0]) & (reach >= MIN_TOE_REACH_SHARE * reach.max())
    is_toe[0] = False
    if is_toe.any():
        return int(is_toe.argmax())
    is_low = heights < heights[0]
    return int(np.where(is_low, reach, -1.0).argmax()) if is_low.any() else None


def _measure_way(points: Float[np.ndarray, "2 n 3"]) -> Float[np.ndarray, " n"]:
    """Return the mean length of the paths to each of their bones."""
    steps = np.linalg.norm(np.diff(points, axis=1), axis=2).mean(0)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _measure_lengths(points: Float[np.ndarray, "2 n 3"]) -> Float[np.ndarray, "n n"]:
    """Return the mean distance on both paths between each two of their bones."""
    return np.linalg.norm(points[:, :, None] - points[:, None], axis=3).mean(0)


def _compare_lengths(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the absolute logarithms of the ratios of lengths; those of length 0 are judged elsewhere."""
    return np.abs(np.log(np.maximum(first, MIN_COMPARED_LENGTH_M) / np.maximum(second, MIN_COMPARED_LENGTH_M)))


def _measure_distance_between(points: Float[np.ndarray, "2 n 3"]) -> Float[np.ndarray, " n"]:
    """Return the horizontal distance between the bones of the two paths."""
    return np.linalg.norm((points[0] - points[1])[:, [0, 2]], axis=1)


def _judge_distance(between: np.ndarray, length: np.ndarray, expected_ratio: float) -> np.ndarray:
    """Return the cost of distances between two hips or shoulders for limbs of given lengths, none for those large enough."""
    ratio = np.maximum(between / np.maximum(length, MIN_COMPARED_LENGTH_M), MIN_DISTANCE_RATIO)
    return NARROW_LIMB_COST * np.maximum(0.0, np.log(expected_ratio / ratio))


MAX_PAIR_DIFFERENCE_SHARE = 0.03
"""difference of the lengths and of the rises of paired bones, as a share of the skeleton's height"""
MAX_PAIRED_BONES = 24  # bones of a paired path: chains of more are hair or ropes, and their ends are no joints of a limb
MAX_PAIRED_SISTERS = 64  # bones with more children carry hair or clothes; their children are not paired


@dataclass(frozen=True)
class PairedPaths:
    """Two paths of bones of equal lengths from two sisters outwards, to the end of what is alike."""

    first: tuple[int, ...]
    second: tuple[int, ...]


class SkeletonTree:
    """The children of each bone and what is below it.

    parents    (J,) index of each bone's parent, -1 for roots; parents come before children
    positions  (J, 3) m, world, Y up
    children   the children of each bone
    reach      (J,) length of the longest path below each bone
    top, bottom  (J,) greatest and least height of each bone and those below it
    height     from the lowest to the highest bone
    """

    def __init__(self, parents: Int[np.ndarray, " J"], positions: Float[np.ndarray, "J 3"]) -> None:
        self.parents, self.positions = parents, positions
        self.children: list[list[int]] = [[] for _ in parents]
        self.reach = np.zeros(len(parents))
        self.top, self.bottom = positions[:, 1].copy(), positions[:, 1].copy()
        self.height = float(np.ptp(positions[:, 1]))
        steps = positions - positions[parents] * (parents >= 0)[:, None]
        self._lengths: list[float] = np.linalg.norm(steps, axis=1).tolist()
        self._rises: list[float] = steps[:, 1].tolist()
        for bone in range(len(parents) - 1, -1, -1):
            parent = int(parents[bone])
            if parent >= 0:
                self.children[parent].insert(0, bone)
                self.reach[parent] = max(self.reach[parent], self.reach[bone] + self._lengths[bone])
                self.top[parent] = max(self.top[parent], self.top[bone])
                self.bottom[parent] = min(self.bottom[parent], self.bottom[bone])

    @cached_property
    def paired_paths(self) -> list[PairedPaths]:
        """The longest paths of all paired sisters, one for each end of the paired bones below them."""
        paths: list[PairedPaths] = []
        for sisters in self.children:
            if len(sisters) <= MAX_PAIRED_SISTERS:
                carriers = [bone for bone in sisters if self.children[bone]]
                for a, b in combinations(carriers, 2):
                    if self._measure_difference(a, b) is not None:
                        paths += [PairedPaths(first, second) for first, second in self._follow(a, b)]
        return paths

    def _follow(self, a: int, b: int) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
        """Return the paired paths from two bones outwards."""
        finished: list[tuple[tuple[int, ...], tuple[int, ...]]] = []
        growing = [((a,), (b,))]
        while growing:
            first, second = growing.pop()
            pairs = self._pair_children(first[-1], second[-1]) if len(first) < MAX_PAIRED_BONES else []
            growing += [((*first, left), (*second, right)) for left, right in pairs]
            if not pairs:
                finished.append((first, second))
        return finished

    def _pair_children(self, a: int, b: int) -> list[tuple[int, int]]:
        """Return the pairs of children of two bones, the most similar ones first, each child in one pair."""
        differences = [
            (difference + abs(self.reach[left] - self.reach[right]), left, right)
            for left in self.children[a][:MAX_PAIRED_SISTERS]
            for right in self.children[b][:MAX_PAIRED_SISTERS]
            if (difference := self._measure_difference(left, right)) is not None
        ]
        pairs: list[tuple[int, int]] = []
        used: set[int] = set()
        for _, left, right in sorted(differences):
            if not used & {left, right}:
                used |= {left, right}
                pairs.append((left, right))
        return pairs

    def _measure_difference(self, a: int, b: int) -> float | None:
        """Return how much two bones differ in distance from their parents and in rise, None if too much for a pair."""
        difference = max(abs(self._lengths[a] - self._lengths[b]), abs(self._rises[a] - self._rises[b]))
        return difference if difference <= MAX_PAIR_DIFFERENCE_SHARE * self.height else None


MIN_TWIST_SHARE = 0.05  # position along a segment from which a bone on its axis is no helper of the joint
MAX_AXIS_DISTANCE_SHARE = 0.1  # distance of a twist bone from the axis, as a share of the segment's length
MIN_LIMB_DISTANCE_SHARE = 0.03
"""horizontal distance between the left and the right knee or elbow, as a share of the skeleton's height"""
MAX_LOWEST_SHARE = 0.35  # height of the lowest bone of a leg above the lowest bone of all, as a share of the skeleton's height
MAX_MIRROR_ERROR_SHARE = 0.1
"""difference of the distances of both ends of the arms from the plane between the legs, as a share of the skeleton's height"""
MIN_LEG_HEIGHT_SHARE = 0.25  # length of the legs, as a share of the skeleton's height
MAX_FLOOR_DISTANCE_SHARE = 0.1
"""height of the lowest bone of a limb that reaches the floor above that of the lowest leg, as a share of the leg's length"""
MIN_FRONT_DISTANCE_SHARE = 0.3
"""horizontal distance between two pairs of legs of an animal on four legs, as a share of the leg's length"""
ARM_LEG_RATIO = 0.65  # length from shoulder to wrist over that from hip to ankle of an adult
MAX_ARM_LEG_FACTOR = 2.2  # factor between that ratio and the one of a figure
MIN_SHOULDER_HEIGHT_SHARE = 0.25  # height of the shoulders above the hips, as a share of the leg's length
MIN_FINGER_RATIO = 0.3  # length of the shortest chain of a hand over that of the second longest; the longest may be a weapon
NESTED_HAND_COST, THUMB_HAND_COST, HANDLESS_ARM_COST = 0.1, 0.15, 0.5
"""costs of a wrist, in units of the logarithm of the ratio of two lengths: for each bone before it that carries several chains
too, of one that carries further bones but no fingers, and of one that does not"""
HANGING_CHAIN_COST, SIDEWAYS_COST = 0.5, 0.4
"""costs of chains below all their sisters, such as hair, and of chains that do not lead sideways, in the same units"""


@dataclass(frozen=True)
class LimbPair:
    """Two legs or two arms."""

    paths: PairedPaths  # the bones of each from the trunk outwards
    places: LimbPlaces  # of the joints on both paths

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


MIN_TRUNK_COSINE = 0.8  # cosine between the vertical and the direction from the hips to the shoulders
END_BONE_RATIO = 1.5  # length of the last bone over that of the bone before, from which it is the top of the head
MAX_NECK_DISTANCE_SHARE = 0.15
"""distance of the bones of the neck from the plane in the middle between the shoulders, as a share of their distance"""
MIN_FACE_DISTANCE_SHARE = 0.5  # distance of eyes or a jaw from the head, as a share of that of its end
MIN_FORWARD_SHARE = 1e-3  # horizontal length of the feet, as a share of the skeleton's height, below which it shows no direction


@dataclass(frozen=True)
class ShapeSegments:
    """The segments that the shape of a skeleton gives."""

    bones: dict[str, tuple[int, ...]]  # segment to its bones
    faces_forward: bool  # whether the feet show where the front is; otherwise the front is taken to be +Z


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
    pelvis = find_common_joint(parents, [*legs.select(0), *arms.select(0)])
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
