"""Where pelvis and feet of a character shall be: the places of the source body, scaled by the ratio of the legs' lengths.

All places are scaled about the origin, so a foot that stands still in the source stands still on the character. Heights are
measured from the floor. A foot is placed by its ball, because the lengths of feet have other ratios than those of legs: the ball
bears the weight from the time when the foot lies flat until it leaves the floor.

How the source's feet are when they lie flat on the floor, so that the character's soles do, too.

The joints of a solved foot are within it, at a height and an inclination that differ from person to person by a centimetre and by
several degrees. They are measured where heel and ball of a foot are in contact at once.

Hold the feet of a character in the contacts of the source: at one place in the horizontal plane while a foot stands.

Where the source's feet are held, ankle and ball stand still; the ankle of a foot of another shape moves when the foot rolls about
the line from one to the other. So the
character's own ankles and balls are held, as those of the source are (`contacts/foot_displacements.py`), and its feet turn.

Keep the feet of a character within reach of its legs, without a sudden stop where a leg becomes straight.

A leg that is nearly straight bends far for a small change of the distance from hip to ankle, and a foot beyond its reach would
pull the pelvis at once. So the distance approaches the leg's length smoothly: of a leg that bears the body, below the hip, the
pelvis is lowered; of one that reaches to the side or ahead, the foot comes nearer.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from mocapfix.characters.body_frames import BodyFrame
from mocapfix.characters.character import SIDES
from mocapfix.characters.kept_hands import compute_smooth_step
from mocapfix.characters.segment_motion import SegmentMotion, compute_shortest_rotations
from mocapfix.contacts.contacts import CONTACT_JOINTS, FOOT_JOINTS, BodyContacts
from mocapfix.contacts.foot_displacements import compute_foot_displacements
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


def hold_kept_feet(
    target: BodyFrame,
    ankles: dict[str, Float[np.ndarray, "T 3"]],
    feet: dict[str, Float[np.ndarray, "T 3 3"]],
    contacts: BodyContacts,
) -> tuple[dict[str, Float[np.ndarray, "T 3"]], dict[str, Float[np.ndarray, "T 3 3"]]]:
    """Return ankles (T, 3) in metres and rotations S (T, 3, 3) of the feet, by side, with the feet held in contacts.

    ankles, feet  by side, before
    contacts      of the source's feet, at the rate of the motion
    """
    balls = {side: ankles[side] + feet[side] @ target.compute_ball(side) for side in SIDES}
    position = np.stack([place[side] for side in FOOT_JOINTS for place in (ankles, balls)], axis=1)
    held = position + compute_foot_displacements(position, contacts, is_locked=True)
    held_ankles: dict[str, Float[np.ndarray, "T 3"]] = {}
    held_feet: dict[str, Float[np.ndarray, "T 3 3"]] = {}
    for k, side in enumerate(FOOT_JOINTS):
        ankle, ball = held[:, 2 * k], held[:, 2 * k + 1]
        held_ankles[side] = ankle
        held_feet[side] = compute_shortest_rotations(balls[side] - ankles[side], ball - ankle) @ feet[side]
    return held_ankles, held_feet


def resample_foot_contacts(contacts: BodyContacts, frame_count: int, rate: float) -> BodyContacts:
    """Return the contacts of heels and balls of the feet at another rate: those of the nearest frames."""
    frames = np.rint(np.arange(frame_count) * contacts.rate / rate).astype(int)
    frames = np.minimum(frames, max(len(contacts.is_contact) - 1, 0))
    columns = [contacts.joints.index(joint) for joint in CONTACT_JOINTS]
    is_contact, is_known = (mask[frames][:, columns] for mask in (contacts.is_contact, contacts.is_known))
    return replace(contacts, joints=CONTACT_JOINTS, is_contact=is_contact, is_known=is_known, rate=rate)


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
