"""Synthetic takes: a person who walks, reaches, crouches and turns round, with the truth that a real take does not contain.

Everything is planned from the floor up: a foot in stance does not move, and the body follows. Left is index 0, right is 1.
Angles are anatomical: about the axes of a person standing with hanging arms, X to their left, Y up, Z forward. Negative about X
lifts an arm or leans back, positive about Y turns to the left. A joint's "posture" is its world rotation relative to standing
with hanging arms, so its world rotation is posture times standing rotation, for any rest axes.

The demo compares the error of each method of filling on such a take, by kind of damage.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import make_interp_spline
from scipy.ndimage import gaussian_filter1d, minimum_filter1d
from scipy.spatial.transform import Rotation

from mocapfix.io.c3d import write_c3d
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton, compute_local_rotations, load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.result import CleaningResult
from mocapfix.solve.kinematics import compute_joint_and_marker_positions, compute_world_poses
from mocapfix.stats.sequences import find_runs
from mocapfix.subject.library import load_marker_set

Curve = Float[np.ndarray, " T"]
Rotations = Float[np.ndarray, "T 3 3"]
Positions = Float[np.ndarray, "T 3"]

CYCLE_DURATION_S = 10.0  # walk, reach, crouch, turn by half a circle; then the same back again
ANKLE_HEIGHT_M = 0.075  # from the sole
TOE_PIVOT_M = 0.17  # forward of the ankle: the point about which a foot rolls off the floor
HEEL_PIVOT_M = -0.06  # forward of the ankle: the point on which a foot lands
SWING_CLEARANCE_M = 0.035  # by which a swinging foot is lifted
HEEL_RISE_RAD = np.radians(40)  # pitch of the foot when a full stride begins
TOE_LIFT_RAD = np.radians(18)  # opposite pitch when it ends
RISE_WINDOW_S = (-0.22, 0.25)  # of the heel rise, relative to the start of the swing
LIFT_WINDOW_S = (-0.20, 0.12)  # of the toe lift, relative to the end of the swing


class FootStep(NamedTuple):
    """One step of a foot in the schedule of a cycle."""

    foot: int
    start_s: float
    swing_s: float
    strides: float  # from the start of the walk
    heading_deg: float  # to the left


STEP_SCHEDULE = (
    FootStep(1, 0.40, 0.46, 0.5, 0),
    FootStep(0, 0.98, 0.46, 1.5, 0),
    FootStep(1, 1.56, 0.46, 2.5, 0),
    FootStep(0, 2.14, 0.46, 3.5, 0),
    FootStep(1, 2.72, 0.46, 4.5, 0),
    FootStep(0, 3.30, 0.46, 4.5, 0),
    FootStep(0, 7.40, 0.40, 4.5, 55),
    FootStep(1, 7.84, 0.40, 4.5, 95),
    FootStep(0, 8.28, 0.40, 4.5, 145),
    FootStep(1, 8.72, 0.40, 4.5, 180),
    FootStep(0, 9.16, 0.40, 4.5, 180),
)


@dataclass(frozen=True)
class FootMotion:
    """Both feet over T frames."""

    floor_position: Float[np.ndarray, "T 2 3"]  # metres: the point on the floor under the ankle of the flat foot
    yaw_rad: Float[np.ndarray, "T 2"]  # heading, to the left of +Z
    is_swinging: Bool[np.ndarray, "T 2"]
    ankle_position: Float[np.ndarray, "T 2 3"]  # metres
    foot_rotation: Float[np.ndarray, "T 2 3 3"]  # in the world, the identity for a flat foot heading along +Z


def compute_ramp(time_s: Curve, first_s: float, last_s: float) -> Curve:
    """Return 0 before `first_s`, 1 after `last_s`, between them the minimum-jerk curve of reaching (Flash and Hogan 1985)."""
    u = np.clip((time_s - first_s) / (last_s - first_s), 0, 1)
    return u**3 * (10 - 15 * u + 6 * u**2)


def compute_bump(time_s: Curve, first_s: float, last_s: float) -> Curve:
    """Return 1 half-way between `first_s` and `last_s`, decreasing smoothly to 0 at both."""
    x = np.clip(2 * (time_s - first_s) / (last_s - first_s) - 1, -1, 1)
    return (1 - x**2) ** 3


def compute_axis_rotation(axis: str, angle_rad: Float[np.ndarray, "*batch"] | float) -> Float[np.ndarray, "*batch 3 3"]:
    """Return rotations about X, Y or Z."""
    return Rotation.from_euler(axis, np.reshape(angle_rad, (-1, 1))).as_matrix().reshape(*np.shape(angle_rad), 3, 3)


def plan_footsteps(time_s: Curve, stride_m: float, half_width_m: float) -> FootMotion:
    """Return the feet of a person of a given stride and half distance between the hips."""
    place, yaw = np.zeros((len(time_s), 2, 3)), np.zeros((len(time_s), 2))
    lift, heel_rise, toe_lift = np.zeros((3, len(time_s), 2))
    is_swinging = np.zeros((len(time_s), 2), bool)
    side = np.array([half_width_m, -half_width_m])
    place[:, :, 0] = side
    here, heading = place[0].copy(), np.zeros(2)
    for foot, start, swing, strides, turn in _generate_steps(time_s[-1]):
        end = start + swing
        there = np.array([np.cos(turn) * side[foot], 0, stride_m * strides - np.sin(turn) * side[foot]])
        done, effort = compute_ramp(time_s, start, end), np.linalg.norm(there - here[foot]) / (2 * stride_m)
        place[:, foot] += done[:, None] * (there - here[foot])
        yaw[:, foot] += done * (turn - heading[foot])
        here[foot], heading[foot] = there, turn
        lift[:, foot] += SWING_CLEARANCE_M * compute_bump(time_s, start, end)
        heel_rise[:, foot] += HEEL_RISE_RAD * effort * compute_bump(time_s, start + RISE_WINDOW_S[0], start + RISE_WINDOW_S[1])
        toe_lift[:, foot] += TOE_LIFT_RAD * effort * compute_bump(time_s, end + LIFT_WINDOW_S[0], end + LIFT_WINDOW_S[1])
        is_swinging[:, foot] |= (time_s > start) & (time_s < end)
    flat = compute_axis_rotation("Y", yaw)
    roll_shift = _compute_roll_shift(heel_rise, TOE_PIVOT_M) + _compute_roll_shift(-toe_lift, HEEL_PIVOT_M)
    ankle = place + np.einsum("tfab,tfb->tfa", flat, roll_shift)
    ankle[..., 1] += ANKLE_HEIGHT_M + lift
    return FootMotion(place, yaw, is_swinging, ankle, flat @ compute_axis_rotation("X", heel_rise - toe_lift))


def _generate_steps(end_s: float) -> Iterator[tuple[int, float, float, float, float]]:
    """Yield foot, start, swing duration, strides and heading (rad) of all steps; every second cycle walks back."""
    length = STEP_SCHEDULE[-1].strides
    for cycle in range(int(end_s // CYCLE_DURATION_S) + 1):
        for foot, start, swing, strides, degrees in STEP_SCHEDULE:
            along = length - strides if cycle % 2 else strides
            yield foot, start + CYCLE_DURATION_S * cycle, swing, along, np.radians(degrees + 180 * cycle)


def _compute_roll_shift(pitch_rad: Float[np.ndarray, "T 2"], pivot_m: float) -> Float[np.ndarray, "T 2 3"]:
    """Return the ankle's shift when the foot pitches about the floor `pivot_m` in front of it."""
    up = ANKLE_HEIGHT_M * (np.cos(pitch_rad) - 1) + pivot_m * np.sin(pitch_rad)
    forward = ANKLE_HEIGHT_M * np.sin(pitch_rad) + pivot_m * (1 - np.cos(pitch_rad))
    return np.stack([np.zeros_like(pitch_rad), up, forward], axis=-1)


