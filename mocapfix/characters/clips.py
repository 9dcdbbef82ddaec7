"""The clip of a motion that is delivered: which frames, and how they are closed to a loop, whose last leads into the first.

From one cycle to the next the body moves on over the floor and turns: a step that is no fault of a walk. Relative to that step
the last frame becomes the pose of the first. Half of the difference is added at the beginning of the motion, half taken away at
its end, and both fade within BLEND_S: of the rotations of the bones, of the place of the pelvis, and of their speeds, by
polynomials of the fifth degree without steps in speed or acceleration.

Feet keep their contacts: a foot that stands at the beginning or the end is moved as a whole, for as long as it stands, and the
difference fades while it swings. Thigh and shin follow by the closed form of two bones, in the plane in which the knee bends.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from mocapfix.characters.character import SIDES, Character, CharacterMotion, compute_character_poses
from mocapfix.characters.root_motion import CycleStep, measure_floor_path
from mocapfix.io.resampling import FRAME_TOLERANCE
from mocapfix.model.take import Take
from mocapfix.solve.kinematics import LegPath
from mocapfix.stats.sequences import find_runs

BLEND_S = 0.4  # time in which the difference at the seam fades: about one swing of a foot
MAX_STANDING_TRAVEL_M = 0.2  # way of the pelvis from the first to the last frame up to which a body returns: under half a step
MAX_STANDING_TURN_RAD = np.deg2rad(20.0)  # the same of its heading
MIN_LOOP_FRAMES = 5
SPEED_SHARES = {(False, False): (0.5, 0.5), (True, False): (0.0, 1.0), (False, True): (1.0, 0.0), (True, True): (0.0, 0.0)}
"""How much of a difference of a foot's speeds is taken at the beginning and at the end, by whether the foot stands there."""
MIN_RESERVE_M = 1e-4  # length by which a leg is shorter than its bones, at least
SHORT_SWING_SHARE = 0.4  # of BLEND_S: a foot that swings for less than 0.16 s is held


def find_trimmed_frames(trim: tuple[int, int] | None, take: Take, rate: float) -> slice:
    """Return the frames of a motion at a rate that lie within the first and the last frame of a range of the take."""
    if trim is None:
        return slice(None)
    first, last = ((frame - take.first_frame) * rate / take.rate for frame in trim)
    return slice(max(math.ceil(first - FRAME_TOLERANCE), 0), max(math.floor(last + FRAME_TOLERANCE) + 1, 0))


def close_loop(
    character: Character, motion: CharacterMotion, is_standing: Mapping[str, Bool[np.ndarray, " T"]]
) -> tuple[CharacterMotion, str]:
    """Return a motion closed to a loop, and a sentence on its seam.

    Args:
        motion: Of T frames, in which the bones above the pelvis keep the rest pose.
        is_standing: When each foot is in contact, by side.
    """
    if motion.frame_count < MIN_LOOP_FRAMES:
        return motion, f"A loop has at least {MIN_LOOP_FRAMES} frames, and the motion {motion.frame_count}: it is left as it is."
    floor_path = measure_floor_path(character, motion)
    step, start = floor_path.measure_step(), floor_path.position[0]
    returns = np.linalg.norm(floor_path.position[-1] - start) < MAX_STANDING_TRAVEL_M
    if returns and abs(np.sin(step.yaw_rad / 2)) < np.sin(MAX_STANDING_TURN_RAD / 2):
        step = CycleStep(0.0, np.zeros(3))  # its place is the same
    blended = _blend_poses(character, motion, step)
    closed = _place_feet(character, motion, blended, step, is_standing)
    before, after = (_describe_seam(character, each, step) for each in (motion, closed))
    duration_s, travel_m = (motion.frame_count - 1) / motion.rate, np.linalg.norm(start - step.undo(start))
    path = f"A cycle travels {travel_m:.2f} m and turns by {np.rad2deg(step.yaw_rad):.0f} degrees."
    return closed, f"Loop of {duration_s:.2f} s: its ends differed by {before}, now by {after}. {path}"


MIN_STRIDE_S, MAX_END_SHIFT_S = 0.5, 0.7  # time of a stride; a whole one ends at most so long before or after another frame
SPEED_TIME_S = 0.1  # time by which speeds count beside poses
MAX_DIFFERENCE_RATIO = 0.7  # of a whole stride's ends to those of another clip: 0.2 to 0.5 where these are 0.1 s apart


