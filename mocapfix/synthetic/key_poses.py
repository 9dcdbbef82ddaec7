"""Motion between key poses: smooth joint angles of a body that stands, lies or is upside down, resting on the floor.

A key pose gives angles in degrees to some joints; the others stay as in standing with hanging arms (see `motions`):

- limbs: forward, outward (away from the body), and turned outward about the bone's own axis. A knee bends by a negative forward
  angle, an elbow and an ankle by a positive one;
- spine, neck and head: bent forward, bent to the left, and turned to the left;
- hips: pitched forward, rolled to the left, and turned to the left. The turn is about the vertical, the roll about the horizontal
  axis that the body then faces; beyond 180 degrees the body turns over.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from mocapfix.motion import Motion
from mocapfix.skeleton import Skeleton
from mocapfix.solve.kinematics import compute_world_poses
from mocapfix.subject import Subject
from mocapfix.synthetic.motions import build_posture_motion

KeyPose = Mapping[str, tuple[float, float, float]]

KEY_RATE_HZ = 500.0  # at which the angles between key poses are computed
ANGLE_SMOOTHING_S = 0.018  # standard deviation of the Gaussian filter that rounds the angles at the key poses
REST_S = 0.1  # in the first and in the last pose: longer than the filter reaches
FLOOR_CLEARANCE_M = 0.05  # of the lowest joint: half the thickness of a limb
FLOOR_SMOOTHING_S = 0.05  # standard deviation of the Gaussian filter of the hips' height
EXTREMITIES = ("Hand", "FingerBase", "Foot", "ToeBase")  # on both sides: the fastest joints of a strike, a kick or a throw
LIMBS = ("Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot")  # on both sides: the joints with angles of a limb


class Move(NamedTuple):
    """The way to a key pose from the one before.

    travel_m  of the hips along world X and Z
    """

    duration_s: float
    pose: KeyPose
    travel_m: tuple[float, float] = (0.0, 0.0)


class KeyedAngles(NamedTuple):
    """Angles in degrees at N equidistant times, and the position of the hips on the floor.

    duration_s  from the first to the last
    """

    angles_deg: Float[np.ndarray, "N J 3"]
    travel_m: Float[np.ndarray, "N 2"]
    duration_s: float


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
