"""Where pelvis, feet and hands of a character shall be: the places of the source body, scaled by the ratio of the legs' lengths.

All places are scaled about the origin, so a foot that stands still in the source stands still on the character. A foot is placed
by its ball, which bears the weight from the time when the foot lies flat until it leaves the floor; its height and inclination
when it lies flat differ from person to person, and are measured where heel and ball are in contact at once. Feet that are held in
the source are held by the character's own ankles and balls, since its feet have another shape.

A leg that is nearly straight bends far for a small change of the distance from hip to ankle, so the distance approaches the leg's
length smoothly: of a leg that bears the body, below the hip, the pelvis is lowered; of one that reaches to the side or ahead, the
foot comes nearer.

Away from the body a hand is where the arm's bones point as in the source, at the same share of the arm's length. Near a part of
the body the palm keeps its vector across the part's axis, so that a hand on a thigh stays there on a character with longer arms.
Palms that are near each other stay so.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from mocapfix.characters.body_frames import BodyFrame, SegmentMotion
from mocapfix.characters.character import SIDES
from mocapfix.contacts.contacts import CONTACT_JOINTS, FOOT_JOINTS, BodyContacts
from mocapfix.contacts.foot_displacements import compute_foot_displacements
from mocapfix.stats.rigid_alignment import compute_shortest_rotation, compute_shortest_rotations

Points = Float[np.ndarray, "T 3"]  # in the world, in metres
Rotations = Float[np.ndarray, "T 3 3"]

NEAR_DISTANCE = 0.3
"""Distance of a palm from the axis of a part of the body, in lengths of the trunk, up to which its place beside it is kept."""
FAR_DISTANCE = 0.45  # distance from which only the arm's directions are kept
NEARNESS_POWER = 4  # power of the nearness with which the places beside several parts are weighted: the nearest part decides
MIN_PLACE_WEIGHT = 1e-12
MAX_REACH = 0.999  # share of the arm's length up to which a hand's target is reached
MIN_PALM_DISTANCE_M = 1e-6
MIN_LINE_LENGTH2_M2 = 1e-12  # squared length of a line below which it has no direction
LEG_PARTS = tuple((f"{side}_thigh", f"{side}_shin") for side in SIDES)
BODY_PARTS = (*LEG_PARTS, ("pelvis", "neck"), ("neck", "head"))
"""Parts of the body near which hands keep their places: lines from one segment's beginning to another's."""


def compute_hand_targets(
    source: BodyFrame, target: BodyFrame, motion: SegmentMotion, target_position: Mapping[str, Points]
) -> dict[str, Points]:
    """Return by side where the wrists shall be, from the source's motion and where the target's segments begin without them."""
    arm_ratio, scale = target.arm_length_m / source.arm_length_m, target.trunk_length_m / source.trunk_length_m
    source_palms = {side: motion.carry(f"{side}_hand", source.compute_palm(side)) for side in SIDES}
    offsets = {side: motion.rotation[f"{side}_hand"] @ target.compute_palm(side) for side in SIDES}
    parts = [each for each in BODY_PARTS if all(end in motion.position and end in target_position for end in each)]
    ends = [[[position[end] for end in part] for position in (motion.position, target_position)] for part in parts]
    palms: dict[str, Points] = {}
    for side in SIDES:
        arm = arm_ratio * (motion.position[f"{side}_hand"] - motion.position[f"{side}_upper_arm"])
        free = target_position[f"{side}_upper_arm"] + arm + offsets[side]
        palms[side] = place_beside_parts(source_palms[side], free, ends, source.trunk_length_m, scale)
    palms = keep_palms_together(source_palms, palms, source.trunk_length_m, scale)
    wrists = {side: palm - offsets[side] for side, palm in palms.items()}
    return {side: limit_reach(each, target_position[f"{side}_upper_arm"], target.arm_length_m) for side, each in wrists.items()}


def keep_palms_together(
    source_palms: Mapping[str, Points], palms: Mapping[str, Points], source_trunk_m: float, scale: float
) -> dict[str, Points]:
    """Return the palms by side, as far apart as in the source, scaled, where they are near each other there.

    Their middle stays where it is. Nearness is measured in lengths of the source's trunk.
    """
    apart = source_palms["left"] - source_palms["right"]
    nearness = compute_nearness(np.linalg.norm(apart, axis=1) / source_trunk_m)[:, None]
    correction = nearness * (scale * apart - palms["left"] + palms["right"]) / 2
    return {"left": palms["left"] + correction, "right": palms["right"] - correction}


def place_beside_parts(
    palm: Points, free: Points, ends: Sequence[Sequence[Sequence[Points]]], source_trunk_m: float, scale: float
) -> Points:
    """Return the places of a palm in metres: beside the parts of the body where it is near one, `free` where it is near none.

    How far along a part it is follows from the arm: a longer arm hangs lower. The nearest part decides.

    Args:
        palm: Of the source.
        free: Of the target, by the arm's directions.
        ends: Of each part in the source, and in the target.
        source_trunk_m: Length of the source's trunk.
        scale: Length of the target's trunk over that of the source's.
    """
    total, weights, nearest = np.zeros(free.shape), np.zeros(len(free)), np.zeros(len(free))
    for source_ends, (start, end) in ends:
        _, across = split_along_line(palm, *source_ends)
        share, _ = split_along_line(free, start, end)
        nearness = compute_nearness(np.linalg.norm(find_nearest_point(palm, *source_ends)[1], axis=1) / source_trunk_m)
        weight = nearness**NEARNESS_POWER
        total += weight[:, None] * (start + share[:, None] * (end - start) + scale * across)
        weights += weight
        nearest = np.maximum(nearest, nearness)
    beside = total / np.maximum(weights, MIN_PLACE_WEIGHT)[:, None]
    return free + nearest[:, None] * np.where(weights[:, None] > MIN_PLACE_WEIGHT, beside - free, 0.0)


def move_hands_out_of_thighs(
    source: BodyFrame,
    target: BodyFrame,
    motion: SegmentMotion,
    solved_position: Mapping[str, Points],
    wanted: Mapping[str, Points],
) -> dict[str, Points]:
    """Return the targets of the wrists, moved so far that no palm is nearer to the axis of a thigh than in the source.

    Distances are compared in lengths of the trunk, and only where they are less than NEAR_DISTANCE of these. The target was
    solved with the `wanted` targets, and its segments then began at `solved_position`.
    """
    ratio = target.trunk_length_m / source.trunk_length_m
    moved = {side: wrist.copy() for side, wrist in wanted.items()}
    for side, wrist in moved.items():
        palm = motion.carry(f"{side}_hand", source.compute_palm(side))
        solved_palm = solved_position[f"{side}_hand"] + motion.rotation[f"{side}_hand"] @ target.compute_palm(side)
        for start, end in LEG_PARTS:
            vector = find_nearest_point(palm, motion.position[start], motion.position[end])[1]
            solved_vector = find_nearest_point(solved_palm, solved_position[start], solved_position[end])[1]
            least = ratio * np.minimum(np.linalg.norm(vector, axis=1), NEAR_DISTANCE * source.trunk_length_m)
            distance = np.linalg.norm(solved_vector, axis=1)
            outward = np.where(distance[:, None] > MIN_PALM_DISTANCE_M, solved_vector, vector)
            outward = outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), MIN_PALM_DISTANCE_M)
            wrist += np.maximum(least - distance, 0.0)[:, None] * outward
    return moved


def find_nearest_point(point: Points, start: Points, end: Points) -> tuple[Float[np.ndarray, " T"], Points]:
    """Return the share of the way along a line of the point on it that is nearest, from 0 to 1, and the vector from there."""
    share = np.clip(split_along_line(point, start, end)[0], 0.0, 1.0)
    return share, point - start - share[:, None] * (end - start)


def split_along_line(point: Points, start: Points, end: Points) -> tuple[Float[np.ndarray, " T"], Points]:
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


def limit_reach(wanted: Points, shoulder: Points, arm_length_m: float) -> Points:
    vector = wanted - shoulder
    distance = np.linalg.norm(vector, axis=1)
    ratio = np.minimum(1.0, MAX_REACH * arm_length_m / np.maximum(distance, MIN_PALM_DISTANCE_M))
    return shoulder + ratio[:, None] * vector


MIN_FLAT_S = 0.1  # time in which a foot must be flat, all contacts together, to be measured
MAX_INCLINATION_RAD, MAX_STEADY_INCLINATION_RAD = np.deg2rad(15.0), np.deg2rad(50.0)
"""A foot that is more inclined in contact does not lie flat: it stands on its toes or on an edge. The second limit is for a foot
that is always inclined alike, because its skeleton has the ankle higher above the ball."""
MAX_UNSTEADINESS_RAD = np.deg2rad(5.0)  # median difference of the inclinations of such a foot from their median
MAX_HEIGHT_CHANGE = 0.05  # largest difference of the measured height of the ball from that of the skeleton, in lengths of the leg
LOWEST_BALL_PERCENTILE = 2.0
MAX_HEIGHT_ABOVE_LOWEST_M = 0.01
"""The ball of a flat foot is at most so much higher than in the lowest frames of the take, which are not below the floor."""
UPWARD = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class FlatFoot:
    """A foot that lies flat."""

    ball_height_m: float  # height of the ball above the floor
    # S of the foot when it lies flat, without its heading; the identity for a foot without inclination
    inclination: Float[np.ndarray, "3 3"]

    def compute_ankle_height(self, ball: Float[np.ndarray, " 3"]) -> float:
        """Return the height of the ankle above the floor; `ball` is relative to the ankle, in the foot's axes, in metres."""
        return self.ball_height_m - float((self.inclination @ ball)[1])


