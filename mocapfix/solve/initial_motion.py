"""Initialisation: a first pose for every frame, from which the solver starts.

The methods (`INIT_METHODS`) are:

- `learned`: those of hybrik-x, and joints that no marker shows by learned inverse kinematics (`learned_ik`)
- `hybrik-...`: joint positions from the frame's markers, and from these its pose in closed form (`hybrik`)
- `registration`: the subject's segments registered to the visible markers, down the tree (`register_poses`)
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.kernels.belief_propagation import JointSegments, SegmentTree, propagate_segment_frames
from mocapfix.kernels.joint_registration import register_limb_frames
from mocapfix.model.body_fit import BodyFit, SubjectInTake
from mocapfix.model.motion import FrameStatus, Motion
from mocapfix.model.skeleton import BodyModel, Skeleton, compute_local_rotations, find_common_joint, list_path
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.options import DEFAULT_INIT_METHOD
from mocapfix.solve import kinematics, mean_pose
from mocapfix.solve.hybrik import MIN_JOINT_DISTANCE_M, MIN_JOINT_SD_M, HybrikVariant, solve_hybrik
from mocapfix.solve.kinematics import compute_world_poses
from mocapfix.solve.learned_ik import PoseRegressor, load_shipped_ik_network, smooth_positions
from mocapfix.solve.mean_pose import MeanPosePrior, load_mean_pose_prior
from mocapfix.solve.parallel import run_over_frames
from mocapfix.solve.pose_problem import POSE_RATE_HZ, FrameChanges, change_all_frames, find_changed_frames, list_posed_frames
from mocapfix.stats.rigid_alignment import compute_cross_covariance, fit_rotations, scale_rotations

MIN_MARKER_SPREAD_M = 1e-7  # smallest marker spread, which bounds the weight of a marker
MAX_JOINT_SD_M = 0.5  # standard deviation of a joint position above which it counts as unknown


class JointEstimate(NamedTuple):
    """Joint positions estimated from markers."""

    positions: np.ndarray  # (T, J, 3) m, NaN where practically unknown
    sd: np.ndarray  # (T, J) m per axis, likewise
    # (T, K) between 0 and 1: robust weight of each marker, below 0.25 if it lies 5 cm off; 0 if not visible
    marker_trust: np.ndarray


def estimate_joint_positions(take: Take, subject: Subject, body: BodyModel) -> JointEstimate:
    """Return the joint positions of every frame with their standard deviations.

    Each segment is registered to its own markers, weighted by the subject's marker spread, and to the estimates of its
    neighbouring segments: of the common joint, and of its axes, weighted by the variation about the mean pose. A limb without
    markers therefore takes the mean pose, with a correspondingly large standard deviation. Coincident joints get the same
    position.

    Args:
        take: The markers in the subject's order, NaN if not visible or an outlier.
    """
    prior = mean_pose.load_mean_pose_prior("mean-pose", subject.skeleton)
    rigid = build_rigid_skeleton(subject.skeleton, body.free_joints, prior)
    order = np.argsort(rigid.carrier_segment[subject.joints], kind="stable")
    joint_count, trust = len(body.free_joints), np.empty(take.visible.shape)
    positions, variance = np.empty((take.frame_count, joint_count, 3)), np.empty((take.frame_count, joint_count))
    run_over_frames(
        propagate_segment_frames,
        take.frame_count,
        build_segments(subject, rigid, prior, order),
        build_meetings(rigid),
        np.ascontiguousarray(take.markers[:, order], float),
        positions,
        variance,
        trust,
    )
    is_unknown = ~(variance < MAX_JOINT_SD_M**2)
    sd = np.maximum(np.sqrt(variance + subject.joint_sd**2), MIN_JOINT_SD_M)
    positions[is_unknown], sd[is_unknown] = np.nan, np.nan
    return JointEstimate(positions, sd, trust[:, order.argsort()])


@dataclass(frozen=True)
class RigidSkeleton:
    """A skeleton as S rigid segments: each free joint with the fixed joints below it, which keep the mean pose."""

    segment_joints: Int[np.ndarray, " S"]  # the free joint of each segment
    parent_segment: Int[np.ndarray, " J"]  # the segment to which each joint is attached; for the root its own
    position_in_parent: Float[np.ndarray, "J 3"]  # m: the joint in the axes of that segment
    parent_axes: Float[np.ndarray, "J 3 3"]  # (J, 3, 3): axes of the joint's parent to axes of that segment
    # (J,) the segment that turns with the joint: its own if it is free, else the parent segment
    carrier_segment: Int[np.ndarray, " J"]
    position_in_carrier: Float[np.ndarray, "J 3"]  # m: the joint in the axes of the carrier segment
    axes_in_carrier: Float[np.ndarray, "J 3 3"]  # (J, 3, 3): joint axes to axes of the carrier segment


def build_rigid_skeleton(skeleton: Skeleton, free_joints: Bool[np.ndarray, " J"], prior: MeanPosePrior) -> RigidSkeleton:
    count, segment_joints = len(free_joints), np.flatnonzero(free_joints)
    parent_segment, carrier_segment = np.zeros(count, int), np.zeros(count, int)
    position_in_parent, position_in_carrier = np.zeros((count, 3)), np.zeros((count, 3))
    parent_axes, axes_in_carrier = np.tile(np.eye(3), (count, 1, 1)), np.tile(np.eye(3), (count, 1, 1))
    carrier_segment[segment_joints] = np.arange(len(segment_joints))
    for j in range(1, count):
        parent = skeleton.parents[j]
        parent_segment[j], parent_axes[j] = carrier_segment[parent], axes_in_carrier[parent]
        position_in_parent[j] = position_in_carrier[parent] + axes_in_carrier[parent] @ skeleton.offsets[j]
        if not free_joints[j]:
            carrier_segment[j], position_in_carrier[j] = parent_segment[j], position_in_parent[j]
            axes_in_carrier[j] = parent_axes[j] @ prior.mean_rotations[j]
    return RigidSkeleton(
        segment_joints, parent_segment, position_in_parent, parent_axes, carrier_segment, position_in_carrier, axes_in_carrier
    )


def build_segments(subject: Subject, rigid: RigidSkeleton, prior: MeanPosePrior, order: Int[np.ndarray, " K"]) -> SegmentTree:
    """Return the segments for the kernel; `order` sorts the subject's markers by segment."""
    own, marker_joints, marker_offsets = rigid.segment_joints, subject.joints[order], subject.marker_offsets[order]
    parent_axes = rigid.parent_axes[own]
    standing_positions, standing_rotations = kinematics.compute_tree_poses(
        kinematics.build_kinematic_tree(subject.skeleton), np.zeros((1, 3)), prior.mean_rotations[None]
    )
    rotated = np.einsum("kab,kb->ka", rigid.axes_in_carrier[marker_joints], marker_offsets)
    standing_rotated = np.einsum("kab,kb->ka", standing_rotations[0, marker_joints], marker_offsets)
    return SegmentTree(
        parent=rigid.parent_segment[own],
        joint_offset=rigid.position_in_parent[own],
        mean_rotation=parent_axes @ prior.mean_rotations[own],
        rotation_information=parent_axes @ prior.information[own] @ np.swapaxes(parent_axes, 1, 2),
        first_marker=np.searchsorted(rigid.carrier_segment[marker_joints], np.arange(len(own) + 1)),
        marker_offset=rigid.position_in_carrier[marker_joints] + rotated,
        weight=1 / np.maximum(subject.marker_spread[order], MIN_MARKER_SPREAD_M) ** 2,
        standing_rotation=standing_rotations[0, own],
        standing_position=standing_positions[0, marker_joints] + standing_rotated,
    )


