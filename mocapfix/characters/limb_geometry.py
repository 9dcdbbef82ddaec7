"""The joints of two legs or two arms on a pair of paths of bones, by their positions alone.

Both sides are judged together: lengths and heights are means of the left and the right path.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

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