REACH_LEFT_TIMES_S = (3.8, 4.5, 4.8, 5.5)
REACH_RIGHT_TIMES_S = (4.7, 5.4, 5.7, 6.4)
CROUCH_TIMES_S = (5.9, 6.5, 6.8, 7.4)
LOOK_LEFT_TIMES_S = (7.0, 7.5, 8.0, 8.6)
LOOK_RIGHT_TIMES_S = (8.6, 9.1, 9.3, 9.9)

GESTURES = (  # joint, axis, degrees, times
    # the left hand reaches forward to shoulder height, and the head faces it
    ("LeftArm", "x", -88, REACH_LEFT_TIMES_S),
    ("LeftForeArm", "x", 8, REACH_LEFT_TIMES_S),
    ("LeftShoulder", "y", -10, REACH_LEFT_TIMES_S),
    ("Spine", "y", -10, REACH_LEFT_TIMES_S),
    ("Spine", "x", 6, REACH_LEFT_TIMES_S),
    ("Neck", "y", 14, REACH_LEFT_TIMES_S),
    # the right hand reaches up and out
    ("RightArm", "x", -125, REACH_RIGHT_TIMES_S),
    ("RightArm", "y", -28, REACH_RIGHT_TIMES_S),
    ("RightForeArm", "x", 6, REACH_RIGHT_TIMES_S),
    ("RightShoulder", "z", -12, REACH_RIGHT_TIMES_S),
    ("Spine", "z", 5, REACH_RIGHT_TIMES_S),
    ("Neck", "y", -25, REACH_RIGHT_TIMES_S),
    ("Neck", "x", -15, REACH_RIGHT_TIMES_S),
    # the hands go to the knees, the head stays up
    ("LowerBack", "x", 14, CROUCH_TIMES_S),
    ("Spine", "x", 8, CROUCH_TIMES_S),
    ("Neck1", "x", -18, CROUCH_TIMES_S),
    ("LeftArm", "x", -55, CROUCH_TIMES_S),
    ("RightArm", "x", -55, CROUCH_TIMES_S),
    ("LeftForeArm", "x", -25, CROUCH_TIMES_S),
    ("RightForeArm", "x", -25, CROUCH_TIMES_S),
    # the head faces the direction of the turn, and then looks around
    ("Neck", "y", 22, LOOK_LEFT_TIMES_S),
    ("Head", "y", 20, LOOK_LEFT_TIMES_S),
    ("Neck", "y", -20, LOOK_RIGHT_TIMES_S),
    ("Head", "y", -18, LOOK_RIGHT_TIMES_S),
)