def measure_flat_feet(source: BodyFrame, motion: SegmentMotion, contacts: BodyContacts | None) -> dict[str, FlatFoot]:
    """Return the flat feet of the source by side, those of its skeleton where they cannot be measured.

    The contacts are those of the feet at the rate of the motion.
    """
    feet = {side: FlatFoot(source.ball_height_m, np.eye(3)) for side in SIDES}
    if contacts is None:
        return feet
    for side in SIDES:
        is_flat = contacts.is_contact[:, [contacts.joints.index(joint) for joint in FOOT_JOINTS[side]]].all(1)
        if is_flat.sum() < MIN_FLAT_S * contacts.rate:
            continue
        heights = contacts.floor.compute_height_above(motion.carry(f"{side}_foot", source.compute_ball(side)))
        lowest_m = float(np.percentile(heights, LOWEST_BALL_PERCENTILE))
        height_m = min(float(np.median(heights[is_flat])), lowest_m + MAX_HEIGHT_ABOVE_LOWEST_M)
        limit_m = MAX_HEIGHT_CHANGE * source.leg_length_m
        verticals = motion.rotation[f"{side}_foot"][is_flat, 1]  # in the foot's axes
        upward = np.median(verticals, axis=0)
        is_steady = np.median(np.linalg.norm(verticals - upward, axis=1)) < MAX_UNSTEADINESS_RAD
        limit_rad = MAX_STEADY_INCLINATION_RAD if is_steady else MAX_INCLINATION_RAD
        is_plausible = upward[1] > np.cos(limit_rad) * np.linalg.norm(upward)
        feet[side] = FlatFoot(
            float(np.clip(height_m, source.ball_height_m - limit_m, source.ball_height_m + limit_m)),
            compute_shortest_rotation(upward, UPWARD) if is_plausible else np.eye(3),
        )
    return feet


