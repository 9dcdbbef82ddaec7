"""Segments of a body by the shape of the skeleton alone: the tree of its bones and their positions in the rest pose.

Legs are a pair of alike chains that lead down to the floor. Arms are a pair of alike chains of about that length that a bone
above carries and that do not reach the floor. The pelvis is the bone from which legs and arms go, the spine leads from it to the
bone that carries the arms, and neck and head lead up from there. Left and right follow from the direction of the toes.

Chains of two sisters are followed together: at each step children are paired whose distances from their parents and heights are
equal. What is on one side only, such as a weapon in a hand, is in no pair. Both sides are judged together: lengths and heights
are means of the left and the right path. Costs are in units of the logarithm of the ratio of two lengths.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

from mocapfix.characters.character import SIDES
from mocapfix.model.skeleton import find_common_joint, list_path

MAX_PAIR_DIFFERENCE_SHARE = 0.03
"""difference of the lengths and of the rises of paired bones, as a share of the skeleton's height"""
MAX_PAIRED_BONES = 24  # bones of a paired path: chains of more are hair or ropes, and their ends are no joints of a limb
MAX_PAIRED_SISTERS = 64  # bones with more children carry hair or clothes; their children are not paired
MIN_LIMB_DISTANCE_SHARE = 0.03
"""horizontal distance between the left and the right knee or elbow, as a share of the skeleton's height"""
SAME_PLACE_SHARE = 0.005
"""distance, as a share of a path's length or a skeleton's height, below which two bones are at the same place"""


class PosedTree:
    """The bones of a skeleton in its rest pose, and what is below each.

    Attributes:
        parents: Index of each bone's parent, -1 for roots; parents come before children.
        positions: In metres in the world, Y up.
        children: The children of each bone.
        reach: Length of the longest path below each bone.
        top: Greatest height of each bone and those below it.
        height: From the lowest to the highest bone.
        paired_paths: The longest paths of all paired sisters outwards, one for each end of the paired bones below them, as the
            bones of both.
    """

    def __init__(self, parents: Int[np.ndarray, " J"], positions: Float[np.ndarray, "J 3"]) -> None:
        self.parents, self.positions = parents, positions
        self.children: list[list[int]] = [[] for _ in parents]
        self.reach, self.top = np.zeros(len(parents)), positions[:, 1].copy()
        self.height = float(np.ptp(positions[:, 1]))
        steps = positions - positions[parents] * (parents >= 0)[:, None]
        self._lengths: list[float] = np.linalg.norm(steps, axis=1).tolist()
        self._rises: list[float] = steps[:, 1].tolist()
        for bone in range(len(parents) - 1, -1, -1):
            if (parent := int(parents[bone])) >= 0:
                self.children[parent].insert(0, bone)
                self.reach[parent] = max(self.reach[parent], self.reach[bone] + self._lengths[bone])
                self.top[parent] = max(self.top[parent], self.top[bone])
        self.paired_paths = [path for sisters in self.children for path in self._follow_sisters(sisters)]

    def _follow_sisters(self, sisters: Sequence[int]) -> list[Int[np.ndarray, "2 n"]]:
        """Return the paired paths of the children of a bone outwards."""
        carriers = [bone for bone in sisters if self.children[bone]] if len(sisters) <= MAX_PAIRED_SISTERS else []
        pairs = [pair for pair in combinations(carriers, 2) if self._measure_difference(*pair) is not None]
        growing = [(pair,) for pair in reversed(pairs)]
        finished: list[Int[np.ndarray, "2 n"]] = []
        while growing:
            path = growing.pop()
            pairs = self._pair_children(*path[-1]) if len(path) < MAX_PAIRED_BONES else []
            growing += [(*path, pair) for pair in pairs]
            if not pairs:
                finished.append(np.array(path).T)
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
        for _, left, right in sorted(differences):
            if not any(left in pair or right in pair for pair in pairs):
                pairs.append((left, right))
        return pairs

    def _measure_difference(self, a: int, b: int) -> float | None:
        """Return how much two bones differ in distance from their parents and in rise, None if too much for a pair."""
        difference = max(abs(self._lengths[a] - self._lengths[b]), abs(self._rises[a] - self._rises[b]))
        return difference if difference <= MAX_PAIR_DIFFERENCE_SHARE * self.height else None


