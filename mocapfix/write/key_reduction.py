"""Fewer keys for a motion, with a limit on the error of the interpolation between them, for curves that an animator can edit.

The limit is an angle: of every bone relative to its parent, in every frame. For the position of the pelvis it is the distance
that this angle means at the end of a leg, angle times leg length. Errors of a leg's bones add up, so while a foot stands there
is a limit of its ankle's and ball's distance too. Source of the keys' choice: `kernels/key_reduction.py` and, for the legs,
`kernels/standing_foot_keys.py`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.kernels import key_reduction, quaternions

if TYPE_CHECKING:
    from mocapfix.write.standing_feet import LegCurves

CONSTANT_TRACK_RAD = 1e-6
"""a rotation that stays within this of its first frame has one key, also without key reduction"""
MAX_STANDING_ERROR_M = 0.002
"""largest distance of an ankle or the ball of a foot from where it is without reduction, while it stands"""
FRAMES_AT_ONCE = 256
"""of which points are computed: their arrays fit in the processor's cache"""


@dataclass(frozen=True)
class KeyReduction:
    """What a reduction of keys came to, over all frames and bones.

    limit_deg       the largest error that was allowed
    max_error_deg   the largest error of a bone's rotation relative to its parent, measured
    max_distance_m  the largest distance of a bone's head or tail from where it is without reduction, measured with slerp and with
                    normalised linear interpolation
    max_standing_m  the same of ankles and balls of the feet alone, while they stand; None if the feet never stand
    key_count       number of keys written
    sample_count    number of keys with one in every frame
    """

    limit_deg: float
    max_error_deg: float
    max_distance_m: float
    max_standing_m: float | None
    key_count: int
    sample_count: int

    @property
    def sentence(self) -> str:
        """The result as a sentence for reports."""
        share = 100 * self.key_count / max(self.sample_count, 1)
        distances = f"bones {1000 * self.max_distance_m:.2g} mm"
        if self.max_standing_m is None:
            distances = f" and {distances}"
        else:
            distances = f", {distances}, and standing feet {1000 * self.max_standing_m:.2g} mm"
        return (
            f"{self.key_count:,} of {self.sample_count:,} keys are kept ({share:.0f} %); between them rotations are at most "
            f"{self.max_error_deg:.2g} degrees off{distances}."
        )


@dataclass(frozen=True)
class MotionKeys:
    """The curves of a motion over T frames, and which frames are keys.

    bones          N indices of the bones with a curve
    rotations      N arrays (T, 4) of their local rotations: unit quaternions x, y, z, w without sign flips
    rotation_keys  N arrays (T,) bool
    position       (T, 3) m: the curve of the pelvis or root
    position_keys  (T,) bool
    """

    bones: tuple[int, ...]
    rotations: tuple[Float[np.ndarray, "T 4"], ...]
    rotation_keys: tuple[Bool[np.ndarray, " T"], ...]
    position: Float[np.ndarray, "T 3"]
    position_keys: Bool[np.ndarray, " T"]

    @property
    def key_count(self) -> int:
        """Number of all keys."""
        return int(sum(keys.sum() for keys in self.rotation_keys) + self.position_keys.sum())


def reduce_rotation_keys(rotation: Float[np.ndarray, "T 4"], max_error_rad: float) -> Int[np.ndarray, " K"]:
    """Return the frames of unit quaternions without sign flips between which interpolation stays within an angle of all frames.

    The angle is kept with slerp and with normalised linear interpolation. One frame, the first, is enough for a curve that is
    constant within the limit; all others keep the last one too.
    """
    return np.flatnonzero(key_reduction.select_rotation_keys(np.ascontiguousarray(rotation, float), float(max_error_rad)))


def reduce_position_keys(position: Float[np.ndarray, "T 3"], max_error_m: float) -> Int[np.ndarray, " K"]:
    """Return the frames between which linear interpolation stays within a distance of all frames: the first, last and others."""
    return np.flatnonzero(key_reduction.select_position_keys(np.ascontiguousarray(position, float), float(max_error_m)))


