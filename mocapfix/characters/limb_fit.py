"""Displacements of pelvis, feet and hands from their scaled places, with which a character's limbs bend as the source's.

Scaled places alone do not fit the limbs: hips are wider or narrower, soles higher, one leg of the source longer than the other.
A limb that is nearly straight bends far for a small change of the distance between its ends. So each limb shall have the vector
that the source's directions of its two bones give, with the target's own lengths. Near a part of the body a palm keeps its vector
across the part's axis, so that a hand on a thigh stays there, and it is never nearer than the source's.

The displacements are solved over the whole motion at once, as those of least acceleration: a foot in contact keeps its
displacement, and a hand comes beside a part of the body, and leaves it, without a jump. The terms are linear, with standard
deviations; the lengths of limbs and what is one-sided are linearised in each round. Characters are of any size: standard
deviations of places, speeds and accelerations are in lengths of the target's leg, those of the hands in lengths of its trunk.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np
import scipy
from jaxtyping import Float

from mocapfix.characters.body_frames import BodyFrame, SegmentMotion
from mocapfix.characters.character import SIDES
from mocapfix.characters.kept_positions import UPWARD, KeptPositions, Points
from mocapfix.contacts.contacts import BodyContacts, Floor
from mocapfix.stats.rigid_alignment import find_nearest_points, split_along_line
from mocapfix.stats.sequences import minimise_acceleration

Weights = Float[np.ndarray, "T 3 3"]  # of displacements, in 1/m^2
BEND_SD_RAD = np.deg2rad(2.0)  # standard deviation of the angle of a knee or elbow about the source's
MIN_BEND_SINE = 0.05  # a limb that is straighter is not held more exactly
DIRECTION_SD_RAD = np.deg2rad(2.0)  # standard deviation of a limb's direction about the source's
FIT_ROUNDS = 3
MIN_LENGTH_M = 1e-6


@dataclass(frozen=True)
class DisplacementProblem:
    """The cost of displacements x of N points in each of T frames, half x A x minus b x, without what couples the frames."""

    curvature: Float[np.ndarray, "T M M"]  # A, for the M = 3 N coordinates, in 1/m^2
    pull: Float[np.ndarray, "T M"]  # b, in 1/m

    def add(self, signs: Mapping[int, int], weight: Weights, wanted: Points) -> None:
        """Add that the sum of the points' displacements, times their signs, shall be `wanted`, in metres."""
        pull = (weight @ wanted[..., None])[..., 0]
        for point, sign in signs.items():
            rows = slice(3 * point, 3 * point + 3)
            self.pull[:, rows] += sign * pull
            for other, other_sign in signs.items():
                self.curvature[:, rows, 3 * other : 3 * other + 3] += sign * other_sign * weight

    def add_limb(
        self, signs: Mapping[int, int], limb: Points, displacement: Points, wanted: Points, sd_m: Float[np.ndarray, " T"]
    ) -> None:
        """Add that `limb`, a vector between points with these signs, shall be `wanted`, with a standard deviation of the length.

        `displacement` is that of the vector in the round before. All are in metres.
        """
        current = limb + displacement
        length, wanted_length = (np.linalg.norm(each, axis=1, keepdims=True) for each in (current, wanted))
        along = current / np.maximum(length, MIN_LENGTH_M)
        lengthwise = along[:, :, None] * along[:, None, :]
        across = np.eye(3) - lengthwise
        across_sd_m = DIRECTION_SD_RAD * np.maximum(wanted_length, MIN_LENGTH_M)
        change = (
            along * (wanted_length - length)
            + (lengthwise @ displacement[..., None] + across @ (wanted - limb)[..., None])[..., 0]
        )
        self.add(signs, lengthwise / sd_m[:, None, None] ** 2 + across / across_sd_m[..., None] ** 2, change)

    def solve(
        self, speed_weight: Float[np.ndarray, "T M"], course: Float[np.ndarray, "T M"], acceleration_sd_m_s2: float, rate: float
    ) -> Float[np.ndarray, "T M"]:
        """Return the displacements of least cost in metres.

        Their speed from each frame to the next has a weight in s^2/m^2; they shall accelerate as those of the `course`, with this
        standard deviation.
        """
        stiffness, bend, pull = (rate**2 / acceleration_sd_m_s2) ** 2, np.diff(course, n=2, axis=0), self.pull.copy()
        for frame, coefficient in enumerate((1.0, -2.0, 1.0)):
            pull[frame : frame + len(bend)] += coefficient * stiffness * bend
        return minimise_acceleration(self.curvature, pull, stiffness, speed_weight[:-1] * rate**2)