@dataclass(frozen=True)
class LimbPair:
    """Two legs or two arms."""

    bones: Int[np.ndarray, "2 n"]  # of each from the trunk outwards
    points: Float[np.ndarray, "2 n 3"]  # where they begin, in metres in the world
    first: int  # first, middle, last: places of hip, knee and ankle, or of shoulder, elbow and wrist
    middle: int
    last: int
    end: int  # of the ball of the foot; that of the ankle or wrist if there is none
    before: int  # of the clavicle; that of the shoulder or hip if there is none
    cost: float  # deviation from what is expected

    @property
    def centre(self) -> Float[np.ndarray, " 3"]:
        """The middle between the hips or the shoulders."""
        return self.points[:, self.first].mean(0)

    @property
    def bottom(self) -> float:
        """The least height of the bones."""
        return float(self.points[..., 1].min())

    @property
    def length(self) -> float:
        """The mean length from hip to ankle or from shoulder to wrist, over knee or elbow."""
        joints = self.points[:, [self.first, self.middle, self.last]]
        return float(np.linalg.norm(np.diff(joints, axis=1), axis=2).sum(1).mean())

    @property
    def foot_length(self) -> float:
        """The mean horizontal length of the feet, 0 for those without toes."""
        return float(np.linalg.norm((self.points[:, self.end] - self.points[:, self.last])[:, [0, 2]], axis=1).mean())

    @property
    def across(self) -> Float[np.ndarray, " 3"]:
        """The horizontal unit vector from one knee or elbow to the other; these are apart, hips may be at one place."""
        across = (self.points[1, self.middle] - self.points[0, self.middle]) * [1, 0, 1]
        return across / np.linalg.norm(across)

    def is_apart(self, tree: PosedTree) -> bool:
        between = (self.points[0, self.middle] - self.points[1, self.middle])[[0, 2]]
        return bool(np.linalg.norm(between) > MIN_LIMB_DISTANCE_SHARE * tree.height)


MAX_ANKLE_HEIGHT_SHARE = 0.2  # height of the ankle above the lowest bone of the leg, as a share of the height of its first bone
MIN_DOWNWARD_COSINE = 0.6  # cosine between a thigh or a shin and the vertical
MAX_LEG_COST = 1.0  # cost from which two paths are no legs
HIP_DISTANCE_RATIO, SHOULDER_DISTANCE_RATIO = 0.2, 0.6
"""distance between the hips over the length of a leg, and between the shoulders over that of an arm to the wrist"""
NARROW_LIMB_COST = 0.3  # cost of hips or shoulders whose distance is 1 / e of that ratio
MIN_DISTANCE_RATIO = 0.01  # distance between hips or shoulders over the length of the limb, below which all are judged alike
SHORT_LIMB_COST = 0.5  # cost of a limb that begins at the end of the path
ARM_LENGTH_COST = 0.5  # cost of an arm that is e times as long as expected
COST_DECIMALS = 6  # costs that are equal to these decimals are alike; of bones at one place the first is chosen
MIN_COMPARED_LENGTH_M = 1e-12
MAX_TOE_HEIGHT_SHARE = 0.45  # height of the ball of the foot, as a share of that of the ankle
MIN_TOE_REACH_SHARE = 0.4  # horizontal distance of the ball of the foot from the ankle, as a share of that of the farthest toe
MIN_FOOT_LENGTH_SHARE = 0.04
"""horizontal length from the ankle to the farthest toe, as a share of the leg's length; less is no foot"""


