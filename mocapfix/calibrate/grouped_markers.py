"""An initial marker set for markers without informative labels, from their rigid groups and the joints between these.

The limbs among the groups show which segments they are (`limb_chains`). Each segment gets axes from its joints and from the axis
about which the knee or elbow bends, so that its markers have places on the average body.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mocapfix.calibrate.limb_chains import LimbChain, find_limbs
from mocapfix.marker_set import MarkerSet
from mocapfix.skeleton import Skeleton
from mocapfix.stats.functional_joints import MovingGroup, build_moving_group
from mocapfix.stats.rigid_groups import group_rigid_markers, measure_distance_spread
from mocapfix.stats.sequences import sample_evenly
from mocapfix.take import Take

MAX_SEGMENT_SPREAD_M = 0.008
"""Variation of the distances between the markers of one segment, as a standard deviation; skin moves less."""
MAX_JOINT_FRAMES = 200
"""Evenly spread frames in which joints between groups are estimated."""
GROUPED_MARKER_SPREAD_M = 0.04
"""Spread of a marker about the place that its group gives it on the average body."""
LOW_FOOT_QUANTILE = 0.3
"""Share of the frames in which a foot is lowest and flat on the floor."""
ROOT_JOINT_NAMES = {"leg": "Hips", "arm": "Spine1"}
LIMB_CHAIN_JOINT_NAMES = {"leg": ("UpLeg", "Leg", "Foot"), "arm": ("Arm", "ForeArm", "Hand")}


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
    """Return a set of the markers on the limbs that rigid groups form, under the names `labels`; None if they form no limb."""
    frames = sample_evenly(take.frame_count, MAX_JOINT_FRAMES)
    markers = take.markers[frames]
    found = group_rigid_markers(measure_distance_spread(take.markers), MAX_SEGMENT_SPREAD_M)
    groups = [build_moving_group(markers, group.markers) for group in found]
    limbs = find_limbs(groups, float(np.nanmin(markers[..., 1], initial=np.inf)))
    if not limbs:
        return None
    size = measure_size(limbs, skeleton)
    segments = [segment for limb in limbs for segment in build_limb_segments(limb, groups, skeleton)]
    for root in dict.fromkeys(limb.groups[0] for limb in limbs):
        carried = [limb for limb in limbs if limb.groups[0] == root]
        segments.append(build_root_segment(carried, groups[root], skeleton, size))
    return build_grouped_marker_set(segments, labels, size)


def measure_size(limbs: list[LimbChain], skeleton: Skeleton) -> float:
    """Return the size of a person relative to the average body, from the lengths of the limbs."""
    measured = average = 0.0
    for limb in limbs:
        joints = get_limb_joints(limb, skeleton)
        measured += float(np.linalg.norm(limb.places[0, 1] - limb.places[1, 0]))
        measured += float(np.linalg.norm(limb.places[1, 1] - limb.places[2, 0]))
        average += float(np.linalg.norm(skeleton.offsets[list(joints[1:])], axis=1).sum())
    return measured / average


def get_limb_joints(limb: LimbChain, skeleton: Skeleton) -> tuple[int, ...]:
    """Return the three joints of a limb."""
    side = "Left" if limb.is_left else "Right"
    return tuple(skeleton.find_joint(side + name) for name in LIMB_CHAIN_JOINT_NAMES[limb.kind])


def build_limb_segments(limb: LimbChain, groups: list[MovingGroup], skeleton: Skeleton) -> list[SegmentAxes]:
    """Return the upper and the lower segment of a limb, and its foot or hand."""
    joints = get_limb_joints(limb, skeleton)
    upper, lower, end = (groups[g] for g in limb.groups[1:])
    sign = 1.0 if limb.is_left else -1.0
    rest_bend = np.array([1.0, 0, 0]) if limb.kind == "leg" else np.array([0, -sign, 0])
    up_rest = [-skeleton.offsets[joint] for joint in joints[1:]]
    bones = (limb.places[0, 1] - limb.places[1, 0], limb.places[1, 1] - limb.places[2, 0])
    rotations = [
        build_axes(rest, rest_bend) @ build_axes(bone, bend).T
        for rest, bone, bend in zip(up_rest, bones, limb.bend_axes, strict=True)
    ]
    segments = [
        SegmentAxes(upper, joints[0], rotations[0], limb.places[0, 1]),
        SegmentAxes(lower, joints[1], rotations[1], limb.places[1, 1]),
    ]
    is_known = lower.is_known & end.is_known
    between = np.swapaxes(end.rotation[is_known], 1, 2) @ lower.rotation[is_known]
    if limb.kind == "leg":
        height = end.move(end.centroid)[:, 1]
        is_flat = is_known & (height <= np.quantile(height[is_known], LOW_FOOT_QUANTILE))
        up = end.rotation[is_flat][:, 1].mean(0)
        bend = (between @ limb.bend_axes[1]).mean(0)
        rotation = build_axes(np.array([0.0, 1, 0]), rest_bend) @ build_axes(up, bend).T
    else:
        mean = (between @ rotations[1].T).mean(0)
        rotation = build_axes(mean[:, 1], mean[:, 0]).T
    return [*segments, SegmentAxes(end, joints[2], rotation, limb.places[2, 1])]


def build_root_segment(limbs: list[LimbChain], group: MovingGroup, skeleton: Skeleton, size: float) -> SegmentAxes:
    """Return the pelvis or the thorax, which carries limbs."""
    left = sum((limb.left for limb in limbs), np.zeros(3))
    if len(limbs) > 1:  # the line between the joints is the more precise one
        ordered = sorted(limbs, key=lambda limb: limb.is_left)
        left = ordered[1].places[0, 0] - ordered[0].places[0, 0]
    up = group.rotation[group.is_known][:, 1].mean(0)
    rotation = build_axes(up, left, is_second_exact=True).T
    rest, root = skeleton.rest_positions, skeleton.find_joint(ROOT_JOINT_NAMES[limbs[0].kind])
    firsts = [get_limb_joints(limb, skeleton)[0] for limb in limbs]
    origins = [
        limb.places[0, 0] - rotation.T @ (rest[first] - rest[root]) * size for limb, first in zip(limbs, firsts, strict=True)
    ]
    return SegmentAxes(group, root, rotation, np.mean(origins, axis=0))


def build_axes(
    up: Float[np.ndarray, "3"], side: Float[np.ndarray, "3"], *, is_second_exact: bool = False
) -> Float[np.ndarray, "3 3"]:
    """Return axes as columns: X to the side, Y up, Z forward. Y is exact and X perpendicular to it, or the other way round."""
    if is_second_exact:
        x = side / np.linalg.norm(side)
        y = up - (up @ x) * x
        y /= np.linalg.norm(y)
    else:
        y = up / np.linalg.norm(up)
        x = side - (side @ y) * y
        x /= np.linalg.norm(x)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def build_grouped_marker_set(segments: list[SegmentAxes], labels: tuple[str, ...], size: float) -> MarkerSet:
    """Return the markers of the segments as a marker set on the average body."""
    names: list[str] = []
    joints: list[int] = []
    offsets: list[np.ndarray] = []
    for group, joint, rotation, origin in segments:
        for m, place in zip(group.markers, group.places, strict=True):
            names.append(labels[m])
            joints.append(joint)
            offsets.append(rotation @ (place - origin) / size)
    spread, aliases = np.full(len(names), GROUPED_MARKER_SPREAD_M), ((),) * len(names)
    return MarkerSet("guess", "guess", "cmu31", tuple(names), np.array(joints), np.array(offsets), spread, aliases)
