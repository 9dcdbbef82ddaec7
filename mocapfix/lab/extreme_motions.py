"""Extreme motion: strikes, kicks, throws and acrobatics as key poses, with speeds and accelerations as in sport.

Between key poses the joint angles are smooth; the body stands, lies or is upside down, resting on the floor. The time is
stretched so that the fastest hand or foot reaches the peak speed of the motion. A key pose gives angles in degrees to some
joints; the others stay as in standing with hanging arms:

- limbs: forward, outward (away from the body), and turned outward about the bone's own axis. A knee bends by a negative forward
  angle, an elbow and an ankle by a positive one;
- spine, neck and head: bent forward, bent to the left, and turned to the left;
- hips: pitched forward, rolled to the left, and turned to the left. The turn is about the vertical, the roll about the horizontal
  axis that the body then faces; beyond 180 degrees the body turns over.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton
from mocapfix.model.subject import Subject
from mocapfix.solve.kinematics import compute_world_poses
from mocapfix.synthetic import build_posture_motion

KeyPose = Mapping[str, tuple[float, float, float]]

KEY_RATE_HZ = 500.0  # at which the angles between key poses are computed
ANGLE_SMOOTHING_S = 0.018  # standard deviation of the Gaussian filter that rounds the angles at the key poses
REST_S = 0.1  # in the first and in the last pose: longer than the filter reaches
FLOOR_CLEARANCE_M = 0.05  # of the lowest joint: half the thickness of a limb
FLOOR_SMOOTHING_S = 0.05  # standard deviation of the Gaussian filter of the hips' height
EXTREMITIES = ("Hand", "FingerBase", "Foot", "ToeBase")  # on both sides: the fastest joints of a strike, a kick or a throw
LIMBS = ("Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot")  # on both sides: the joints with angles of a limb


class Move(NamedTuple):
    """The way to a key pose from the one before."""

    duration_s: float
    pose: KeyPose
    travel_m: tuple[float, float] = (0.0, 0.0)  # of the hips along world X and Z


class KeyedAngles(NamedTuple):
    """Angles in degrees at N equidistant times, and the position of the hips on the floor."""

    angles_deg: Float[np.ndarray, "N J 3"]
    travel_m: Float[np.ndarray, "N 2"]
    duration_s: float  # from the first to the last


def mirror_pose(pose: KeyPose) -> KeyPose:
    """Return the pose with left and right exchanged."""
    mirrored: dict[str, tuple[float, float, float]] = {}
    for name, (forward, sideways, turn) in pose.items():
        other = "Right" + name[4:] if name.startswith("Left") else "Left" + name[5:] if name.startswith("Right") else name
        mirrored[other] = (forward, sideways, turn) if other != name else (forward, -sideways, -turn)
    return mirrored


def mirror_moves(moves: Sequence[Move]) -> tuple[Move, ...]:
    """Return the moves with left and right exchanged."""
    return tuple(Move(move.duration_s, mirror_pose(move.pose), (-move.travel_m[0], move.travel_m[1])) for move in moves)


def interpolate_key_poses(skeleton: Skeleton, start: KeyPose, moves: Sequence[Move]) -> KeyedAngles:
    """Return the angles from the start pose through all others: monotonic between two of them, smooth, at rest at both ends."""
    moves = [Move(REST_S, start), *moves, Move(REST_S, moves[-1].pose)]
    times_s = np.cumsum([0.0, *(move.duration_s for move in moves)])
    keys = np.zeros((len(times_s), len(skeleton.names), 3))
    for n, pose in enumerate((start, *(move.pose for move in moves))):
        for name, angles in pose.items():
            keys[n, skeleton.find_joint(name)] = angles
    travel = np.cumsum([(0.0, 0.0), *(move.travel_m for move in moves)], axis=0)
    count = round(times_s[-1] * KEY_RATE_HZ)
    fine_s = np.linspace(0, times_s[-1], count + 1)
    smoothing = ANGLE_SMOOTHING_S * KEY_RATE_HZ
    angles = gaussian_filter1d(PchipInterpolator(times_s, keys)(fine_s), smoothing, axis=0, mode="nearest")
    path = gaussian_filter1d(PchipInterpolator(times_s, travel)(fine_s), smoothing, axis=0, mode="nearest")
    return KeyedAngles(angles, path, float(times_s[-1]))


def stretch_time(keyed: KeyedAngles, factor: float) -> KeyedAngles:
    """Return the same angles over a duration that is longer by a factor."""
    return keyed._replace(duration_s=keyed.duration_s * factor)


def join_angles(first: KeyedAngles, second: KeyedAngles) -> KeyedAngles:
    """Return both motions in sequence, at KEY_RATE_HZ; the second begins with the pose in which the first ends, but for whole
    turns, which are added to its angles.
    """
    parts = [_sample_times(each, np.arange(0, each.duration_s, 1 / KEY_RATE_HZ)) for each in (first, second)]
    travel = [parts[0].travel_m, parts[1].travel_m + parts[0].travel_m[-1]]
    turns_deg = first.angles_deg[-1] - second.angles_deg[0]
    angles = np.concatenate([parts[0].angles_deg, parts[1].angles_deg + turns_deg])
    return KeyedAngles(angles, np.concatenate(travel), (len(angles) - 1) / KEY_RATE_HZ)


def sample_angles(keyed: KeyedAngles, rate: float) -> KeyedAngles:
    """Return the angles at the frames of a rate in Hz."""
    return _sample_times(keyed, np.arange(round(keyed.duration_s * rate)) / rate)


def _sample_times(keyed: KeyedAngles, times_s: Float[np.ndarray, " T"]) -> KeyedAngles:
    known_s = np.linspace(0, keyed.duration_s, len(keyed.angles_deg))
    return KeyedAngles(
        CubicSpline(known_s, keyed.angles_deg)(times_s), CubicSpline(known_s, keyed.travel_m)(times_s), keyed.duration_s
    )


def build_keyed_motion(subject: Subject, keyed: KeyedAngles, rate: float) -> Motion:
    """Return the motion of angles, given at frames of a rate in Hz, with the lowest joint on the floor."""
    skeleton, travel = subject.skeleton, keyed.travel_m
    postures: dict[str, np.ndarray] = {}
    for j, name in enumerate(skeleton.names):
        rotation = _build_rotations(name, keyed.angles_deg[:, j])
        postures[name] = rotation if j == 0 else postures[skeleton.names[skeleton.parents[j]]] @ rotation
    root = np.stack([travel[:, 0], np.zeros(len(travel)), travel[:, 1]], axis=1)
    motion = build_posture_motion(subject, root, postures)
    joints, rotations = compute_world_poses(skeleton, motion)
    is_leaf = ~np.isnan(skeleton.ends[:, 0])
    ends = joints[:, is_leaf] + np.einsum("tjab,jb->tja", rotations[:, is_leaf], skeleton.ends[is_leaf])
    lowest = np.minimum(joints[..., 1].min(axis=1), ends[..., 1].min(axis=1))
    root[:, 1] = FLOOR_CLEARANCE_M - gaussian_filter1d(lowest, FLOOR_SMOOTHING_S * rate, mode="nearest")
    return build_posture_motion(subject, root, postures)


def _build_rotations(name: str, angles_deg: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3 3"]:
    """Return the rotations of a joint relative to its parent, in anatomical axes: X to the left, Y up, Z forward."""
    forward, sideways, turn = np.radians(angles_deg).T
    zeros = np.zeros_like(forward)
    if name == "Hips":
        return Rotation.from_euler("YZX", np.stack([turn, -sideways, forward], axis=1)).as_matrix()
    if name.removeprefix("Left").removeprefix("Right") in LIMBS:
        side = 1.0 if name.startswith("Left") else -1.0
        swing, twist = np.stack([-forward, zeros, side * sideways], axis=1), side * turn
    else:
        swing, twist = np.stack([forward, zeros, -sideways], axis=1), turn
    return (Rotation.from_rotvec(swing) * Rotation.from_rotvec(np.stack([zeros, twist, zeros], axis=1))).as_matrix()


def measure_extremity_motion(subject: Subject, motion: Motion, rate: float) -> tuple[float, float]:
    """Return the largest speed in m/s and the largest acceleration in m/s2 of hands and feet."""
    joints, _ = compute_world_poses(subject.skeleton, motion)
    columns = [subject.skeleton.find_joint(side + name) for side in ("Left", "Right") for name in EXTREMITIES]
    velocity = np.gradient(joints[:, columns], 1 / rate, axis=0)
    acceleration = np.diff(joints[:, columns], 2, axis=0) * rate**2
    return float(np.linalg.norm(velocity, axis=-1).max()), float(np.linalg.norm(acceleration, axis=-1).max())


@dataclass(frozen=True)
class ExtremeMotion:
    """A motion from standing through key poses back to standing."""

    peak_speed_m_per_s: float  # of the fastest hand or foot
    moves: tuple[Move, ...]


STAND: KeyPose = {"LeftForeArm": (15, 0, 0), "RightForeArm": (15, 0, 0)}
GUARD: KeyPose = {  # of a fighter, the left side in front
    "Hips": (5, 0, -30), "Spine": (8, 0, 10), "Neck": (0, 0, 20),
    "LeftArm": (40, 10, -10), "LeftForeArm": (105, 0, 0), "RightArm": (20, 15, -20), "RightForeArm": (125, 0, 0),
    "LeftUpLeg": (30, 8, 5), "LeftLeg": (-30, 0, 0), "RightUpLeg": (-5, 15, 15), "RightLeg": (-30, 0, 0),
}  # fmt: skip
CROUCH: KeyPose = {
    "Hips": (25, 0, 0), "LowerBack": (25, 0, 0), "Spine": (15, 0, 0), "Neck": (25, 0, 0), "Neck1": (20, 0, 0),
    "LeftArm": (70, 10, 0), "RightArm": (70, 10, 0), "LeftForeArm": (40, 0, 0), "RightForeArm": (40, 0, 0),
    "LeftUpLeg": (105, 12, 0), "LeftLeg": (-125, 0, 0), "RightUpLeg": (105, 12, 0), "RightLeg": (-125, 0, 0),
    "LeftFoot": (15, 0, 0), "RightFoot": (15, 0, 0),
}  # fmt: skip
TUCK: KeyPose = CROUCH | {
    "LowerBack": (35, 0, 0), "Spine": (20, 0, 0), "Spine1": (15, 0, 0), "Neck": (40, 0, 0), "Neck1": (25, 0, 0),
    "LeftArm": (60, 5, 0), "RightArm": (60, 5, 0), "LeftForeArm": (70, 0, 0), "RightForeArm": (70, 0, 0),
}  # fmt: skip
ARMS_UP: KeyPose = {"LeftArm": (160, 25, 0), "RightArm": (160, 25, 0), "LeftForeArm": (8, 0, 0), "RightForeArm": (8, 0, 0)}
ARMS_OUT: KeyPose = {"LeftArm": (0, 88, 20), "RightArm": (0, 88, 20), "LeftForeArm": (8, 0, 0), "RightForeArm": (8, 0, 0)}
STRADDLE: KeyPose = {"LeftUpLeg": (0, 50, 10), "RightUpLeg": (0, 50, 10)}

WARM_UP = (
    Move(0.5, STAND),
    Move(0.6, ARMS_OUT),
    Move(0.6, ARMS_UP | {"Spine": (-8, 0, 0)}),
    Move(0.7, ARMS_OUT | {"LeftForeArm": (90, 0, 15), "RightForeArm": (90, 0, 15), "Spine": (0, 0, 25), "Neck": (0, 0, 30)}),
    Move(0.6, ARMS_OUT | {"LeftForeArm": (60, 0, -30), "RightForeArm": (60, 0, -30), "Spine": (0, 0, -25), "Neck": (0, 0, -30)}),
    Move(0.9, CROUCH),
    Move(0.7, STAND | {"LeftUpLeg": (70, 0, 0), "LeftLeg": (-90, 0, 0), "LeftFoot": (-25, 0, 0)}),
    Move(0.6, STAND | {"Spine": (5, 20, 0), "Neck": (20, 0, 0)}),
    Move(0.7, STAND | {"RightUpLeg": (70, 0, 0), "RightLeg": (-90, 0, 0), "RightFoot": (-25, 0, 0)}),
    Move(0.6, STAND | {"Spine": (5, -20, 0), "Neck": (-15, 0, 0)}),
    Move(0.6, STAND),
)  # fmt: skip

CROSS = GUARD | {
    "Hips": (5, 0, 25), "Spine": (8, 0, 20), "Spine1": (0, 0, 10), "Neck": (0, 0, -20),
    "RightArm": (88, -8, -35), "RightForeArm": (6, 0, -60), "RightUpLeg": (-20, 12, -10),
}  # fmt: skip
JAB = GUARD | {"Hips": (5, 0, -40), "LeftArm": (85, 0, -30), "LeftForeArm": (6, 0, -60), "Spine1": (0, 0, -10)}
HOOK_BACK = GUARD | {"Hips": (5, 0, -50), "Spine": (8, 0, -10), "RightArm": (0, 75, 10), "RightForeArm": (95, 0, 0)}
HOOK = GUARD | {"Hips": (5, 0, 35), "Spine": (8, 0, 25), "RightArm": (85, 15, -40), "RightForeArm": (85, 0, -30)}

CHAMBER = GUARD | {"Hips": (-8, -5, 15), "RightUpLeg": (100, 10, 0), "RightLeg": (-120, 0, 0), "RightFoot": (-30, 0, 0)}
FRONT_KICK = CHAMBER | {"Hips": (-18, -5, 25), "RightUpLeg": (105, 5, 0), "RightLeg": (-5, 0, 0), "RightFoot": (-35, 0, 0)}
ROUND_CHAMBER = GUARD | {"Hips": (0, -25, 40), "Spine": (5, 15, 10), "RightUpLeg": (60, 55, -30), "RightLeg": (-115, 0, 0)}
ROUND_KICK = ROUND_CHAMBER | {
    "Hips": (0, -45, 95), "RightUpLeg": (70, 60, -30), "RightLeg": (-8, 0, 0), "RightFoot": (-35, 0, 0), "RightArm": (-25, 30, 0),
}  # fmt: skip

WIND_UP = STAND | {
    "Hips": (0, 0, -50), "Spine": (-8, -5, -20), "Neck": (0, 0, 50), "LeftArm": (70, 30, 0), "RightArm": (-10, 90, 70),
    "RightForeArm": (95, 0, 0), "RightHand": (-20, 0, 0), "LeftUpLeg": (60, 5, 0), "LeftLeg": (-70, 0, 0),
}  # fmt: skip
COCKED = STAND | {
    "Hips": (5, 0, 5), "Spine": (-5, 0, -5), "LeftArm": (45, 35, 0), "LeftForeArm": (60, 0, 0), "RightArm": (-5, 100, 85),
    "RightForeArm": (90, 0, 0), "RightHand": (-30, 0, 0), "LeftUpLeg": (40, 8, 0), "LeftLeg": (-20, 0, 0),
    "RightUpLeg": (-20, 5, 0),
}  # fmt: skip
RELEASE = STAND | {
    "Hips": (15, 0, 30), "Spine": (15, 5, 15), "LeftArm": (0, 25, 0), "LeftForeArm": (90, 0, 0), "RightArm": (85, 85, 20),
    "RightForeArm": (15, 0, -40), "RightHand": (20, 0, 0), "LeftUpLeg": (35, 5, 0), "LeftLeg": (-15, 0, 0),
    "RightUpLeg": (-25, 5, 0),
}  # fmt: skip
FOLLOW_THROUGH = RELEASE | {
    "Hips": (25, 0, 60), "Spine": (25, 5, 20), "RightArm": (55, -25, -10), "RightForeArm": (30, 0, -60), "RightUpLeg": (20, 5, 0),
    "RightLeg": (-35, 0, 0),
}  # fmt: skip

HANG: KeyPose = {}  # straight arms and legs, in which a bone's turn about its axis is hardly known from its markers
ARM_FRONT: KeyPose = {"RightArm": (100, 0, 0)}
ARM_BACK: KeyPose = {"RightArm": (-40, 5, 0), "Hips": (0, 0, -25)}
ARM_SIDE: KeyPose = {"RightArm": (10, 95, 0)}
ARM_HIGH: KeyPose = {"RightArm": (150, 20, 0), "Hips": (0, 0, 20)}
ARM_CROSSED: KeyPose = {"RightArm": (80, -20, 0), "Hips": (0, 0, 15)}
LEG_HIGH: KeyPose = {"RightUpLeg": (105, 5, 0), "RightFoot": (-20, 0, 0), "Hips": (-10, 0, 0)}
LEG_FRONT: KeyPose = {"RightUpLeg": (45, 0, 0), "RightFoot": (20, 0, 0)}
LEG_SIDE: KeyPose = {"RightUpLeg": (20, 70, 0), "RightFoot": (-30, 0, 0), "Hips": (0, -15, 0)}

SWING_TOP = ARMS_UP | {
    "Hips": (-8, 0, 0), "Spine": (-12, 0, 0), "LeftForeArm": (55, 0, 0), "RightForeArm": (55, 0, 0), "LeftArm": (165, 5, 0),
    "RightArm": (165, 5, 0),
}  # fmt: skip
SWING_BOTTOM = {
    "Hips": (35, 0, 0), "LowerBack": (25, 0, 0), "Spine": (15, 0, 0), "LeftArm": (45, -8, 0), "RightArm": (45, -8, 0),
    "LeftForeArm": (8, 0, 0), "RightForeArm": (8, 0, 0), "LeftUpLeg": (60, 12, 0), "LeftLeg": (-50, 0, 0),
    "RightUpLeg": (60, 12, 0), "RightLeg": (-50, 0, 0),
}  # fmt: skip
SERVE_BOTTOM = FOLLOW_THROUGH | {"RightArm": (30, -20, -10)}


def _turn_over(pose: KeyPose, hips: tuple[float, float, float]) -> KeyPose:
    """Return the pose of a body whose hips are turned otherwise."""
    return {**pose, "Hips": hips}


EXTREME_MOTIONS = {
    "punch": ExtremeMotion(
        11.0,
        (
            Move(0.5, GUARD), Move(0.13, CROSS), Move(0.2, GUARD), Move(0.25, GUARD), Move(0.11, JAB), Move(0.16, GUARD),
            Move(0.11, JAB), Move(0.17, CROSS), Move(0.25, GUARD), Move(0.3, HOOK_BACK), Move(0.16, HOOK), Move(0.3, GUARD),
            Move(0.5, STAND),
        ),
    ),
    "kick": ExtremeMotion(
        12.0,
        (
            Move(0.5, GUARD), Move(0.22, CHAMBER), Move(0.12, FRONT_KICK), Move(0.16, CHAMBER), Move(0.3, GUARD),
            Move(0.25, ROUND_CHAMBER), Move(0.14, ROUND_KICK), Move(0.2, ROUND_CHAMBER), Move(0.35, GUARD), Move(0.5, STAND),
        ),
    ),
    "straight arm": ExtremeMotion(
        12.0,
        (
            Move(1.5, HANG), Move(0.15, ARM_FRONT), Move(0.2, ARM_FRONT), Move(0.3, HANG), Move(1.0, HANG), Move(0.15, ARM_SIDE),
            Move(0.15, HANG), Move(1.0, HANG), Move(0.16, ARM_HIGH), Move(0.16, HANG), Move(1.0, HANG), Move(0.15, ARM_SIDE),
            Move(0.15, ARM_CROSSED), Move(0.4, HANG), Move(1.0, HANG), Move(0.3, ARM_BACK), Move(0.24, ARM_HIGH),
            Move(0.24, ARM_BACK), Move(0.3, HANG), Move(1.0, HANG), Move(0.3, STAND),
        ),
    ),
    "arm circle": ExtremeMotion(
        11.0,
        (
            Move(1.5, HANG), Move(0.12, {"RightArm": (90, 0, 0)}), Move(0.12, {"RightArm": (179, 0, 0)}),
            Move(0.12, {"RightArm": (90, 60, 0)}), Move(0.15, HANG), Move(1.0, HANG), Move(0.3, STAND),
        ),
    ),
    "straight leg": ExtremeMotion(
        12.0,
        (
            Move(1.5, HANG), Move(0.2, LEG_HIGH), Move(0.2, HANG), Move(1.0, HANG), Move(0.16, LEG_SIDE), Move(0.2, HANG),
            Move(1.0, HANG), Move(0.12, LEG_FRONT), Move(0.1, LEG_HIGH), Move(0.3, HANG), Move(1.0, HANG), Move(0.3, STAND),
        ),
    ),
    "throw": ExtremeMotion(
        12.0,
        (
            Move(0.7, WIND_UP), Move(0.3, COCKED, (0.0, 0.4)), Move(0.11, RELEASE, (0.0, 0.15)),
            Move(0.2, FOLLOW_THROUGH, (0.0, 0.2)),
            Move(0.6, STAND),
        ),
    ),
    "cartwheel": ExtremeMotion(
        7.0,
        (
            Move(0.6, ARMS_UP | STRADDLE), Move(0.4, _turn_over(ARMS_UP | STRADDLE, (0, 90, 0)), (0.7, 0.0)),
            Move(0.35, _turn_over(ARMS_UP | STRADDLE, (0, 180, 0)), (0.6, 0.0)),
            Move(0.35, _turn_over(ARMS_UP | STRADDLE, (0, 270, 0)), (0.6, 0.0)),
            Move(0.4, _turn_over(ARMS_UP | STRADDLE, (0, 360, 0)), (0.7, 0.0)), Move(0.6, _turn_over(STAND, (0, 360, 0))),
        ),
    ),
    "floor roll": ExtremeMotion(
        5.0,
        (
            Move(0.7, CROUCH), Move(0.4, _turn_over(TUCK, (120, 0, 0)), (0.0, 0.4)),
            Move(0.35, _turn_over(TUCK, (240, 0, 0)), (0.0, 0.4)),
            Move(0.4, _turn_over(CROUCH, (385, 0, 0)), (0.0, 0.3)), Move(0.5, _turn_over(STAND, (360, 0, 0))),
            Move(0.8, _turn_over(ARMS_UP, (450, 0, 0)), (0.0, 0.5)), Move(0.5, _turn_over(ARMS_UP, (450, 180, 0)), (0.4, 0.0)),
            Move(0.5, _turn_over(ARMS_UP, (450, 360, 0)), (0.4, 0.0)), Move(0.8, _turn_over(CROUCH, (385, 360, 0))),
            Move(0.7, _turn_over(STAND, (360, 360, 0))),
        ),
    ),
    "overhead swing": ExtremeMotion(
        12.0,
        (
            Move(0.6, SWING_TOP), Move(0.2, SWING_BOTTOM), Move(0.6, SWING_TOP), Move(0.18, SWING_BOTTOM), Move(0.5, STAND),
            Move(0.6, WIND_UP), Move(0.3, COCKED | {"RightArm": (30, 130, 60)}), Move(0.1, RELEASE | {"RightArm": (120, 90, 20)}),
            Move(0.15, SERVE_BOTTOM), Move(0.6, STAND),
        ),
    ),
    "splits": ExtremeMotion(
        4.0,
        (
            Move(0.5, ARMS_OUT), Move(0.35, ARMS_OUT | {"LeftUpLeg": (5, 80, 30), "RightUpLeg": (5, 80, 30)}),
            Move(0.4, ARMS_OUT | {"LeftUpLeg": (5, 80, 30), "RightUpLeg": (5, 80, 30), "Spine": (15, 15, 0)}),
            Move(0.5, ARMS_OUT),
            Move(0.4, ARMS_UP | {"Hips": (10, 0, 0), "LeftUpLeg": (95, 3, 0), "RightUpLeg": (-45, 3, 10), "RightLeg": (-15, 0, 0),
                                 "LowerBack": (-15, 0, 0)}),
            Move(0.5, STAND),
        ),
    ),
    "spin": ExtremeMotion(
        9.0,
        (
            Move(0.5, ARMS_OUT | {"Hips": (0, 0, -60), "Spine": (0, 0, -20)}), Move(0.3, ARMS_OUT | {"Hips": (0, 0, 180)}),
            Move(0.25, {"Hips": (0, 0, 540), "LeftArm": (45, 10, -40), "RightArm": (45, 10, -40), "LeftForeArm": (100, 0, 0),
                        "RightForeArm": (100, 0, 0), "RightUpLeg": (40, 10, 0), "RightLeg": (-80, 0, 0)}),
            Move(0.25, ARMS_OUT | {"Hips": (0, 0, 900), "RightUpLeg": (70, 20, 0), "RightLeg": (-10, 0, 0)}),
            Move(0.4, ARMS_OUT | {"Hips": (0, 0, 1080)}), Move(0.5, _turn_over(STAND, (0, 0, 1080))),
        ),
    ),
    "hand stand": ExtremeMotion(
        6.0,
        (
            Move(0.5, ARMS_UP),
            Move(0.45, ARMS_UP | {"Hips": (90, 0, 0), "LeftUpLeg": (60, 3, 0), "RightUpLeg": (-15, 3, 0)}, (0.0, 0.6)),
            Move(0.35, ARMS_UP | {"Hips": (170, 0, 0), "LeftUpLeg": (40, 3, 0), "RightUpLeg": (-30, 3, 0)}, (0.0, 0.4)),
            Move(0.3, _turn_over(ARMS_UP, (180, 0, 0))), Move(0.6, ARMS_UP | STRADDLE | {"Hips": (178, 0, 0)}),
            Move(0.5, _turn_over(ARMS_UP, (182, 0, 0))),
            Move(0.4, ARMS_UP | {"Hips": (100, 0, 0), "RightUpLeg": (80, 3, 0), "LeftUpLeg": (5, 3, 0)}, (0.0, -0.5)),
            Move(0.6, STAND),
        ),
    ),
}  # fmt: skip
"""by name"""
