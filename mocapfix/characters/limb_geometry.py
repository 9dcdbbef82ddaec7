"""The joints of a leg or an arm on a path of bones, by their positions alone."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float

MAX_ANKLE_HEIGHT_SHARE = 0.2
"""height of the ankle above the lowest bone of the leg, as a share of the height of its first bone"""
MIN_DOWNWARD_COSINE = 0.6
"""cosine between a thigh and the vertical; bones from the pelvis to the hip joint point sideways"""
MIN_KNEE_SHARE, MAX_KNEE_SHARE = 0.3, 0.7
"""position of the knee on the way from the hip to the ankle"""
MAX_TOE_HEIGHT_SHARE = 0.45
"""height of the ball of the foot, as a share of that of the ankle"""
MIN_TOE_REACH_SHARE = 0.4
"""horizontal distance of the ball of the foot from the ankle, as a share of that of the farthest toe"""
MIN_FOOT_LENGTH_SHARE = 0.04
"""horizontal length from the ankle to the farthest toe, as a share of the leg's length; less is no foot"""
SHORT_ARM_COST = 0.5
"""cost of an arm that begins at the end of the path, relative to that of arm and forearm in the ratio e"""
ARM_LENGTH_COST = 0.5
"""cost of an arm that is e times as long as expected, relative to that of arm and forearm in the ratio e"""
HANDLESS_WRIST_COST, NESTED_HAND_COST = 0.5, 0.1
"""costs of a wrist that carries no fingers, and of each bone before the wrist that carries several chains too"""
SAME_PLACE_SHARE = 0.005
"""distance, as a share of the path's length, below which two bones are at the same place"""


@dataclass(frozen=True)
class LimbJoints:
    """The bones at the joints of a limb.

    first, middle, last   hip, knee and ankle, or shoulder, elbow and wrist
    end                   ball of the foot; None without one, and for arms
    before                clavicle; None without one, and for legs
    path                  the bones from the trunk outwards
    """

    first: int
    middle: int
    last: int
    end: int | None
    before: int | None
    path: tuple[int, ...]

    def list_between(self, start: int, stop: int) -> tuple[int, ...]:
        """Return the bones of the path from `start` to the one before `stop`."""
        return self.path[self.path.index(start) : self.path.index(stop)]


def find_leg_joints(path: Sequence[int], positions: Float[np.ndarray, "J 3"]) -> LimbJoints | None:
    """Find hip, knee, ankle and ball of the foot on a path of bones that leads down from the pelvis.

    The ankle is the first bone near the lowest one. The thigh is the first bone that points down. The knee is the bone nearest to
    the middle between them, so that parts of a thigh or a shin are not taken for it.

    Returns:
        The joints, or None if the path is no leg.
    """
    points = positions[list(path)]
    heights = points[:, 1] - points[:, 1].min()
    low = np.flatnonzero(heights < MAX_ANKLE_HEIGHT_SHARE * heights[0])
    if len(path) < 3 or heights[0] <= 0.0 or not len(low):
        return None
    ankle = int(low[0])
    steps = np.diff(points, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    is_thigh = (lengths > SAME_PLACE_SHARE * heights[0]) & (-steps[:, 1] > MIN_DOWNWARD_COSINE * lengths)
    hip = int(is_thigh.argmax())
    if not is_thigh[hip] or hip >= ankle - 1:
        return None
    way = np.cumsum(lengths[hip:ankle])
    shares = way[:-1] / way[-1]
    knee = hip + 1 + int(np.abs(shares - 0.5).argmin())
    if not MIN_KNEE_SHARE < shares[knee - hip - 1] < MAX_KNEE_SHARE:
        return None
    toe = _find_toe(points[ankle:], heights[ankle:], heights[hip])
    end = None if toe is None else path[ankle + toe]
    return LimbJoints(path[hip], path[knee], path[ankle], end, None, tuple(path))


def _find_toe(points: Float[np.ndarray, "n 3"], heights: Float[np.ndarray, " n"], leg_length: float) -> int | None:
    """Return the index of the ball of the foot among the bones from the ankle outwards."""
    reach = np.linalg.norm((points - points[0])[:, [0, 2]], axis=1)
    if len(points) < 2 or reach.max() < MIN_FOOT_LENGTH_SHARE * leg_length:
        return None
    is_toe = (heights <= MAX_TOE_HEIGHT_SHARE * heights[0]) & (reach >= MIN_TOE_REACH_SHARE * reach.max())
    is_toe[0] = False
    if is_toe.any():
        return int(is_toe.argmax())
    is_low = heights < heights[0]
    return int(np.where(is_low, reach, -1.0).argmax()) if is_low.any() else None


def find_arm_joints(
    path: Sequence[int], hands: Sequence[int], positions: Float[np.ndarray, "J 3"], expected_length: float
) -> LimbJoints | None:
    """Find clavicle, shoulder, elbow and wrist on a path of bones that leads from the chest to the fingers.

    Upper arm and forearm are as long as each other and nearly as long as the path to the wrist together, which is about as long
    as expected and the first bone that carries fingers. The bones with the least total deviation from this are chosen.

    Args:
        path: The bones from the chest outwards.
        hands: The bones of the path that carry several chains, as hands carry fingers.
        positions: (J, 3) m, world.
        expected_length: Length from shoulder to wrist of an adult with the legs of the character.

    Returns:
        The joints, or None if the path is no arm.
    """
    points = positions[list(path)]
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    best: tuple[float, tuple[int, int, int]] | None = None
    for last in range(2, len(path)):
        hand_cost = NESTED_HAND_COST * hands.index(path[last]) if path[last] in hands else HANDLESS_WRIST_COST
        for first, middle in combinations(range(last), 2):
            upper, lower = np.linalg.norm(points[middle] - points[first]), np.linalg.norm(points[last] - points[middle])
            if min(upper, lower) <= SAME_PLACE_SHARE * way[-1]:
                continue
            cost = abs(np.log(upper / lower)) + SHORT_ARM_COST * way[first] / way[last]
            cost += ARM_LENGTH_COST * abs(np.log((upper + lower) / expected_length)) + hand_cost
            if best is None or cost < best[0] - 1e-6:
                best = float(cost), (first, middle, last)
    if best is None:
        return None
    first, middle, last = best[1]
    before = [bone for bone in range(first) if way[first] - way[bone] > SAME_PLACE_SHARE * way[-1]]
    return LimbJoints(path[first], path[middle], path[last], None, path[before[0]] if before else None, tuple(path))
