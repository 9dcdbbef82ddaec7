"""The motion of the hands of a take with finger markers: calibration and solve, after the body and without moving it.

The body carries the palm. Each hand is a skeleton of its own (`hand_model`) whose root may leave the palm by as much as the
body's hand is uncertain, so that nothing of the body changes. A frame has the terms of the body's solver: the markers of fingers
and of the back of the hand, the palm, limits, and a Gaussian on poses of the hand.

`solve_hand` solves the frames as `solve.motion_solver` does: each by itself, from its pose in closed form; across gaps of a
finger with its smooth trajectory too, whose variance grows with the distance from the gap's edges, so that in a long gap the
synergies and the other fingers decide; and all again about the smooth trajectories of the joints, which of keypoints are the
motion.

`attach_hands` makes one tree of the body and its hands, for files of motion. Fingers have the names of VRM and Unity, so that the
body's LeftHandIndex1, which does not move with the finger, keeps its own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.hands.calibrated_hand import (
    MARKER_SD_M,
    PALM_LEVER_M,
    POSE_ITERATIONS,
    ROBUST_SCALES_M,
    CalibratedHand,
    PalmPath,
    linearise_hand_prior,
    minimise_hand_poses,
)
from mocapfix.hands.calibration import calibrate_hand
from mocapfix.hands.finger_markers import FingerMarkers, find_finger_markers, select_carried
from mocapfix.hands.hand_model import HAND_JOINTS, JOINTS_PER_RAY, RAY_ROOTS, TIP_JOINTS, HandModel, Side, load_hand
from mocapfix.model.body_fit import BodyFit
from mocapfix.model.motion import Motion, PoseUncertainty, resample_motion
from mocapfix.model.skeleton import Skeleton
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.solve import hybrik, smoothing
from mocapfix.solve.kinematics import Poses, compute_world_poses, predict_markers
from mocapfix.solve.minimise import compute_uncertainty
from mocapfix.solve.parallel import map_in_threads
from mocapfix.solve.pose_problem import find_key_frames, find_unobserved_joints
from mocapfix.solve.terms import TrackingTerm
from mocapfix.stats.rigid_alignment import compute_rotations
from mocapfix.stats.sequences import interpolate_rows
from mocapfix.subject.library import build_subject_marker_set, load_marker_set

MIN_PALM_SD_M = 0.005  # per axis, of the wrist as the forearm carries it; more where the body's hand is less certain
MIN_PALM_SD_RAD = 0.17  # of the palm about the body's hand joint
THUMB_NAMES = ("ThumbMetacarpal", "ThumbProximal", "ThumbDistal")
FINGER_NAMES = tuple(
    f"{finger}{bone}" for finger in ("Index", "Middle", "Ring", "Little") for bone in ("Proximal", "Intermediate", "Distal")
)
ATTACHED_NAMES = ("Palm", *THUMB_NAMES, *FINGER_NAMES)  # after the side; in the order of a hand's joints


@dataclass(frozen=True)
class HandMotion:
    """The motion of one hand over T frames.

    Attributes:
        hand: The calibrated hand.
        palm_position: Metres: the wrist's centre in the world.
        palm_rotation: The palm's axes in the world; in a T-pose they are the world's.
        joint_rotations: Of the 15 joints, ray by ray, to the parent's axes; in the rest pose all axes are those of the palm.
        point_positions: Metres: the 15 joints and the five tips in the world.
        point_sd: Metres: predicted standard deviation per axis of these.
        rotation_sd: Radians: predicted standard deviation of the rotation of each joint, over its three axes.
        is_seen: Whether a marker on a ray is used in a frame.
        marker_sd: Metres: predicted standard deviation per axis of the hand's markers as it places them.
    """

    hand: CalibratedHand
    palm_position: Float[np.ndarray, "T 3"]
    palm_rotation: Float[np.ndarray, "T 3 3"]
    joint_rotations: Float[np.ndarray, "T 15 3 3"]
    point_positions: Float[np.ndarray, "T 20 3"]
    point_sd: Float[np.ndarray, "T 20"]
    rotation_sd: Float[np.ndarray, "T 15"]
    is_seen: Bool[np.ndarray, "T 5"]
    marker_sd: Float[np.ndarray, "T K"]

    def lower_floor(self, height_m: float) -> "HandMotion":
        """Return the motion with the floor of a height at height 0."""
        down = np.array([0.0, height_m, 0.0])
        return replace(self, palm_position=self.palm_position - down, point_positions=self.point_positions - down)

    @property
    def motion(self) -> Motion:
        """The motion of the palm, as the root, and of the 15 joints."""
        rotations = np.concatenate([self.palm_rotation[:, None], self.joint_rotations], axis=1)
        none = np.zeros(len(rotations), int)
        return Motion(self.palm_position, rotations, none, none, np.zeros((len(rotations), 0)), self.point_sd)

    def carry_markers(self, take: Take) -> BodyFit:
        """Return the hand as a body that carries its finger markers in a take."""
        hand, subject, frames = self.hand, self.hand.subject, len(self.palm_position)
        local = np.tile(hand.model.skeleton.rest_rotations, (frames, 1, 1, 1))
        local[:, 0], local[:, HAND_JOINTS] = self.palm_rotation, hand.model.convert_from_palm_axes(self.joint_rotations)
        none = np.zeros(frames, int)
        motion = Motion(self.palm_position, local, none, none, self.marker_sd, np.zeros((frames, 0)))
        columns = np.where(subject.joints > 0, hand.markers.columns, -1)  # the body carries those on the back of the hand
        places = predict_markers(subject, (self.palm_position, local))
        return BodyFit(subject, subject, columns, take, motion, self.point_positions, places, None)

    @property
    def tip_positions(self) -> Float[np.ndarray, "T 5 3"]:
        """The tips of thumb to little finger in the world, in metres."""
        return self.point_positions[:, len(HAND_JOINTS) :]

    @property
    def angles(self) -> Float[np.ndarray, "T 15 3"]:
        """Twist, abduction and flexion of the 15 joints in radians."""
        return self.hand.model.compute_angles(self.hand.model.compute_rotation_vectors(self.joint_rotations))


def calibrate_hands(take: Take, is_used: Bool[np.ndarray, "T M"], subject: Subject, motion: Motion) -> tuple[CalibratedHand, ...]:
    """Return the hands of a take, which are those of its parts too; arguments as of `solve_hands`."""

    def calibrate_one(part: _HandInTake) -> CalibratedHand:
        return calibrate_hand(*part, take.rate, subject.skeleton.size_ratio)

    return tuple(map_in_threads(calibrate_one, _list_hands(take, is_used, subject, motion)))


def solve_hands(
    take: Take,
    is_used: Bool[np.ndarray, "T M"],
    subject: Subject,
    motion: Motion,
    calibrated: Sequence[CalibratedHand] | None = None,
) -> tuple[HandMotion, ...]:
    """Return the motion of each hand of a take that shows its fingers, and its forearm: without that no palm carries them.

    Args:
        is_used: The samples that the solver may use.
        subject: The person's body.
        motion: Of the body; it is not changed.
        calibrated: The hands, if they are known from more of the take: these are solved, whether or not this part shows them.
    """

    def solve_one(part: _HandInTake) -> HandMotion:
        known = [each for each in calibrated or () if each.model.side == part.markers.side]
        hand = known[0] if known else calibrate_hand(*part, take.rate, subject.skeleton.size_ratio)
        return solve_hand(hand, *part[1:], take.rate)

    sides = None if calibrated is None else [each.model.side for each in calibrated]
    return tuple(map_in_threads(solve_one, _list_hands(take, is_used, subject, motion, sides)))


class _HandInTake(NamedTuple):
    """The markers of a hand, their samples and those that are used, and its palm."""

    markers: FingerMarkers
    positions: Float[np.ndarray, "T K 3"]
    is_used: Bool[np.ndarray, "T K"]
    palm: PalmPath


def _list_hands(
    take: Take, is_used: Bool[np.ndarray, "T M"], subject: Subject, motion: Motion, sides: Sequence[str] | None = None
) -> list[_HandInTake]:
    """Return the hands of a take on these sides, by default those that show a finger marker and whose forearm is known."""
    hands, listed = find_finger_markers(subject.marker_set, take.labels), list[_HandInTake]()
    if not hands:
        return listed
    for each in hands:
        is_shown = bool(select_carried([each], subject.joints)) and is_used[:, each.columns].any()
        if each.side in sides if sides is not None else is_shown:
            markers = add_palm_markers(each, subject, take.labels)
            used = np.ascontiguousarray(is_used[:, markers.columns])
            listed.append(_HandInTake(markers, take.markers[:, markers.columns], used, trace_palm(subject, motion, each.side)))
    return listed


def trace_palm(subject: Subject, motion: Motion, side: Side) -> PalmPath:
    """Return what a body says of a palm."""
    position, rotation = compute_world_poses(subject.skeleton, motion)
    hand, forearm = (subject.skeleton.find_joint(f"{side}{name}") for name in ("Hand", "ForeArm"))
    sd = motion.joint_sd[:, hand] if motion.joint_sd.size else np.zeros(len(position))
    sd_m, sd_rad = np.hypot(MIN_PALM_SD_M, sd), np.hypot(MIN_PALM_SD_RAD, sd / PALM_LEVER_M)
    origin = position[:, forearm] + rotation[:, forearm] @ find_forearm_shift(subject, side)
    return PalmPath(origin, rotation[:, forearm], rotation[:, hand], sd_m, sd_rad)


def find_forearm_shift(subject: Subject, side: Side) -> Float[np.ndarray, "3"]:
    """Return the mean displacement in metres of the forearm's markers from their usual places in its axes; 0 for keypoints.

    The calibrated joint of the hand is drawn to the wrist where the hand bends there, and takes the forearm's axis along.
    The wrist stays where it is beside the markers.
    """
    usual, forearm = load_marker_set(subject.marker_set), subject.skeleton.find_joint(f"{side}ForeArm")
    columns = usual.find_columns(subject.labels)
    known = np.flatnonzero((columns >= 0) & (subject.joints[columns] == forearm))
    if usual.point_sd or not len(known):
        return np.zeros(3)
    return (subject.marker_offsets[columns[known]] - usual.marker_offsets[known] * subject.skeleton.size_ratio).mean(0)


def add_palm_markers(hand: FingerMarkers, subject: Subject, labels: tuple[str, ...]) -> FingerMarkers:
    """Return the markers of a hand with those of the body on its back, which move with the palm; keypoints as they are."""
    if hand.markers.point_sd:
        return hand
    model, joint = load_hand(hand.side), subject.skeleton.find_joint(f"{hand.side}Hand")
    rows, own, size_ratio = np.flatnonzero(subject.joints == joint), hand.markers, subject.skeleton.size_ratio
    from_wrist = subject.skeleton.offsets[joint] - model.palm_position * size_ratio - find_forearm_shift(subject, hand.side)
    palm = build_subject_marker_set(subject).select_markers([subject.labels[k] for k in rows])
    columns = palm.find_columns(labels)
    shown = columns >= 0
    offsets = (subject.marker_offsets[rows] + from_wrist) / size_ratio
    marker_set = replace(
        own,
        labels=(*own.labels, *np.array(palm.labels, str)[shown].tolist()),
        joints=np.concatenate([own.joints, np.zeros(int(shown.sum()), int)]),
        marker_offsets=np.concatenate([own.marker_offsets, offsets[shown]]),
        marker_spread=np.concatenate([own.marker_spread, np.full(int(shown.sum()), model.palm_marker_sd_m)]),
        aliases=(*own.aliases, *((),) * int(shown.sum())),
    )
    return FingerMarkers(hand.side, marker_set, np.concatenate([hand.columns, columns[shown]]))


def solve_hand(
    hand: CalibratedHand,
    markers: Float[np.ndarray, "T K 3"],
    is_used: Bool[np.ndarray, "T K"],
    palm: PalmPath,
    rate: float,
) -> HandMotion:
    """Return the motion of a calibrated hand; arguments as of `calibrate_hand`."""
    measured, frames = np.where(is_used[..., None], markers, 0.0), np.arange(len(markers))
    tracking = hand.track_palm(palm)
    start = pose_in_closed_form(hand, np.where(is_used[..., None], markers, np.nan), palm)
    poses, _ = minimise_hand_poses(hand, hand.build_terms(measured, is_used, tracking), start, ROBUST_SCALES_M, POSE_ITERATIONS)
    is_unobserved = _find_unobserved(hand, is_used)
    if is_unobserved.any():
        across, _ = smoothing.track_across_gaps(poses[1], is_unobserved, rate)
        rotations, weight = across.rotations, across.weight
        rotations[:, 0], weight[:, 0] = tracking.rotations[:, 0], tracking.weight[:, 0]
        tracking = tracking._replace(rotations=rotations, weight=weight)
        lost = np.flatnonzero(is_unobserved.any(1))  # the other frames keep their poses
        terms = hand.build_terms(measured[lost], is_used[lost], TrackingTerm(*(each[lost] for each in tracking)))
        found, _ = minimise_hand_poses(hand, terms, _select(poses, lost), ROBUST_SCALES_M[-1:], POSE_ITERATIONS)
        poses[0][lost], poses[1][lost] = found
    known = np.flatnonzero(find_key_frames(frames, is_used, rate))
    uncertainty = _compute_uncertainty(
        hand, measured[known], is_used[known], TrackingTerm(*(each[known] for each in tracking)), _select(poses, known)
    )
    uncertainty = PoseUncertainty(*(interpolate_rows(each, known, frames) for each in uncertainty))
    smooth = smoothing.smooth_poses(poses[0], poses[1].copy(), uncertainty, is_unobserved, hand.model.free_joints, rate)
    if hand.markers.markers.point_sd:  # each frame by itself would shake: the noise of keypoints is as large as the bones
        poses = smooth.root, smooth.rotations
    else:
        root, local = hand.place_palm(palm)
        smooth.rotations[:, 0], smooth.weight[:, 0] = local[:, 0], palm.sd_rad**-2.0
        smooth = smooth._replace(root=root, root_weight=palm.sd_m**-2.0)
        terms = hand.build_terms(measured, is_used, smooth)
        poses, _ = minimise_hand_poses(hand, terms, poses, ROBUST_SCALES_M[-1:], POSE_ITERATIONS)
    carriers = hand.markers.turning_joints
    is_seen = np.stack([is_used[:, (carriers > ray) & (carriers <= ray + 3)].any(1) for ray in RAY_ROOTS], axis=1)
    point_sd = np.concatenate([uncertainty.joint_sd[:, HAND_JOINTS], uncertainty.marker_sd[:, -len(TIP_JOINTS) :]], axis=1)
    return HandMotion(
        hand,
        poses[0],
        np.ascontiguousarray(poses[1][:, 0]),
        hand.model.convert_to_palm_axes(poses[1]),
        hand.compute_points(poses),
        np.hypot(point_sd, hand.point_sd_m),
        np.sqrt(3 * uncertainty.rotation_variance[:, HAND_JOINTS]),
        is_seen,
        uncertainty.marker_sd[:, : len(carriers)],
    )


class BodyWithHands(NamedTuple):
    """The motion of J joints of a body with its hands over T frames."""

    skeleton: Skeleton
    positions: dict[int, Float[np.ndarray, "T 3"]]  # m, in the parent's axes: of the joints that move in their parents
    local_rotations: Float[np.ndarray, "T J 3 3"]


def attach_hands(
    skeleton: Skeleton,
    motion: Motion,
    rate: float,
    hands: Sequence[HandMotion],
    hand_rate: float,
    *,
    joints: Mapping[str, int] | None = None,
    rest_axes: Mapping[str, Float[np.ndarray, "3 3"]] | None = None,
    is_numbered: bool = False,
) -> BodyWithHands:
    """Return a body's motion with those of hands below its joints LeftHand and RightHand.

    Args:
        rate: Frames per second of the body's motion.
        hand_rate: Those of the hands, which begin at the same time.
        joints: By side the joints that carry the hands, if they have other names.
        rest_axes: By side the palm's axes in the rest pose of the skeleton; by default the world's.
        is_numbered: Whether fingers have HumanIK's names (LeftHandIndex1), which a skeleton must not have itself.
    """
    body_positions, body_rotations = compute_world_poses(skeleton, motion)
    names, parents, positions = list(skeleton.names), skeleton.parents.tolist(), {0: motion.root_position}
    offsets, ends, rotations = [skeleton.offsets], [skeleton.ends], [motion.local_rotations]
    for hand in hands:
        palm, model = len(names), hand.hand.model
        side, axes = model.side, rest_axes[model.side] if rest_axes else np.eye(3)
        carrier = joints[side] if joints else skeleton.find_joint(f"{side}Hand")
        moved = resample_motion(hand.motion, hand_rate, rate)
        turn = body_rotations[:, carrier].swapaxes(-1, -2)
        positions[palm] = (turn @ (moved.root_position - body_positions[:, carrier])[..., None])[..., 0]
        palm_rotation, turned = turn @ moved.local_rotations[:, 0] @ axes.T, axes @ moved.local_rotations[:, 1:] @ axes.T
        rotations.append(np.concatenate([palm_rotation[:, None], turned], axis=1))
        rest, tips = model.skeleton.rest_positions @ axes.T, np.full((1 + len(HAND_JOINTS), 3), np.nan)
        rest_tips = model.skeleton.compute_rest_ends()[TIP_JOINTS] @ axes.T
        tips[JOINTS_PER_RAY::JOINTS_PER_RAY] = rest_tips - rest[TIP_JOINTS]
        offsets += [np.median(positions[palm], axis=0)[None], model.ray_offsets @ axes.T]
        ends.append(tips)
        names += [f"{side}Palm", *model.joint_names] if is_numbered else [f"{side}{name}" for name in ATTACHED_NAMES]
        parents += [carrier, *(palm + index if index % JOINTS_PER_RAY else palm for index in range(len(HAND_JOINTS)))]
    tree = Skeleton(tuple(names), np.array(parents), np.concatenate(offsets), np.concatenate(ends))
    return BodyWithHands(tree, positions, np.concatenate(rotations, axis=1))


def _find_unobserved(hand: CalibratedHand, is_used: Bool[np.ndarray, "T K"]) -> Bool[np.ndarray, "T J"]:
    """Return the joints that no marker shows in a frame, if one does in others."""
    subject = replace(hand.subject, joints=hand.markers.turning_joints)
    return find_unobserved_joints(is_used, subject, hand.model.free_joints)


def _compute_uncertainty(
    hand: CalibratedHand, measured: np.ndarray, is_used: np.ndarray, tracking: TrackingTerm, poses: Poses
) -> PoseUncertainty:
    """Return the uncertainty of poses under all terms; the last five points are the tips."""
    terms, latent = hand.build_terms(measured, is_used, tracking), linearise_hand_prior(hand, len(measured))
    codes = np.zeros((len(measured), hand.model.prior.code_size))
    return compute_uncertainty(hand.tree, (*terms, latent), poses, (ROBUST_SCALES_M[-1] / MARKER_SD_M) ** 2, codes=codes)


def _select(poses: Poses, frames: Int[np.ndarray, " N"]) -> Poses:
    return poses[0][frames], poses[1][frames]


def pose_in_closed_form(
    hand: CalibratedHand, points: Float[np.ndarray, "T K 3"], palm: PalmPath, variant: hybrik.HybrikVariant = "adaptive"
) -> Poses:
    """Return the poses of frames that are independent of each other; joints without points beyond them have the mean pose.

    This is HybrIK on the tree of the hand. The palm is registered to the wrist and the knuckles. Then each joint is swung, from
    the place that it obtained, to the points at the end of its segment (HybrIK's Algorithm 2). Fingers have hinges: the twist of
    a joint is near zero, and turns the plane in which the next joint bends towards the points beyond. The saddle joint of the
    thumb pronates as it opposes: its twist follows from its swing, by the hand's prior.

    Args:
        points: The markers of the hand in metres, NaN where unknown.
        palm: What the body says of the palm; its wrist and axes are points beside those of the hand.
        variant: "adaptive", or "naive" for comparison.
    """
    skeleton, (joints, offsets) = hand.model.skeleton, hand.attachment
    count, mean = len(skeleton.names), skeleton.rest_rotations.copy()
    mean[HAND_JOINTS] = mean[HAND_JOINTS] @ compute_rotations(hand.model.prior.mean_vectors[HAND_JOINTS])
    carriers = hand.markers.turning_joints
    of_bones: list[list[hybrik.BonePoint]] = [[] for _ in skeleton.names]
    for k, (joint, offset) in enumerate(zip(joints.tolist(), offsets, strict=True)):
        place = offset
        while joint != carriers[k]:  # up to the palm across the root of a ray
            place, joint = skeleton.offsets[joint] + mean[joint] @ place, skeleton.parents[joint]
        of_bones[joint].append(hybrik.BonePoint(count + k, place, True, 0.0))
    root_points, of_bones[0] = of_bones[0], []
    for joint in HAND_JOINTS[np.isin(HAND_JOINTS, skeleton.parents)]:
        child = joint + 1  # a hinge
        for point in [each for each in of_bones[child] if each.is_child]:
            variance = (hand.model.prior.axis_sd_rad[child, 1] * np.linalg.norm(point.rest_position)) ** 2
            place = skeleton.offsets[child] + mean[child] @ point.rest_position
            of_bones[joint].append(hybrik.BonePoint(point.point_index, place, False, float(variance)))
    root, rest = hand.place_palm(palm)
    axes = root[:, None] + PALM_LEVER_M * rest[:, 0].swapaxes(-1, -2)
    root_points += [hybrik.BonePoint(count + len(joints) + axis, PALM_LEVER_M * np.eye(3)[axis], False, 0.0) for axis in range(3)]
    every, is_centre = np.full((len(points), count, 3), np.nan), joints != carriers
    every[:, joints[is_centre]] = points[:, is_centre]
    every = np.concatenate([every, points, axes], axis=1)
    variance = np.ones(every.shape[:2])
    variance[:, count:-3] = hand.marker_sd_m**2
    variance[:, -3:] = (palm.sd_m**2 + (PALM_LEVER_M * palm.sd_rad) ** 2)[:, None]
    root, rotation, _ = hybrik.register_root(hybrik.pack_root_points(root_points), every, variance, True)
    local = np.tile(mean, (len(points), 1, 1, 1))
    local[:, 0] = rotation
    twists = np.zeros((len(points), count, 2))
    twists[:, HAND_JOINTS, 0] = hand.model.prior.axis_sd_rad[HAND_JOINTS, 0] ** -2.0
    thumb = RAY_ROOTS[0] + 1
    place = root + (local[:, 0] @ skeleton.offsets[RAY_ROOTS[0]])
    aim = ((every[:, thumb + 1] - place)[:, None] @ local[:, 0] @ mean[RAY_ROOTS[0]])[:, 0]
    twists[:, thumb] = predict_saddle_twist(hand.model, aim)
    bones = hybrik.pack_bones(skeleton, of_bones, np.zeros(count, bool), np.full(count, -1))
    hybrik.solve_hybrik_tree(bones, (every, variance, twists), (root, local), variant)
    return root, local


def predict_saddle_twist(model: HandModel, aim: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 2"]:
    """Return cosine and sine, times the information, of the twist of the thumb's saddle joint.

    Args:
        aim: The direction of the thumb's first bone in the axes of its ray; NaN where unknown, for the mean twist.
    """
    joint, prior = RAY_ROOTS[0] + 1, model.prior
    along = model.skeleton.offsets[joint + 1] / np.linalg.norm(model.skeleton.offsets[joint + 1])
    modes = prior.components[:, joint]
    covariance = modes.T @ modes + np.diag(prior.axis_sd_rad[joint] ** 2)
    gain = covariance[0, 1:] @ np.linalg.inv(covariance[1:, 1:])
    axis = np.cross(along, aim)
    sine = np.linalg.norm(axis, axis=1)
    turn = axis * (np.arctan2(sine, aim @ along) / np.maximum(sine, 1e-12))[:, None]
    beside = np.nan_to_num(turn[:, 1:] - prior.mean_vectors[joint, 1:])
    twist = (prior.mean_vectors[joint, 0] + beside @ gain) * along[0]
    return np.stack([np.cos(twist), np.sin(twist)], axis=1) / (covariance[0, 0] - gain @ covariance[1:, 0])