def build_meetings(rigid: RigidSkeleton) -> JointSegments:
    """Return the segments that share each joint: its parent segment, and the segments whose own joint coincides with it."""
    distance = np.linalg.norm(rigid.position_in_parent[:, None] - rigid.position_in_parent, axis=2)
    is_shared = (distance < MIN_JOINT_DISTANCE_M) & (rigid.parent_segment[:, None] == rigid.parent_segment)
    coincident = [[s for s, j in enumerate(rigid.segment_joints) if s and is_shared[i, j]] for i in range(len(is_shared))]
    segments: list[int] = []
    joint_offsets: list[np.ndarray] = []
    for parent, position, own in zip(rigid.parent_segment, rigid.position_in_parent, coincident, strict=True):
        segments += [parent, *own]
        joint_offsets += [position, *np.zeros((len(own), 3))]
    return JointSegments(np.cumsum([0] + [1 + len(own) for own in coincident]), np.array(segments), np.array(joint_offsets))


MIN_MARKER_TRUST = 0.25
"""Robust weight below which a marker is not used by HybrIK; a marker 5 cm from its segment has this weight."""
LEARNED_METHOD = "learned"
HYBRIK_VARIANTS: dict[str, HybrikVariant] = {
    "hybrik-x": "x",
    LEARNED_METHOD: "x",
    "hybrik-adaptive": "adaptive",
    "hybrik-naive": "naive",
}
"""The HybrIK variant of each method."""