def level_feet(motion: SegmentMotion, feet: Mapping[str, FlatFoot]) -> SegmentMotion:
    """Return the segments with feet and toes turned so that a foot that lies flat in the source has no inclination."""
    turned = {
        segment: motion.rotation[segment] @ foot.inclination.T
        for side, foot in feet.items()
        for segment in (f"{side}_foot", f"{side}_toe")
    }
    return replace(motion, rotation={**motion.rotation, **turned})


@dataclass(frozen=True)
class KeptPositions:
    """Targets of a character's joints in every frame, in metres."""

    pelvis: Points  # the head of the pelvis bone
    ankles: dict[str, Points]  # by side


def compute_kept_positions(
    source: BodyFrame, target: BodyFrame, motion: SegmentMotion, flat_feet: Mapping[str, FlatFoot], floor_height_m: float = 0.0
) -> KeptPositions:
    """Compute where pelvis and ankles of a target body shall be, from the segments, flat feet and floor of the source.

    The floor of the target is at height 0.
    """
    scale = target.leg_length_m / source.leg_length_m
    thighs = [motion.position[f"{side}_thigh"] for side in SIDES]
    ankle_height_m = float(np.mean([flat_feet[side].compute_ankle_height(source.compute_ball(side)) for side in SIDES]))
    hips = scale_positions(np.mean(thighs, axis=0), scale, floor_height_m + ankle_height_m, target.ankle_height_m)
    ankles: dict[str, Points] = {}
    for side, flat in flat_feet.items():
        ball = motion.carry(f"{side}_foot", source.compute_ball(side))
        kept = scale_positions(ball, scale, floor_height_m + flat.ball_height_m, target.ball_height_m)
        ankles[side] = kept - motion.rotation[f"{side}_foot"] @ flat.inclination.T @ target.compute_ball(side)
    return KeptPositions(hips - motion.rotation["pelvis"] @ target.hip_centre, ankles)


