"""Checks of a marker set that was learned from a take: whether a body with this set explains how the markers move.

A body with many joints follows nearly any markers to a few millimetres, so a small residual is no proof. A wrong body shows in
other ways: it has an impossible size, knees that bend forwards, or segments far apart on it whose markers keep their distance.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from mocapfix.errors import format_name_list
from mocapfix.marker_set import MarkerSet
from mocapfix.pose_prior.mean_pose import JointLimits
from mocapfix.skeleton import find_common_joint, load_cmu31_body
from mocapfix.stats.rigid_groups import find_rigid_groups, measure_distance_spread
from mocapfix.stats.sequences import sample_evenly
from mocapfix.take import Take

if TYPE_CHECKING:
    from mocapfix.calibrate.marker_set_fit import MarkerSetFit

MAX_LEARNED_MEAN_RESIDUAL_M = 0.009
"""Mean distance of the markers from the body of a correct set; with a wrong side or segment among them it is larger."""
MIN_LEARNED_SIZE_RATIO = 0.5
"""Smallest size relative to the average body: a child of three. Learning from positions alone needs MIN_POSITION_SIZE_RATIO."""
MIN_POSITION_SIZE_RATIO = 0.75
"""Smallest size of a body that is located by positions alone; a part of a body that is taken for a whole one is smaller."""
MAX_LEARNED_SIZE_RATIO = 1.3
"""Largest size relative to the average body."""
STEADINESS_RATIO = 2.0
"""Variation of the distance to a distant segment, relative to the least one to a near segment, that is a contradiction."""
MAX_STEADY_SPREAD_M = 0.006
"""Variation of a distance, as a standard deviation, below which two markers seem to be on the same segment."""
MIN_TRAVEL_SPREAD_M = 0.05
"""Variation of a marker's position that shows that it moves; two markers at rest keep their distance on any segments."""
PASSED_JOINT_NAMES = ("LowerBack", "Spine", "Neck", "Neck1")
"""Joints that are not counted between two segments: pelvis, thorax and head are neighbours."""
MIN_DISTANT_SEGMENTS = 4
"""Segments along the way between two that are far apart: an upper arm hardly moves against the head in a short walk."""
MAX_CONTRADICTED_SHARE = 0.04
"""Share of the markers whose steadiest neighbours may be on distant segments."""
MIN_DISTANCE_MOTION_M = 0.008
"""Median variation of the distances between markers on distant segments; less is too little motion to learn from."""
MAX_BEND_VIOLATION_RAD = 0.35
"""Angle beyond its limits at which a knee or an elbow bends the wrong way."""
MAX_TURN_VIOLATION_RAD = 0.05
"""Angle beyond its limits at which a foot or an upper arm is turned: the wrong way round, they are further beyond."""
MAX_VIOLATION_SHARE = 0.2
"""Share of the frames in which they may be."""
MIN_JUDGED_MARKERS = 2
"""Markers of a segment whose joint is judged: one marker leaves its rotation open."""
MAX_NAMED_MARKER_SD_M = 0.02
"""Motion per axis of a marker against its segment above which it is left out, though its label or position names the segment."""
MAX_UNNAMED_MARKER_SD_M = 0.012
"""The same for a marker that is attached for its motion alone."""
MIN_UNNAMED_PROBABILITY = 0.9
"""Probability of the segment of such a marker below which it is left out, unless the alternative is a neighbouring segment."""
MIN_LOCATED_SHARE = 0.8
"""Share of the visible markers that a body located by positions alone must explain."""
TRUNK_JOINT_NAMES = ("Hips", "Spine1", "Head")
LIMB_SEGMENT_NAMES = ("UpLeg", "Leg", "Foot", "Arm", "ForeArm")
MIN_TRUNK_SEGMENT_MARKERS = 3
"""Markers on pelvis, thorax and head each of such a body."""
MIN_PAIRED_LIMB_SEGMENTS = 8
"""Number of its ten limb segments that have two markers or more; each has at least one."""
HINGE_JOINT_NAMES = ("LeftLeg", "RightLeg", "LeftForeArm", "RightForeArm")
"""Knees and elbows, which bend in one direction only."""
TURNED_JOINT_NAMES = ("LeftFoot", "RightFoot", "LeftArm", "RightArm")
"""Ankles and shoulders, which a body that faces backwards would have to turn round."""


