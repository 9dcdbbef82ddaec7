"""Where the hands of a character shall be.

Away from the body a hand is where the arm's bones point as in the source: in the same direction from the shoulder, at the same
share of the arm's length. Near a part of the body (thighs, trunk, head) the palm keeps its vector across the part's axis. So a
hand on a thigh stays on the thigh of a character with longer arms, and does not pass through it. Palms that are near each other
stay so.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mocapfix.characters.body_frames import BodyFrame
from mocapfix.characters.character import SIDES
from mocapfix.characters.segment_motion import SegmentMotion

NEAR_DISTANCE = 0.3
"""Distance of a palm from the axis of a part of the body, in lengths of the trunk, up to which its place beside it is kept."""
FAR_DISTANCE = 0.45
"""Distance from which only the arm's directions are kept."""
NEARNESS_POWER = 4
"""Power of the nearness with which the places beside several parts are weighted: the nearest part decides."""
MIN_PLACE_WEIGHT = 1e-12
MAX_REACH = 0.999
"""Share of the arm's length up to which a hand's target is reached."""
MIN_PALM_DISTANCE_M = 1e-6
MIN_LINE_LENGTH2_M2 = 1e-12
"""Squared length of a line below which it has no direction."""


class BodyPart(NamedTuple):
    """A part of the body near which hands keep their places: the line from one segment's beginning to another's."""

    start: str
    end: str


LEG_PARTS = tuple(BodyPart(f"{side}_thigh", f"{side}_shin") for side in SIDES)
TRUNK_PARTS = (BodyPart("pelvis", "neck"), BodyPart("neck", "head"))


def compute_hand_targets(
    source: BodyFrame, target: BodyFrame, motion: SegmentMotion, target_position: Mapping[str, Float[np.ndarray, "T 3"]]
) -> dict[str, Float[np.ndarray, "T 3"]]:
    """Return by side where the wrists shall be, in metres.

    motion           of the source
    target_position  segment to (T, 3) m: where it begins, before the hands are placed
    """
    arm_ratio = target.arm_length_m / source.arm_length_m
    palms: dict[str, Float[np.ndarray, "T 3"]] = {}
    source_palms: dict[str, Float[np.ndarray, "T 3"]] = {}
    for side in SIDES:
        wrist, hand = motion.position[f"{side}_hand"], motion.rotation[f"{side}_hand"]
        source_palms[side] = wrist + hand @ source.compute_palm(side)
        arm = arm_ratio * (wrist - motion.position[f"{side}_upper_arm"])
        free = target_position[f"{side}_upper_arm"] + arm + hand @ target.compute_palm(side)
        places = BesideParts.allocate(len(free))
        for part in (*LEG_PARTS, *TRUNK_PARTS):
            if all(end in motion.position and end in target_position for end in part):
                ends = [motion.position[end] for end in part], [target_position[end] for end in part]
                places.add(source_palms[side], free, *ends, (source, target))
        palms[side] = places.combine(free)
    palms = keep_palms_together(source_palms, palms, source.trunk_length_m, target.trunk_length_m)
    return {
        side: limit_reach(
            palm - motion.rotation[f"{side}_hand"] @ target.compute_palm(side),
            target_position[f"{side}_upper_arm"],
            target.arm_length_m,
        )
        for side, palm in palms.items()
    }


def keep_palms_together(
    source_palms: Mapping[str, Float[np.ndarray, "T 3"]],
    palms: Mapping[str, Float[np.ndarray, "T 3"]],
    source_trunk_m: float,
    target_trunk_m: float,
) -> dict[str, Float[np.ndarray, "T 3"]]:
    """Return the palms (T, 3) in metres by side, where they are near each other in the source as far apart as there.

    Their middle stays where it is. Distances are compared in lengths of the trunk.
    """
    apart = source_palms["left"] - source_palms["right"]
    nearness = compute_nearness(np.linalg.norm(apart, axis=1) / source_trunk_m)[:, None]
    middle, half = (palms["left"] + palms["right"]) / 2, target_trunk_m / source_trunk_m * apart / 2
    return {
        "left": palms["left"] + nearness * (middle + half - palms["left"]),
        "right": palms["right"] + nearness * (middle - half - palms["right"]),
    }


