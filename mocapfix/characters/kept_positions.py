"""Where pelvis and feet of a character shall be: the places of the source body, scaled by the ratio of the legs' lengths.

All places are scaled about the origin, so a foot that stands still in the source stands still on the character. A foot is placed
by its ball, which bears the weight from the time when the foot lies flat until it leaves the floor; its height and inclination
when it lies flat differ from person to person, and are measured where heel and ball are in contact at once. Feet that are held in
the source are held by the character's own ankles and balls, since its feet have another shape.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from mocapfix.characters.body_frames import BodyFrame, SegmentMotion
from mocapfix.characters.character import SIDES
from mocapfix.contacts.contacts import FOOT_JOINTS, BodyContacts
from mocapfix.contacts.foot_displacements import compute_foot_displacements
from mocapfix.stats.rigid_alignment import compute_shortest_rotation, compute_shortest_rotations

Points = Float[np.ndarray, "T 3"]  # in the world, in metres
Rotations = Float[np.ndarray, "T 3 3"]

MIN_FLAT_S = 0.1  # time in which a foot must be flat, all contacts together, to be measured
MAX_INCLINATION_RAD, MAX_STEADY_INCLINATION_RAD = np.deg2rad(15.0), np.deg2rad(50.0)
"""A foot that is more inclined in contact does not lie flat: it stands on its toes or on an edge. The second limit is for a foot
that is always inclined alike, because its skeleton has the ankle higher above the ball."""
MAX_UNSTEADINESS_RAD = np.deg2rad(5.0)  # median difference of the inclinations of such a foot from their median
MAX_SLOPE_DIFFERENCE_RAD = np.deg2rad(10.0)
"""of the lines from ankle to ball of two flat feet of a body, 6 degrees at most in six captures; one that slopes more is on its
toes."""
MAX_HEIGHT_CHANGE = 0.05  # largest difference of the measured height of the ball from that of the skeleton, in lengths of the leg
LOWEST_BALL_PERCENTILE = 2.0
MAX_HEIGHT_ABOVE_LOWEST_M = 0.01
"""The ball of a flat foot is at most so much higher than in the lowest frames of the take, which are not below the floor."""
UPWARD = np.array([0.0, 1.0, 0.0])
MIRROR = np.diag([-1.0, 1.0, 1.0])  # from one side to the other


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

    A foot that never lies flat in the take is like the other one. The contacts are those of the feet at the rate of the motion.
    """
    feet, slopes = {side: FlatFoot(source.ball_height_m, np.eye(3)) for side in SIDES}, dict.fromkeys(SIDES, -np.inf)
    if contacts is None:
        return feet
    for side in SIDES:
        is_flat = contacts.is_contact[:, [contacts.joints.index(joint) for joint in FOOT_JOINTS[side]]].all(1)
        if is_flat.sum() < MIN_FLAT_S * contacts.rate:
            continue
        ball = source.compute_ball(side)
        heights = contacts.floor.compute_height_above(motion.carry(f"{side}_foot", ball))
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
        if is_plausible:
            slopes[side] = measure_slope(upward, ball)
    flatter, steeper = sorted(SIDES, key=slopes.__getitem__, reverse=True)
    if slopes[flatter] - slopes[steeper] > MAX_SLOPE_DIFFERENCE_RAD:
        feet[steeper] = replace(feet[flatter], inclination=MIRROR @ feet[flatter].inclination @ MIRROR)
    return feet


def measure_slope(upward: Float[np.ndarray, " 3"], ball: Float[np.ndarray, " 3"]) -> float:
    """Return the angle in radians by which the line from ankle to ball rises; the vertical is in the same axes, of any length."""
    return float(np.arcsin(upward @ ball / (np.linalg.norm(upward) * np.linalg.norm(ball))))


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
    clearances_m: dict[str, Float[np.ndarray, " T"]]  # by side: of the sole of the mesh above the floor; none without a mesh


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
    return KeptPositions(hips - motion.rotation["pelvis"] @ target.hip_centre, ankles, {})


SETTLING_S = 0.06  # before and after a contact in which a foot comes to the floor or leaves it, and its standard deviation
LIFT_S = 0.04  # standard deviation of the time over which changes of a foot's height are smoothed
SETTLING_ROUNDS = 3  # the bend of the toe depends on the height of the foot, and that on the toe
MAX_TOE_BEND_RAD = np.deg2rad(70.0)
RESTING_S, MIN_SHARE = 0.5, 1e-9  # standard deviation of the time over which a foot's usual inclination is averaged; avoids 0 / 0
LEVEL_SHARE = 0.7  # of the differences from its usual inclination that is taken from a foot while heel and ball stand
LEVEL_SD_RAD = np.deg2rad(5.0)  # of usual inclinations of flat feet, 95 % below 5.5 degrees in 15 captures; others are on toes
TOE_TIP_SHARE = 0.3  # of a toe's length, from which its points are ahead of the ball


