"""An initial marker set for markers without informative labels: from their rigid groups and the joints between these, or bodies
that are fitted to the cloud that the markers form.

A functional joint is the point that is fixed in two rigid groups while both move: a place in the axes of each group such that
both are at the same point in all frames (Ehrig et al. 2006, "A survey of formal methods for determining the centre of rotation
of ball joints"). A hinge fixes it only across its axis; along it, it is the point nearest to both groups.

A chain of pelvis, thigh, shank and foot is a leg if the lengths between its joints, their order in height, and the direction in
which the knee bends are those of a leg. Left and right follow from this direction, which must agree with that of the foot.
Where two groups fit the same place of a chain, there is no leg. Each segment gets axes from its joints and from the axis about
which the knee bends, so that its markers have places on the average body.

Frames in which the cloud is tall show a standing person. The average body, with the markers of one shipped set, is placed there
in many headings, with raised, half raised and hanging arms. Markers are assigned one-to-one to the nearest marker positions of
the body, and the body is solved with this assignment, in turns (iterative closest points; Besl & McKay 1992). The best bodies
are then tested on more frames, in all of which the assignment must hold: a body that faces backwards or has an arm assigned to a
leg fails there.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise, permutations
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float

from mocapfix.errors import TakeError
from mocapfix.model.marker_set import MarkerSet
from mocapfix.model.skeleton import Skeleton, load_cmu31_body
from mocapfix.model.take import Take
from mocapfix.solve import kinematics
from mocapfix.solve.mean_pose import load_mean_pose_prior
from mocapfix.stats.marker_distances import find_rigid_groups, measure_distance_spread
from mocapfix.stats.rigid_alignment import align_to_shape, fit_common_shape
from mocapfix.stats.sequences import assign_points, sample_evenly
from mocapfix.subject import refinement
from mocapfix.subject.average_body import PosedBody, build_average_subject, build_posed_body
from mocapfix.subject.calibration import scale_average_subject, select_candidate_frames
from mocapfix.subject.library import load_marker_set

JOINT_SAMPLE_SD_M = 0.01  # distance between the two places in one frame by which a fit is weighted: markers move with the skin
JOINT_PRIOR_SD_M = 0.2  # per axis of a joint about the point between its groups; it matters along a hinge's axis
INDEPENDENT_JOINT_POSES = 20.0  # effective number of independent frames of a take
MIN_FUNCTIONAL_JOINT_FRAMES = 30  # with the poses of both groups, or a third of the frames of a short take


class MovingGroup(NamedTuple):
    """The poses of a rigid group of markers in N frames."""

    markers: tuple[int, ...]  # their indices
    rotation: Float[np.ndarray, "N 3 3"]  # of the group's axes in the world
    origin: Float[np.ndarray, "N 3"]  # m
    places: Float[np.ndarray, "K 3"]  # m: mean places of the markers in these axes
    is_known: Bool[np.ndarray, " N"]  # whether a frame shows enough of the markers

    @property
    def centroid(self) -> Float[np.ndarray, "3"]:
        return self.places.mean(0)

    def move(self, place: Float[np.ndarray, "3"]) -> Float[np.ndarray, "N 3"]:
        """Return a place in the group's axes in the world."""
        return self.rotation @ place + self.origin


class FunctionalJoint(NamedTuple):
    """The joint between two groups."""

    places: Float[np.ndarray, "2 3"]  # m: in the axes of the first and of the second group
    residual_m: float  # root mean square distance between the two in a frame
    range_rad: float  # root mean square angle by which the groups turn against each other


def build_moving_group(markers: Float[np.ndarray, "N M 3"], columns: tuple[int, ...]) -> MovingGroup:
    """Return the poses of some markers, in metres, that keep their distances; without those that no such frame shows."""
    grouped = markers[:, list(columns)]
    rotation, origin, is_known = align_to_shape(grouped, ~np.isnan(grouped[..., 0]), fit_common_shape(grouped))
    shown = [m for m in columns if not np.isnan(markers[is_known, m, 0]).all()]
    local = np.einsum("tba,tkb->tka", rotation[is_known], markers[is_known][:, shown] - origin[is_known, None])
    return MovingGroup(tuple(shown), rotation, origin, np.nanmean(local, axis=0), is_known)


