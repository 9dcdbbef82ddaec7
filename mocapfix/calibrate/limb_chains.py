"""Limbs among rigid groups of markers: chains of groups with functional joints between them that move like a leg or an arm.

Nothing is known of the labels. A chain is a limb if the lengths between its joints, their order in height, and the direction in
which its middle joint bends are those of a leg or of an arm. Left and right follow from this direction, which must agree with that
of the foot, or of the reach of the arm. Where two groups fit the same place of a chain, there is no limb.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise, permutations
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from mocapfix.stats.functional_joints import FunctionalJoint, MovingGroup, estimate_functional_joint

LimbKind = Literal["leg", "arm"]

MAX_JOINT_RESIDUAL_M = 0.025
"""Root mean square distance between the two places of a joint."""
MIN_JOINT_RANGE_RAD = 0.08
"""Root mean square angle by which two groups must turn against each other; groups on one segment turn less."""
MIN_COMPETING_RATIO = 2.0
"""Ratio of residuals below which another group at the same joint competes for its place."""
MAX_SAME_JOINT_DISTANCE_M = 0.12
"""Distance between joints on one group below which they are the same."""
MIN_BEND_RAD = 0.26
"""Angle of the middle joint from which a frame shows the direction in which it bends."""
MIN_BENT_SHARE = 0.1
"""Share of the frames that must show it."""
MIN_BEND_AGREEMENT = 0.7
"""Length of the mean direction of bending; 1 if it is the same in all frames."""
MIN_SIDE_AGREEMENT = 0.5
"""Cosine between two directions to the left, from different evidence, that agree."""
MIN_UPRIGHT_COSINE = 0.6
"""Mean cosine between a bone and the vertical; less does not show which end is the upper one."""
MIN_LEG_REACH = 0.5
"""Mean height of the hip above the ankle, relative to the length of the leg; a runner bends the knees."""
MIN_SIDE_DISTANCE_M = 0.03
"""Distance of the first joint of a limb from the middle of the group that carries it, to its side."""
MAX_ROOT_DISTANCE_M = 0.35
"""Distance of the first joint from the middle of the group that carries it."""
MIN_HIP_DISTANCE_M, MAX_HIP_DISTANCE_M = 0.08, 0.35
"""Distance between the hip joints."""
MIN_SHOULDER_DISTANCE_M, MAX_SHOULDER_DISTANCE_M = 0.2, 0.5
"""Distance between the shoulder joints."""
MAX_BONE_DISTANCE_M = 0.2
"""Distance of a marker from the bone of its segment; wands are this long."""
MAX_ANKLE_HEIGHT_M = 0.3
"""Height of the ankle above the lowest marker of the take, in the tenth of the frames in which it is lowest."""
MIN_WRIST_HEIGHT_M = 0.35
"""Height of the wrist above the floor in these frames; a child's leg is as long as an arm, but reaches the floor."""
LOW_FRAME_QUANTILE = 0.1
"""These frames, as a quantile of the height."""


class LimbProportions(NamedTuple):
    """Ranges in metres of the lengths of the upper and the lower bone of a limb, and of their sum."""

    upper: tuple[float, float]
    lower: tuple[float, float]
    total: tuple[float, float]


LIMB_PROPORTIONS: dict[LimbKind, LimbProportions] = {
    "leg": LimbProportions((0.28, 0.56), (0.28, 0.56), (0.62, 1.1)),
    "arm": LimbProportions((0.18, 0.4), (0.16, 0.36), (0.4, 0.7)),
}
"""Of people from about 1.3 m to 2.1 m in height; functional joints are some centimetres off."""


@dataclass(frozen=True)
class LimbChain:
    """A leg or an arm.

    kind           what it is
    groups         indices of the groups on trunk or pelvis, upper segment, lower segment, and foot or hand
    places         (3, 2, 3) m: hip, knee and ankle, or shoulder, elbow and wrist, in the axes of both groups that each joins
    bend_axes      (2, 3) the axis about which the middle joint bends, in the axes of the upper and of the lower group
    left           (3,) the direction to the person's left in the axes of the first group
    is_left        whether it is the left limb
    root_residual_m  residual of the hip or shoulder
    """

    kind: LimbKind
    groups: tuple[int, int, int, int]
    places: Float[np.ndarray, "3 2 3"]
    bend_axes: Float[np.ndarray, "2 3"]
    left: Float[np.ndarray, "3"]
    is_left: bool
    root_residual_m: float