def find_leg_joints(bones: Int[np.ndarray, "2 n"], points: Float[np.ndarray, "2 n 3"]) -> LimbPair | None:
    """Find hip, knee, ankle and ball of the foot on a pair of paths that lead down from the pelvis; None if these are no legs.

    The ankle is the first bone near the lowest one. Thigh and shin point down, are as long as each other, begin apart, and are
    together nearly as long as the path to the ankle; so neither a bone from the pelvis to the hip nor a part of a thigh is taken
    for the thigh.
    """
    heights = (points[..., 1] - points[..., 1].min(1, keepdims=True)).mean(0)
    low = np.flatnonzero(heights < MAX_ANKLE_HEIGHT_SHARE * heights[0])
    if len(heights) < 3 or heights[0] <= 0.0 or not len(low):
        return None
    ankle = int(low[0])
    way, between, lengths = _measure_paths(points)
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
    toe = ankle + _find_toe(points[:, ankle:], heights[ankle:], heights[hip])
    return LimbPair(bones, points, hip, knee, ankle, toe, hip, float(cost[hip, knee]))


def find_arm_joints(
    bones: Int[np.ndarray, "2 n"], points: Float[np.ndarray, "2 n 3"], hand_costs: Float[np.ndarray, " n"], expected_length: float
) -> LimbPair | None:
    """Find clavicle, shoulder, elbow and wrist on a pair of paths from the chest to the fingers; None if these are no arms.

    Upper arm and forearm are as long as each other, begin apart, and are together nearly as long as the path to the wrist, which
    is about as long as expected; the wrist is a bone that looks like a hand. The bones with the least total cost are chosen.

    Args:
        bones: The bones of both paths from the chest outwards.
        points: Where they begin.
        hand_costs: How little each bone of the path looks like a hand.
        expected_length: Length from shoulder to wrist of an adult with the legs of the character.
    """
    way, between, lengths = _measure_paths(points)
    upper, lower = lengths[None], lengths.T[:, None]  # by wrist, shoulder and elbow
    is_later = np.triu(np.ones(lengths.shape, bool), 1)
    is_arm = is_later[None] & is_later.T[:, None] & (np.minimum(upper, lower) > SAME_PLACE_SHARE * way[-1])
    if not is_arm.any():
        return None
    cost = _compare_lengths(upper, lower) + ARM_LENGTH_COST * _compare_lengths(upper + lower, np.array(expected_length))
    cost += SHORT_LIMB_COST * way[None, :, None] / np.maximum(way, SAME_PLACE_SHARE * way[-1])[:, None, None]
    cost += _judge_distance(between, np.array(expected_length), SHOULDER_DISTANCE_RATIO)[None, :, None]
    cost += hand_costs[:, None, None]
    cost = np.where(is_arm, cost, np.inf).round(COST_DECIMALS)
    last, first, middle = (int(index) for index in np.unravel_index(cost.argmin(), cost.shape))
    is_apart = way[first] - way[:first] > SAME_PLACE_SHARE * way[-1]
    before = int(is_apart.argmax()) if is_apart.any() else first
    return LimbPair(bones, points, first, middle, last, last, before, float(cost[last, first, middle]))


def _find_toe(points: Float[np.ndarray, "2 n 3"], heights: Float[np.ndarray, " n"], leg_length: float) -> int:
    """Return the place of the ball of the foot on the paths from the ankles outwards, 0 without one."""
    reach = np.linalg.norm((points - points[:, :1])[..., [0, 2]], axis=2).mean(0)
    if len(reach) < 2 or reach.max() < MIN_FOOT_LENGTH_SHARE * leg_length:
        return 0
    is_toe = (heights <= MAX_TOE_HEIGHT_SHARE * heights[0]) & (reach >= MIN_TOE_REACH_SHARE * reach.max())
    is_toe[0] = False
    return int(is_toe.argmax() if is_toe.any() else np.where(heights < heights[0], reach, -1.0).argmax())


def _measure_paths(
    points: Float[np.ndarray, "2 n 3"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, "n n"]]:
    """Return means over both paths: of the way to each bone, of their horizontal distance, and of distances between bones."""
    way = np.cumsum(np.linalg.norm(np.diff(points, axis=1, prepend=points[:, :1]), axis=2).mean(0))
    between = np.linalg.norm((points[0] - points[1])[:, [0, 2]], axis=1)
    return way, between, np.linalg.norm(points[:, :, None] - points[:, None], axis=3).mean(0)