def estimate_functional_joint(first: MovingGroup, second: MovingGroup) -> FunctionalJoint | None:
    """Return the joint between two groups, None if too few frames show both."""
    is_known = first.is_known & second.is_known
    count = int(is_known.sum())
    if count < min(MIN_FUNCTIONAL_JOINT_FRAMES, len(is_known) // 3 + 2):
        return None
    a, b = first.rotation[is_known], second.rotation[is_known]
    between = (first.move(first.centroid) + second.move(second.centroid))[is_known] / 2
    sides = ((first.origin[is_known], a), (second.origin[is_known], b))
    prior = np.concatenate([np.einsum("tba,tb->ta", rotation, between - origin).mean(0) for origin, rotation in sides])
    design = np.concatenate([a, -b], axis=2).reshape(-1, 6)
    gap = (second.origin - first.origin)[is_known].ravel()
    precision = INDEPENDENT_JOINT_POSES / count / JOINT_SAMPLE_SD_M**2
    normal = precision * design.T @ design + np.eye(6) / JOINT_PRIOR_SD_M**2
    places = prior + np.linalg.solve(normal, precision * design.T @ (gap - design @ prior))
    residual = (design @ places - gap).reshape(-1, 3)
    relative = scipy.spatial.transform.Rotation.from_matrix(np.swapaxes(a, 1, 2) @ b)
    angles = (relative.mean().inv() * relative).magnitude()
    return FunctionalJoint(places.reshape(2, 3), float(np.sqrt((residual**2).sum(1).mean())), float(np.sqrt((angles**2).mean())))


MAX_JOINT_RESIDUAL_M = 0.025  # root mean square distance between the two places of a joint
MAX_KNEE_RESIDUAL_RATIO = 2.5  # to the larger one of hip and ankle; with the other leg's shank it is larger
MIN_JOINT_RANGE_RAD = 0.08  # rms angle by which two groups turn against each other; on one segment they turn less
MIN_COMPETING_RATIO = 2.0  # ratio of residuals below which another group at the same joint competes for its place
MAX_SAME_JOINT_DISTANCE_M = 0.12  # distance between joints on one group below which they are the same
MIN_ORDER_DISTANCE_M = 0.08  # difference of the distances from the knee by which the foot is farther than the shank
MIN_BONE_LENGTH_M, MAX_BONE_LENGTH_M = 0.28, 0.56  # of a thigh or shank, of people of 1.3 to 2.1 m
MIN_LEG_LENGTH_M = 0.62  # length of both together; an arm has less
MIN_BEND_RAD = 0.26  # angle of the knee from which a frame shows the direction in which it bends
MIN_BENT_SHARE = 0.1  # share of the frames that must show it
MIN_BEND_AGREEMENT = 0.7  # length of the mean direction of bending; 1 if it is the same in all frames
MIN_SIDE_AGREEMENT = 0.5  # cosine between two directions to the left, from different evidence, that agree
MIN_THIGH_COSINE = 0.6  # mean cosine between thigh and vertical; less does not show which end is the upper one
MIN_LEG_REACH = 0.5  # mean height of the hip above the ankle, relative to the length of the leg; a runner bends the knees
MIN_SIDE_DISTANCE_M, MAX_SIDE_DISTANCE_M = 0.03, 0.16  # distance of a hip from the middle of the group on the pelvis, to its side
MIN_SINGLE_SIDE_DISTANCE_M = 0.05  # the same where only one leg is found: nothing else shows which one it is
MAX_HIP_OFFSET_M = 0.35  # distance of a hip from the middle of the group on the pelvis
MAX_PELVIS_HEIGHT_M = 0.2  # height of the middle of the group on the pelvis above the hips; that of the thorax is higher
MIN_HIP_DISTANCE_M, MAX_HIP_DISTANCE_M = 0.08, 0.35  # distance between the hips
MAX_BONE_DISTANCE_M = 0.2  # distance of a marker from the bone of its segment; wands are this long
MAX_ANKLE_HEIGHT_M = 0.3  # above the lowest marker of the take, in the tenth of the frames in which it is lowest
LOW_FRAME_QUANTILE = 0.1  # these frames, as a quantile of the height


@dataclass(frozen=True)
class LegChain:
    """A leg."""

    groups: tuple[int, int, int, int]  # indices of the groups on pelvis, thigh, shank and foot
    places: Float[np.ndarray, "3 2 3"]  # m: hip, knee and ankle, each in the axes of the two groups that it joins
    bend_axes: Float[np.ndarray, "2 3"]  # the direction to the left about which the knee bends, in the axes of thigh and shank
    left: Float[np.ndarray, "3"]  # the direction to the person's left in the axes of the pelvis
    is_left: bool  # whether it is the left leg
    hip_residual_m: float  # residual of the hip


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

    def has_joint(self, first: int, second: int) -> bool:
        return (first, second) in self._joints

    def get_joint(self, first: int, second: int) -> FunctionalJoint:
        """Return the joint between two groups, with the place in the first one first."""
        return self._joints[first, second]

    def list_neighbours(self, group: int) -> list[int]:
        return [b for a, b in self._joints if a == group]


def _complete_chain(graph: JointGraph, chain: tuple[int, int, int], floor_m: float) -> LegChain | None:
    """Return the leg that a chain of three groups and the best of the groups at its end form; None if it is no leg."""
    shank = chain[2]
    feet = [group for group in graph.list_neighbours(shank) if group not in chain]
    found = [leg for foot in feet if (leg := _build_leg(graph, (*chain, foot), floor_m))]
    return min(found, key=lambda leg: graph.get_joint(shank, leg.groups[3]).residual_m, default=None)


def _build_leg(graph: JointGraph, chain: tuple[int, int, int, int], floor_m: float) -> LegChain | None:
    """Return the leg that a chain of four groups forms, None if it is no leg."""
    pelvis, thigh, shank, foot = (graph.groups[group] for group in chain)
    joints = [graph.get_joint(a, b) for a, b in pairwise(chain)]
    places = np.stack([joint.places for joint in joints])
    lengths = [float(np.linalg.norm(places[k, 1] - places[k + 1, 0])) for k in range(2)]
    is_known = pelvis.is_known & thigh.is_known & shank.is_known & foot.is_known
    has_lengths = all(MIN_BONE_LENGTH_M <= length <= MAX_BONE_LENGTH_M for length in lengths) and sum(lengths) >= MIN_LEG_LENGTH_M
    is_implausible = _is_scattered(thigh, places[0, 1], places[1, 0]) or _is_scattered(shank, places[1, 1], places[2, 0])
    other_residual_m = max(joints[0].residual_m, joints[2].residual_m)
    is_implausible |= joints[1].residual_m > MAX_KNEE_RESIDUAL_RATIO * other_residual_m
    if not has_lengths or is_implausible or not is_known.any() or _has_competitor(graph, chain, places):
        return None
    hip, knee = thigh.move(places[0, 1])[is_known], thigh.move(places[1, 0])[is_known]
    ankle = shank.move(places[2, 0])[is_known]
    bones = (knee - hip) / lengths[0], (ankle - knee) / lengths[1]
    is_upright = -bones[0][:, 1].mean() >= MIN_THIGH_COSINE and (hip - ankle)[:, 1].mean() >= MIN_LEG_REACH * sum(lengths)
    if not is_upright or np.quantile(ankle[:, 1], LOW_FRAME_QUANTILE) - floor_m > MAX_ANKLE_HEIGHT_M:
        return None
    bend = np.cross(*bones)  # to the left, since knees bend backwards
    is_bent = np.linalg.norm(bend, axis=1) >= np.sin(MIN_BEND_RAD)
    if is_bent.mean() < MIN_BENT_SHARE:
        return None
    axes = [_average_direction(group.rotation[is_known][is_bent], bend[is_bent]) for group in (pelvis, thigh, shank)]
    toe = foot.move(_find_toe(foot, places[2, 1]))[is_known]
    across_foot = _average_direction(pelvis.rotation[is_known], np.cross([0.0, 1.0, 0.0], toe - ankle))
    if min(np.linalg.norm(axes[1]), np.linalg.norm(axes[2])) < MIN_BEND_AGREEMENT:
        return None
    if _normalise(axes[0]) @ _normalise(across_foot) < MIN_SIDE_AGREEMENT:
        return None
    left, hip_offset = _normalise(_normalise(axes[0]) + _normalise(across_foot)), places[0, 0] - pelvis.centroid
    height = float((pelvis.move(pelvis.centroid)[is_known] - hip)[:, 1].mean())
    if not MIN_SIDE_DISTANCE_M <= abs(hip_offset @ left) <= MAX_SIDE_DISTANCE_M or np.linalg.norm(hip_offset) > MAX_HIP_OFFSET_M:
        return None
    middle, across = pelvis.move(pelvis.centroid), pelvis.rotation @ left
    centroids = np.stack([group.move(group.centroid) for group in (thigh, shank, foot)])
    sides = np.einsum("gta,ta->gt", centroids - middle, across)[:, is_known].mean(1)
    if not 0 <= height <= MAX_PELVIS_HEIGHT_M or (sides * (hip_offset @ left) < 0).any():
        return None
    bend_axes = np.stack([_normalise(axis) for axis in axes[1:]])
    return LegChain(chain, places, bend_axes, left, bool(hip_offset @ left > 0), joints[0].residual_m)


def _is_scattered(group: MovingGroup, start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"]) -> bool:
    """Return whether a marker of a group is too far from the bone from `start` to `end` to be on its segment."""
    share = np.clip((group.places - start) @ (end - start) / ((end - start) @ (end - start)), 0, 1)
    return bool((np.linalg.norm(group.places - start - share[:, None] * (end - start), axis=1) > MAX_BONE_DISTANCE_M).any())


def _find_toe(foot: MovingGroup, ankle: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Return the place of the marker of a foot that is farthest from its ankle."""
    return foot.places[int(np.linalg.norm(foot.places - ankle, axis=1).argmax())]


def _has_competitor(graph: JointGraph, chain: tuple[int, int, int, int], places: Float[np.ndarray, "3 2 3"]) -> bool:
    """Return whether another group fits the place of the thigh about as well, or the foot that of the shank.

    Another group is a possible thigh if it has the same joint with the shank, or joints with both shank and pelvis. Where thigh
    and foot have a joint too, the foot must be farther from the knee.
    """
    pelvis, thigh, shank, foot = chain
    max_residual = MIN_COMPETING_RATIO * graph.get_joint(thigh, shank).residual_m
    if graph.has_joint(thigh, foot) and graph.get_joint(thigh, foot).residual_m < max_residual:
        knee = graph.groups[thigh].move(places[1, 0])
        near, far = (
            np.nanmean(np.linalg.norm(group.move(group.centroid) - knee, axis=1))
            for group in (graph.groups[shank], graph.groups[foot])
        )
        if not far - near >= MIN_ORDER_DISTANCE_M:
            return True
    for other in set(graph.list_neighbours(shank)) - set(chain):
        joint = graph.get_joint(shank, other)
        is_near = bool(np.linalg.norm(joint.places[0] - places[1, 1]) < MAX_SAME_JOINT_DISTANCE_M)
        if (is_near or graph.has_joint(pelvis, other)) and joint.residual_m < max_residual:
            return True
    return False


def _select_pair(groups: Sequence[MovingGroup], chains: list[LegChain]) -> list[LegChain]:
    """Return one leg, or a left and a right one on the same pelvis; none if more chains are possible."""
    chains = [chain for chain in chains if not any(_has_better_pelvis(groups, other, chain) for other in chains)]
    if len(chains) == 1:
        return chains if _is_single_leg(groups, chains[0]) else []
    if len(chains) != 2:
        return []
    one, other = chains
    if one.groups[0] != other.groups[0] or one.is_left == other.is_left or set(one.groups[1:]) & set(other.groups[1:]):
        return []
    distance = float(np.linalg.norm(one.places[0, 0] - other.places[0, 0]))
    is_possible = MIN_HIP_DISTANCE_M <= distance <= MAX_HIP_DISTANCE_M
    return chains if is_possible and one.left @ other.left >= MIN_SIDE_AGREEMENT else []


def _is_single_leg(groups: Sequence[MovingGroup], leg: LegChain) -> bool:
    """Return whether a leg is clearly on one side and no other group is below its hip: of two legs, both must be found."""
    pelvis = groups[leg.groups[0]]
    heights = [float(group.move(group.centroid)[group.is_known, 1].mean()) for group in groups]
    hip_height = float(pelvis.move(leg.places[0, 0])[pelvis.is_known, 1].mean())
    has_others = any(height < hip_height for g, height in enumerate(heights) if g not in leg.groups)
    side = float((leg.places[0, 0] - pelvis.centroid) @ leg.left)
    return not has_others and abs(side) >= MIN_SINGLE_SIDE_DISTANCE_M


def _has_better_pelvis(groups: Sequence[MovingGroup], one: LegChain, other: LegChain) -> bool:
    """Return whether the first of two chains has the same leg on another group that is nearer and has a more precise hip."""
    if one.groups[1:3] != other.groups[1:3] or one.groups[0] == other.groups[0]:
        return False
    near, far = (np.linalg.norm(chain.places[0, 0] - groups[chain.groups[0]].centroid) for chain in (one, other))
    return bool(near < far) and one.hip_residual_m < other.hip_residual_m


def _average_direction(rotation: Float[np.ndarray, "N 3 3"], direction: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "3"]:
    """Return the mean of world directions in moving axes; its length is 1 if they are all the same."""
    length = np.linalg.norm(direction, axis=1)
    unit = direction[length > 0] / length[length > 0, None]
    return np.einsum("tba,tb->ta", rotation[length > 0], unit).mean(0)


def _normalise(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    return vector / max(float(np.linalg.norm(vector)), 1e-9)


MAX_SEGMENT_SPREAD_M = 0.008  # of the distances between the markers of one segment (sd); skin moves less
MAX_FUNCTIONAL_FRAMES = 200  # evenly spread frames in which joints between groups are estimated
GROUPED_MARKER_SPREAD_M = 0.04  # spread of a marker about the place that its group gives it on the average body
FLAT_FOOT_QUANTILE = 0.3  # share of the frames in which a foot is lowest, and flat on the floor
LEG_CHAIN_JOINT_NAMES = ("UpLeg", "Leg", "Foot")
TO_THE_LEFT = np.array([1.0, 0.0, 0.0])  # in the rest pose


class SegmentAxes(NamedTuple):
    """A group as a segment: its joint, and how places in the group's axes become offsets in those of the joint."""

    group: MovingGroup
    joint: int  # index of the joint
    rotation: Float[np.ndarray, "3 3"]  # from the group's axes to those of the joint
    origin: Float[np.ndarray, "3"]  # m: the joint in the group's axes


def guess_from_rigid_groups(take: Take, labels: tuple[str, ...], skeleton: Skeleton) -> MarkerSet | None:
    """Return a set of the markers on the legs that rigid groups form, under the names `labels`; None if they form no leg."""
    markers = take.markers[sample_evenly(take.frame_count, MAX_FUNCTIONAL_FRAMES)]
    found = find_rigid_groups(measure_distance_spread(take.markers), MAX_SEGMENT_SPREAD_M)
    groups = [build_moving_group(markers, group.markers) for group in found]
    graph, floor_m = JointGraph(groups), float(np.nanmin(markers[..., 1], initial=np.inf))
    chains = [
        _complete_chain(graph, (pelvis, thigh, shank), floor_m)
        for pelvis, thigh, shank in permutations(range(len(groups)), 3)
        if graph.has_joint(pelvis, thigh) and graph.has_joint(thigh, shank)
    ]
    legs = _select_pair(groups, [chain for chain in chains if chain])
    if not legs:
        return None
    bones = [leg.places[k, 1] - leg.places[k + 1, 0] for leg in legs for k in range(2)]
    average = [skeleton.offsets[joint] for leg in legs for joint in get_leg_joints(leg, skeleton)[1:]]
    size = float(np.linalg.norm(bones, axis=1).sum() / np.linalg.norm(average, axis=1).sum())
    segments = [build_pelvis_segment(legs, groups[legs[0].groups[0]], skeleton, size)]
    segments += [segment for leg in legs for segment in build_leg_segments(leg, groups, skeleton)]
    names = tuple(labels[m] for segment in segments for m in segment.group.markers)
    joints = np.array([segment.joint for segment in segments for _ in segment.group.markers])
    offsets = [(segment.group.places - segment.origin) @ segment.rotation.T / size for segment in segments]
    spread, aliases = np.full(len(names), GROUPED_MARKER_SPREAD_M), ((),) * len(names)
    return MarkerSet("guess", "guess", "cmu31", names, joints, np.concatenate(offsets), spread, aliases)


def get_leg_joints(leg: LegChain, skeleton: Skeleton) -> list[int]:
    """Return hip, knee and ankle."""
    return [skeleton.find_joint(("Left" if leg.is_left else "Right") + name) for name in LEG_CHAIN_JOINT_NAMES]


def build_leg_segments(leg: LegChain, groups: list[MovingGroup], skeleton: Skeleton) -> list[SegmentAxes]:
    """Return thigh, shank and foot."""
    joints = get_leg_joints(leg, skeleton)
    thigh, shank, foot = (groups[group] for group in leg.groups[1:])
    rotations = [
        build_axes(-skeleton.offsets[joints[k + 1]], TO_THE_LEFT) @ build_axes(leg.places[k, 1] - leg.places[k + 1, 0], axis).T
        for k, axis in enumerate(leg.bend_axes)
    ]
    is_known = shank.is_known & foot.is_known
    height = foot.move(foot.centroid)[:, 1]
    is_flat = is_known & (height <= np.quantile(height[is_known], FLAT_FOOT_QUANTILE))
    left = (np.swapaxes(foot.rotation[is_known], 1, 2) @ shank.rotation[is_known] @ leg.bend_axes[1]).mean(0)
    rotations.append(build_axes(foot.rotation[is_flat][:, 1].mean(0), left).T)
    return [
        SegmentAxes(group, joint, rotation, place)
        for group, joint, rotation, place in zip((thigh, shank, foot), joints, rotations, leg.places[:, 1], strict=True)
    ]


def build_pelvis_segment(legs: list[LegChain], pelvis: MovingGroup, skeleton: Skeleton, size: float) -> SegmentAxes:
    """Return the pelvis, which carries one or two legs."""
    left = legs[0].left
    if len(legs) > 1:  # the line between the hips is more precise
        right_leg, left_leg = sorted(legs, key=lambda leg: leg.is_left)
        left = left_leg.places[0, 0] - right_leg.places[0, 0]
    up = pelvis.rotation[pelvis.is_known][:, 1].mean(0)
    rotation = build_axes(up - (up @ left) / (left @ left) * left, left).T
    rest = skeleton.rest_positions
    origins = [leg.places[0, 0] - rotation.T @ rest[get_leg_joints(leg, skeleton)[0]] * size for leg in legs]
    return SegmentAxes(pelvis, 0, rotation, np.mean(origins, axis=0))


def build_axes(up: Float[np.ndarray, "3"], side: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return axes as columns: X to the side, perpendicular to Y, Y up, Z forward."""
    y = up / np.linalg.norm(up)
    x = side - (side @ y) * y
    x /= np.linalg.norm(x)
    return np.stack([x, y, np.cross(x, y)], axis=1)


# Shipped sets of whole bodies, one after the other placed in the cloud; others resemble one of them.
FITTED_SET_NAMES = (
    "cmu41", "frontwaist53", "production57", "plug-in-gait39", "optitrack-baseline41", "optitrack-core50", "qualisys-animation",
    "qualisys-sports",
)  # fmt: skip
BODY_HEADING_COUNT = 16  # headings in which a body is placed
GUESSED_MARKER_SPREAD_M = 0.05  # spread of a marker about its guessed offset
MIN_CLOUD_MARKERS = 20  # markers visible in one frame; fewer fit a body in many ways
HEIGHT_QUANTILES = (0.5, 0.8, 1.0)  # of the cloud, of the frames that are fitted; the tallest have raised arms
MATCHING_ROUNDS = 20  # rounds of assignment and solve
BODY_SCREENING_ROUNDS = 6  # rounds after which only the best bodies are continued
CONTINUED_BODIES = 12  # number of these bodies
MATCHING_ITERATIONS = 5  # solver iterations of a round
MATCHING_GATES_M = (0.4, 0.15)  # largest distance of an assigned marker in the first and in the last round
MATCHING_MARKER_SD_M = 0.04  # standard deviation of a person's markers about those of the average body
MAX_TRIED_BODIES = 9  # best bodies that are tested on more frames
MAX_TRIAL_FRAMES = 60  # frames they are tested on
TRIAL_ROUNDS = 6  # rounds of assignment and solve in this test


class MarkerAssignment(NamedTuple):
    """Assigned markers of a set, -1 for none, and the mean misfit in metres; both for one body or for H bodies."""

    indices: np.ndarray
    misfit_m: np.ndarray


def guess_from_marker_cloud(take: Take, labels: tuple[str, ...]) -> MarkerSet:
    """Return a set of those markers of the take for which the body has a position, under the names `labels`."""
    candidates = select_candidate_frames(take.markers)
    trial = take.markers[candidates[sample_evenly(len(candidates), MAX_TRIAL_FRAMES)]]
    if (~np.isnan(trial[..., 0])).sum(1).max(initial=0) < MIN_CLOUD_MARKERS:
        raise TakeError(f"{take.name}: shows fewer than {MIN_CLOUD_MARKERS} markers at once; name a similar known set (--like).")
    mean_height = np.nanmean(trial[..., 1], axis=1, keepdims=True)
    height = np.ptp(np.where(np.isnan(trial[..., 1]), mean_height, trial[..., 1]), axis=1)
    standing = np.argsort(height)[[round(quantile * (len(height) - 1)) for quantile in HEIGHT_QUANTILES]]
    hypotheses: list[tuple[float, np.ndarray, MarkerSet]] = []
    for marker_set in map(load_marker_set, FITTED_SET_NAMES):
        average = build_posed_body(build_average_subject(marker_set))
        for frame in standing:
            fits = fit_bodies_to_markers(trial[frame], average.fit_height(float(height[frame])))
            hypotheses += [
                (float(misfit), indices, marker_set) for indices, misfit in zip(fits.indices, fits.misfit_m, strict=True)
            ]
    hypotheses.sort(key=lambda hypothesis: hypothesis[0])
    tested = [(known, refine_assignment(indices, trial, known)) for _, indices, known in hypotheses[:MAX_TRIED_BODIES]]
    known, best = min(tested, key=lambda each: float(each[1].misfit_m))
    return build_guessed_marker_set(best.indices, labels, known)


def fit_bodies_to_markers(markers: Float[np.ndarray, "M 3"], body: PosedBody) -> MarkerAssignment:
    """Return the assignment (H, M) and misfit (H,) of the H best poses of a body fitted to one frame's markers in metres."""
    local_rotations = body.turn_around(BODY_HEADING_COUNT)
    predicted = body.predict((np.zeros((len(local_rotations), 3)), local_rotations))
    root_position = np.nanmedian(markers, axis=0) - np.median(predicted, axis=1)
    root_position[:, 1] = np.nanmin(markers[:, 1]) - predicted[:, :, 1].min(1)
    poses = root_position, local_rotations
    indices, misfit = np.full((len(poses[0]), len(markers)), -1), np.full(len(poses[0]), np.inf)
    for solve_round, gate in enumerate(np.geomspace(*MATCHING_GATES_M, MATCHING_ROUNDS)):
        if solve_round == BODY_SCREENING_ROUNDS:
            best = np.sort(np.argsort(misfit, kind="stable")[:CONTINUED_BODIES])
            poses, indices, misfit = (poses[0][best], poses[1][best]), indices[best], misfit[best]
        predicted = body.predict(poses)
        target = np.full(predicted.shape, np.nan)
        for h, positions in enumerate(predicted):
            indices[h], misfit[h] = assign_nearest(np.linalg.norm(markers[:, None] - positions, axis=-1), float(gate))
            is_assigned = indices[h] >= 0
            target[h, indices[h, is_assigned]] = markers[is_assigned]
        poses = body.solve(poses, target, MATCHING_MARKER_SD_M, (float(gate),), MATCHING_ITERATIONS)
    return MarkerAssignment(indices, misfit)


def assign_nearest(distance: Float[np.ndarray, "M A"], max_distance: float) -> MarkerAssignment:
    """Assign markers one-to-one to the nearest of A positions, given their distances in metres (NaN if not visible).

    Markers farther than about `max_distance` from every free position are not assigned, and count with `max_distance` in the
    mean misfit of the visible markers.
    """
    indices, visible = np.full(len(distance), -1), np.flatnonzero(~np.isnan(distance[:, 0]))
    indices[visible], costs = assign_points(distance[visible], max_distance)
    total = costs.sum() + max_distance * (len(visible) - len(costs))
    return MarkerAssignment(indices, total / max(len(visible), 1))


def refine_assignment(indices: np.ndarray, markers: Float[np.ndarray, "N M 3"], known: MarkerSet) -> MarkerAssignment:
    """Return the assignment that fits all frames, starting from the assignment `indices` (M,) in one frame."""
    body, assignment, gate = load_cmu31_body(), MarkerAssignment(indices, np.array(np.inf)), MATCHING_GATES_M[1]
    prior = load_mean_pose_prior("mean-pose", body.skeleton)
    for _ in range(TRIAL_ROUNDS):
        guess = build_guessed_marker_set(assignment.indices, tuple(map(str, range(len(indices)))), known)
        take = Take(markers[:, [int(label) for label in guess.labels]], guess.labels, 1.0)
        subject = scale_average_subject(take, guess)
        poses = refinement.pose_frames(subject, body, prior, take.markers)
        scaled = build_average_subject(known, subject.skeleton.size_ratio)
        predicted = kinematics.predict_markers(scaled, poses)
        distance = np.full((len(indices), predicted.shape[1]), np.nan)
        for m in np.flatnonzero(~np.isnan(markers[..., 0]).all(0)):
            each = np.linalg.norm(markers[:, m, None] - predicted, axis=-1)
            distance[m] = np.nanmean(np.minimum(each, gate), axis=0)
        assignment = assign_nearest(distance, gate)
    return assignment


def build_guessed_marker_set(indices: np.ndarray, labels: tuple[str, ...], known: MarkerSet) -> MarkerSet:
    """Return the markers (M,) that are assigned to one of a known set as a marker set."""
    assigned = np.flatnonzero(indices >= 0)
    places, spread = indices[assigned], np.full(len(assigned), GUESSED_MARKER_SPREAD_M)
    names, aliases = tuple(labels[m] for m in assigned), ((),) * len(assigned)
    return MarkerSet("guess", "guess", "cmu31", names, known.joints[places], known.marker_offsets[places], spread, aliases)