class JointGraph:
    """The functional joints between all groups of a take."""

    def __init__(self, groups: Sequence[MovingGroup]) -> None:
        self.groups = groups
        self._joints: dict[tuple[int, int], FunctionalJoint] = {}
        for a, b in combinations(range(len(groups)), 2):
            joint = estimate_functional_joint(groups[a], groups[b])
            if joint and joint.residual_m <= MAX_JOINT_RESIDUAL_M and joint.range_rad >= MIN_JOINT_RANGE_RAD:
                self._joints[a, b] = joint
                self._joints[b, a] = joint._replace(places=joint.places[::-1])

    def get_joint(self, first: int, second: int) -> FunctionalJoint | None:
        """Return the joint between two groups, with the place in the first one first; None if they have none."""
        return self._joints.get((first, second))

    def list_neighbours(self, group: int) -> list[int]:
        """Return the groups that have a joint with a group."""
        return [b for a, b in self._joints if a == group]


def find_limbs(groups: Sequence[MovingGroup], floor_m: float) -> list[LimbChain]:
    """Return the limbs of one person among rigid groups, none where it is uncertain which groups they are.

    floor_m  height of the lowest marker of the take
    """
    graph = JointGraph(groups)
    limbs: list[LimbChain] = []
    for kind in ("leg", "arm"):
        chains = [
            chain
            for root, upper, lower in permutations(range(len(groups)), 3)
            if graph.get_joint(root, upper) and graph.get_joint(upper, lower)
            for chain in _complete_chain(graph, kind, (root, upper, lower), floor_m)
        ]
        limbs += _select_pair(groups, chains)
    used = [g for limb in limbs for g in limb.groups[1:]]
    return limbs if len(used) == len(set(used)) and _face_one_way(groups, limbs) else []


def _complete_chain(graph: JointGraph, kind: LimbKind, chain: tuple[int, int, int], floor_m: float) -> list[LimbChain]:
    """Return the limb that a chain of three groups and the best of the groups at its end form; none if it is no limb."""
    lower = chain[2]
    ends = [g for g in graph.list_neighbours(lower) if g not in chain]
    found = [limb for end in ends if (limb := _build_limb(graph, kind, (*chain, end), floor_m))]
    return sorted(found, key=lambda limb: _get_joint(graph, lower, limb.groups[3]).residual_m)[:1]


def _get_joint(graph: JointGraph, first: int, second: int) -> FunctionalJoint:
    joint = graph.get_joint(first, second)
    assert joint is not None
    return joint


def _build_limb(graph: JointGraph, kind: LimbKind, chain: tuple[int, int, int, int], floor_m: float) -> LimbChain | None:
    root, upper, lower, end = (graph.groups[g] for g in chain)
    joints = [_get_joint(graph, a, b) for a, b in pairwise(chain)]
    places = np.stack([joint.places for joint in joints])
    if _has_competitor(graph, chain, places):
        return None
    upper_length = float(np.linalg.norm(places[0, 1] - places[1, 0]))
    lower_length = float(np.linalg.norm(places[1, 1] - places[2, 0]))
    proportions = LIMB_PROPORTIONS[kind]
    lengths = zip((upper_length, lower_length, upper_length + lower_length), proportions, strict=True)
    if not all(low <= length <= high for length, (low, high) in lengths):
        return None
    is_known = root.is_known & upper.is_known & lower.is_known & end.is_known
    first, middle = upper.move(places[0, 1])[is_known], upper.move(places[1, 0])[is_known]
    last = lower.move(places[2, 0])[is_known]
    bones = (middle - first) / upper_length, (last - middle) / lower_length
    if not is_known.any() or -bones[0][:, 1].mean() < MIN_UPRIGHT_COSINE:
        return None
    low_height = float(np.quantile(last[:, 1], LOW_FRAME_QUANTILE))
    reach = float((first - last)[:, 1].mean()) / (upper_length + lower_length)
    if kind == "leg" and (low_height - floor_m > MAX_ANKLE_HEIGHT_M or reach < MIN_LEG_REACH):
        return None
    if kind == "arm" and low_height < MIN_WRIST_HEIGHT_M:
        return None
    bend = np.cross(*bones)
    is_bent = np.linalg.norm(bend, axis=1) >= np.sin(MIN_BEND_RAD)
    if is_bent.mean() < MIN_BENT_SHARE:
        return None
    rotations = [group.rotation[is_known][is_bent] for group in (root, upper, lower)]
    axes = [_average_direction(rotation, bend[is_bent]) for rotation in rotations]
    bent_to_left = axes[0] * (1 if kind == "leg" else -1)  # knees bend backwards, elbows forwards
    forward = end.move(_find_toe(end, places[2, 1]))[is_known] - last if kind == "leg" else last - first
    ahead = _average_direction(root.rotation[is_known], np.cross([0.0, 1.0, 0.0], forward * [1, 0, 1]))
    if min(np.linalg.norm(axes[1]), np.linalg.norm(axes[2])) < MIN_BEND_AGREEMENT:
        return None
    if _normalise(bent_to_left) @ _normalise(ahead) < MIN_SIDE_AGREEMENT:
        return None
    left = _normalise(_normalise(bent_to_left) + _normalise(ahead))
    side = float((places[0, 0] - root.centroid) @ left)
    distance = float(np.linalg.norm(places[0, 0] - root.centroid))
    below = float((root.move(root.centroid)[is_known] - first)[:, 1].mean())
    if abs(side) < MIN_SIDE_DISTANCE_M or distance > MAX_ROOT_DISTANCE_M or (kind == "leg" and below < 0):
        return None
    if _is_scattered(upper, places[0, 1], places[1, 0]) or _is_scattered(lower, places[1, 1], places[2, 0]):
        return None
    bend_axes = np.stack([_normalise(axis) for axis in axes[1:]])
    return LimbChain(kind, chain, places, bend_axes, left, side > 0, joints[0].residual_m)