SETTLING_S = 0.06  # before and after a contact in which a foot comes to the floor or leaves it, and its standard deviation
LIFT_S = 0.04  # standard deviation of the time over which changes of a foot's height are smoothed
SETTLING_ROUNDS = 3  # the bend of the toe depends on the height of the foot, and that on the toe
MAX_TOE_BEND_RAD = np.deg2rad(70.0)
TOE_TIP_SHARE = 0.3  # of a toe's length, from which its points are ahead of the ball


def settle_soles(
    source: BodyFrame, target: BodyFrame, kept: KeptPositions, motion: SegmentMotion, contacts: BodyContacts | None
) -> tuple[KeptPositions, SegmentMotion]:
    """Return the targets with soles on the floor in contacts, and never below it, and the segments with toes bent so far up.

    The soles are those of the target's mesh; without one nothing changes. The contacts are those of the feet at the rate of the
    motion, the segments those of the source, whose feet are level when they lie flat.
    """
    from scipy.ndimage import gaussian_filter1d, maximum_filter1d  # slow to import

    if contacts is None:
        return kept, motion
    ankles, rotations, scale = dict(kept.ankles), dict(motion.rotation), target.leg_length_m / source.leg_length_m
    for side in SIDES:
        foot, toe = f"{side}_foot", f"{side}_toe"
        sole, toe_sole, ball = target.compute_sole(foot), target.compute_sole(toe), target.compute_ball(side)
        if not len(sole):
            continue
        place = motion.carry(foot, source.compute_ball(side))
        level = scale * (place[:, 1] - contacts.floor.compute_height_above(place) - contacts.floor.height_m)
        reach = SETTLING_S * contacts.rate
        contact = gaussian_filter1d(maximum_filter1d(contacts.find_foot_contact(side) * 1.0, 2 * round(reach) + 1), reach)
        upward, free = motion.rotation[foot][:, 1], kept.ankles[side][:, 1] - level
        height = free
        for _ in range(SETTLING_ROUNDS if len(toe_sole) else 1):
            rotations[toe] = bend_toe(motion.rotation[toe], toe_sole, height + upward @ ball)
            lowest = (upward @ sole.T).min(1)
            if len(toe_sole):
                lowest = np.minimum(lowest, upward @ ball + (rotations[toe][:, 1] @ toe_sole.T).min(1))
            height = free + np.maximum(-free - lowest, 0.0) - contact * np.maximum(free + lowest, 0.0)
        ankles[side] = ankles[side] + gaussian_filter1d(height - free, LIFT_S * contacts.rate)[:, None] * UPWARD
    return replace(kept, ankles=ankles), replace(motion, rotation=rotations)


def bend_toe(rotation: Rotations, sole: Float[np.ndarray, "P 3"], height: Float[np.ndarray, " T"]) -> Rotations:
    """Return the rotation S of a toe, bent up until no point of its sole ahead of the ball at this height is below the floor."""
    ahead = sole[sole[:, 2] > TOE_TIP_SHARE * sole[:, 2].max(initial=0.0)]
    pitch = np.arcsin(np.clip(rotation[:, 1, 2], -1.0, 1.0))[:, None] + np.arctan2(ahead[:, 1], ahead[:, 2])
    least = np.arcsin(np.clip(-height[:, None] / np.hypot(ahead[:, 1], ahead[:, 2]), -1.0, 1.0))
    bend = np.clip((least - pitch).max(axis=1, initial=0.0), 0.0, MAX_TOE_BEND_RAD)
    return rotation @ Rotation.from_rotvec(-bend[:, None] * [1.0, 0.0, 0.0]).as_matrix()


def scale_positions(position: Points, scale: float, source_height_m: float, target_height_m: float) -> Points:
    """Return positions scaled about the origin, so that one at `source_height_m` comes to `target_height_m`."""
    return scale * position + [0.0, target_height_m - scale * source_height_m, 0.0]