ARM, LEG = ("upper_arm", "forearm", "hand"), ("thigh", "shin", "foot")
"""Segments of a side that begin where a limb begins, bends and ends."""


def compute_wanted_limb(
    target: BodyFrame, motion: SegmentMotion, side: str, limb: Sequence[str], place_share: float
) -> tuple[Points, Float[np.ndarray, " T"]]:
    """Return a target's limb with the directions of the source's bones, and the standard deviation of its length, in metres.

    `place_share` is the share of the way from there to the source's limb, scaled as a whole, which differs where one bone has
    another share of the limb.
    """
    segments = [f"{side}_{segment}" for segment in limb]
    bones = [end - start for start, end in pairwise(motion.position[segment] for segment in segments)]
    lengths = [np.maximum(np.linalg.norm(bone, axis=1, keepdims=True), MIN_LENGTH_M) for bone in bones]
    upper, lower = (bone / length for bone, length in zip(bones, lengths, strict=True))
    upper_m, lower_m = (target.compute_way(each) for each in pairwise(segments))
    vector, sine = upper_m * upper + lower_m * lower, np.linalg.norm(np.cross(upper, lower), axis=1)
    vector += place_share * ((upper_m + lower_m) * sum(bones) / sum(lengths) - vector)
    length = np.maximum(np.linalg.norm(vector, axis=1), MIN_LENGTH_M)
    return vector, BEND_SD_RAD * upper_m * lower_m * np.maximum(sine, MIN_BEND_SINE) / length


PELVIS_PLACE_SD, FOOT_PLACE_SD = 0.1, 0.3  # standard deviations of pelvis and feet about their scaled places
FLOOR_SD, SUNK_SD = 0.0006, 0.002  # of the height of a foot that stands, and of one whose sole would swing through the floor
CLEARANCE_SHARE, RISE_SHARE = 0.04, 0.3
"""Standard deviations of the height of a foot that swings, downwards and upwards, as shares of its height above the floor."""
CONTACT_SPEED_SD = 0.0006  # of the speed of a displacement while the foot stands
LEG_ACCELERATION_SD = 1.7  # of the acceleration of a displacement
TRUNK_COURSE_SHARE, FOOT_COURSE_SHARE = 0.5, 0.8
"""Share of the way from where the trunk is placed by the hips to where it would be by the shoulders, with which the pelvis
accelerates, and of that from where an ankle is placed to where the directions of its leg's bones bring it, as a foot does.
Trunks, legs and feet of other lengths swing less so."""
LOWEST_PERCENTILE = 2.0  # of a foot's heights: the floor
STANDING_HEIGHT, STANDING_SPEED = 0.03, 0.2
"""Height above the floor, in lengths of the leg, and speed, in these a second, up to which a foot stands without contacts."""