def _is_scattered(group: MovingGroup, start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"]) -> bool:
    """Return whether a marker of a group is too far from the bone from `start` to `end` to be on its segment."""
    share = np.clip((group.places - start) @ (end - start) / ((end - start) @ (end - start)), 0, 1)
    return bool((np.linalg.norm(group.places - start - share[:, None] * (end - start), axis=1) > MAX_BONE_DISTANCE_M).any())


def _find_toe(foot: MovingGroup, ankle: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Return the place of the marker of a foot that is farthest from its ankle."""
    return foot.places[int(np.linalg.norm(foot.places - ankle, axis=1).argmax())]


def _has_competitor(graph: JointGraph, chain: tuple[int, int, int, int], places: np.ndarray) -> bool:
    """Return whether another group fits the place of the upper segment about as well.

    It has the same joint with the lower one, or it is also between that and the group that carries the limb.
    """
    for other in set(graph.list_neighbours(chain[2])) - set(chain):
        joint = _get_joint(graph, chain[2], other)
        is_between = graph.get_joint(chain[0], other) is not None
        is_near = np.linalg.norm(joint.places[0] - places[1, 1]) < MAX_SAME_JOINT_DISTANCE_M
        if (is_near or is_between) and joint.residual_m < MIN_COMPETING_RATIO * _get_joint(graph, chain[1], chain[2]).residual_m:
            return True
    return False


def _select_pair(groups: Sequence[MovingGroup], chains: Sequence[LimbChain]) -> list[LimbChain]:
    """Return one limb, or a left and a right one on the same group; none if more chains are possible."""
    chains = [chain for chain in chains if not any(_is_better_root(groups, other, chain) for other in chains)]
    if len(chains) == 1:
        return list(chains)
    if len(chains) != 2 or chains[0].groups[0] != chains[1].groups[0] or chains[0].is_left == chains[1].is_left:
        return []
    distance = float(np.linalg.norm(chains[0].places[0, 0] - chains[1].places[0, 0]))
    low, high = MIN_HIP_DISTANCE_M, MAX_HIP_DISTANCE_M
    if chains[0].kind == "arm":
        low, high = MIN_SHOULDER_DISTANCE_M, MAX_SHOULDER_DISTANCE_M
    return list(chains) if low <= distance <= high and not set(chains[0].groups[1:]) & set(chains[1].groups[1:]) else []


def _is_better_root(groups: Sequence[MovingGroup], one: LimbChain, other: LimbChain) -> bool:
    """Return whether the same limb is better carried by another group: it is nearer and its joint more precise."""
    if one.groups[1:3] != other.groups[1:3] or one.groups[0] == other.groups[0]:
        return False
    distances = [np.linalg.norm(chain.places[0, 0] - groups[chain.groups[0]].centroid) for chain in (one, other)]
    return bool(distances[0] < distances[1]) and one.root_residual_m < other.root_residual_m


def _face_one_way(groups: Sequence[MovingGroup], limbs: Sequence[LimbChain]) -> bool:
    """Return whether all limbs agree about the person's left side."""
    for a, b in combinations(limbs, 2):
        first, second = groups[a.groups[0]], groups[b.groups[0]]
        cosine = np.einsum("ta,ta->t", first.rotation @ a.left, second.rotation @ b.left)
        is_known = first.is_known & second.is_known
        if not is_known.any() or cosine[is_known].mean() < MIN_SIDE_AGREEMENT:
            return False
    return True


def _average_direction(rotation: Float[np.ndarray, "N 3 3"], direction: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "3"]:
    """Return the mean of world directions in moving axes; its length is 1 if they are all the same."""
    length = np.linalg.norm(direction, axis=1)
    unit = direction[length > 0] / length[length > 0, None]
    return np.einsum("tba,tb->ta", rotation[length > 0], unit).mean(0)


def _normalise(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    return vector / max(float(np.linalg.norm(vector)), 1e-9)