@dataclass(frozen=True)
class LearnedBody:
    """What the checks compare: a learned set with the body on which it was learned.

    marker_set           K markers
    mean_residual_m      their mean distance from the body
    size_ratio           size relative to the average body
    joint_rotations      (N, J, 3, 3) world rotations of the joints in N frames
    distance_spread      (K, K) m: variation of the distances between the markers
    position_spread      (K,) m: variation of their positions
    """

    marker_set: MarkerSet
    mean_residual_m: float
    size_ratio: float
    joint_rotations: Float[np.ndarray, "N J 3 3"]
    distance_spread: Float[np.ndarray, "K K"]
    position_spread: Float[np.ndarray, " K"]


def describe_implausible_body(learned: LearnedBody, limits: JointLimits, *, from_positions: bool) -> str:
    """Return why a learned body is not plausible as the predicate of a sentence, "" if it is.

    from_positions  whether the segments were guessed from positions alone
    """
    min_size = MIN_POSITION_SIZE_RATIO if from_positions else MIN_LEARNED_SIZE_RATIO
    segment_distance = count_segments_between(learned.marker_set.joints)
    motion = measure_distant_motion(segment_distance, learned.distance_spread)
    if not motion >= MIN_DISTANCE_MOTION_M:
        return "moves too little in this take to be verified"
    if not min_size <= learned.size_ratio <= MAX_LEARNED_SIZE_RATIO:
        return f"would have {learned.size_ratio:.0%} of the size of the average person"
    if learned.mean_residual_m > MAX_LEARNED_MEAN_RESIDUAL_M:
        return f"would be {learned.mean_residual_m * 1e3:.0f} mm from its markers on average"
    contradiction = _describe_contradiction(
        learned.marker_set, segment_distance, learned.distance_spread, learned.position_spread
    )
    if contradiction:
        return contradiction
    if name := find_impossible_joint(learned.marker_set.joints, learned.joint_rotations, limits):
        return f"would turn {name} in an impossible way"
    return ""


def describe_incomplete_location(joints: Int[np.ndarray, " K"], visible_count: int) -> str:
    """Return why markers located by positions alone, attached to K joints, are not enough of a whole body, "" if they are."""
    skeleton = load_cmu31_body().skeleton
    counts = {name: int((joints == j).sum()) for j, name in enumerate(skeleton.names)}
    limbs = {side + name: counts[side + name] for side in ("Left", "Right") for name in LIMB_SEGMENT_NAMES}
    sparse = [name for name in TRUNK_JOINT_NAMES if counts[name] < MIN_TRUNK_SEGMENT_MARKERS]
    sparse += [name for name, count in limbs.items() if not count]
    if len(joints) < MIN_LOCATED_SHARE * visible_count:
        return f"explains only {len(joints)} of {visible_count} markers"
    if sparse:
        return f"has too few markers on {format_name_list(sparse)}"
    if sum(count > 1 for count in limbs.values()) < MIN_PAIRED_LIMB_SEGMENTS:
        return f"has single markers on {format_name_list([name for name, count in limbs.items() if count == 1])}"
    return ""


def describe_contradicted_guess(take: Take, labels: Sequence[str], guess: MarkerSet) -> str:
    """Return why a guess from positions alone is not plausible, before a body is fitted to it; "" if it may be."""
    if problem := describe_incomplete_location(guess.joints, int(take.visible.any(0).sum())):
        return problem
    markers = take.markers[:, [labels.index(label) for label in guess.labels]]
    segment_distance = count_segments_between(guess.joints)
    return _describe_contradiction(guess, segment_distance, measure_distance_spread(markers), measure_position_spread(markers))


def _describe_contradiction(
    marker_set: MarkerSet, segment_distance: np.ndarray, distance_spread: np.ndarray, position_spread: np.ndarray
) -> str:
    is_contradicted = find_contradicted_markers(segment_distance, distance_spread, position_spread)
    if is_contradicted.mean() <= MAX_CONTRADICTED_SHARE:
        return ""
    names = [label for label, is_wrong in zip(marker_set.labels, is_contradicted, strict=True) if is_wrong]
    return f"would have {names[0]} on another segment than the markers with which it moves"


