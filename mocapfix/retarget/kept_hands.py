"""Where the hands of a character shall be.

Away from the body a hand is where the arm's bones point as in the source: in the same direction from the shoulder, at the same
share of the arm's length. Near a part of the body (thighs, trunk, head, the other forearm) it keeps its place beside that part:
the vector from the nearest point of the part's axis. So a hand on a thigh stays on the thigh of a character with longer arms, and
does not pass through it.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mocapfix.characters.character import SIDES
from mocapfix.retarget.body_frames import BodyFrame

NEAR_DISTANCE_M = 0.14
"""Distance of a wrist from the axis of a part of the body up to which its place beside the part is kept."""
FAR_DISTANCE_M = 0.35
"""Distance from which only the arm's directions are kept."""
MAX_REACH = 0.999
"""Share of the arm's length up to which a hand's target is reached."""
MIN_DISTANCE_M = 1e-6


class BodyPart(NamedTuple):
    """A part of the body near which hands keep their places: the line from one segment's beginning to another's."""

    start: str
    end: str


LEG_PARTS = {side: BodyPart(f"{side}_thigh", f"{side}_shin") for side in SIDES}
TRUNK_PARTS = (BodyPart("pelvis", "neck"), BodyPart("neck", "head"))
TRUNK_PARTS_WITHOUT_NECK = (BodyPart("pelvis", "head"),)


def compute_hand_targets(
    source: BodyFrame,
    target: BodyFrame,
    source_position: dict[str, Float[np.ndarray, "T 3"]],
    target_position: dict[str, Float[np.ndarray, "T 3"]],
) -> dict[str, Float[np.ndarray, "T 3"]]:
    """Return by side where the wrists shall be, in metres.

    source_position, target_position  segment to (T, 3) m: where it begins; the target's before its hands are placed
    """
    size_ratio = target.trunk_length_m / source.trunk_length_m  # of the thickness of the body
    arm_ratio = target.arm_length_m / source.arm_length_m
    targets: dict[str, Float[np.ndarray, "T 3"]] = {}
    for side, other in (("left", "right"), ("right", "left")):
        wrist, shoulder = source_position[f"{side}_hand"], source_position[f"{side}_upper_arm"]
        shoulder_target = target_position[f"{side}_upper_arm"]
        free = shoulder_target + arm_ratio * (wrist - shoulder)
        has_necks = "neck" in source_position and "neck" in target_position
        trunk = TRUNK_PARTS if has_necks else TRUNK_PARTS_WITHOUT_NECK
        parts = [*LEG_PARTS.values(), *trunk, BodyPart(f"{other}_forearm", f"{other}_hand")]
        parts = [part for part in parts if all(end in source_position and end in target_position for end in part)]
        total, weight_sum, largest = np.zeros_like(wrist), np.zeros(len(wrist)), np.zeros(len(wrist))
        for part in parts:
            share, vector = find_nearest_point(wrist, source_position[part.start], source_position[part.end])
            weight = compute_nearness(np.linalg.norm(vector, axis=1))
            axis = target_position[part.end] - target_position[part.start]
            total += weight[:, None] * (target_position[part.start] + share[:, None] * axis + size_ratio * vector)
            weight_sum += weight
            np.maximum(largest, weight, out=largest)
        beside = total / np.maximum(weight_sum, MIN_DISTANCE_M)[:, None]
        wanted = free + largest[:, None] * np.where(weight_sum[:, None] > 0, beside - free, 0.0)
        targets[side] = limit_reach(wanted, shoulder_target, target.arm_length_m)
    return targets


def find_nearest_point(
    point: Float[np.ndarray, "T 3"], start: Float[np.ndarray, "T 3"], end: Float[np.ndarray, "T 3"]
) -> tuple[Float[np.ndarray, " T"], Float[np.ndarray, "T 3"]]:
    """Return the share of the way along a line of the point on it that is nearest, from 0 to 1, and the vector from there."""
    axis = end - start
    share = np.einsum("ti,ti->t", point - start, axis) / np.maximum(np.einsum("ti,ti->t", axis, axis), MIN_DISTANCE_M)
    share = np.clip(share, 0.0, 1.0)
    return share, point - start - share[:, None] * axis


def compute_nearness(distance: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T"]:
    """Return 1 up to NEAR_DISTANCE_M, 0 from FAR_DISTANCE_M on, and a smooth step between."""
    share = np.clip((FAR_DISTANCE_M - distance) / (FAR_DISTANCE_M - NEAR_DISTANCE_M), 0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)


def limit_reach(
    wanted: Float[np.ndarray, "T 3"], shoulder: Float[np.ndarray, "T 3"], arm_length_m: float
) -> Float[np.ndarray, "T 3"]:
    """Return targets that are within reach of the shoulder."""
    vector = wanted - shoulder
    distance = np.linalg.norm(vector, axis=1)
    ratio = np.minimum(1.0, MAX_REACH * arm_length_m / np.maximum(distance, MIN_DISTANCE_M))
    return shoulder + ratio[:, None] * vector