def compute_plateau(time_s: Curve, times_s: tuple[float, float, float, float]) -> Curve:
    """Return a curve from 0 to 1 and back, at the same times of every cycle."""
    begins, is_complete, begins_to_end, has_ended = times_s
    cycle_time_s = time_s % CYCLE_DURATION_S
    return compute_ramp(cycle_time_s, begins, is_complete) - compute_ramp(cycle_time_s, begins_to_end, has_ended)


def compute_gesture_angles(gait_phase: Curve, pelvis_drop_deg: Curve, time_s: Curve) -> dict[str, Positions]:
    """Return angles in degrees about X, Y, Z of the rotated joints above the pelvis, each in its parent's axes.

    Args:
        gait_phase: Distance of the left foot in front of the right, in strides.
        pelvis_drop_deg: Rotation of the pelvis about Z, which the back compensates.
    """
    zeros, ones = np.zeros_like(gait_phase), np.ones_like(gait_phase)
    curves = {  # the shoulders rotate against the hips, the head with neither
        "LowerBack": [ones, 4 * gait_phase, -pelvis_drop_deg],
        "Spine": [2 * ones, 4 * gait_phase, zeros],
        "Spine1": [zeros, 4 * gait_phase, zeros],
        "Neck": [zeros, -4 * gait_phase, zeros],
        "Neck1": [zeros, -3 * gait_phase, zeros],
    }
    for side, swing in (("Left", -gait_phase), ("Right", gait_phase)):  # an arm swings with the opposite leg
        curves[f"{side}Arm"] = [4 - 20 * swing, zeros, zeros]
        curves[f"{side}ForeArm"] = [-20 - 8 * swing, zeros, zeros]
    angles = {joint: np.stack(curve, axis=1) for joint, curve in curves.items()}
    for joint, axis, degrees, times_s in GESTURES:
        joint_angles = angles.setdefault(joint, np.zeros((len(time_s), 3)))
        joint_angles[:, "xyz".index(axis)] += degrees * compute_plateau(time_s, times_s)
    return angles


