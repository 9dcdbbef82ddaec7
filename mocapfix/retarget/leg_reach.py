"""Keep the feet of a character within reach of its legs, without a sudden stop where a leg becomes straight.

A leg that is nearly straight bends far for a small change of the distance from hip to ankle, and a foot beyond its reach would
pull the pelvis at once. So the distance approaches the leg's length smoothly: of a leg that bears the body, below the hip, the
pelvis is lowered; of one that reaches to the side or ahead, the foot comes nearer.
"""

import numpy as np
from jaxtyping import Float

from mocapfix.characters.character import SIDES
from mocapfix.retarget.body_frames import BodyFrame
from mocapfix.retarget.kept_hands import compute_smooth_step
from mocapfix.retarget.kept_positions import KeptPositions

FREE_REACH = 0.985
"""Share of a leg's length up to which the distance from hip to ankle is kept as it is."""
BELOW_COSINE, BESIDE_COSINE = 0.9, 0.7
"""Cosines of the angle between a leg and the vertical from which it bears the body, and up to which it does not."""
LARGER_DROP_POWER = 4
"""Power by which the drops that both legs need are combined: the larger one decides, without a jump where they are equal."""
MIN_DROP_M = 1e-12


def keep_feet_within_reach(target: BodyFrame, kept: KeptPositions, pelvis_rotation: Float[np.ndarray, "T 3 3"]) -> KeptPositions:
    """Return the targets with the pelvis lowered, and feet brought nearer, where a leg would be stretched.

    pelvis_rotation  (T, 3, 3) S of the pelvis
    """
    hips = {side: pelvis_rotation @ target.compute_vector("pelvis", target.find_head(f"{side}_thigh")) for side in SIDES}
    drops = [compute_drop(kept.ankles[side] - kept.pelvis - hips[side], target.leg_length_m) for side in SIDES]
    drop = (np.sum(np.power(drops, LARGER_DROP_POWER), axis=0)) ** (1 / LARGER_DROP_POWER)
    pelvis = kept.pelvis - drop[:, None] * np.array([0.0, 1.0, 0.0])
    ankles: dict[str, Float[np.ndarray, "T 3"]] = {}
    for side in SIDES:
        leg = kept.ankles[side] - pelvis - hips[side]
        distance = np.maximum(np.linalg.norm(leg, axis=1), MIN_DROP_M)
        is_beside = 1.0 - compute_bearing(leg)
        factor = 1.0 + is_beside * (limit_distance(distance, target.leg_length_m) / distance - 1.0)
        ankles[side] = pelvis + hips[side] + factor[:, None] * leg
    return KeptPositions(pelvis, ankles, kept.scale)


def compute_drop(leg: Float[np.ndarray, "T 3"], leg_length_m: float) -> Float[np.ndarray, " T"]:
    """Return how far in metres the hip must be lowered for a leg that bears the body, from hip to ankle (T, 3) in metres."""
    across, height = np.linalg.norm(leg[:, [0, 2]], axis=1), -leg[:, 1]
    wanted = limit_distance(np.linalg.norm(leg, axis=1), leg_length_m)
    lower = np.sqrt(np.maximum(wanted**2 - across**2, 0.0))
    return compute_bearing(leg) * np.maximum(height - lower, 0.0)


def compute_bearing(leg: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, " T"]:
    """Return 1 for a leg (T, 3) below its hip, 0 for one that reaches to the side, ahead or up, and a smooth step between."""
    cosine = -leg[:, 1] / np.maximum(np.linalg.norm(leg, axis=1), MIN_DROP_M)
    return compute_smooth_step(-cosine, -BELOW_COSINE, -BESIDE_COSINE)


def limit_distance(distance: Float[np.ndarray, " T"], leg_length_m: float) -> Float[np.ndarray, " T"]:
    """Return distances from hip to ankle: as they are up to FREE_REACH of the leg's length, approaching the length beyond."""
    free, rest = FREE_REACH * leg_length_m, (1.0 - FREE_REACH) * leg_length_m
    return np.where(distance <= free, distance, leg_length_m - rest * np.exp(-np.maximum(distance - free, 0.0) / rest))
