"""Fewer keys for a motion, with a limit on the error of the interpolation between them, for curves that an animator can edit.

The limit is an angle: of every bone relative to its parent, in every frame. For the position of the pelvis it is the distance
that this angle means at the end of a leg, angle times leg length. Errors of a leg's bones add up, so while a foot stands there
is a limit of its ankle's and ball's distance too. Source of the keys' choice: `kernels/key_reduction.py` and, for the legs,
`kernels/key_reduction.py`.

The legs of a character and when its feet stand, for a reduction of keys that keeps standing feet where they are.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.characters.character import SIDES, Character, CharacterMotion
from mocapfix.kernels import key_reduction, lie

if TYPE_CHECKING:
    from mocapfix.contacts.contacts import BodyContacts


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
    rotations = tuple(lie.extract_joint_quaternions(local_rotations, bone, is_known) for bone in bones)
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
                lie.store_joint_quaternions(rotation[frames], bone, reduced)
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


MAX_STANDING_SPEED_M_S = 0.1
"""Speed below which an ankle or the ball of a foot stands, where no contacts are known."""


@dataclass(frozen=True)
class LegCurves:
    """The bones from the pelvis to the feet of a motion over T frames, and when the feet stand.

    bones      N indices of bones: the pelvis, those from the left hip to the foot, and those from the right hip to the foot
    leg_ends   (2,): the number of the bone after each leg's last one
    position   (T, 3) m: of the pelvis, in its parent's axes
    rotations  (N, T, 4): of the bones relative to their parents, unit quaternions x, y, z, w without sign flips
    offsets    (N, 3) m: the head of each bone in its parent's axes
    balls      (2, 3) m: the balls of the feet in the axes of the feet; NaN for a foot without
    standing   (T, 4): whether the left ankle, the left ball, the right ankle and the right ball stand
    points     (T, 4, 3) m: where these are, in the axes of the pelvis' parent
    """

    bones: tuple[int, ...]
    leg_ends: Int[np.ndarray, " 2"]
    position: Float[np.ndarray, "T 3"]
    rotations: Float[np.ndarray, "N T 4"]
    offsets: Float[np.ndarray, "N 3"]
    balls: Float[np.ndarray, "2 3"]
    standing: Bool[np.ndarray, "T 4"]
    points: Float[np.ndarray, "T 4 3"]

    def select_keys(
        self, max_error_rad: float, max_error_m: float, max_standing_error_m: float
    ) -> tuple[dict[int, Bool[np.ndarray, " T"]], Bool[np.ndarray, " T"]]:
        """Return the frames that are keys of each bone's rotation, by bone, and those of the pelvis' position.

        max_error_rad         of each rotation relative to the bone's parent
        max_error_m           of the pelvis' position
        max_standing_error_m  of ankles and balls of the feet while they stand
        """
        kept = key_reduction.select_leg_keys(
            self.position, self.rotations, self.offsets, self.leg_ends, self.balls, self.standing, self.points,
            float(max_error_rad), float(max_error_m), float(max_standing_error_m),
        )  # fmt: skip
        return dict(zip(self.bones, kept, strict=False)), kept[-1]

    def measure_standing_error(self, position: Float[np.ndarray, "T 3"], rotations: dict[int, Float[np.ndarray, "T 4"]]) -> float:
        """Return the largest distance in metres of a standing ankle or ball from where it is.

        position   the pelvis' position
        rotations  bone to its rotations, quaternions of any length; bones that are missing are as they are
        """
        moved = self.rotations.copy()
        for k, bone in enumerate(self.bones):
            if bone in rotations:
                moved[k] = rotations[bone]
        return key_reduction.measure_standing_error(
            np.ascontiguousarray(position, float), moved, self.offsets, self.leg_ends, self.balls, self.standing, self.points
        )


def build_leg_curves(character: Character, motion: CharacterMotion, contacts: "BodyContacts | None" = None) -> LegCurves:
    """Build the curves of a character's legs.

    contacts  of the motion, at their own rate. Without any, what is slower than MAX_STANDING_SPEED_M_S stands
    """
    pelvis = character.mapping.bones["pelvis"][0]
    bones, leg_ends, balls = [pelvis], [], np.full((2, 3), np.nan)
    for k, side in enumerate(SIDES):
        foot = character.mapping.bones[f"{side}_foot"][0]
        toe = character.mapping.bones.get(f"{side}_toe", ())
        is_toe_of_foot = bool(toe) and int(character.parents[toe[0]]) == foot
        balls[k] = character.rest_positions[toe[0]] if is_toe_of_foot else character.tails[foot]
        bones += _list_leg(character, pelvis, foot)
        leg_ends.append(len(bones))
    is_known = np.ones(motion.frame_count, bool)
    rotations = np.stack([lie.extract_joint_quaternions(motion.local_rotations, bone, is_known) for bone in bones])
    position = np.ascontiguousarray(motion.pelvis_position, float)
    legs = np.ascontiguousarray(character.rest_positions[bones], float), np.array(leg_ends), balls
    points = key_reduction.compute_foot_points(position, rotations, *legs)
    if contacts is not None and contacts.has_feet:
        from mocapfix.characters.kept_positions import resample_foot_contacts  # few cleanings need it

        standing = resample_foot_contacts(contacts, motion.frame_count, motion.rate).is_contact
    else:
        standing = _find_slow_points(points, motion.rate)
    return LegCurves(tuple(bones), legs[1], position, rotations, legs[0], balls, np.ascontiguousarray(standing), points)


def _list_leg(character: Character, pelvis: int, foot: int) -> list[int]:
    """Return the bones below the pelvis down to the foot."""
    path: list[int] = []
    bone = foot
    while bone not in (pelvis, -1):
        path.insert(0, bone)
        bone = int(character.parents[bone])
    return path


def _find_slow_points(points: Float[np.ndarray, "T 4 3"], rate: float) -> Bool[np.ndarray, "T 4"]:
    """Return which points are slow in a frame: towards the frame before or after."""
    standing = np.zeros(points.shape[:2], bool)
    is_slow = np.linalg.norm(np.diff(points, axis=0), axis=2) < MAX_STANDING_SPEED_M_S / rate
    standing[1:] = is_slow
    standing[:-1] |= is_slow
    return standing
