"""The legs of a character and when its feet stand, for a reduction of keys that keeps standing feet where they are."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from mocapfix.characters.character import SIDES, Character, CharacterMotion
from mocapfix.kernels import quaternions, standing_foot_keys

if TYPE_CHECKING:
    from mocapfix.contacts.contacts import BodyContacts

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
        kept = standing_foot_keys.select_leg_keys(
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
        return standing_foot_keys.measure_standing_error(
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
    rotations = np.stack([quaternions.extract_joint_quaternions(motion.local_rotations, bone, is_known) for bone in bones])
    position = np.ascontiguousarray(motion.pelvis_position, float)
    legs = np.ascontiguousarray(character.rest_positions[bones], float), np.array(leg_ends), balls
    points = standing_foot_keys.compute_foot_points(position, rotations, *legs)
    if contacts is not None and contacts.has_feet:
        from mocapfix.retarget.kept_contacts import resample_foot_contacts  # few cleanings need it

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
