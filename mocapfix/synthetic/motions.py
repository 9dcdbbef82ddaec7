"""A body over its feet: the pelvis goes where the feet let it, legs reach down to them, the rest makes its gestures.

A joint's "posture" is the identity when standing with hanging arms (see gestures), so its rotation in the world is
posture times stance, whatever way its own axes rest.
"""

import numpy as np
from scipy.ndimage import gaussian_filter1d, minimum_filter1d
from scipy.spatial.transform import Rotation

from mocapfix.motion import Motion
from mocapfix.skeleton import Skeleton
from mocapfix.subject import Subject
from mocapfix.synthetic.footsteps import FootMotion, compute_axis_rotation, plan_footsteps
from mocapfix.synthetic.gestures import CROUCH_TIMES_S, compute_gesture_angles, compute_plateau

STRIDE_TO_LEG_RATIO = 0.68  # of the leg's length, from one foot's place to the other's
MAX_LEG_EXTENSION_RATIO = 0.992  # of the leg's length: a standing person's knees are not locked
ARM_HANG_ANGLE_RAD = np.radians(75)  # an arm about Z, from the T-pose
CROUCH_DEPTH_M = 0.26  # metres the hips go down in a crouch
CROUCH_BACKWARD_M = 0.06  # metres they go back in it


def compose_motion(subject: Subject, seconds: float, rate: float) -> Motion:
    """-> `seconds` (more than 0) of walking, reaching, crouching and turning of this person, at `rate` frames a second."""
    skeleton = subject.skeleton
    time = np.arange(round(seconds * rate)) / rate
    leg = np.linalg.norm(skeleton.offsets[[skeleton.find_joint("LeftLeg"), skeleton.find_joint("LeftFoot")]], axis=1)
    hips = skeleton.offsets[[skeleton.find_joint("LeftUpLeg"), skeleton.find_joint("RightUpLeg")]]
    feet = plan_footsteps(time, STRIDE_TO_LEG_RATIO * leg.sum(), hips[0, 0])
    lead = _compute_gait_phase(feet, STRIDE_TO_LEG_RATIO * leg.sum(), rate)
    drop = 4 * gaussian_filter1d(feet.is_swinging @ [-1.0, 1.0], 0.08 * rate)
    crouch = compute_plateau(time, CROUCH_TIMES_S)
    pelvis = _compute_pelvis_rotation(feet, lead, drop, crouch, rate)
    root = _compute_root_position(feet, pelvis, hips, MAX_LEG_EXTENSION_RATIO * leg.sum(), crouch, rate)
    posture = _compute_upper_body(skeleton, pelvis, compute_gesture_angles(lead, drop, time))
    for side, name in enumerate(("Left", "Right")):
        hip = root + pelvis @ hips[side]
        posture[f"{name}UpLeg"], posture[f"{name}Leg"] = _solve_leg(hip, feet, side, leg, pelvis)
        posture[f"{name}Foot"] = posture[f"{name}ToeBase"] = feet.foot_rotation[:, side]
    return _build_motion(subject, root, posture)


def _compute_gait_phase(feet: FootMotion, stride: float, rate: float) -> np.ndarray:
    """-> (T,) how far the left foot is in front of the right, in strides: the phase of the gait."""
    heading = feet.yaw_rad.mean(axis=1)
    apart = feet.floor_position[:, 0] - feet.floor_position[:, 1]
    return gaussian_filter1d((apart[:, 0] * np.sin(heading) + apart[:, 2] * np.cos(heading)) / stride, 0.06 * rate)


def _compute_pelvis_rotation(feet: FootMotion, lead: np.ndarray, drop: np.ndarray, crouch: np.ndarray, rate: float) -> np.ndarray:
    """-> (T, 3, 3): it heads where the feet head, turns with the leading leg and drops on the side of the swinging one."""
    yaw = np.degrees(gaussian_filter1d(feet.yaw_rad.mean(axis=1), 0.15 * rate)) - 5 * lead
    return Rotation.from_euler("YXZ", np.stack([yaw, 3 + 22 * crouch, drop], axis=1), degrees=True).as_matrix()