def initialise_motion(
    take: Take, subject: Subject, body: BodyModel, prior: MeanPosePrior, method: str = DEFAULT_INIT_METHOD
) -> Motion:
    """Return the initial pose of every frame.

    Args:
        take: The markers in the subject's order, NaN if not visible or an outlier.
        prior: Its mean pose is that of the joints that the body does not turn.
    """
    if method in HYBRIK_VARIANTS:
        estimate, is_held = estimate_joint_positions(take, subject, body), ~body.free_joints
        motion = solve_hybrik(
            estimate.positions,
            subject,
            variant=HYBRIK_VARIANTS[method],
            joint_sd=estimate.sd,
            markers=np.where(estimate.marker_trust[..., None] > MIN_MARKER_TRUST, take.markers, np.nan),
            held_joints=is_held,
        )
        motion.local_rotations[:, is_held] = prior.mean_rotations[is_held]
        motion = bend_unmarked_chains(motion, subject, prior)
        if method == LEARNED_METHOD and body.shown_segments.all():
            motion = infer_unseen_joints(motion, estimate, subject, take.rate)
        return motion
    return register_poses(subject, body.free_joints, prior, take.markers)


def initialise_frames(
    take: Take, frames: Int[np.ndarray, " N"], subject: Subject, body: BodyModel, prior: MeanPosePrior, *, method: str
) -> Motion:
    """Return the initial poses of some frames of a take; arguments as those of `initialise_motion`."""
    if method == LEARNED_METHOD:  # which smooths positions over time, and so needs the frames between them
        return initialise_motion(take, subject, body, prior, method).select_frames(frames)
    return initialise_motion(take.replace_markers(take.markers[frames]), subject, body, prior, method)


def bend_unmarked_chains(motion: Motion, subject: Subject, prior: MeanPosePrior) -> Motion:
    """Distribute the rotation of each marked leaf over the unmarked joints before it, in equal parts about the mean pose.

    The joints of the neck carry no markers. Two short, nearly straight bones fold to one side or the other for a millimetre more
    or less between their ends, and the markers hardly determine the side, so the solver would stay on it.
    """
    skeleton, local_rotations = subject.skeleton, motion.local_rotations.copy()
    world_rotations = kinematics.compute_world_poses(skeleton, motion)[1]
    for chain in find_unmarked_chains(subject):
        rotation = world_rotations[:, skeleton.parents[chain[0]]].swapaxes(1, 2) @ world_rotations[:, chain[-1]]
        mean = np.linalg.multi_dot(prior.mean_rotations[chain])
        part = scale_rotations(mean.T @ rotation, 1 / len(chain))
        product = np.eye(3)
        for j in chain[:-1]:
            local_rotations[:, j] = prior.mean_rotations[j] @ part
            product = product @ local_rotations[:, j]
        local_rotations[:, chain[-1]] = np.swapaxes(product, -1, -2) @ rotation
    return replace(motion, local_rotations=local_rotations)