def count_segments_between(joints: Int[np.ndarray, " K"]) -> Int[np.ndarray, "K K"]:
    """Return for each pair of markers how many segments lie on the way from one to the other, the last included."""
    body = load_cmu31_body()
    passed = {body.skeleton.find_joint(name) for name in PASSED_JOINT_NAMES} | set(np.flatnonzero(~body.free_joints).tolist())
    count = {(a, b): _count_steps(a, b, passed) for a in set(joints.tolist()) for b in set(joints.tolist())}
    return np.array([[count[int(a), int(b)] for b in joints] for a in joints], int)


def _count_steps(start: int, end: int, passed: set[int]) -> int:
    parents = load_cmu31_body().skeleton.parents
    top = find_common_joint(parents, (start, end))
    path: set[int] = {top}
    for joint in (start, end):
        while joint != top:
            path.add(joint)
            joint = int(parents[joint])
    return len(path - passed - {start})


def measure_distant_motion(segment_distance: Int[np.ndarray, "K K"], distance_spread: Float[np.ndarray, "K K"]) -> float:
    """Return the median variation in metres of the distances between markers on distant segments; 0 if there are none."""
    spread = distance_spread[(segment_distance >= MIN_DISTANT_SEGMENTS) & np.isfinite(distance_spread)]
    if not len(spread):  # a single limb
        spread = distance_spread[(segment_distance > 0) & np.isfinite(distance_spread)]
    return float(np.median(spread)) if len(spread) else 0.0


def find_contradicted_markers(
    segment_distance: Int[np.ndarray, "K K"],
    distance_spread: Float[np.ndarray, "K K"],
    position_spread: Float[np.ndarray, " K"],
) -> Bool[np.ndarray, " K"]:
    """Find the markers that keep their distance to a marker on a distant segment, though both move."""
    spread = np.where(position_spread > MIN_TRAVEL_SPREAD_M, distance_spread, np.inf)
    distant = np.where(segment_distance >= MIN_DISTANT_SEGMENTS, spread, np.inf).min(1)
    near = np.where(segment_distance < MIN_DISTANT_SEGMENTS, spread, np.inf).min(1)
    limit = np.minimum(MAX_STEADY_SPREAD_M, STEADINESS_RATIO * near)
    return (position_spread > MIN_TRAVEL_SPREAD_M) & (distant < limit)


def measure_position_spread(markers: Float[np.ndarray, "T M 3"]) -> Float[np.ndarray, " M"]:
    """Return the variation of each marker's position in metres: the norm of its standard deviations; 0 if never visible."""
    sampled = markers[sample_evenly(len(markers), 200)]
    is_visible = ~np.isnan(sampled[..., 0])
    count = np.maximum(is_visible.sum(0), 1)[:, None]
    centred = np.where(is_visible[..., None], sampled - np.nansum(sampled, axis=0) / count, 0.0)
    return np.sqrt((centred**2).sum((0, 2)) / count[:, 0])


def find_impossible_joint(
    joints: Int[np.ndarray, " K"], joint_rotations: Float[np.ndarray, "N J 3 3"], limits: JointLimits
) -> str:
    """Return the name of a joint that is beyond its limits in many frames, "" if none is.

    Knees and elbows are judged about the axis about which they bend. Of a body that faces backwards, or has its sides exchanged,
    the feet and the upper arms are turned about any axis. Only joints with two markers or more are judged.
    """
    skeleton = load_cmu31_body().skeleton
    for joint, name in enumerate(skeleton.names):
        is_hinge = name in HINGE_JOINT_NAMES
        if not (is_hinge or name in TURNED_JOINT_NAMES) or (joints == joint).sum() < MIN_JUDGED_MARKERS:
            continue
        parent = int(skeleton.parents[joint])
        local = np.einsum("nba,nbc->nac", joint_rotations[:, parent], joint_rotations[:, joint])
        turn = Rotation.from_matrix(local @ limits.mean_rotations[joint].T).as_rotvec()
        beyond = np.maximum(limits.lower_rad[joint] - turn, turn - limits.upper_rad[joint])
        axis = int((limits.upper_rad[joint] - limits.lower_rad[joint]).argmax())  # about which it bends
        excess, max_excess = (beyond[:, axis], MAX_BEND_VIOLATION_RAD) if is_hinge else (beyond.max(1), MAX_TURN_VIOLATION_RAD)
        if (excess > max_excess).mean() > MAX_VIOLATION_SHARE:
            return name
    return ""


