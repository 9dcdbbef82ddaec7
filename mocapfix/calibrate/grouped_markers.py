"""An initial marker set for markers without informative labels, from their rigid groups and the joints between these.

The legs among the groups show which segments they are (`leg_chains`). Each segment gets axes from its joints and from the axis
about which the knee bends, so that its markers have places on the average body.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mocapfix.calibrate.leg_chains import LegChain, find_legs
from mocapfix.marker_set import MarkerSet
from mocapfix.skeleton import Skeleton
from mocapfix.stats.functional_joints import MovingGroup, build_moving_group
from mocapfix.stats.rigid_groups import group_rigid_markers, measure_distance_spread
from mocapfix.stats.sequences import sample_evenly
from mocapfix.take import Take

MAX_SEGMENT_SPREAD_M = 0.008
"""Variation of the distances between the markers of one segment, as a standard deviation; skin moves less."""
MAX_FUNCTIONAL_FRAMES = 200
"""Evenly spread frames in which joints between groups are estimated."""
GROUPED_MARKER_SPREAD_M = 0.04
"""Spread of a marker about the place that its group gives it on the average body."""
FLAT_FOOT_QUANTILE = 0.3
"""Share of the frames in which a foot is lowest, and flat on the floor."""
LEG_CHAIN_JOINT_NAMES = ("UpLeg", "Leg", "Foot")
TO_THE_LEFT = np.array([1.0, 0.0, 0.0])
"""In the rest pose."""


class SegmentAxes(NamedTuple):
    """A group as a segment: its joint, and how places in the group's axes become offsets in those of the joint.

    joint     index of the joint
    rotation  (3, 3) from the group's axes to those of the joint
    origin    (3,) m: the joint in the group's axes
    """

    group: MovingGroup
    joint: int
    rotation: Float[np.ndarray, "3 3"]
    origin: Float[np.ndarray, "3"]


def guess_from_rigid_groups(take: Take, labels: tuple[str, ...], skeleton: Skeleton) -> MarkerSet | None:
    """Return a set of the markers on the legs that rigid groups form, under the names `labels`; None if they form no leg."""
    markers = take.markers[sample_evenly(take.frame_count, MAX_FUNCTIONAL_FRAMES)]
    found = group_rigid_markers(measure_distance_spread(take.markers), MAX_SEGMENT_SPREAD_M)
    groups = [build_moving_group(markers, group.markers) for group in found]
    legs = find_legs(groups, float(np.nanmin(markers[..., 1], initial=np.inf)))
    if not legs:
        return None
    size = measure_leg_size(legs, skeleton)
    segments = [build_pelvis_segment(legs, groups[legs[0].groups[0]], skeleton, size)]
    segments += [segment for leg in legs for segment in build_leg_segments(leg, groups, skeleton)]
    return build_grouped_marker_set(segments, labels, size)


def measure_leg_size(legs: list[LegChain], skeleton: Skeleton) -> float:
    """Return the size of a person relative to the average body, from the lengths of the legs."""
    bones = [leg.places[k, 1] - leg.places[k + 1, 0] for leg in legs for k in range(2)]
    average = [skeleton.offsets[joint] for leg in legs for joint in get_leg_joints(leg, skeleton)[1:]]
    return float(np.linalg.norm(bones, axis=1).sum() / np.linalg.norm(average, axis=1).sum())


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


def build_grouped_marker_set(segments: list[SegmentAxes], labels: tuple[str, ...], size: float) -> MarkerSet:
    """Return the markers of the segments as a marker set on the average body."""
    names = tuple(labels[m] for segment in segments for m in segment.group.markers)
    joints = np.array([segment.joint for segment in segments for _ in segment.group.markers])
    offsets = [(segment.group.places - segment.origin) @ segment.rotation.T / size for segment in segments]
    spread, aliases = np.full(len(names), GROUPED_MARKER_SPREAD_M), ((),) * len(names)
    return MarkerSet("guess", "guess", "cmu31", names, joints, np.concatenate(offsets), spread, aliases)