def find_unmarked_chains(subject: Subject) -> list[list[int]]:
    """Return for each leaf with markers the joints from the last one with markers (exclusive) down to it; two or more joints."""
    parents, marked = subject.skeleton.parents, set(subject.joints.tolist())
    chains: list[list[int]] = []
    for leaf in marked - set(parents.tolist()):
        chain = [leaf]
        while int(parents[chain[0]]) > 0 and int(parents[chain[0]]) not in marked:
            chain.insert(0, int(parents[chain[0]]))
        if len(chain) > 1:
            chains.append(chain)
    return chains


class PoseStart(NamedTuple):
    """The poses from which the solver starts, and the frames that it has to solve."""

    motion: Motion
    changes: FrameChanges


def initialise_body(subject: SubjectInTake, solved: BodyFit | None, method: str) -> PoseStart:
    """Return a first pose in closed form for every frame that was not yet solved, or whose samples changed since.

    Args:
        subject: The subject and the samples that the solver uses.
        solved: The body as it was solved before, if it was.
    """
    take, body = subject.take, subject.extended_subject.body_model
    changes = change_all_frames(take.frame_count)
    if solved is not None and solved.evidence is not None:
        changes = find_changed_frames(solved.take.markers, take.markers, is_same_subject=subject.subject is solved.subject)
    if solved is None or changes.is_restarted.all():
        return PoseStart(initialise_between(subject, method), change_all_frames(take.frame_count))
    restarted = np.flatnonzero(changes.is_restarted)
    prior = load_mean_pose_prior("mean-pose", body.skeleton)
    poses = initialise_frames(take, restarted, subject.extended_subject, body, prior, method=method)
    is_placed = poses.status != FrameStatus.GUESSED
    root_position, local_rotations = solved.motion.root_position.copy(), solved.motion.local_rotations.copy()
    root_position[restarted[is_placed]] = poses.root_position[is_placed]
    local_rotations[restarted[is_placed]] = poses.local_rotations[is_placed]
    return PoseStart(replace(solved.motion, root_position=root_position, local_rotations=local_rotations), changes)


PREVIEW_POSE_RATE_HZ = 15.0  # at which a preview has poses of its own: its joints are 0.4 mm farther off than with 30 Hz


def initialise_between(subject: SubjectInTake, method: str, pose_rate_hz: float = POSE_RATE_HZ) -> Motion:
    """Return first poses of all frames: those at a rate in closed form, and interpolations in the frames between."""
    take, body = subject.take, subject.extended_subject.body_model
    frames = list_posed_frames(take.frame_count, take.rate, pose_rate_hz)
    posed = replace(take.replace_markers(take.markers[frames]), rate=take.rate * len(frames) / take.frame_count)
    motion = initialise_motion(posed, subject.extended_subject, body, load_mean_pose_prior("mean-pose", body.skeleton), method)
    root, local = kinematics.interpolate_poses((motion.root_position, motion.local_rotations), frames, take.frame_count)
    nearest = np.rint(np.interp(np.arange(take.frame_count), frames, np.arange(len(frames)))).astype(int)
    others = (values[nearest] for values in (motion.status, motion.iterations, motion.marker_sd, motion.joint_sd))
    return Motion(root, local, *others)


MIN_SEGMENT_TRUST = 0.25  # robust weight from which a marker shows the rotation of its segment