STRIDE_TO_LEG_RATIO = 0.68  # distance from one foot's place to the other's, over the leg's length
MAX_LEG_EXTENSION_RATIO = 0.992  # hip to ankle over the leg's length: a standing person's knees are not locked
ARM_HANG_ANGLE_RAD = np.radians(75)  # rotation of an arm about Z from the T-pose
ARM_HANG_TWIST_RAD = np.radians(30)  # rotation of a hanging arm about itself: the elbow's hinge, as the skeleton has it, then
# points to the side, and the forearm bends forwards; the markers of elbow and wrist lie on the arm accordingly
CROUCH_DEPTH_M = 0.26  # by which the hips are lowered in a crouch
CROUCH_BACKWARD_M = 0.06  # by which they move back in it
PELVIS_FORWARD_M = 0.02  # of the pelvis in front of the feet
PELVIS_DROP_DEG = 4.0  # on the side of the swinging leg
PELVIS_YAW_DEG = 5.0  # per stride that a foot is ahead
PELVIS_PITCH_DEG = 3.0  # of the standing pelvis
ELBOW_HINGE_LEAN_RAD = {"LeftForeArm": np.pi / 2 - ARM_HANG_ANGLE_RAD, "RightForeArm": ARM_HANG_ANGLE_RAD - np.pi / 2}
# rotation about Z of the hinge from X in standing: it is perpendicular to the arm, which hangs a little to the side
CROUCH_PITCH_DEG = 22.0  # added in a crouch
SUPPORT_SHIFT = 0.1  # of the distance between the feet, by which the pelvis moves towards the standing one

# Standard deviations, in seconds, of the Gaussian filters that make the plan's steps smooth.
DROP_SMOOTHING_S = 0.08
PHASE_SMOOTHING_S = 0.06
YAW_SMOOTHING_S = 0.15
SUPPORT_SMOOTHING_S = 0.13
HEIGHT_SMOOTHING_S = 0.12  # radius of the running minimum and mean of the pelvis' height


def compose_motion(subject: Subject, seconds: float, rate: float) -> Motion:
    """Return `seconds` (more than 0) of walking, reaching, crouching and turning of this person, at `rate` Hz."""
    skeleton = subject.skeleton
    time_s = np.arange(round(seconds * rate)) / rate
    leg = np.linalg.norm(skeleton.offsets[[skeleton.find_joint("LeftLeg"), skeleton.find_joint("LeftFoot")]], axis=1)
    hips = skeleton.offsets[[skeleton.find_joint("LeftUpLeg"), skeleton.find_joint("RightUpLeg")]]
    feet = plan_footsteps(time_s, STRIDE_TO_LEG_RATIO * leg.sum(), hips[0, 0])
    heading, apart = feet.yaw_rad.mean(axis=1), feet.floor_position[:, 0] - feet.floor_position[:, 1]
    ahead = (apart[:, 0] * np.sin(heading) + apart[:, 2] * np.cos(heading)) / (STRIDE_TO_LEG_RATIO * leg.sum())
    gait_phase = gaussian_filter1d(ahead, PHASE_SMOOTHING_S * rate)  # of the left foot before the right, in strides
    drop_deg = PELVIS_DROP_DEG * gaussian_filter1d(feet.is_swinging @ [-1.0, 1.0], DROP_SMOOTHING_S * rate)
    crouch = compute_plateau(time_s, CROUCH_TIMES_S)
    # the pelvis heads as the feet do, turns with the leading leg and drops on the swinging side
    yaw = np.degrees(gaussian_filter1d(heading, YAW_SMOOTHING_S * rate)) - PELVIS_YAW_DEG * gait_phase
    turns_deg = np.stack([yaw, PELVIS_PITCH_DEG + CROUCH_PITCH_DEG * crouch, drop_deg], axis=1)
    pelvis = Rotation.from_euler("YXZ", turns_deg, degrees=True).as_matrix()
    root = _compute_root_position(feet, pelvis, hips, MAX_LEG_EXTENSION_RATIO * leg.sum(), crouch, rate)
    posture = _compute_upper_body(skeleton, pelvis, compute_gesture_angles(gait_phase, drop_deg, time_s))
    for side, name in enumerate(("Left", "Right")):
        hip = root + pelvis @ hips[side]
        posture[f"{name}UpLeg"], posture[f"{name}Leg"] = _solve_leg(hip, feet, side, leg, pelvis)
        posture[f"{name}Foot"] = posture[f"{name}ToeBase"] = feet.foot_rotation[:, side]
    return build_posture_motion(subject, root, posture)