def fit_legs(
    frames: tuple[BodyFrame, BodyFrame],
    motion: SegmentMotion,
    kept: KeptPositions,
    start: Mapping[str, Points],
    contacts: BodyContacts | None,
    rate: float,
) -> KeptPositions:
    """Return the targets of pelvis and ankles, displaced to fit the legs of the target.

    The frames are those of source and target, the motion that of the source, and `start` has where the target's segments begin in
    the world with the source's rotations. The contacts of the feet are at the rate of the motion, if they are known.
    """
    if not len(kept.pelvis):
        return kept
    source, target = frames
    leg_m, scale, count = source.leg_length_m, target.leg_length_m / source.leg_length_m, len(kept.pelvis)
    speed_weight, course, place_sd = np.zeros((count, 9)), np.zeros((count, 9)), np.full((2, count, 9), FOOT_PLACE_SD)
    place_sd[:, :, :3] = PELVIS_PLACE_SD
    lowest, is_sunk = np.full((count, 9), -np.inf), np.zeros((count, 9), bool)
    trunks = [
        np.mean([each[f"{side}_upper_arm"] - each[f"{side}_thigh"] for side in SIDES], axis=0)
        for each in (motion.position, start)
    ]
    course[:, :3] = TRUNK_COURSE_SHARE * (scale * trunks[0] - trunks[1])
    limbs: list[tuple[Points, Points, Float[np.ndarray, " T"]]] = []
    for k, side in enumerate(SIDES, 1):
        ankle, ball = motion.position[f"{side}_foot"], motion.carry(f"{side}_foot", source.compute_ball(side))
        height = np.min([place[:, 1] - np.percentile(place[:, 1], LOWEST_PERCENTILE) for place in (ankle, ball)], axis=0)
        if contacts and contacts.has_feet:
            is_standing = contacts.find_foot_contact(side)
        else:  # a foot stands whose lower end is low and whose slower end is slow
            steps = [np.linalg.norm(np.diff(place, axis=0, append=place[-1:]), axis=1) for place in (ankle, ball)]
            is_standing = (height < STANDING_HEIGHT * leg_m) & (np.min(steps, axis=0) * rate < STANDING_SPEED * leg_m)
        for direction, share in enumerate((CLEARANCE_SHARE, RISE_SHARE)):
            swing_sd = np.clip(share * height / leg_m, FLOOR_SD, FOOT_PLACE_SD)
            place_sd[direction, :, 3 * k + 1] = np.where(is_standing, FLOOR_SD, swing_sd)
        lowest[:, 3 * k + 1] = -kept.clearances_m.get(side, np.inf)
        own = slice(3 * k, 3 * k + 3)
        speed_weight[:-1, own] = (is_standing[1:] & is_standing[:-1])[:, None] * (CONTACT_SPEED_SD * target.leg_length_m) ** -2
        hip = motion.rotation["pelvis"] @ target.compute_vector("pelvis", target.find_head(f"{side}_thigh"))
        leg, (wanted, sd_m) = kept.ankles[side] - kept.pelvis - hip, compute_wanted_limb(target, motion, side, LEG, 0.0)
        course[:, own] = FOOT_COURSE_SHARE * (wanted - leg)
        limbs.append((leg, wanted, sd_m))
    displacement = np.zeros((count, 9))
    for _ in range(FIT_ROUNDS):
        is_sunk |= displacement < lowest
        sunk_sd = np.where(place_sd[0] > FLOOR_SD, SUNK_SD, FLOOR_SD)
        sd = np.where(is_sunk, sunk_sd, np.where(displacement > 0, place_sd[1], place_sd[0]))
        information = (target.leg_length_m * sd) ** -2
        problem = DisplacementProblem(information[:, :, None] * np.eye(9), information * np.where(is_sunk, lowest, 0.0))
        for k, (leg, wanted, sd_m) in enumerate(limbs, 1):
            problem.add_limb({k: 1, 0: -1}, leg, displacement[:, 3 * k : 3 * k + 3] - displacement[:, :3], wanted, sd_m)
        displacement = problem.solve(speed_weight, course, LEG_ACCELERATION_SD * target.leg_length_m, rate)
    ankles = {side: kept.ankles[side] + displacement[:, 3 * k : 3 * k + 3] for k, side in enumerate(SIDES, 1)}
    return replace(kept, pelvis=kept.pelvis + displacement[:, :3], ankles=ankles)


HAND_PLACE_SHARE = 0.5
"""Share of the way of a hand from where the directions of the arm's bones bring it to its scaled place. Hands of arms whose upper
arm is 0.42 or 0.56 of their length come nearer to it by a quarter, for one or two degrees of the directions."""
NEAR_DISTANCE, FAR_DISTANCE = 0.17, 0.25
"""Distances of a palm from the axis of a part of the body, in lengths of the trunk, up to which its place beside it is kept, and
from which only the arm's directions are."""
TOUCH_DISTANCE = 0.28  # distance up to which a palm comes no nearer than the source's
TOUCH_SD = 0.01  # standard deviation of a palm about its place beside a part of the body, or beside the other palm
ARM_ACCELERATION_SD = 3.0  # of the acceleration of a displacement
LEG_PARTS = tuple((f"{side}_thigh", f"{side}_shin") for side in SIDES)
BODY_PARTS = (*LEG_PARTS, ("hips", "neck"), ("neck", "head"))
"""Parts of the body near which hands keep their places: lines from where one segment begins to where another does; "hips" is the
middle between the thighs."""