def infer_unseen_joints(motion: Motion, estimate: JointEstimate, subject: Subject, rate_hz: float) -> Motion:
    """Return poses whose joints without a visible marker have the rotations that the network infers; the others are unchanged.

    Args:
        motion: Closed-form poses of all frames.
        estimate: The joint positions that they are made of.
    """
    model = PoseRegressor(load_shipped_ik_network(), subject.skeleton)
    joint_sd = np.nan_to_num(estimate.sd, nan=1.0)
    start = motion.root_position, motion.local_rotations
    is_seen = find_seen_segments(estimate, subject)
    is_given = is_seen | is_seen[:, np.maximum(subject.skeleton.parents, 0)]  # at an end of a segment with markers
    given = np.where(is_given[..., None], estimate.positions, np.nan)
    root, local = model.refine_poses(start, *smooth_positions(given, joint_sd, rate_hz))
    seen_world = compute_world_poses(subject.skeleton, motion)[1]
    learned = Motion(root, local, motion.status, motion.iterations, motion.marker_sd, motion.joint_sd)
    world = np.where(is_seen[..., None, None], seen_world, compute_world_poses(subject.skeleton, learned)[1])
    combined = compute_local_rotations(world, subject.skeleton.parents)
    root = np.where(is_seen[:, :1], motion.root_position, root)
    return Motion(root, combined, motion.status, motion.iterations, motion.marker_sd, motion.joint_sd)


def find_seen_segments(estimate: JointEstimate, subject: Subject) -> Bool[np.ndarray, "T J"]:
    """Return in which frames a marker shows each joint's own segment."""
    is_seen = np.zeros(estimate.sd.shape, bool)
    for marker, joint in enumerate(subject.joints):
        is_seen[:, joint] |= estimate.marker_trust[:, marker] > MIN_SEGMENT_TRUST
    return is_seen


PELVIS_MARKER_WEIGHT = 3.0  # of a pelvis marker relative to a chest marker, as the chest moves relative to the root
MIN_TRUNK_MARKERS = 3  # in a frame that determines the root, and on the joint of the chest


def register_poses(
    subject: Subject, free: Bool[np.ndarray, " J"], prior: MeanPosePrior, markers: Float[np.ndarray, "T K 3"]
) -> Motion:
    """Return every frame's pose from its own markers alone.

    The root is fitted to pelvis and chest in the mean pose, or, without pelvis markers, to the segments nearest to it. Then, down
    the tree, each joint that carries markers is rotated about its own position to fit them, and the joints between it and the
    last such joint share the rotation. Without markers, the mean pose is kept; a frame with fewer than three markers on the
    trunk takes its root from its neighbours in time.

    Args:
        free: Joints that may rotate.
        markers: Metres, in the subject's order, NaN where missing or rejected.
    """
    skeleton, frames = subject.skeleton, len(markers)
    root, local = register_trunk(subject, prior, markers)
    shared_rotations = find_shared_rotations(skeleton, subject.joints, free)
    run_over_frames(
        register_limb_frames, frames, skeleton.parents, skeleton.offsets, shared_rotations, subject.joints,
        subject.marker_offsets, np.ascontiguousarray(markers), root, local,
    )  # fmt: skip
    zeros = np.zeros(frames, int)
    return Motion(root, local, zeros, zeros, np.full(markers.shape[:2], np.nan), np.full(local.shape[:2], np.nan))


