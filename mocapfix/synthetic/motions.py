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
from mocapfix.synthetic.footsteps import Feet, about, plan
from mocapfix.synthetic.gestures import CROUCH, angles, plateau

STRIDE = 0.68  # of the leg's length, from one foot's place to the other's
REACH = 0.992  # of the leg's length: a standing person's knees are not locked
HANGING = np.radians(75)  # an arm about Z, from the T-pose
DEPTH = 0.26  # metres the hips go down in a crouch
BACK = 0.06  # metres they go back in it


def compose(subject: Subject, seconds: float, rate: float) -> Motion:
    """-> `seconds` (more than 0) of walking, reaching, crouching and turning of this person, at `rate` frames a second."""
    skeleton = subject.skeleton
    time = np.arange(round(seconds * rate)) / rate
    leg = np.linalg.norm(skeleton.offsets[[skeleton.index("LeftLeg"), skeleton.index("LeftFoot")]], axis=1)
    hips = skeleton.offsets[[skeleton.index("LeftUpLeg"), skeleton.index("RightUpLeg")]]
    feet = plan(time, STRIDE * leg.sum(), hips[0, 0])
    lead = _lead(feet, STRIDE * leg.sum(), rate)
    drop = 4 * gaussian_filter1d(feet.swinging @ [-1.0, 1.0], 0.08 * rate)
    crouch = plateau(time, CROUCH)
    pelvis = _pelvis(feet, lead, drop, crouch, rate)
    root = _root(feet, pelvis, hips, REACH * leg.sum(), crouch, rate)
    posture = _trunk_and_arms(skeleton, pelvis, angles(lead, drop, time))
    for side, name in enumerate(("Left", "Right")):
        hip = root + pelvis @ hips[side]
        posture[f"{name}UpLeg"], posture[f"{name}Leg"] = _leg(hip, feet, side, leg, pelvis)
        posture[f"{name}Foot"] = posture[f"{name}ToeBase"] = feet.rotation[:, side]
    return _motion(subject, root, posture)


def _lead(feet: Feet, stride: float, rate: float) -> np.ndarray:
    """-> (T,) how far the left foot is in front of the right, in strides: the phase of the gait."""
    heading = feet.yaw.mean(axis=1)
    apart = feet.place[:, 0] - feet.place[:, 1]
    return gaussian_filter1d((apart[:, 0] * np.sin(heading) + apart[:, 2] * np.cos(heading)) / stride, 0.06 * rate)


def _pelvis(feet: Feet, lead: np.ndarray, drop: np.ndarray, crouch: np.ndarray, rate: float) -> np.ndarray:
    """-> (T, 3, 3): it heads where the feet head, turns with the leading leg and drops on the side of the swinging one."""
    yaw = np.degrees(gaussian_filter1d(feet.yaw.mean(axis=1), 0.15 * rate)) - 5 * lead
    return Rotation.from_euler("YXZ", np.stack([yaw, 3 + 22 * crouch, drop], axis=1), degrees=True).as_matrix()


def _root(feet: Feet, pelvis: np.ndarray, hips: np.ndarray, reach: float, crouch: np.ndarray, rate: float) -> np.ndarray:
    """-> (T, 3): over the feet, a little towards the standing one, and as high as both legs allow (hence the gait's bob)."""
    share = 0.5 + 0.1 * (feet.swinging @ [-1.0, 1.0])[:, None]
    middle = gaussian_filter1d(share * feet.place[:, 0] + (1 - share) * feet.place[:, 1], 0.13 * rate, axis=0)
    middle += (0.02 - BACK * crouch)[:, None] * pelvis[:, :, 2] * [1, 0, 1]
    from_ankle = middle[:, None] + (hips - hips.mean(axis=0)) @ pelvis.swapaxes(1, 2) - feet.ankle
    ceiling = np.sqrt(reach**2 - from_ankle[..., 0] ** 2 - from_ankle[..., 2] ** 2) - from_ankle[..., 1]
    # a running mean, with the window of the running minimum, never passes the ceiling
    radius = max(1, round(0.12 * rate))
    lowest = minimum_filter1d(ceiling.min(axis=1), 2 * radius + 1)
    middle[:, 1] = gaussian_filter1d(lowest, radius / 3, radius=radius) - DEPTH * crouch
    return middle - pelvis @ hips.mean(axis=0)


def _trunk_and_arms(skeleton: Skeleton, pelvis: np.ndarray, turns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """-> (T, 3, 3) posture per joint: the parent's, turned by the gesture."""
    posture = {skeleton.names[0]: pelvis}
    for name, parent in zip(skeleton.names[1:], skeleton.parents[1:], strict=True):
        posture[name] = posture[skeleton.names[parent]]
        if name in turns:
            posture[name] = posture[name] @ Rotation.from_euler("YXZ", turns[name][:, [1, 0, 2]], degrees=True).as_matrix()
    return posture


def _leg(hip: np.ndarray, feet: Feet, side: int, leg: np.ndarray, pelvis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> postures (T, 3, 3) of thigh and shin that put the ankle where it is, the knee pointing between pelvis and toes."""
    thigh, shin = leg
    up = hip - feet.ankle[:, side]
    length = np.linalg.norm(up, axis=1)
    up /= length[:, None]
    left = np.cross(up, pelvis[:, :, 2] + about("Y", feet.yaw[:, side])[:, :, 2])
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    straight = np.stack([left, up, np.cross(left, up)], axis=2)
    lift = np.arccos((thigh**2 + length**2 - shin**2) / (2 * thigh * length))
    bend = np.pi - np.arccos((thigh**2 + shin**2 - length**2) / (2 * thigh * shin))
    return straight @ about("X", -lift), straight @ about("X", bend - lift)


def _motion(subject: Subject, root: np.ndarray, posture: dict[str, np.ndarray]) -> Motion:
    """-> the motion of these postures, with the status, iterations and deviation of one that nobody had to solve."""
    skeleton = subject.skeleton
    stance = _stance(skeleton)
    world = np.stack([posture[name] @ stance[name] for name in skeleton.names], axis=1)
    local = world.copy()
    local[:, 1:] = world[:, skeleton.parents[1:]].swapaxes(-1, -2) @ world[:, 1:]
    none = np.zeros(len(root), int)
    return Motion(root, local, none, none, np.zeros((len(root), len(subject.labels))), np.zeros(local.shape[:2]))


def _stance(skeleton: Skeleton) -> dict[str, np.ndarray]:
    """-> (3, 3) per joint: its rotation when standing, the legs, which rest spread, brought together, the arms let down."""
    x, y, _ = skeleton.offsets[skeleton.index("LeftLeg")]
    spread = np.arctan2(x, -y)
    turns = {"LeftUpLeg": -spread, "RightUpLeg": spread, "LeftArm": -HANGING, "RightArm": HANGING}
    stance = {skeleton.names[0]: np.eye(3)}
    for name, parent in zip(skeleton.names[1:], skeleton.parents[1:], strict=True):
        stance[name] = about("Z", turns[name]) if name in turns else stance[skeleton.names[parent]]
    return stance
