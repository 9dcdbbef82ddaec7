"""How the source's feet are when they lie flat on the floor, so that the character's soles do, too.

The joints of a solved foot are within it, at a height and an inclination that differ from person to person by a centimetre and by
several degrees. They are measured where heel and ball of a foot are in contact at once.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from mocapfix.characters.character import SIDES
from mocapfix.contacts.contacts import FOOT_JOINTS, BodyContacts
from mocapfix.retarget.body_frames import BodyFrame
from mocapfix.retarget.segment_motion import SegmentMotion
from mocapfix.stats.rigid_alignment import compute_shortest_rotation

MIN_FLAT_S = 0.1
"""Time in which a foot must be flat, all contacts together, to be measured."""
MAX_INCLINATION_RAD = np.deg2rad(15.0)
"""A foot that is more inclined in contact does not lie flat: it stands on its toes or on an edge."""
MAX_HEIGHT_CHANGE = 0.05
"""Largest difference of the measured height of the ball from that of the skeleton, in lengths of the leg."""
LOWEST_BALL_PERCENTILE = 2.0
MAX_HEIGHT_ABOVE_LOWEST_M = 0.01
"""The ball of a flat foot is at most so much higher than in the lowest frames of the take, which are not below the floor."""
UPWARD = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class FlatFoot:
    """A foot that lies flat.

    ball_height_m  height of the ball above the floor
    inclination    (3, 3): S of the foot when it lies flat, without its heading; the identity for a foot without inclination
    """

    ball_height_m: float
    inclination: Float[np.ndarray, "3 3"]

    def compute_ankle_height(self, ball: Float[np.ndarray, " 3"]) -> float:
        """Return the height of the ankle above the floor; `ball` is relative to the ankle, in the foot's axes, in metres."""
        return self.ball_height_m - float((self.inclination @ ball)[1])


def measure_flat_feet(source: BodyFrame, motion: SegmentMotion, contacts: BodyContacts | None) -> dict[str, FlatFoot]:
    """Return the flat feet of the source by side, those of its skeleton where they cannot be measured.

    contacts  of the feet at the rate of the motion
    """
    feet = {side: FlatFoot(source.ball_height_m, np.eye(3)) for side in SIDES}
    if contacts is None:
        return feet
    for side in SIDES:
        is_flat = contacts.is_contact[:, [contacts.joints.index(joint) for joint in FOOT_JOINTS[side]]].all(1)
        if is_flat.sum() < MIN_FLAT_S * contacts.rate:
            continue
        foot = motion.rotation[f"{side}_foot"]
        ball = motion.position[f"{side}_foot"] + foot @ source.compute_ball(side)
        heights = contacts.floor.compute_height_above(ball)
        lowest_m = float(np.percentile(heights, LOWEST_BALL_PERCENTILE))
        height_m = min(float(np.median(heights[is_flat])), lowest_m + MAX_HEIGHT_ABOVE_LOWEST_M)
        limit_m = MAX_HEIGHT_CHANGE * source.leg_length_m
        upward = np.median(foot[is_flat, 1], axis=0)  # the vertical in the foot's axes: the middle row of S
        inclination = compute_shortest_rotation(upward, UPWARD)
        is_plausible = upward[1] > np.cos(MAX_INCLINATION_RAD) * np.linalg.norm(upward)
        feet[side] = FlatFoot(
            float(np.clip(height_m, source.ball_height_m - limit_m, source.ball_height_m + limit_m)),
            inclination if is_plausible else np.eye(3),
        )
    return feet


def level_feet(motion: SegmentMotion, feet: Mapping[str, FlatFoot]) -> SegmentMotion:
    """Return the segments with feet and toes turned so that a foot that lies flat in the source has no inclination."""
    rotation = dict(motion.rotation)
    for side, foot in feet.items():
        for segment in (f"{side}_foot", f"{side}_toe"):
            rotation[segment] = rotation[segment] @ foot.inclination.T
    return replace(motion, rotation=rotation)