def register_trunk(
    subject: Subject, prior: MeanPosePrior, markers: Float[np.ndarray, "T K 3"]
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T J 3 3"]]:
    """Return root positions and local rotations: the mean pose, its root fitted to the markers of pelvis and chest."""
    skeleton, joints, offsets = subject.skeleton, subject.joints, subject.marker_offsets
    local = np.tile(prior.mean_rotations, (len(markers), 1, 1, 1))
    model = np.full(offsets.shape, np.nan)
    position, rotation = np.zeros(3), np.eye(3)
    marker_weight = np.where(joints == 0, PELVIS_MARKER_WEIGHT, 1.0)
    if (joints == 0).any():
        model[joints == 0] = offsets[joints == 0]
        for j in find_trunk_chain(skeleton, joints):
            position, rotation = position + rotation @ skeleton.offsets[j], rotation @ prior.mean_rotations[j]
            model[joints == j] = position + offsets[joints == j] @ rotation.T
    else:
        model, marker_weight = place_mean_pose_markers(subject, prior)
    used = ~np.isnan(model[:, 0])
    weight = ~np.isnan(markers[:, used, 0]) * marker_weight[used]
    cross, mean_markers, mean_model = compute_cross_covariance(markers[:, used], model[used], weight)
    root_rotation = fit_rotations(cross)
    root = mean_markers - np.einsum("tab,tb->ta", root_rotation, mean_model)
    known = np.flatnonzero((weight > 0).sum(1) >= MIN_TRUNK_MARKERS)
    if len(known) == 0:
        known = np.flatnonzero((weight > 0).any(1))[:1]
    if len(known) == 0:
        return np.zeros((len(markers), 3)), local
    frames = np.arange(len(markers))
    nearest = known[np.rint(np.interp(frames, known, np.arange(len(known)))).astype(int)]
    for a in range(3):
        root[:, a] = np.interp(frames, known, root[known, a])
    local[:, 0] = root_rotation[nearest]
    return root, local


def place_mean_pose_markers(subject: Subject, prior: MeanPosePrior) -> tuple[Float[np.ndarray, "K 3"], Float[np.ndarray, " K"]]:
    """Return the markers of a body without pelvis markers in the mean pose, in metres in the axes of the root, and their weights.

    The segment nearest to the root keeps its place relative to it (see `restrict_body`), those beyond turn.
    """
    skeleton, joints = subject.skeleton, subject.joints
    top = find_common_joint(skeleton.parents, set(joints.tolist()))
    positions, rotations = np.zeros((len(skeleton.parents), 3)), np.tile(np.eye(3), (len(skeleton.parents), 1, 1))
    depth = np.zeros(len(skeleton.parents))
    for j in range(1, len(skeleton.parents)):
        p = skeleton.parents[j]
        positions[j] = positions[p] + rotations[p] @ skeleton.offsets[j]
        rotations[j] = rotations[p] @ prior.mean_rotations[j]
        depth[j] = 0 if j == top else depth[p] + 1
    model = positions[joints] + np.einsum("kab,kb->ka", rotations[joints], subject.marker_offsets)
    return model, PELVIS_MARKER_WEIGHT ** -depth[joints]


def find_trunk_chain(skeleton: Skeleton, joints: Int[np.ndarray, " K"]) -> list[int]:
    """Return the joints from below the root to the first joint up the spine that carries three markers or more."""
    for j in range(1, len(skeleton.parents)):
        if (joints == j).sum() >= MIN_TRUNK_MARKERS:
            chain = list_path(j, 0, skeleton.parents)
            if not any((joints == c).any() for c in chain[:-1]):
                return chain
    return []


def find_shared_rotations(
    skeleton: Skeleton, joints: Int[np.ndarray, " K"], free: Bool[np.ndarray, " J"]
) -> Bool[np.ndarray, "J J"]:
    """Return a mask whose row j marks the joints that share the rotation of j, itself included; empty if j is not rotated.

    These are the free joints between j and the last joint above it that carries markers.
    """
    shared_rotations = np.zeros((len(free), len(free)), bool)
    carrying: set[int] = set(joints.tolist()) | {0}
    for j in carrying - {0}:
        chain = [j]
        while int(skeleton.parents[chain[-1]]) not in carrying:
            chain.append(int(skeleton.parents[chain[-1]]))
        shared_rotations[j, chain] = free[chain] & free[j]
    return shared_rotations