def name_whole_stride(character: Character, motion: CharacterMotion, frames: slice) -> str:
    """Return a sentence on the frame near the last of some frames of a motion that is more like the first, "" if none is."""
    first, stop, _ = frames.indices(motion.frame_count)
    bones = {bone for chain in character.mapping.bones.values() for bone in chain} - {character.mapping.bones["pelvis"][0]}
    poses = motion.local_rotations[:, sorted(bones)]
    reach, earliest = round(MAX_END_SHIFT_S * motion.rate), first + max(round(MIN_STRIDE_S * motion.rate), 1)
    ends = np.arange(max(earliest, stop - 1 - reach), min(stop + reach, motion.frame_count))
    if not len(ends):
        return ""
    speeds = SPEED_TIME_S * motion.rate * np.gradient(poses, axis=0)
    difference = np.hypot(*(np.linalg.norm((each - each[first]).reshape(len(each), -1), axis=1) for each in (poses, speeds)))
    shift = int(ends[difference[ends].argmin()]) - (stop - 1)
    if difference[stop - 1 + shift] >= MAX_DIFFERENCE_RATIO * difference[stop - 1]:
        return ""
    when = f"{abs(shift) / motion.rate:.2f} s ({abs(shift)} frames) {'later' if shift > 0 else 'earlier'}"
    return (
        f"The last frame is less like the first than the one {when}, where a whole stride may end; move the end of --trim there."
    )


def _describe_seam(character: Character, motion: CharacterMotion, step: CycleStep) -> str:
    """Return the largest differences of the body's bones between the last frame and the first, as part of a sentence."""
    bones = sorted({bone for chain in character.mapping.bones.values() for bone in chain})
    positions, rotations = (each[:, bones] for each in compute_character_poses(character, motion))
    place_mm = 1e3 * np.linalg.norm(step.undo(positions[-1]) - positions[0], axis=1).max()
    turn_deg = np.rad2deg(np.linalg.norm(_compute_vectors(rotations[0], step.rotation.T @ rotations[-1]), axis=1).max())
    speed = np.linalg.norm(_compute_speed_gap(positions, step, motion.rate), axis=1).max()
    return f"{place_mm:.1f} mm, {turn_deg:.1f} degrees and {speed:.2f} m/s"


def _compute_speed_gap(positions: Float[np.ndarray, "T *n 3"], step: CycleStep, rate: float) -> Float[np.ndarray, "*n 3"]:
    """Return the velocity in m/s at the end less that at the beginning, as seen in the first cycle."""
    return rate * ((positions[-1] - positions[-2]) @ step.rotation - (positions[1] - positions[0]))


class Fade(NamedTuple):
    """How a correction fades: weights of a difference of places and of one of speeds, over T frames."""

    place: Float[np.ndarray, " T"]  # from 1 at the seam to 0
    speed_s: Float[np.ndarray, " T"]  # 0 at the seam, where it rises by the share of the speed per second, and 0 later

    @staticmethod
    def build(frame_count: int, rate: float, lasts: "FadeFrames", speed_share: float) -> "Fade":
        """Return a fade.

        Args:
            lasts: How long.
            speed_share: How much of the difference of speeds is taken at this side of the seam.
        """
        s, u = (np.clip(each, 0.0, 1.0) for each in (
            (np.arange(frame_count) - lasts.held) / lasts.fading, np.arange(frame_count) / lasts.speed_fading,
        ))  # fmt: skip
        place = 1.0 - s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        speed = u - 6.0 * u**3 + 8.0 * u**4 - 3.0 * u**5
        return Fade(place, speed_share * lasts.speed_fading / rate * speed)


class FadeFrames(NamedTuple):
    """How many frames a correction lasts."""

    held: int  # in which the difference of places is corrected in full
    fading: int  # in which that fades then
    speed_fading: int  # in which the difference of speeds fades, from the seam on


def _close(
    fades: tuple[Fade, Fade], gap: Float[np.ndarray, "*n 3"], speed_gap: Float[np.ndarray, "*n 3"]
) -> tuple[Float[np.ndarray, "T *n 3"], Float[np.ndarray, "T *n 3"]]:
    """Return what is added at the beginning and at the end, from the fades of both and the differences end less beginning."""
    start, end = (np.multiply.outer(each.place, 0.5 * gap) for each in fades)
    start_speed, end_speed = (np.multiply.outer(each.speed_s, speed_gap) for each in fades)
    return start + start_speed, (end_speed - end)[::-1]


def _close_places(
    place: Float[np.ndarray, "T 3"], step: CycleStep, fades: tuple[Fade, Fade], rate: float
) -> Float[np.ndarray, "T 3"]:
    start, end = _close(fades, step.undo(place[-1]) - place[0], _compute_speed_gap(place, step, rate))
    return place + start + end @ step.rotation.T


def _close_rotations(
    rotations: Float[np.ndarray, "T n 3 3"], turns: Float[np.ndarray, "n 3 3"], fades: tuple[Fade, Fade], rate: float
) -> Float[np.ndarray, "T n 3 3"]:
    """Return rotations closed; the last of them, turned by `turns`, become the first."""
    gap = _compute_vectors(rotations[0], turns @ rotations[-1])
    speed_gap = rate * (_compute_vectors(rotations[-2], rotations[-1]) - _compute_vectors(rotations[0], rotations[1]))
    turn = np.sum(_close(fades, gap, speed_gap), axis=0)
    return rotations @ Rotation.from_rotvec(turn.reshape(-1, 3)).as_matrix().reshape(rotations.shape)