def _compute_root_position(
    feet: FootMotion, pelvis: Rotations, hips: Float[np.ndarray, "2 3"], reach_m: float, crouch: Curve, rate: float
) -> Positions:
    """Return positions over the feet, nearer to the standing one, and as high as both legs can reach."""
    share = 0.5 + SUPPORT_SHIFT * (feet.is_swinging @ [-1.0, 1.0])[:, None]
    support = share * feet.floor_position[:, 0] + (1 - share) * feet.floor_position[:, 1]
    middle = gaussian_filter1d(support, SUPPORT_SMOOTHING_S * rate, axis=0)
    middle += (PELVIS_FORWARD_M - CROUCH_BACKWARD_M * crouch)[:, None] * pelvis[:, :, 2] * [1, 0, 1]
    from_ankle = middle[:, None] + (hips - hips.mean(axis=0)) @ pelvis.swapaxes(1, 2) - feet.ankle_position
    ceiling = np.sqrt(reach_m**2 - from_ankle[..., 0] ** 2 - from_ankle[..., 2] ** 2) - from_ankle[..., 1]
    # a running mean over the window of the running minimum never exceeds the ceiling
    radius = max(1, round(HEIGHT_SMOOTHING_S * rate))
    lowest = minimum_filter1d(ceiling.min(axis=1), 2 * radius + 1)
    middle[:, 1] = gaussian_filter1d(lowest, radius / 3, radius=radius) - CROUCH_DEPTH_M * crouch
    return middle - pelvis @ hips.mean(axis=0)


def _compute_upper_body(skeleton: Skeleton, pelvis: Rotations, angles_deg: dict[str, Positions]) -> dict[str, Rotations]:
    """Return the posture of each joint: its parent's, rotated by the gesture."""
    posture = {skeleton.names[0]: pelvis}
    for name, parent in zip(skeleton.names[1:], skeleton.parents[1:], strict=True):
        posture[name] = posture[skeleton.names[parent]]
        if name in angles_deg:
            yxz = angles_deg[name][:, [1, 0, 2]]
            turn = Rotation.from_euler("YXZ", yxz, degrees=True).as_matrix()
            if name in ELBOW_HINGE_LEAN_RAD:
                lean = compute_axis_rotation("Z", ELBOW_HINGE_LEAN_RAD[name])
                turn = lean @ turn @ lean.T
            posture[name] = posture[name] @ turn
    return posture


def _solve_leg(
    hip: Positions, feet: FootMotion, side: int, leg: Float[np.ndarray, "2"], pelvis: Rotations
) -> tuple[Rotations, Rotations]:
    """Return the postures of thigh and shin for the ankle's position, the knee pointing between pelvis and toes."""
    thigh, shin = leg
    up = hip - feet.ankle_position[:, side]
    length = np.linalg.norm(up, axis=1)
    up /= length[:, None]
    left = np.cross(up, pelvis[:, :, 2] + compute_axis_rotation("Y", feet.yaw_rad[:, side])[:, :, 2])
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    straight = np.stack([left, up, np.cross(left, up)], axis=2)
    lift = np.arccos((thigh**2 + length**2 - shin**2) / (2 * thigh * length))
    bend = np.pi - np.arccos((thigh**2 + shin**2 - length**2) / (2 * thigh * shin))
    return straight @ compute_axis_rotation("X", -lift), straight @ compute_axis_rotation("X", bend - lift)


def build_posture_motion(subject: Subject, root: Positions, posture: dict[str, Rotations]) -> Motion:
    """Return the motion of the postures of all joints by name, with zero iterations and uncertainty."""
    skeleton = subject.skeleton
    standing = _compute_standing_rotations(skeleton)
    world = np.stack([posture[name] @ standing[name] for name in skeleton.names], axis=1)
    local = compute_local_rotations(world, skeleton.parents)
    zeros = np.zeros(len(root), int)
    return Motion(root, local, zeros, zeros, np.zeros((len(root), len(subject.labels))), np.zeros(local.shape[:2]))