def _compare_lengths(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the absolute logarithms of the ratios of lengths; those of length 0 are judged elsewhere."""
    return np.abs(np.log(np.maximum(first, MIN_COMPARED_LENGTH_M) / np.maximum(second, MIN_COMPARED_LENGTH_M)))


def _judge_distance(between: np.ndarray, length: np.ndarray, expected_ratio: float) -> np.ndarray:
    """Return the cost of distances between two hips or shoulders for limbs of given lengths, none for those large enough."""
    ratio = np.maximum(between / np.maximum(length, MIN_COMPARED_LENGTH_M), MIN_DISTANCE_RATIO)
    return NARROW_LIMB_COST * np.maximum(0.0, np.log(expected_ratio / ratio))


MAX_LOWEST_SHARE = 0.35  # height of the lowest bone of a leg above the lowest bone of all, as a share of the skeleton's height
MIN_LEG_HEIGHT_SHARE = 0.25  # length of the legs, as a share of the skeleton's height
MAX_FLOOR_DISTANCE_SHARE = 0.1
"""height of the lowest bone of a limb that reaches the floor above that of the lowest leg, as a share of the leg's length"""
MIN_FRONT_DISTANCE_SHARE = 0.3
"""horizontal distance between two pairs of legs of an animal on four legs, as a share of the leg's length"""
MAX_MIRROR_ERROR_SHARE = 0.1
"""difference of the distances of both ends of the arms from the plane between the legs, as a share of the skeleton's height"""
ARM_LEG_RATIO = 0.65  # length from shoulder to wrist over that from hip to ankle of an adult
MAX_ARM_LEG_FACTOR = 2.2  # factor between that ratio and the one of a figure
MIN_SHOULDER_HEIGHT_SHARE = 0.25  # height of the shoulders above the hips, as a share of the leg's length
HANGING_CHAIN_COST, SIDEWAYS_COST = 0.5, 0.4
"""costs of chains below all their sisters, such as hair, and of chains that do not lead sideways"""
MIN_FINGER_RATIO = 0.3  # length of the shortest chain of a hand over that of the second longest; the longest may be a weapon
NESTED_HAND_COST, THUMB_HAND_COST, HANDLESS_ARM_COST = 0.1, 0.15, 0.5
"""costs of a wrist: for each bone before it that carries several chains too, of one that carries further bones but no fingers,
and of one that does not"""
MIN_TWIST_SHARE = 0.05  # position along a segment from which a bone on its axis is no helper of the joint
MAX_AXIS_DISTANCE_SHARE = 0.1  # distance of a twist bone from the axis, as a share of the segment's length


def find_legs(tree: PosedTree) -> LimbPair:
    """Find the legs: the longest pair of chains that lead down to the floor, with feet if any such pair has feet.

    Raises:
        ValueError: If there are none, or if further legs stand in front or behind. The message is the end of a sentence.
    """
    lowest = tree.positions[:, 1].min() + MAX_LOWEST_SHARE * tree.height
    low = [bones for bones in tree.paired_paths if tree.positions[bones, 1].min() < lowest]
    pairs = [find_leg_joints(bones, tree.positions[bones]) for bones in low]
    found = [pair for pair in pairs if pair is not None and pair.is_apart(tree)]
    floor = min((pair.bottom for pair in found), default=0.0)
    least_length = MIN_LEG_HEIGHT_SHARE * (tree.positions[:, 1].max() - floor)
    standing = [
        pair for pair in found if pair.length > least_length and pair.bottom - floor < MAX_FLOOR_DISTANCE_SHARE * pair.length
    ]
    if not standing:
        raise ValueError("no two legs lead down to the floor")
    best = max(standing, key=lambda pair: (pair.end != pair.last, pair.length, pair.foot_length))
    for pair in standing:
        if np.linalg.norm((pair.centre - best.centre)[[0, 2]]) > MIN_FRONT_DISTANCE_SHARE * best.length:
            raise ValueError("it stands on four legs")
    return best


def find_arms(tree: PosedTree, legs: LimbPair) -> LimbPair:
    """Find the arms: the pair of chains above the hips that is the most like arms and does not reach the floor.

    Raises:
        ValueError: If there are none. The message is the end of a sentence.
    """
    best: tuple[float, LimbPair] | None = None
    leg_length, across, bone_count = legs.length, legs.across, len(tree.parents)
    is_hand = np.array([_count_fingers(tree, bone) >= 2 for bone in range(bone_count)])
    has_thumb_beside = np.array([_is_beside_thumb(tree, bone) for bone in range(bone_count)])
    for bones in tree.paired_paths:
        points = tree.positions[bones]
        offsets = (points[:, -1] - legs.centre) @ across
        if np.isin(bones[:, 0], legs.bones).any() or abs(offsets.sum()) > MAX_MIRROR_ERROR_SHARE * tree.height:
            continue
        is_hand_pair, has_thumb = is_hand[bones].all(0), np.append(has_thumb_beside[bones[0, 1:]], False)
        handless_costs = np.where(has_thumb, THUMB_HAND_COST, HANDLESS_ARM_COST)
        hand_costs = np.where(is_hand_pair, NESTED_HAND_COST * (np.cumsum(is_hand_pair) - 1), handless_costs)
        pair = find_arm_joints(bones, points, hand_costs, ARM_LEG_RATIO * leg_length)
        if pair is None:
            continue
        ratio = abs(np.log(pair.length / leg_length / ARM_LEG_RATIO))
        rise, wrist_height = pair.centre[1] - legs.centre[1], points[:, pair.last, 1].min() - legs.bottom
        is_low = rise < MIN_SHOULDER_HEIGHT_SHARE * leg_length or wrist_height < MAX_FLOOR_DISTANCE_SHARE * leg_length
        if is_low or ratio > np.log(MAX_ARM_LEG_FACTOR) or not pair.is_apart(tree):
            continue
        vectors = points[:, pair.last] - points[:, pair.first]
        sideways = vectors @ across / np.linalg.norm(vectors, axis=1)
        others = [child for child in tree.children[int(tree.parents[bones[0, 0]])] if child not in bones[:, 0]]
        is_hanging = all(tree.top[child] <= points[0, 0, 1] for child in others)
        cost = pair.cost + ratio + abs(float(sideways.sum())) + HANGING_CHAIN_COST * is_hanging
        cost += SIDEWAYS_COST * (1 - float(np.abs(sideways).mean()))
        if best is None or cost < best[0]:
            best = cost, pair
    if best is None:
        raise ValueError("no two arms go from a bone above the hips")
    return best[1]


def _count_fingers(tree: PosedTree, bone: int) -> int:
    """Return how many chains of similar lengths begin at children of a bone, as fingers do."""
    heads = tree.positions[tree.children[bone]].reshape(-1, 3)
    distances = np.linalg.norm(heads - tree.positions[bone], axis=1)
    reach = tree.reach[tree.children[bone]][distances > SAME_PLACE_SHARE * tree.height]
    reach = np.sort(reach[reach > 0])[::-1]
    return int((reach > MIN_FINGER_RATIO * reach[min(1, len(reach) - 1)]).sum()) if len(reach) else 0


def _is_beside_thumb(tree: PosedTree, bone: int) -> bool:
    """Return whether a bone has sisters that do not lie between it and their parent."""
    parent = int(tree.parents[bone])
    sisters = [child for child in tree.children[parent] if child != bone] if parent >= 0 else []
    axis = tree.positions[bone] - tree.positions[parent]
    length = max(float(np.linalg.norm(axis)), SAME_PLACE_SHARE * tree.height)
    vectors = tree.positions[sisters].reshape(-1, 3) - tree.positions[parent]
    shares = vectors @ axis / length**2
    distances = np.linalg.norm(vectors - shares[:, None] * axis, axis=1)
    is_between = (shares > MIN_TWIST_SHARE) & (shares < 1) & (distances < MAX_AXIS_DISTANCE_SHARE * length)
    return not is_between.all()


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
        parents: Index of each bone's parent, -1 for roots; parents come before children.
        positions: In metres in the world, Y up, in a rest pose that stands upright and faces any direction.

    Raises:
        ValueError: If the skeleton is no body with two legs and two arms. The message is the end of a sentence that says why.
    """
    tree = PosedTree(parents, positions)
    legs = find_legs(tree)
    arms = find_arms(tree, legs)
    trunk = arms.centre - legs.centre
    if trunk[1] < MIN_TRUNK_COSINE * np.linalg.norm(trunk):
        raise ValueError("the trunk is not upright in the rest pose")
    pelvis = find_common_joint(parents, [*legs.bones[:, 0].tolist(), *arms.bones[:, 0].tolist()])
    if pelvis < 0:
        raise ValueError("legs and arms are below different roots")
    chest = int(parents[arms.bones[0, 0]])
    feet = (legs.points[:, legs.end] - legs.points[:, legs.last]).sum(0) * [1, 0, 1]
    forward = feet - legs.across * (feet @ legs.across)
    faces_forward = bool(np.linalg.norm(forward) >= MIN_FORWARD_SHARE * tree.height)
    if not faces_forward:
        forward = np.array([0.0, 0.0, 1.0])
    bones: dict[str, tuple[int, ...]] = {"pelvis": (pelvis,), "spine": tuple(list_path(chest, pelvis, parents))}
    bones["neck"], bones["head"] = _find_neck(tree, chest, arms)
    for pair, names in ((legs, ("", "thigh", "shin", "foot", "toe")), (arms, ("clavicle", "upper_arm", "forearm", "hand", ""))):
        is_second_left = pair.across @ [forward[2], 0.0, -forward[0]] >= 0
        for side, path in zip(SIDES[::-1] if is_second_left else SIDES, pair.bones.tolist(), strict=True):
            before, end = (
                [path[place]] * (place != joint) for place, joint in ((pair.before, pair.first), (pair.end, pair.last))
            )
            upper, lower = path[pair.first : pair.middle], path[pair.middle : pair.last]
            chains = zip(names, (before, upper, lower, [path[pair.last]], end), strict=True)
            bones |= {f"{side}_{name}": tuple(chain) for name, chain in chains if name}
    return ShapeSegments({segment: chain for segment, chain in bones.items() if chain}, faces_forward)


def _find_neck(tree: PosedTree, chest: int, arms: LimbPair) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the bones of the neck and that of the head, none where nothing leads up from the chest."""
    path: list[int] = []
    bone = _choose_upward(tree, chest, arms)
    while bone is not None:
        path.append(bone)
        following = _choose_upward(tree, bone, arms)
        bone = None if following is None or _carries_face(tree, bone, following) else following
    lengths = np.linalg.norm(np.diff(tree.positions[[chest, *path]], axis=0), axis=1)
    while len(path) > 1 and lengths[len(path) - 1] <= SAME_PLACE_SHARE * lengths.sum():
        path.pop()
    if len(path) > 1 and not tree.children[path[-1]] and lengths[len(path) - 1] > END_BONE_RATIO * lengths[len(path) - 2]:
        path.pop()
    return tuple(path[:-1]), tuple(path[-1:])


def _choose_upward(tree: PosedTree, bone: int, arms: LimbPair) -> int | None:
    """Return the child of a bone that leads up, near the middle between the arms, to the highest bone."""
    width = abs(float((arms.points[0, arms.first] - arms.points[1, arms.first]) @ arms.across))
    upward = [
        child
        for child in tree.children[bone]
        if child not in arms.bones[:, 0]
        and tree.top[child] > tree.positions[bone, 1]
        and abs((tree.positions[child] - arms.centre) @ arms.across) <= MAX_NECK_DISTANCE_SHARE * width
    ]
    return max(upward, key=lambda child: tree.top[child], default=None)


def _carries_face(tree: PosedTree, bone: int, following: int) -> bool:
    """Return whether a bone carries several chains, or several bones at distances of the same order, as heads do."""
    others = [child for child in tree.children[bone] if child != following]
    if any(tree.children[other] for other in others):
        return True
    distances = np.linalg.norm(tree.positions[[following, *others]] - tree.positions[bone], axis=1)
    return not tree.children[following] and bool((distances[1:] > MIN_FACE_DISTANCE_SHARE * distances[0]).any())