def fit_arms(
    frames: tuple[BodyFrame, BodyFrame], motion: SegmentMotion, start: Mapping[str, Points], rate: float
) -> dict[str, Points]:
    """Return by side where the wrists shall be, in metres; arguments as for `fit_legs`, of bodies with hands."""
    source, target = frames
    scale = target.trunk_length_m / source.trunk_length_m
    sizes = source.trunk_length_m, scale
    positions = [{**each, "hips": (each["left_thigh"] + each["right_thigh"]) / 2} for each in (motion.position, start)]
    parts = [
        [[position[end] for end in part] for position in positions]
        for part in BODY_PARTS
        if all(end in position for end in part for position in positions)
    ]
    arms = [compute_wanted_limb(target, motion, side, ARM, HAND_PLACE_SHARE) for side in SIDES]
    wrists = {side: start[f"{side}_upper_arm"] + arm for side, (arm, _) in zip(SIDES, arms, strict=True)}
    palms = [
        [place + motion.rotation[f"{side}_hand"] @ frame.compute_palm(side) for place, frame in zip(places, frames, strict=True)]
        for side, *places in ((side, motion.position[f"{side}_hand"], wrist) for side, wrist in wrists.items())
    ]
    apart, target_apart = (palms[0][k] - palms[1][k] for k in (0, 1))
    nearness = compute_nearness(np.linalg.norm(apart, axis=1) / source.trunk_length_m)
    none = np.zeros((len(apart), 6))
    beside = DisplacementProblem(np.zeros((len(none), 6, 6)), none.copy())
    touch_weight = (TOUCH_SD * target.trunk_length_m) ** -2
    beside.add({0: 1, 1: -1}, nearness[:, None, None] * touch_weight * np.eye(3), scale * apart - target_apart)
    for k, part in product(range(len(arms)), parts):
        beside.add({k: 1}, *place_beside_part(palms[k], part, sizes))
    displacement = none
    for _ in range(FIT_ROUNDS):
        problem = DisplacementProblem(beside.curvature.copy(), beside.pull.copy())
        for k, (arm, sd_m) in enumerate(arms):
            moved = displacement[:, 3 * k : 3 * k + 3]
            problem.add_limb({k: 1}, arm, moved, arm, sd_m)
            for part in parts:
                problem.add({k: 1}, *keep_off_part(palms[k], moved, part, sizes))
        displacement = problem.solve(none, none, ARM_ACCELERATION_SD * target.trunk_length_m, rate)
    return {side: wrist + displacement[:, 3 * k : 3 * k + 3] for k, (side, wrist) in enumerate(wrists.items())}


def place_beside_part(
    palms: Sequence[Points], part: Sequence[Sequence[Points]], sizes: tuple[float, float]
) -> tuple[Weights, Points]:
    """Return the weights and the wanted displacements in metres of a target's palm near a part of its body.

    Beside the part it has the vector across it that the source's palm has, scaled. How far along the part it is follows from the
    arm: a longer arm hangs lower. Palms and ends of the part are those of the source and of the target, and `sizes` are the trunk
    of the source and the scale.
    """
    trunk_m, scale = sizes
    distance = np.linalg.norm(find_nearest_points(palms[0], *part[0])[1], axis=1)
    across, target_across = (split_along_line(palm, *ends)[1] for palm, ends in zip(palms, part, strict=True))
    axis = part[1][1] - part[1][0]
    axis = axis / np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), MIN_LENGTH_M)
    share = compute_nearness(distance / trunk_m)[:, None, None] * (TOUCH_SD * scale * trunk_m) ** -2
    return share * (np.eye(3) - axis[:, :, None] * axis[:, None, :]), scale * across - target_across