def _blend_poses(character: Character, motion: CharacterMotion, step: CycleStep) -> CharacterMotion:
    """Return the motion with the differences of all rotations and of the pelvis at the seam taken out."""
    count, rate, pelvis = motion.frame_count, motion.rate, character.mapping.bones["pelvis"][0]
    fade = Fade.build(count, rate, _find_fade(np.zeros(count, bool), rate), 0.5)
    positions, rotations = compute_character_poses(character, motion)
    local, turns = motion.local_rotations.copy(), np.tile(np.eye(3), (rotations.shape[1], 1, 1))
    local[:, pelvis], turns[pelvis] = rotations[:, pelvis], step.rotation.T
    local = _close_rotations(local, turns, (fade, fade), rate)
    place = _close_places(positions[:, pelvis], step, (fade, fade), rate)
    above = int(character.skeleton.parents[pelvis])
    if above >= 0:
        local[:, pelvis] = rotations[:, above].swapaxes(1, 2) @ local[:, pelvis]
        place = np.einsum("tba,tb->ta", rotations[:, above], place - positions[:, above])
    return replace(motion, pelvis_position=place, local_rotations=local)


def _compute_vectors(one: Float[np.ndarray, "*n 3 3"], other: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 3"]:
    """Return the rotation vectors from one rotation to another, in the axes of the first."""
    turns = one.swapaxes(-1, -2) @ other
    return Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_rotvec().reshape(turns.shape[:-1])


def _place_feet(
    character: Character,
    motion: CharacterMotion,
    blended: CharacterMotion,
    step: CycleStep,
    is_standing: Mapping[str, Bool[np.ndarray, " T"]],
) -> CharacterMotion:
    """Return the blended motion with the feet of the motion, moved as a whole while they stand at the seam."""
    count, rate, bones, parents = motion.frame_count, motion.rate, character.mapping.bones, character.skeleton.parents
    positions, rotations = compute_character_poses(character, motion)
    blended_positions, blended_rotations = compute_character_poses(character, blended)
    local = blended.local_rotations.copy()
    for side in SIDES:
        thigh, shin, foot = (bones[f"{side}_{segment}"][0] for segment in ("thigh", "shin", "foot"))
        place, axes, stands = positions[:, foot], rotations[:, [foot]], is_standing[side]
        shares = SPEED_SHARES[bool(stands[0]), bool(stands[-1])]
        fades = (
            Fade.build(count, rate, _find_fade(stands, rate), shares[0]),
            Fade.build(count, rate, _find_fade(stands[::-1], rate), shares[1]),
        )
        target = _close_places(place, step, fades, rate)
        turned = _close_rotations(axes, step.rotation.T[None], fades, rate)[:, 0]
        leg = LegPath.build(blended_positions[:, [thigh, shin, foot]], blended_rotations[:, thigh])
        # the ankle is as far from the hip as the target needs, less where the leg would be too straight
        distance, longest = np.linalg.norm(leg.ankle - leg.hip, axis=1), np.sum(leg.lengths_m, axis=0)
        longer, reserve = np.linalg.norm(target - leg.hip, axis=1) - distance, np.maximum(longest - distance, MIN_RESERVE_M)
        reach = distance + np.where(longer > 0, -reserve * np.expm1(-np.maximum(longer, 0.0) / reserve), longer)
        _, thigh_turn, shin_turn = leg.pose(leg.hip, target, reach)
        above_thigh, above_shin, above_foot = (blended_rotations[:, parents[bone]] for bone in (thigh, shin, foot))
        local[:, thigh] = above_thigh.swapaxes(1, 2) @ thigh_turn @ blended_rotations[:, thigh]
        local[:, shin] = (thigh_turn @ above_shin).swapaxes(1, 2) @ shin_turn @ blended_rotations[:, shin]
        local[:, foot] = (shin_turn @ above_foot).swapaxes(1, 2) @ turned
    return replace(blended, local_rotations=local)


def _find_fade(stands: Bool[np.ndarray, " T"], rate: float) -> FadeFrames:
    """Return how long the difference of a foot lasts from the seam on.

    It is held while the foot stands. A foot that soon stands, or soon stands again, keeps it too: in a short swing it would move
    too fast.
    """
    last_frame = len(stands) - 1
    duration = max(min(round(BLEND_S * rate), last_frame // 2), 1)  # it is gone in the middle of the motion
    held, following = 0, last_frame
    for first, last in find_runs(stands):
        if first - held > SHORT_SWING_SHARE * duration:
            following = first
            break
        held = last
    if last_frame - held < SHORT_SWING_SHARE * duration:  # it stands all the time: the difference fades all the time
        return FadeFrames(0, last_frame, duration)
    swing = int(np.argmax(stands)) or duration
    return FadeFrames(held, min(duration, following - held), min(duration, swing))