def _compute_root_position(
    feet: FootMotion, pelvis: np.ndarray, hips: np.ndarray, reach: float, crouch: np.ndarray, rate: float
) -> np.ndarray:
    """-> (T, 3): over the feet, a little towards the standing one, and as high as both legs allow (hence the gait's bob)."""
    share = 0.5 + 0.1 * (feet.is_swinging @ [-1.0, 1.0])[:, None]
    middle = gaussian_filter1d(share * feet.floor_position[:, 0] + (1 - share) * feet.floor_position[:, 1], 0.13 * rate, axis=0)
    middle += (0.02 - CROUCH_BACKWARD_M * crouch)[:, None] * pelvis[:, :, 2] * [1, 0, 1]
    from_ankle = middle[:, None] + (hips - hips.mean(axis=0)) @ pelvis.swapaxes(1, 2) - feet.ankle_position
    ceiling = np.sqrt(reach**2 - from_ankle[..., 0] ** 2 - from_ankle[..., 2] ** 2) - from_ankle[..., 1]
    # a running mean, with the window of the running minimum, never passes the ceiling
    radius = max(1, round(0.12 * rate))
    lowest = minimum_filter1d(ceiling.min(axis=1), 2 * radius + 1)
    middle[:, 1] = gaussian_filter1d(lowest, radius / 3, radius=radius) - CROUCH_DEPTH_M * crouch
    return middle - pelvis @ hips.mean(axis=0)


def _compute_upper_body(skeleton: Skeleton, pelvis: np.ndarray, turns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """-> (T, 3, 3) posture per joint: the parent's, turned by the gesture."""
    posture = {skeleton.names[0]: pelvis}
    for name, parent in zip(skeleton.names[1:], skeleton.parents[1:], strict=True):
        posture[name] = posture[skeleton.names[parent]]
        if name in turns:
            posture[name] = posture[name] @ Rotation.from_euler("YXZ", turns[name][:, [1, 0, 2]], degrees=True).as_matrix()
    return posture


def _solve_leg(
    hip: np.ndarray, feet: FootMotion, side: int, leg: np.ndarray, pelvis: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """-> postures (T, 3, 3) of thigh and shin that put the ankle where it is, the knee pointing between pelvis and toes."""
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


def _build_motion(subject: Subject, root: np.ndarray, posture: dict[str, np.ndarray]) -> Motion:
    """-> the motion of these postures, with the status, iterations and deviation of one that nobody had to solve."""
    skeleton = subject.skeleton
    stance = _compute_standing_rotations(skeleton)
    world = np.stack([posture[name] @ stance[name] for name in skeleton.names], axis=1)
    local = world.copy()
    local[:, 1:] = world[:, skeleton.parents[1:]].swapaxes(-1, -2) @ world[:, 1:]
    none = np.zeros(len(root), int)
    return Motion(root, local, none, none, np.zeros((len(root), len(subject.labels))), np.zeros(local.shape[:2]))


def _compute_standing_rotations(skeleton: Skeleton) -> dict[str, np.ndarray]:
    """-> (3, 3) per joint: its rotation when standing, the legs, which rest spread, brought together, the arms let down."""
    x, y, _ = skeleton.offsets[skeleton.find_joint("LeftLeg")]
    spread = np.arctan2(x, -y)
    turns = {"LeftUpLeg": -spread, "RightUpLeg": spread, "LeftArm": -ARM_HANG_ANGLE_RAD, "RightArm": ARM_HANG_ANGLE_RAD}
    stance = {skeleton.names[0]: np.eye(3)}
    for name, parent in zip(skeleton.names[1:], skeleton.parents[1:], strict=True):
        stance[name] = compute_axis_rotation("Z", turns[name]) if name in turns else stance[skeleton.names[parent]]
    return stance