def measure_learned_body(
    take: Take, labels: Sequence[str], marker_set: MarkerSet, fit: "MarkerSetFit", average_length_m: float
) -> LearnedBody:
    """Return what the checks compare of a set that was fitted to a take.

    labels            the names of the take's markers in the set
    average_length_m  total length of the average skeleton
    """
    columns = [labels.index(label) for label in marker_set.labels]
    markers = take.markers[:, columns]
    size_ratio = fit.subject.skeleton.total_length_m / average_length_m
    return LearnedBody(
        marker_set,
        float(np.sqrt(3 * np.mean(fit.attachment.residual_sd[columns] ** 2))),
        size_ratio,
        fit.joint_rotations,
        measure_distance_spread(markers),
        measure_position_spread(markers),
    )


def describe_contradicted_words(labels: Sequence[str], fit: "MarkerSetFit", guess: MarkerSet) -> str:
    """Return why the motion contradicts the words of the labels, "" if it does not.

    Words may name a neighbouring segment, such as the thigh for a marker on the knee.
    """
    attached = np.array([fit.attachment.joints[labels.index(label)] for label in guess.labels])
    is_attached = attached >= 0
    pairs = zip(guess.joints[is_attached].tolist(), attached[is_attached].tolist(), strict=True)
    is_moved = np.array([count_segments_between(np.array(pair))[0, 1] > 1 for pair in pairs], bool)
    if not len(is_moved) or is_moved.mean() <= MAX_CONTRADICTED_SHARE:
        return ""
    names = [label for label, is_kept in zip(guess.labels, is_attached, strict=True) if is_kept]
    return f"would have {names[int(is_moved.argmax())]} on another segment than its label says"


def is_contradicted_by_words(guess: MarkerSet, from_words: MarkerSet) -> bool:
    """Return whether words name a segment that is no neighbour of the guessed one for any of the markers."""
    guessed = dict(zip(guess.labels, guess.joints.tolist(), strict=True))
    pairs = [(guessed[label], joint) for label, joint in zip(from_words.labels, from_words.joints.tolist(), strict=True)]
    return any(count_segments_between(np.array(pair))[0, 1] > 1 for pair in pairs)


def find_doubtful_markers(
    take: Take, labels: Sequence[str], fit: "MarkerSetFit", named_labels: Collection[str]
) -> dict[str, str]:
    """Return why a marker is left out of the learned set though it was attached to a segment, by label.

    named_labels  the markers whose segments were known before
    """
    skeleton, attachment = load_cmu31_body().skeleton, fit.attachment
    is_named = np.array([label in named_labels for label in labels])
    max_sd = np.where(is_named, MAX_NAMED_MARKER_SD_M, MAX_UNNAMED_MARKER_SD_M)
    reasons: dict[str, str] = {}
    for m in np.flatnonzero(attachment.joints >= 0).tolist():
        joint, second = int(attachment.joints[m]), int(attachment.second_joints[m])
        is_unclear = attachment.probability[m] < MIN_UNNAMED_PROBABILITY and not is_named[m]
        if attachment.residual_sd[m] > max_sd[m]:
            reasons[labels[m]] = f"moves by {attachment.residual_sd[m] * 1e3:.0f} mm against {skeleton.names[joint]}"
        elif is_unclear and joint not in (skeleton.parents[second], second) and second != skeleton.parents[joint]:
            reasons[labels[m]] = f"may be on {skeleton.names[joint]} or on {skeleton.names[second]}"
    is_left_out = (attachment.joints < 0) | np.array([label in reasons for label in labels])
    for group in find_rigid_groups(take.markers):
        members = np.array(group.markers)
        if is_left_out[members].any() and not is_named[members].any():
            reasons |= {labels[m]: "belongs to a prop" for m in group.markers if not is_left_out[m]}
    return reasons