@dataclass
class BesideParts:
    """The places of a palm beside the parts of a body, weighted by its nearness to each.

    total    (T, 3) m: sum of the weighted places
    weight   (T,) sum of the weights
    nearest  (T,) nearness to the nearest part, from 0 to 1
    """

    total: Float[np.ndarray, "T 3"]
    weight: Float[np.ndarray, " T"]
    nearest: Float[np.ndarray, " T"]

    @classmethod
    def allocate(cls, frame_count: int) -> "BesideParts":
        """Return no places."""
        return cls(np.zeros((frame_count, 3)), np.zeros(frame_count), np.zeros(frame_count))

    def add(
        self,
        palm: Float[np.ndarray, "T 3"],
        free: Float[np.ndarray, "T 3"],
        source_ends: list[Float[np.ndarray, "T 3"]],
        target_ends: list[Float[np.ndarray, "T 3"]],
        frames: tuple[BodyFrame, BodyFrame],
    ) -> None:
        """Add the place beside a part, whose ends are given in the source and in the target.

        How far along the part it is follows from the arm: a longer arm hangs lower.

        palm  of the source;  free  (T, 3) m: of the target, by the arm's directions
        """
        source, target = frames
        distance = np.linalg.norm(find_nearest_point(palm, *source_ends)[1], axis=1) / source.trunk_length_m
        _, across = split_along_line(palm, *source_ends)
        share, _ = split_along_line(free, *target_ends)
        nearness = compute_nearness(distance)
        weight = nearness**NEARNESS_POWER
        axis = target_ends[1] - target_ends[0]
        place = target_ends[0] + share[:, None] * axis + target.trunk_length_m / source.trunk_length_m * across
        self.total += weight[:, None] * place
        self.weight += weight
        np.maximum(self.nearest, nearness, out=self.nearest)

    def combine(self, free: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3"]:
        """Return the places of the palm: beside the parts where it is near one, `free` where it is near none."""
        beside = self.total / np.maximum(self.weight, MIN_PLACE_WEIGHT)[:, None]
        return free + self.nearest[:, None] * np.where(self.weight[:, None] > MIN_PLACE_WEIGHT, beside - free, 0.0)


def move_hands_out_of_thighs(
    source: BodyFrame,
    target: BodyFrame,
    motion: SegmentMotion,
    solved_position: Mapping[str, Float[np.ndarray, "T 3"]],
    wanted: Mapping[str, Float[np.ndarray, "T 3"]],
) -> dict[str, Float[np.ndarray, "T 3"]]:
    """Return the targets of the wrists, moved so far that no palm is nearer to the axis of a thigh than in the source.

    Distances are compared in lengths of the trunk, and only where they are less than NEAR_DISTANCE of these.

    motion           of the source
    solved_position  segment to (T, 3) m: where it begins in the solved poses of the target
    wanted           (T, 3) m by side: the targets with which it was solved
    """
    ratio = target.trunk_length_m / source.trunk_length_m
    moved = {side: wrist.copy() for side, wrist in wanted.items()}
    for side, wrist in moved.items():
        hand = motion.rotation[f"{side}_hand"]
        palm = motion.position[f"{side}_hand"] + hand @ source.compute_palm(side)
        solved_palm = solved_position[f"{side}_hand"] + hand @ target.compute_palm(side)
        for start, end in LEG_PARTS:
            vector = find_nearest_point(palm, motion.position[start], motion.position[end])[1]
            solved_vector = find_nearest_point(solved_palm, solved_position[start], solved_position[end])[1]
            least = ratio * np.minimum(np.linalg.norm(vector, axis=1), NEAR_DISTANCE * source.trunk_length_m)
            distance = np.linalg.norm(solved_vector, axis=1)
            outward = np.where(distance[:, None] > MIN_PALM_DISTANCE_M, solved_vector, vector)
            outward = outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), MIN_PALM_DISTANCE_M)
            wrist += np.maximum(least - distance, 0.0)[:, None] * outward
    return moved


def find_nearest_point(
    point: Float[np.ndarray, "T 3"], start: Float[np.ndarray, "T 3"], end: Float[np.ndarray, "T 3"]
) -> tuple[Float[np.ndarray, " T"], Float[np.ndarray, "T 3"]]:
    """Return the share of the way along a line of the point on it that is nearest, from 0 to 1, and the vector from there."""
    share = np.clip(split_along_line(point, start, end)[0], 0.0, 1.0)
    return share, point - start - share[:, None] * (end - start)


def split_along_line(
    point: Float[np.ndarray, "T 3"], start: Float[np.ndarray, "T 3"], end: Float[np.ndarray, "T 3"]
) -> tuple[Float[np.ndarray, " T"], Float[np.ndarray, "T 3"]]:
    """Return how far along a line a point is, in lengths of the line also beyond its ends, and its vector across the line."""
    axis = end - start
    share = np.einsum("ti,ti->t", point - start, axis) / np.maximum(np.einsum("ti,ti->t", axis, axis), MIN_LINE_LENGTH2_M2)
    return share, point - start - share[:, None] * axis


def compute_nearness(distance: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T"]:
    """Return 1 up to NEAR_DISTANCE, 0 from FAR_DISTANCE on, and a smooth step between."""
    return compute_smooth_step(distance, NEAR_DISTANCE, FAR_DISTANCE)


def compute_smooth_step(value: Float[np.ndarray, " T"], full: float, none: float) -> Float[np.ndarray, " T"]:
    """Return 1 up to `full`, 0 from `none` on, and a cubic between with no slope at either end."""
    share = np.clip((none - value) / (none - full), 0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)


def limit_reach(
    wanted: Float[np.ndarray, "T 3"], shoulder: Float[np.ndarray, "T 3"], arm_length_m: float
) -> Float[np.ndarray, "T 3"]:
    """Return targets that are within reach of the shoulder."""
    vector = wanted - shoulder
    distance = np.linalg.norm(vector, axis=1)
    ratio = np.minimum(1.0, MAX_REACH * arm_length_m / np.maximum(distance, MIN_PALM_DISTANCE_M))
    return shoulder + ratio[:, None] * vector
