"""Measure retargeting: onto each preset and back, and onto characters of other proportions, beside copied rotations.

Copied rotations are what constraints in Blender do: each bone turns from its rest pose as the source's bone does, in the world,
and the pelvis moves as the source's does, from the height of its own rest pose.

The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF EIA-0196217.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.characters.body_frames import BodyFrame, build_body_frame, compute_segment_motion
from mocapfix.characters.character import (
    SIDES,
    Character,
    CharacterMotion,
    build_cmu31_character,
    compute_character_poses,
    convert_motion,
)
from mocapfix.characters.kept_positions import find_nearest_point
from mocapfix.characters.load_character import load_character_preset
from mocapfix.characters.retarget_motion import (
    build_retarget_problem,
    build_solve_tree,
    compose_character_motion,
    retarget_motion,
    solve_retarget_problem,
    spread_rotations,
)
from mocapfix.contacts.contacts import BodyContacts
from mocapfix.contacts.find_contacts import find_contacts
from mocapfix.lab.sound_takes import iterate_sound_takes, read_performed_motions
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import Skeleton, compute_local_rotations, load_cmu31_body
from mocapfix.options import CHARACTER_PRESETS


def copy_rotations(source: Character, motion: CharacterMotion, target: Character) -> CharacterMotion:
    """Return the motion of a target whose bones have the source's rotations, and whose pelvis has the source's path."""
    source_frame, target_frame = build_body_frame(source), build_body_frame(target)
    segments, tree = compute_segment_motion(source_frame, motion), build_solve_tree(target_frame)
    rotation = spread_rotations(source_frame, target_frame, tree, segments)
    standing = [frame.leg_length_m + frame.ankle_height_m - frame.hip_centre[1] for frame in (source_frame, target_frame)]
    pelvis = segments.position["pelvis"] + np.array([0.0, standing[1] - standing[0], 0.0])
    return compose_character_motion(
        target_frame, tree, pelvis, compute_local_rotations(rotation, tree.skeleton.parents), motion.rate
    )


SKATE_RATE_HZ = 30.0
MAX_STANDING_STEP_M = 0.005
"""Movement of a foot in contact from one of 30 frames a second to the next from which it skates. Papers that have no contacts
count 25 mm of any foot below 50 mm, which feet that swing low exceed."""
TOUCHING_DISTANCE_M = 0.115  # distance of a palm from the axis of a thigh below which they penetrate, of a person of average size
MAX_MOTIONS = 40
UNTURNED_JOINTS = ("HipJoint", "FingerBase", "Index1", "Thumb", "ToeBase")
"""Ends of the names of joints whose rotations are not retargeted, or whose rotation no marker shows."""


@dataclass(frozen=True)
class BenchMotion:
    """A motion of the 31-joint skeleton with its contacts, at `rate` frames per second."""

    skeleton: Skeleton
    motion: Motion
    rate: float
    contacts: BodyContacts


@dataclass(frozen=True)
class RoundTripErrors:
    """Errors of the source after retargeting onto a character and back."""

    character: str
    joints_mm: float  # joints_mm, joints_p99_mm: mean distance of joints and the 99th percentile
    joints_p99_mm: float
    rotations_deg: float  # rotations_deg, rotations_p99_deg: the same of the angles between world rotations
    rotations_p99_deg: float
    copied_joints_mm: float  # copied_joints_mm, copied_rotations_deg: the means with rotations copied both ways
    copied_rotations_deg: float
    frames_per_second: float  # of retargeting onto the character


@dataclass(frozen=True)
class ProportionErrors:
    """What is kept on a character of other proportions, by a method: "source" (the motion itself), "copied", "retargeted"."""

    character: str
    method: str
    # share of the frames of contact in which a foot moves more than MAX_STANDING_STEP_M to the next of 30 a second
    skate_ratio: float
    slide_mm_s: float  # mean horizontal speed of the feet in contact
    hands_mm: float  # largest distance of a wrist from its target
    # penetration_share, penetration_mm: share of frames in which a palm is in a thigh, and the mean depth over all frames
    penetration_share: float
    penetration_mm: float


def load_bench_motions(folder: Path | None) -> list[BenchMotion]:
    """Load at most MAX_MOTIONS of the test people's motions in a folder, or compose some."""
    motions = [BenchMotion(*each, build_contacts(*each)) for each in _iterate_motions(folder)]
    return motions[:: max(1, -(-len(motions) // MAX_MOTIONS))]


def _iterate_motions(folder: Path | None) -> Iterator[tuple[Skeleton, Motion, float]]:
    if folder is None:
        for _, take in iterate_sound_takes(None, 4):
            yield take.subject.skeleton, take.motion, take.rate
        return
    skeleton = load_cmu31_body().skeleton
    for performed in read_performed_motions(folder / "test.npz"):
        yield skeleton, performed.motion, performed.rate_hz


def build_contacts(skeleton: Skeleton, motion: Motion, rate: float) -> BodyContacts:
    """Find the contacts of a motion without uncertainty."""
    position = compute_character_poses(build_cmu31_character(skeleton), convert_motion(motion, rate))[0]
    certain = replace(motion, joint_sd=np.zeros(position.shape[:2]))
    return find_contacts(skeleton, certain, position, rate)


def measure_round_trips(motions: Sequence[BenchMotion], report_progress: Callable[[str], None]) -> list[RoundTripErrors]:
    """Measure each preset."""
    results: list[RoundTripErrors] = []
    for name in CHARACTER_PRESETS:
        report_progress(name)
        target, distances, angles, copied, seconds = load_character_preset(name), [], [], [], 0.0
        for each in motions:
            source, motion = build_cmu31_character(each.skeleton), convert_motion(each.motion, each.rate)
            start_s = time.perf_counter()
            there = retarget_motion(source, motion, target)
            seconds += time.perf_counter() - start_s
            back = retarget_motion(target, there, source)
            errors = compare_motions(source, motion, back)
            distances.append(errors[0])
            angles.append(errors[1])
            copied.append(compare_motions(source, motion, copy_rotations(target, copy_rotations(source, motion, target), source)))
        distance, angle = np.concatenate(distances), np.concatenate(angles)
        results.append(
            RoundTripErrors(
                name,
                float(distance.mean() * 1e3),
                float(np.percentile(distance, 99) * 1e3),
                float(np.degrees(angle.mean())),
                float(np.degrees(np.percentile(angle, 99))),
                float(np.concatenate([errors[0] for errors in copied]).mean() * 1e3),
                float(np.degrees(np.concatenate([errors[1] for errors in copied]).mean())),
                len(distance) / seconds,
            )
        )
    return results


def compare_motions(
    character: Character, motion: CharacterMotion, other: CharacterMotion
) -> tuple[Float[np.ndarray, "T N"], Float[np.ndarray, "T N"]]:
    """Return the distances in metres and the angles in radians between joints in the world, of joints that are turned."""
    turned = [k for k, name in enumerate(character.skeleton.names) if not name.endswith(UNTURNED_JOINTS)]
    (position, rotation), (other_position, other_rotation) = (
        compute_character_poses(character, each) for each in (motion, other)
    )
    trace = np.einsum("tjab,tjab->tj", rotation[:, turned], other_rotation[:, turned])
    return np.linalg.norm(position - other_position, axis=-1)[:, turned], np.arccos(np.clip((trace - 1) / 2, -1, 1))


def build_proportions(skeleton: Skeleton) -> dict[str, Character]:
    """Return characters with legs of 0.7 and 1.3 times the length, and with arms of 1.3 times the length."""
    factors = {"short legs": (0.7, 1.0), "long legs": (1.3, 1.0), "long arms": (1.0, 1.3)}
    characters: dict[str, Character] = {}
    for name, (legs, arms) in factors.items():
        offsets = skeleton.offsets.copy()
        for joint, parent in enumerate(skeleton.parents):
            above = skeleton.names[parent]
            offsets[joint] *= legs if above.endswith(("UpLeg", "LeftLeg", "RightLeg")) else arms if above.endswith("Arm") else 1.0
        characters[name] = build_cmu31_character(replace(skeleton, offsets=offsets))
    return characters


def measure_proportions(motions: Sequence[BenchMotion], report_progress: Callable[[str], None]) -> list[ProportionErrors]:
    """Measure characters of other proportions."""
    results: list[ProportionErrors] = []
    for name in build_proportions(motions[0].skeleton):
        report_progress(name)
        rows: dict[str, list[tuple[float, ...]]] = {"source": [], "copied": [], "retargeted": []}
        for each in motions:
            source, motion = build_cmu31_character(each.skeleton), convert_motion(each.motion, each.rate)
            target = build_proportions(each.skeleton)[name]
            problem = build_retarget_problem(source, motion, target, contacts=each.contacts)
            problem, poses = solve_retarget_problem(problem)
            retargeted, wanted = compose_character_motion(problem.target, problem.tree, *poses, motion.rate), problem.wrists
            rows["source"].append(measure_kept(source, motion, each.contacts, None))
            rows["copied"].append(measure_kept(target, copy_rotations(source, motion, target), each.contacts, wanted))
            rows["retargeted"].append(measure_kept(target, retargeted, each.contacts, wanted))
        results += [ProportionErrors(name, method, *_pool(np.array(measured))) for method, measured in rows.items()]
    return results


def _pool(rows: Float[np.ndarray, "N 8"]) -> tuple[float, ...]:
    """Return skate ratio, slide, hands, share and depth of penetration over all motions."""
    contacts, frames = np.maximum(rows[:, 0].sum(), 1), rows[:, 1].sum()
    skate, slide = rows[:, 2].sum() / contacts, rows[:, 3].sum() / contacts
    return float(skate), float(slide), float(rows[:, 4].max()), float(rows[:, 5].sum() / frames), float(rows[:, 6].sum() / frames)


def measure_kept(
    character: Character, motion: CharacterMotion, contacts: BodyContacts, wrists: dict[str, Float[np.ndarray, "T 3"]] | None
) -> tuple[float, ...]:
    """Return frames of contact, frames, skates, sum of speeds, hands' error, frames with penetration, sum of depths (mm)."""
    frame = build_body_frame(character)
    position, rotation = compute_character_poses(character, motion)
    step = max(1, round(motion.rate / SKATE_RATE_HZ))
    count = skates = 0
    speeds, hands, depths = 0.0, 0.0, []
    for side in SIDES:
        is_contact = contacts.is_contact[:, contacts.joints.index(f"{side.capitalize()}ToeBase")]
        ball = position[:, character.mapping.bones[f"{side}_toe"][0]][:, [0, 2]]
        moved, stays = np.linalg.norm(ball[step:] - ball[:-step], axis=1), is_contact[step:] & is_contact[:-step]
        count += int(stays.sum())
        skates += int((moved[stays] > MAX_STANDING_STEP_M).sum())
        speeds += float(moved[stays].sum() * motion.rate / step * 1e3)
        hand = character.mapping.bones[f"{side}_hand"][0]
        if wrists is not None:
            hands = max(hands, float(np.linalg.norm(position[:, hand] - wrists[side], axis=1).max() * 1e3))
        depths += _measure_depths(frame, position, rotation, side)
    is_inside: Bool[np.ndarray, " T"] = np.any(np.array(depths) > 0, axis=0)
    return count, len(position), skates, speeds, hands, float(is_inside.sum()), float(np.sum(depths) * 1e3)


def _measure_depths(
    frame: BodyFrame, position: Float[np.ndarray, "T J 3"], rotation: Float[np.ndarray, "T J 3 3"], side: str
) -> list[Float[np.ndarray, " T"]]:
    """Return how deep a palm is in each thigh, in metres."""
    bones = frame.character.mapping.bones
    hand = bones[f"{side}_hand"][0]
    palm = position[:, hand] + rotation[:, hand] @ frame.standard_rotations[hand].T @ frame.compute_palm(side)
    depths: list[Float[np.ndarray, " T"]] = []
    for other in SIDES:
        ends = [position[:, bones[f"{other}_{segment}"][0]] for segment in ("thigh", "shin")]
        distance = np.linalg.norm(find_nearest_point(palm, *ends)[1], axis=1)
        depths.append(np.maximum(TOUCHING_DISTANCE_M - distance, 0.0))
    return depths