def _compute_standing_rotations(skeleton: Skeleton) -> dict[str, Float[np.ndarray, "3 3"]]:
    """Return each joint's world rotation in standing: the legs, spread in the rest pose, together, and the arms hanging."""
    x, y, _ = skeleton.offsets[skeleton.find_joint("LeftLeg")]
    spread = np.arctan2(x, -y)
    twist = compute_axis_rotation("X", ARM_HANG_TWIST_RAD)
    turned = {
        "LeftUpLeg": compute_axis_rotation("Z", -spread),
        "RightUpLeg": compute_axis_rotation("Z", spread),
        "LeftArm": compute_axis_rotation("Z", -ARM_HANG_ANGLE_RAD) @ twist,
        "RightArm": compute_axis_rotation("Z", ARM_HANG_ANGLE_RAD) @ twist,
    }
    standing = {skeleton.names[0]: np.eye(3)}
    for name, parent in zip(skeleton.names[1:], skeleton.parents[1:], strict=True):
        standing[name] = turned.get(name, standing[skeleton.names[parent]])
    return standing


BONE_GROUP_LENGTH_SD = 0.04  # of a bone group's length, relative
BONE_LENGTH_SD = 0.03  # of a single bone's length beside its group's, relative (about that of CMU's subjects)
BONE_LEAN_SD_RAD = 0.06  # per axis, of a single bone's direction
LEANING_JOINTS = ("LeftUpLeg", "RightUpLeg", "Spine", "Spine1", "Neck", "Neck1", "Head", "LeftArm", "RightArm")  # not the limbs
MARKER_PLACEMENT_SD_M = 0.012  # per axis, of a marker's offset on the person
SKIN_SLIDE_SD_M = 0.004  # per axis, of a marker's motion with the skin
SKIN_SLIDE_TIME_S = 0.3  # after which its correlation has fallen to 1/e
CAMERA_NOISE_SD_M = 0.0003  # per axis, of a sample

DAMAGED_ARM_JOINTS = ("LeftArm", "LeftForeArm", "LeftHand")
ARM_GAP_S = (1.0, 2.5)  # while the arm swings
LATE_START_S = 0.5  # until one of the markers is first visible
SHORT_GAP_RATE_HZ = 0.12  # gaps a second and marker
SHORT_GAP_DURATION_S = (0.03, 0.2)
LONG_GAP_RATE_HZ = 0.6  # gaps a second, over all markers
LONG_GAP_DURATION_S = (0.5, 3.0)
SPIKE_RATE_HZ = 1.5  # spikes a second, over all markers
SPIKE_DURATION_S = (0.008, 0.025)
MIN_SPIKE_M = 0.03  # a spike's displacement is up to ten times this


@dataclass(frozen=True)
class SyntheticTake:
    """A synthetic take: the truth, and what the cameras measured."""

    motion: Motion  # (T frames) of the subject's skeleton
    subject: Subject  # the person's true bones and marker offsets
    joint_positions: Float[np.ndarray, "T J 3"]  # metres, in the world
    marker_positions: Float[np.ndarray, "T M 3"]  # metres, without damage
    damaged_positions: Float[np.ndarray, "T M 3"]  # metres, with spikes, NaN where missing
    missing_mask: Bool[np.ndarray, "T M"]  # samples in gaps
    spike_mask: Bool[np.ndarray, "T M"]  # samples displaced by a spike
    labels: tuple[str, ...]  # M marker labels
    rate: float  # Hz


def compose_take(seed: int = 0, seconds: float = 10.0, rate: float = 120.0, asymmetric: bool = False) -> SyntheticTake:
    """Return a take of a person who walks, reaches, crouches and turns round, repeatedly; the same for the same arguments.

    The seed determines the person, the skin and the damage; the motion depends on the length of the person's legs only.

    Args:
        asymmetric: Give every bone its own length and direction, as people have, instead of scaling groups of bones only.
    """
    rng = np.random.default_rng(seed)
    subject = draw_subject(rng, asymmetric)
    motion = compose_motion(subject, seconds, rate)
    joints, markers = simulate_markers(rng, subject, motion, rate)
    is_arm_marker = np.isin(subject.joints, [subject.skeleton.find_joint(name) for name in DAMAGED_ARM_JOINTS])
    missing = draw_gaps(rng, motion.frame_count, rate, is_arm_marker)
    shift = draw_spikes(rng, ~missing, rate)
    damaged = np.where(missing[..., None], np.nan, markers + shift)
    return SyntheticTake(motion, subject, joints, markers, damaged, missing, (shift != 0).any(axis=2), subject.labels, rate)