def select_motion_keys(
    bones: Sequence[int],
    local_rotations: Float[np.ndarray, "T J 3 3"],
    position: Float[np.ndarray, "T 3"],
    max_error_rad: float | None,
    leg_length_m: float,
    legs: "LegCurves | None" = None,
) -> MotionKeys:
    """Select the keys of some bones of a motion and of its position.

    Without a limit every frame is a key, except those of constant rotations. The position has at least its first and last frame:
    they keep the length of the motion. With the curves of the legs, standing feet stay within MAX_STANDING_ERROR_M.
    """
    frame_count = len(position)
    is_known = np.ones(frame_count, bool)
    rotations = tuple(quaternions.extract_joint_quaternions(local_rotations, bone, is_known) for bone in bones)
    if max_error_rad is None:
        constant = [key_reduction.select_rotation_keys(rotation, CONSTANT_TRACK_RAD) for rotation in rotations]
        keys = tuple(each if each.sum() == 1 else is_known for each in constant)
        return MotionKeys(tuple(bones), rotations, keys, position, is_known)
    max_error_m = float(max_error_rad * leg_length_m)
    leg_keys, position_keys = {}, None
    if legs is not None and legs.standing.any():
        leg_keys, position_keys = legs.select_keys(max_error_rad, max_error_m, MAX_STANDING_ERROR_M)
    keys = tuple(
        leg_keys[bone] if bone in leg_keys else key_reduction.select_rotation_keys(rotation, float(max_error_rad))
        for bone, rotation in zip(bones, rotations, strict=True)
    )
    if position_keys is None:
        position_keys = key_reduction.select_position_keys(np.ascontiguousarray(position, float), max_error_m)
    return MotionKeys(tuple(bones), rotations, keys, position, position_keys)


def measure_key_reduction(
    keys: MotionKeys,
    local_rotations: Float[np.ndarray, "T J 3 3"],
    limit_rad: float,
    compute_points: Callable[[Float[np.ndarray, "T 3"], Float[np.ndarray, "T J 3 3"]], Float[np.ndarray, "T P 3"]],
    legs: "LegCurves | None" = None,
) -> KeyReduction:
    """Measure the errors of a motion between its keys.

    compute_points  the points of the body in the world, from the curve of the position and the local rotations of all bones
    legs            the curves of the legs, with which the distances of standing feet are measured too
    """
    distance_m = 0.0
    position = key_reduction.interpolate_keys(np.ascontiguousarray(keys.position, float), keys.position_keys, False)
    tracks = list(zip(keys.bones, keys.rotations, keys.rotation_keys, strict=True))
    curves = [
        [key_reduction.interpolate_keys(rotation, kept, on_arc) for _, rotation, kept in tracks] for on_arc in (True, False)
    ]
    for start in range(0, len(position), FRAMES_AT_ONCE):
        frames = slice(start, start + FRAMES_AT_ONCE)
        points, reduced = compute_points(keys.position[frames], local_rotations[frames]), local_rotations[frames].copy()
        for rotations in curves:
            for bone, rotation in zip(keys.bones, rotations, strict=True):
                quaternions.store_joint_quaternions(rotation[frames], bone, reduced)
            difference = compute_points(position[frames], reduced) - points
            distance_m = max(distance_m, float(np.linalg.norm(difference, axis=-1).max(initial=0.0)))
    has_standing = legs is not None and bool(legs.standing.any())
    standing_m = [
        legs.measure_standing_error(position, dict(zip(keys.bones, rotations, strict=True))) for rotations in curves if legs
    ]
    errors = [key_reduction.measure_key_error(rotation, kept, True) for _, rotation, kept in tracks]
    return KeyReduction(
        limit_deg=float(np.degrees(limit_rad)),
        max_error_deg=float(np.degrees(max(errors, default=0.0))),
        max_distance_m=distance_m,
        max_standing_m=max(standing_m) if has_standing else None,
        key_count=keys.key_count,
        sample_count=len(keys.position) * (len(keys.bones) + 1),
    )