def keep_off_part(
    palms: Sequence[Points], displacement: Points, part: Sequence[Sequence[Points]], sizes: tuple[float, float]
) -> tuple[Weights, Points]:
    """Return the same as `place_beside_part` for a palm that is nearer to a part than the source's, by the round before."""
    trunk_m, scale = sizes
    distance = np.linalg.norm(find_nearest_points(palms[0], *part[0])[1], axis=1)
    outward = find_nearest_points(palms[1] + displacement, *part[1])[1]
    reached = np.linalg.norm(outward, axis=1)
    outward = outward / np.maximum(reached, MIN_LENGTH_M)[:, None]
    missing = scale * np.minimum(distance, TOUCH_DISTANCE * trunk_m) - reached
    share = (missing > 0)[:, None, None] * (TOUCH_SD * scale * trunk_m) ** -2
    return share * outward[:, :, None] * outward[:, None, :], displacement + missing[:, None] * outward


def compute_nearness(distance: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T"]:
    """Return 1 up to NEAR_DISTANCE, 0 from FAR_DISTANCE on, and a cubic between with no slope at either end."""
    share = np.clip((FAR_DISTANCE - distance) / (FAR_DISTANCE - NEAR_DISTANCE), 0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)


RESTING_HEIGHTS = {"palm": 0.035, "hand": 0.035, "forearm": 0.045, "shin": 0.055, "thigh": 0.1, "head": 0.11}
"""Heights above the floor, in lengths of the leg, of a palm, and of where segments begin, of a person who rests them there."""
RESTING_DISTANCES = {LEG_PARTS[0]: 0.25, LEG_PARTS[1]: 0.25, ("hips", "shoulders"): 0.31}
"""Distances of a palm from the axes of thighs and trunk, in lengths of the trunk, of a person whose hand rests there."""
FREE_HEIGHT = 0.3  # height of a wrist or ankle, in lengths of the leg, from which it moves with a body that is lifted
PUSH_ACCELERATION = 12.0  # of a push, in lengths of the leg per square second
PUSH_S = 0.1  # time before and after a frame over which directions of pushes are averaged


def compute_pushes(
    frames: tuple[BodyFrame, BodyFrame], motion: SegmentMotion, solved: Mapping[str, Points], floor: Floor, rate: float
) -> dict[str, Points]:
    """Return by segment how far pelvis, hands and feet must move to keep parts out of the floor and palms off the body.

    A part may be as low, and a palm as near, as that of the source, scaled, or as where it rests; meshes of hands and head are
    above the floor. All but hands move with the pelvis, as far as feet on the floor let it; free hands and feet move along. The
    direction in which a palm is pushed is smooth too: it turns fast where a hand passes a part.

    Args:
        frames: Source and target.
        motion: The source's segments.
        solved: Where the target's segments begin.
        floor: Of the source. Its lowest level counts: hands may pass the height of a box. Without a level there is no floor.
        rate: Frames per second.
    """
    source, target = frames
    scale, trunk_scale = target.leg_length_m / source.leg_length_m, target.trunk_length_m / source.trunk_length_m
    ground = replace(floor, level_heights_m=floor.level_heights_m[:1])
    bodies = [_add_points(frame, motion, place) for frame, place in zip(frames, (motion.position, solved), strict=True)]
    rises = {"pelvis": np.zeros(len(solved["pelvis"]))}
    for name in [name for name in bodies[0] if name in bodies[1]]:
        side, _, part = name.partition("_")
        resting = RESTING_HEIGHTS.get(part or name)
        if resting is None or not floor.level_heights_m:
            continue
        least = np.minimum(ground.compute_height_above(bodies[0][name]), resting * source.leg_length_m)
        height = ground.compute_height_above(bodies[1][name] / scale + [0.0, ground.height_m, 0.0])
        if len(mesh := target.compute_hull(name)):  # it is as deep as it is when the hand is turned as the source's
            least = np.minimum(least, 0.0) - (motion.rotation[name][:, 1] @ mesh.T).min(axis=1) / scale
        moved = f"{side}_hand" if part in ("hand", "palm") else "pelvis"
        rises[moved] = np.maximum(rises.get(moved, 0.0), scale * (least - height))
    leg_m, limbs = target.leg_length_m, dict[str, tuple[Float[np.ndarray, " T"], Float[np.ndarray, " T"]]]()
    for side, limb in product(SIDES, (LEG, ARM)):
        start, *_, end = names = [f"{side}_{segment}" for segment in limb]
        if end in solved:  # how much of a lift it shares, and how far its limb begins below where it would be straight
            resting_m = target.ankle_height_m if limb is LEG else RESTING_HEIGHTS["hand"] * leg_m
            height = np.clip((solved[end][:, 1] - resting_m) / (FREE_HEIGHT * leg_m), 0.0, 1.0)
            across, up, along = (solved[end] - solved[start]).T
            straight = np.sqrt(np.maximum(target.compute_way(names) ** 2 - across**2 - along**2, 0.0))
            limbs[end] = height * height * (3.0 - 2.0 * height), np.maximum(up + straight, 0.0)
    held = [limbs[f"{side}_foot"][1] / np.maximum(1.0 - limbs[f"{side}_foot"][0], MIN_LENGTH_M) for side in SIDES]
    lift = spread_push(np.min([rises.pop("pelvis"), *held], axis=0), rate, leg_m)
    for end, (share, reserve) in limbs.items():
        rises[end] = np.maximum(rises.get(end, 0.0), lift * share + np.maximum(lift * (1.0 - share) - reserve, 0.0))
    pushes = {name: spread_push(rise, rate, leg_m)[:, None] * UPWARD for name, rise in rises.items()}
    pushes["pelvis"] = lift[:, None] * UPWARD
    push_weights = np.hanning(2 * round(PUSH_S * rate) + 3)[1:-1]
    push_weights /= push_weights.sum()
    for side, (ends, resting) in product(SIDES, RESTING_DISTANCES.items()):
        if all(f"{side}_palm" in body for body in bodies):
            vectors = [find_nearest_points(body[f"{side}_palm"], *(body[end] for end in ends))[1] for body in bodies]
            distance, reached = (np.linalg.norm(vector, axis=1) for vector in vectors)
            missing = trunk_scale * np.minimum(distance, resting * source.trunk_length_m) - reached
            outward = scipy.ndimage.convolve1d(
                vectors[0] / np.maximum(distance, MIN_LENGTH_M)[:, None], push_weights, axis=0, mode="nearest"
            )
            outward = outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), MIN_LENGTH_M)
            push = spread_push(missing, rate, leg_m)[:, None] * outward
            pushes[f"{side}_hand"] = pushes.get(f"{side}_hand", 0.0) + push
    return pushes