def write_synthetic_take(path: Path, synthetic: SyntheticTake) -> None:
    """Write the damaged take as a C3D file, as a capture system would export it: millimetres, Z up, frames numbered from 1."""
    markers = np.where(synthetic.missing_mask[..., None], np.nan, synthetic.damaged_positions)
    write_c3d(path, Take(markers, synthetic.labels, synthetic.rate))


def draw_subject(rng: np.random.Generator, asymmetric: bool, marker_set_name: str = "cmu41") -> Subject:
    """Return the average body with every group of bones scaled at random, and markers of a shipped set placed with errors."""
    nominal = load_marker_set(marker_set_name)
    offsets = nominal.marker_offsets + rng.normal(0, MARKER_PLACEMENT_SD_M, nominal.marker_offsets.shape)
    spread = np.full(len(nominal.labels), SKIN_SLIDE_SD_M)
    body = load_cmu31_body()
    lengths = body.skeleton.offsets.copy()
    for joints in body.bone_groups.values():
        lengths[list(joints)] *= rng.normal(1, BONE_GROUP_LENGTH_SD)
    skeleton = replace(body.skeleton, offsets=lengths)
    skeleton = _vary_bones(rng, skeleton) if asymmetric else skeleton
    return Subject(skeleton, nominal.name, nominal.labels, nominal.joints, offsets, spread)


def _vary_bones(rng: np.random.Generator, skeleton: Skeleton) -> Skeleton:
    """Return the skeleton with an own length for each bone and, for bones that do not lie along their axis, an own direction."""
    offsets = skeleton.offsets * rng.normal(1, BONE_LENGTH_SD, (len(skeleton.names), 1))
    leans = Rotation.from_rotvec(rng.normal(0, BONE_LEAN_SD_RAD, offsets.shape)).as_matrix()
    leaning = [skeleton.find_joint(name) for name in LEANING_JOINTS]
    offsets[leaning] = np.einsum("jab,jb->ja", leans[leaning], offsets[leaning])
    shoulders = [skeleton.find_joint("LeftShoulder"), skeleton.find_joint("RightShoulder")]
    offsets[shoulders] = offsets[skeleton.find_joint("Neck")]  # the thorax, one bone, carries all three
    return replace(skeleton, offsets=offsets)


