"""The joints of two legs or two arms on a pair of paths of bones, by their positions alone.

Both sides are judged together: lengths and heights are means of the left and the right path.

The tree of a skeleton's bones, and the pairs of chains in it that are alike on two sides.

Chains of two sisters are followed together: at each step children are paired whose distances from their parents and heights are
equal. What is on one side only, such as a weapon in a hand, is in no pair.

Twist bones beside the chain of a limb: children that lie on its axis and carry a share of its twist.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

from mocapfix.characters.character import SIDES, TWISTING_SEGMENTS

MAX_ANKLE_HEIGHT_SHARE = 0.2
"""height of the ankle above the lowest bone of the leg, as a share of the height of its first bone"""
MIN_DOWNWARD_COSINE = 0.6
"""cosine between a thigh or a shin and the vertical"""
MAX_LEG_COST = 1.0
"""deviation of a leg from what is expected, in units of the logarithm of the ratio of two lengths, from which it is none"""
HIP_DISTANCE_RATIO, SHOULDER_DISTANCE_RATIO = 0.2, 0.6
"""distance between the hips over the length of a leg, and between the shoulders over that of an arm to the wrist"""
NARROW_LIMB_COST = 0.3
"""cost of hips or shoulders whose distance is 1 / e of that ratio, relative to that of the parts of a limb in the ratio e"""
MIN_DISTANCE_RATIO = 0.01
"""distance between hips or shoulders over the length of the limb, below which all are judged alike"""
SHORT_LIMB_COST = 0.5
"""cost of a limb that begins at the end of the path, relative to that of its two parts in the ratio e"""
ARM_LENGTH_COST = 0.5
"""cost of an arm that is e times as long as expected, relative to that of arm and forearm in the ratio e"""
MAX_TOE_HEIGHT_SHARE = 0.45
"""height of the ball of the foot, as a share of that of the ankle"""
MIN_TOE_REACH_SHARE = 0.4
"""horizontal distance of the ball of the foot from the ankle, as a share of that of the farthest toe"""
MIN_FOOT_LENGTH_SHARE = 0.04
"""horizontal length from the ankle to the farthest toe, as a share of the leg's length; less is no foot"""
COST_DECIMALS = 6
"""Costs that are equal to these decimals are alike; of bones at one place the first is chosen."""
MIN_COMPARED_LENGTH_M = 1e-12
SAME_PLACE_SHARE = 0.005
"""distance, as a share of a path's length or a skeleton's height, below which two bones are at the same place"""


@dataclass(frozen=True)
class LimbPlaces:
    """The places of joints on a path of bones.

    first, middle, last   hip, knee and ankle, or shoulder, elbow and wrist
    end                   ball of the foot; None without one, and for arms
    before                clavicle; None without one, and for legs
    cost                  deviation from what is expected, in units of the logarithm of the ratio of two lengths
    """

    first: int
    middle: int
    last: int
    end: int | None
    before: int | None
    cost: float


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
MAX_PAIRED_BONES = 24
"""bones of a paired path: chains of more are hair or ropes, and their ends are no joints of a limb"""
MAX_PAIRED_SISTERS = 64
"""bones with more children carry hair or clothes; their children are not paired"""


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


NEXT_SEGMENTS = {
    f"{side}_{name}": f"{side}_{following}"
    for side in SIDES
    for name, following in (("upper_arm", "forearm"), ("forearm", "hand"), ("thigh", "shin"), ("shin", "foot"))
}
"""the segment at the end of each segment that may have twist bones"""
MIN_TWIST_SHARE, MAX_TWIST_SHARE = 0.05, 0.98
"""positions along the segment between which a bone without a telling name is a twist bone; others are helpers of the joints"""
NAMED_TWIST_MARGIN = 0.1
"""share of the segment by which a bone named as a twist bone may lie outside it"""
MAX_AXIS_DISTANCE_SHARE = 0.1
"""distance of a twist bone from the axis, as a share of the segment's length"""
TWIST_WORDS = ("twist", "roll")
CORRECTIVE_WORDS = ("cor", "corrective", "drv")
"""ends of the names of bones that correct the skin at a twist bone"""


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
        chain, following = bones.get(segment, ()), bones.get(NEXT_SEGMENTS[segment], ())
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