def _add_points(frame: BodyFrame, motion: SegmentMotion, position: Mapping[str, Points]) -> dict[str, Points]:
    """Return where a body's segments begin, its palms, which turn as the source's hands, and the ends of its trunk."""
    points = dict(position)
    for side in SIDES:
        if (hand := f"{side}_hand") in points:
            points[f"{side}_palm"] = points[hand] + motion.rotation[hand] @ frame.compute_palm(side)
    for name, segment in (("hips", "thigh"), ("shoulders", "upper_arm")):
        points[name] = (points[f"left_{segment}"] + points[f"right_{segment}"]) / 2
    return points


def spread_push(push: Float[np.ndarray, " T"], rate: float, length_m: float) -> Float[np.ndarray, " T"]:
    """Return what is nowhere less than a push in metres, and begins and ends smoothly.

    The joint in the middle of a straight limb moves aside as the root of what the limb becomes shorter. So the root of the push
    is spread: dilated by a parabola and closed by it (Serra 1982), its acceleration is nowhere larger than PUSH_ACCELERATION.
    """
    root = np.sqrt(np.maximum(push, 0.0) / length_m)
    reach = int(np.ceil(2.0 * np.sqrt(root.max(initial=0.0) / PUSH_ACCELERATION) * rate)) + 1
    fall = -0.5 * PUSH_ACCELERATION * (np.arange(-reach, reach + 1) / rate) ** 2
    dilated = np.maximum(scipy.ndimage.grey_dilation(root, structure=fall / 2, mode="nearest"), 0.0)
    return length_m * np.maximum(scipy.ndimage.grey_erosion(dilated, structure=fall, mode="nearest"), 0.0) ** 2