def simulate_markers(
    rng: np.random.Generator, subject: Subject, motion: Motion, rate: float
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T M 3"]]:
    """Return joints and markers of a motion, in metres; the markers slide with the skin and have camera noise."""
    _, rotation = compute_world_poses(subject.skeleton, motion)
    slide = _simulate_skin_motion(rng, motion.frame_count, len(subject.labels), rate)
    joints, markers = compute_joint_and_marker_positions(subject, motion)
    noise = rng.normal(0, CAMERA_NOISE_SD_M, markers.shape)
    markers += np.einsum("tkab,tkb->tka", rotation[:, subject.joints], slide) + noise
    return joints, markers


def _simulate_skin_motion(rng: np.random.Generator, frames: int, markers: int, rate: float) -> Float[np.ndarray, "T M 3"]:
    """Return smooth displacements in metres whose correlation falls to 1/e after SKIN_SLIDE_TIME_S."""
    sigma = SKIN_SLIDE_TIME_S / 2 * rate  # white noise filtered by a Gaussian of sigma has correlation exp(-lag^2 / 4 sigma^2)
    margin = round(4 * sigma)
    white = rng.normal(size=(frames + 2 * margin, markers, 3))
    smooth = gaussian_filter1d(white, sigma, axis=0)[margin : margin + frames]
    return smooth * SKIN_SLIDE_SD_M * np.sqrt(2 * np.sqrt(np.pi) * sigma)


def draw_gaps(
    rng: np.random.Generator, frames: int, rate: float, is_arm_marker: Bool[np.ndarray, " M"]
) -> Bool[np.ndarray, "T M"]:
    """Return a mask of the missing samples; the arm's markers are lost together."""
    missing = np.zeros((frames, len(is_arm_marker)), bool)
    seconds = frames / rate
    short_gaps = (SHORT_GAP_RATE_HZ * len(is_arm_marker), *SHORT_GAP_DURATION_S)
    for gap_rate_hz, shortest_s, longest_s in (short_gaps, (LONG_GAP_RATE_HZ, *LONG_GAP_DURATION_S)):
        for _ in range(rng.poisson(gap_rate_hz * seconds)):
            first, marker = rng.integers(frames), rng.integers(len(is_arm_marker))
            duration_s = shortest_s * (longest_s / shortest_s) ** rng.random()
            missing[first : first + max(1, round(duration_s * rate)), marker] = True
    first, end = (round(time_s * rate) for time_s in ARM_GAP_S)
    missing[first:end, is_arm_marker] = True
    late_marker = rng.integers(len(is_arm_marker))
    missing[: round(LATE_START_S * rate), late_marker] = True
    return missing


def draw_spikes(rng: np.random.Generator, is_visible: Bool[np.ndarray, "T M"], rate: float) -> Float[np.ndarray, "T M 3"]:
    """Return displacements in metres of the visible samples: 0 for nearly all."""
    frames, count = is_visible.shape
    shift = np.zeros((frames, count, 3))
    for _ in range(rng.poisson(SPIKE_RATE_HZ * frames / rate)):
        marker = rng.integers(count)
        visible_runs = find_runs(is_visible[:, marker])
        if not visible_runs:
            continue
        first, last = visible_runs[rng.integers(len(visible_runs))]
        start = rng.integers(first, last + 1)
        stop = min(last + 1, start + max(1, round(rng.uniform(*SPIKE_DURATION_S) * rate)))
        direction = rng.normal(size=3)
        shift[start:stop, marker] = direction / np.linalg.norm(direction) * MIN_SPIKE_M * 10 ** rng.random()
    return shift


MIN_ARM_MARKERS = 6  # missing at the same time: a whole arm
MAX_SHORT_GAP_S = 0.5  # half of all gaps are shorter; nine tenths of the missing samples are in longer gaps
SPLINE_DEGREES = (("linear", 1), ("cubic", 3))
MIN_SPLINE_SAMPLES = 5  # of a marker that is interpolated


def interpolate_markers(markers: Float[np.ndarray, "T M 3"], degree: int) -> Float[np.ndarray, "T M 3"]:
    """Return markers with gaps filled by a spline in time; at the ends of the take the nearest sample is repeated."""
    frames, filled = np.arange(len(markers)), markers.copy()
    for m in range(markers.shape[1]):
        is_visible = ~np.isnan(markers[:, m, 0])
        if not MIN_SPLINE_SAMPLES <= is_visible.sum() < len(markers):
            continue
        visible_frames = frames[is_visible]
        missing_frames = np.clip(frames[~is_visible], visible_frames[0], visible_frames[-1])
        filled[~is_visible, m] = make_interp_spline(visible_frames, markers[is_visible, m], k=degree)(missing_frames)
    return filled


def compute_fill_errors(truth: SyntheticTake, result: CleaningResult) -> dict[str, dict[str, float]]:
    """Return the root mean square error in mm by method (linear, cubic, mocapfix) and by kind of damage."""
    is_long = np.zeros_like(truth.missing_mask)
    for m in range(truth.missing_mask.shape[1]):
        for first, last in find_runs(truth.missing_mask[:, m]):
            is_long[first : last + 1, m] = (last - first + 1) / truth.rate >= MAX_SHORT_GAP_S
    is_arm = is_long & (is_long.sum(1) >= MIN_ARM_MARKERS)[:, None]
    damage = {
        f"gaps under {MAX_SHORT_GAP_S:g} s": truth.missing_mask & ~is_long,
        f"one marker lost for {MAX_SHORT_GAP_S:g} s and more": is_long & ~is_arm,
        "a whole arm lost": is_arm,
        "spikes": truth.spike_mask & ~truth.missing_mask,
    }
    methods = {degree_name: interpolate_markers(truth.damaged_positions, degree) for degree_name, degree in SPLINE_DEGREES}
    methods["mocapfix"] = result.take.markers
    return {
        method: {name: compute_rms_error_mm(markers, truth, mask) for name, mask in damage.items()}
        for method, markers in methods.items()
    }


def compute_rms_error_mm(markers: Float[np.ndarray, "T M 3"], truth: SyntheticTake, mask: Bool[np.ndarray, "T M"]) -> float:
    """Return the root mean square distance from the truth in mm over the visible samples in a mask."""
    distance_mm = np.linalg.norm(markers - truth.marker_positions, axis=-1)[mask] * 1e3
    return float(np.sqrt(np.nanmean(distance_mm**2)))
