"""Where pelvis and feet of a character shall be: the places of the source body, scaled by the ratio of the legs' lengths.

All places are scaled about the origin, so a foot that stands still in the source stands still on the character. Heights are
measured from the floor. A foot is placed by its ball, because the lengths of feet have other ratios than those of legs: the ball
bears the weight from the time when the foot lies flat until it leaves the floor.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mocapfix.characters.character import SIDES
from mocapfix.retarget.body_frames import BodyFrame
from mocapfix.retarget.flat_feet import FlatFoot
from mocapfix.retarget.segment_motion import SegmentMotion


@dataclass(frozen=True)
class KeptPositions:
    """Targets of a character's joints in every frame, in metres.

    pelvis  (T, 3): the head of the pelvis bone
    ankles  side to (T, 3)
    scale   metres of the character per metre of the source
    """

    pelvis: Float[np.ndarray, "T 3"]
    ankles: dict[str, Float[np.ndarray, "T 3"]]
    scale: float


def compute_kept_positions(
    source: BodyFrame,
    target: BodyFrame,
    motion: SegmentMotion,
    flat_feet: Mapping[str, FlatFoot],
    floor_height_m: float = 0.0,
) -> KeptPositions:
    """Compute where pelvis and ankles of a target body shall be, from the segments of the source.

    flat_feet       the source's feet when they lie flat, by side
    floor_height_m  height of the source's floor; the target's floor is at height 0
    """
    scale = target.leg_length_m / source.leg_length_m
    pelvis, thighs = motion.rotation["pelvis"], [motion.position[f"{side}_thigh"] for side in SIDES]
    ankle_height_m = float(np.mean([flat_feet[side].compute_ankle_height(source.compute_ball(side)) for side in SIDES]))
    hips = scale_positions(np.mean(thighs, axis=0), scale, floor_height_m + ankle_height_m, target.ankle_height_m)
    ankles: dict[str, Float[np.ndarray, "T 3"]] = {}
    for side in SIDES:
        foot, flat = motion.rotation[f"{side}_foot"], flat_feet[side]
        ball = motion.position[f"{side}_foot"] + foot @ source.compute_ball(side)
        kept = scale_positions(ball, scale, floor_height_m + flat.ball_height_m, target.ball_height_m)
        ankles[side] = kept - foot @ flat.inclination.T @ target.compute_ball(side)
    return KeptPositions(hips - pelvis @ target.hip_centre, ankles, scale)


def scale_positions(
    position: Float[np.ndarray, "T 3"], scale: float, source_height_m: float, target_height_m: float
) -> Float[np.ndarray, "T 3"]:
    """Return positions scaled about the origin, so that one at `source_height_m` comes to `target_height_m`."""
    scaled = scale * position
    scaled[:, 1] += target_height_m - scale * source_height_m
    return scaled