def hold_kept_feet(
    target: BodyFrame, ankles: dict[str, Points], feet: dict[str, Rotations], contacts: BodyContacts
) -> tuple[dict[str, Points], dict[str, Rotations]]:
    """Return ankles in metres and rotations S of the feet, by side, with the feet held in contacts at the rate of the motion."""
    balls = {side: ankles[side] + feet[side] @ target.compute_ball(side) for side in SIDES}
    position = np.stack([place[side] for side in FOOT_JOINTS for place in (ankles, balls)], axis=1)
    held = position + compute_foot_displacements(position, contacts, is_locked=True)
    held_ankles = {side: held[:, 2 * k] for k, side in enumerate(FOOT_JOINTS)}
    held_balls = {side: held[:, 2 * k + 1] for k, side in enumerate(FOOT_JOINTS)}
    turns = {side: compute_shortest_rotations(balls[side] - ankles[side], held_balls[side] - held_ankles[side]) for side in SIDES}
    return held_ankles, {side: turns[side] @ feet[side] for side in SIDES}


def resample_foot_contacts(contacts: BodyContacts, frame_count: int, rate: float) -> BodyContacts:
    """Return the contacts of heels and balls of the feet at another rate: those of the nearest frames."""
    frames = np.rint(np.arange(frame_count) * contacts.rate / rate).astype(int)
    frames = np.minimum(frames, max(len(contacts.is_contact) - 1, 0))
    columns = [contacts.joints.index(joint) for joint in CONTACT_JOINTS]
    is_contact, is_known = (mask[frames][:, columns] for mask in (contacts.is_contact, contacts.is_known))
    return replace(contacts, joints=CONTACT_JOINTS, is_contact=is_contact, is_known=is_known, rate=rate)


FREE_REACH = 0.985  # share of a leg's length up to which the distance from hip to ankle is kept as it is
BELOW_COSINE, BESIDE_COSINE = 0.9, 0.7
"""Cosines of the angle between a leg and the vertical from which it bears the body, and up to which it does not."""
LARGER_DROP_POWER = 4
"""Power by which the drops that both legs need are combined: the larger one decides, without a jump where they are equal."""
MIN_DROP_M = 1e-12


def keep_feet_within_reach(target: BodyFrame, kept: KeptPositions, pelvis_rotation: Rotations) -> KeptPositions:
    """Return the targets with the pelvis, of rotation S, lowered, and feet brought nearer, where a leg would be stretched."""
    hips = {side: pelvis_rotation @ target.compute_vector("pelvis", target.find_head(f"{side}_thigh")) for side in SIDES}
    drops = [compute_drop(kept.ankles[side] - kept.pelvis - hips[side], target.leg_length_m) for side in SIDES]
    drop = (np.sum(np.power(drops, LARGER_DROP_POWER), axis=0)) ** (1 / LARGER_DROP_POWER)
    pelvis = kept.pelvis - drop[:, None] * UPWARD
    ankles: dict[str, Points] = {}
    for side in SIDES:
        leg = kept.ankles[side] - pelvis - hips[side]
        distance = np.maximum(np.linalg.norm(leg, axis=1), MIN_DROP_M)
        is_beside = 1.0 - compute_bearing(leg)
        factor = 1.0 + is_beside * (limit_distance(distance, target.leg_length_m) / distance - 1.0)
        ankles[side] = pelvis + hips[side] + factor[:, None] * leg
    return KeptPositions(pelvis, ankles)


def compute_drop(leg: Points, leg_length_m: float) -> Float[np.ndarray, " T"]:
    """Return how far in metres the hip must be lowered for a leg that bears the body, a vector from hip to ankle."""
    across, height = np.linalg.norm(leg[:, [0, 2]], axis=1), -leg[:, 1]
    wanted = limit_distance(np.linalg.norm(leg, axis=1), leg_length_m)
    lower = np.sqrt(np.maximum(wanted**2 - across**2, 0.0))
    return compute_bearing(leg) * np.maximum(height - lower, 0.0)


def compute_bearing(leg: Points) -> Float[np.ndarray, " T"]:
    """Return 1 for a leg below its hip, 0 for one that reaches to the side, ahead or up, and a smooth step between."""
    cosine = -leg[:, 1] / np.maximum(np.linalg.norm(leg, axis=1), MIN_DROP_M)
    return compute_smooth_step(-cosine, -BELOW_COSINE, -BESIDE_COSINE)


def limit_distance(distance: Float[np.ndarray, " T"], leg_length_m: float) -> Float[np.ndarray, " T"]:
    """Return distances from hip to ankle: as they are up to FREE_REACH of the leg's length, approaching the length beyond."""
    free, rest = FREE_REACH * leg_length_m, (1.0 - FREE_REACH) * leg_length_m
    return np.where(distance <= free, distance, leg_length_m - rest * np.exp(-np.maximum(distance - free, 0.0) / rest))