def rest_feet(
    target: BodyFrame, kept: KeptPositions, motion: SegmentMotion, contacts: BodyContacts
) -> tuple[KeptPositions, SegmentMotion]:
    """Return the targets and the segments with feet that tilt less about their balls while heel and ball are in contact.

    The ankle of a target that is higher above the ball than the source's would slide more. A foot that is nearly flat lies
    flatter; one that is held on its toes stays so. Arguments as for `settle_soles`.
    """
    from scipy.ndimage import gaussian_filter1d  # slow to import

    ankles, rotations = dict(kept.ankles), dict(motion.rotation)
    for side in SIDES:
        foot, columns = rotations[f"{side}_foot"], [contacts.joints.index(joint) for joint in FOOT_JOINTS[side]]
        is_flat = contacts.is_contact[:, columns].min(axis=1)
        upward = foot[:, 1]  # in the foot's axes
        resting = gaussian_filter1d(np.where(is_flat[:, None], upward, MIN_SHARE * UPWARD), RESTING_S * contacts.rate, axis=0)
        resting = resting / np.linalg.norm(resting, axis=1, keepdims=True)
        resting = resting * (1.0 - np.exp((resting[:, 1:2] - 1.0) / LEVEL_SD_RAD**2) * [1.0, 0.0, 1.0])
        share = LEVEL_SHARE * spread_contact(is_flat, contacts.rate)[:, None]
        turned = foot @ compute_shortest_rotations(upward + share * (resting - upward), upward)
        ankles[side] = ankles[side] + (foot - turned) @ target.compute_ball(side)
        rotations[f"{side}_toe"] = turned @ np.swapaxes(foot, 1, 2) @ rotations[f"{side}_toe"]
        rotations[f"{side}_foot"] = turned
    return replace(kept, ankles=ankles), replace(motion, rotation=rotations)


def spread_contact(is_contact: Bool[np.ndarray, " T"], rate: float) -> Float[np.ndarray, " T"]:
    """Return a share that is 1 in contacts, and begins before them and ends after them, smoothly."""
    from scipy.ndimage import gaussian_filter1d, maximum_filter1d  # slow to import

    return gaussian_filter1d(maximum_filter1d(is_contact * 1.0, 2 * round(SETTLING_S * rate) + 1), SETTLING_S * rate)


def settle_soles(
    source: BodyFrame, target: BodyFrame, kept: KeptPositions, motion: SegmentMotion, contacts: BodyContacts
) -> tuple[KeptPositions, SegmentMotion]:
    """Return the targets with soles on the floor in contacts, and never below it, and the segments with toes bent so far up.

    The soles are those of the target's mesh; without one nothing changes. The contacts are those of the feet at the rate of the
    motion, the segments those of the source, whose feet are level when they lie flat.
    """
    from scipy.ndimage import gaussian_filter1d  # slow to import

    ankles, rotations, clearances_m = dict(kept.ankles), dict(motion.rotation), dict[str, Float[np.ndarray, " T"]]()
    scale = target.leg_length_m / source.leg_length_m
    for side in SIDES:
        foot, toe = f"{side}_foot", f"{side}_toe"
        sole, toe_sole, ball = target.compute_hull(foot), target.compute_hull(toe), target.compute_ball(side)
        if not len(sole):
            continue
        place = motion.carry(foot, source.compute_ball(side))
        level = scale * (place[:, 1] - contacts.floor.compute_height_above(place) - contacts.floor.height_m)
        contact = spread_contact(contacts.find_foot_contact(side), contacts.rate)
        upward, free = motion.rotation[foot][:, 1], kept.ankles[side][:, 1] - level
        height, lowest = free, free
        for _ in range(SETTLING_ROUNDS if len(toe_sole) else 1):
            rotations[toe] = bend_toe(motion.rotation[toe], toe_sole, height + upward @ ball)
            lowest = (upward @ sole.T).min(1)
            if len(toe_sole):
                lowest = np.minimum(lowest, upward @ ball + (rotations[toe][:, 1] @ toe_sole.T).min(1))
            height = free + np.maximum(-free - lowest, 0.0) - contact * np.maximum(free + lowest, 0.0)
        lift = gaussian_filter1d(height - free, LIFT_S * contacts.rate)
        ankles[side], clearances_m[side] = ankles[side] + lift[:, None] * UPWARD, free + lift + lowest
    return KeptPositions(kept.pelvis, ankles, clearances_m), replace(motion, rotation=rotations)


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
    lines = {side: (balls[side] - ankles[side], held[:, 2 * k + 1] - held[:, 2 * k]) for k, side in enumerate(FOOT_JOINTS)}
    return held_ankles, {side: compute_shortest_rotations(*lines[side]) @ feet[side] for side in SIDES}


def resample_foot_contacts(contacts: BodyContacts, frame_count: int, rate: float) -> BodyContacts:
    """Return the contacts of heels and balls of the feet at another rate: those of the nearest frames."""
    frames = np.rint(np.arange(frame_count) * contacts.rate / rate).clip(0, max(len(contacts.is_contact) - 1, 0)).astype(int)
    return replace(contacts.select_feet(frames), rate=rate)
