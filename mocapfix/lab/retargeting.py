"""Measure retargeting: characters beside the performer's solved landmarks and markers.

A landmark is where a segment of the body begins. The wrist of the performer is the joint FingerBase, since the joint Hand of the
31-joint skeleton lies in the forearm. No motion is brought back: both ways of a round trip would share an error.

The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF EIA-0196217.
"""

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from mocapfix import pipeline
from mocapfix.characters.body_frames import build_body_frame, compute_segment_motion
from mocapfix.characters.character import (
    LIMB_ENDS,
    SIDES,
    Character,
    CharacterMotion,
    build_cmu31_character,
    compute_character_poses,
    convert_motion,
)
from mocapfix.characters.limb_fit import LEG_PARTS, TOUCH_DISTANCE
from mocapfix.characters.load_character import compute_skin_vertices, load_character
from mocapfix.characters.retarget_motion import retarget_motion
from mocapfix.contacts.contacts import FOOT_JOINTS, BodyContacts, Floor
from mocapfix.errors import MocapfixError, TakeError
from mocapfix.lab.common_task import clean_composed_take
from mocapfix.lab.sound_takes import iterate_sound_takes
from mocapfix.model.skeleton import Skeleton, is_below
from mocapfix.model.subject import Subject
from mocapfix.options import CleanOptions
from mocapfix.result import CleaningResult
from mocapfix.stats.rigid_alignment import find_nearest_points

Points = Float[np.ndarray, "T 3"]  # in the world, in metres
Quantities = dict[str, dict[str, Float[np.ndarray, " T"]]]
"""By quantity and place on the body: a value in each frame, NaN where there is none."""
COMPOSED, MAX_PERFORMED = 4, 40  # numbers of takes
MARKED_LANDMARKS = {
    "forearm": ("Arm", "ForeArm"), "hand": ("ForeArm", "FingerBase"), "shin": ("UpLeg", "Leg"), "foot": ("Leg", "Foot"),
}  # fmt: skip
"""By landmark: the joint with which its markers move, and the joint beside which they are."""
MAX_MARKER_DISTANCE_M = 0.11  # from the joint
LANDMARK_CHAINS = "hips thigh shin foot ball", "hips shoulders upper_arm forearm hand", "shoulders head"
MIN_PEAK_M_S2 = 20.0  # largest acceleration of the performer's landmark that is told from noise
HALF_THICKNESS_M = {"palm": 0.03, "forearm": 0.04, "shin": 0.05, "thigh": 0.09, "head": 0.1}
"""Height of a landmark above the floor on which a person of average size rests it."""
TOUCHING_DISTANCE_M = {LEG_PARTS[0]: 0.115, LEG_PARTS[1]: 0.115, ("hips", "shoulders"): 0.14}
"""Distance of a palm from the axis of a thigh or the trunk below which they penetrate, of a person of average size."""


@dataclass(frozen=True)
class BenchMotion:
    """A motion of the 31-joint skeleton with its contacts."""

    name: str
    skeleton: Skeleton
    motion: CharacterMotion
    contacts: BodyContacts
    markers: Mapping[str, Points]  # landmark to the middle of the markers beside it, NaN where one is missing


class Landmarks(NamedTuple):
    """Where the segments of a body begin in every frame, its palms and the balls of its feet, in metres, and its measures."""

    places: dict[str, Points]
    leg_m: float
    arm_m: float
    trunk_m: float
    soles_m: dict[str, Float[np.ndarray, " T"]]  # by side: height of the lower end of the sole


def load_bench_motions(folder: Path | None, captures: Path | None, feet: str) -> list[BenchMotion]:
    """Solve the captures of whole bodies in a folder, or takes of the test people's motions in another, or composed takes.

    Raises:
        TakeError: If no capture has a whole body.
    """
    options, motions = CleanOptions().change(feet=feet), list[BenchMotion]()
    for name, result in _iterate_results(folder, captures, options):
        subject, motion, contacts, take = result.subject, result.motion, result.contacts, result.relabelled_take
        if subject is not None and motion is not None and contacts is not None and subject.solved_joints.all():
            middles = find_marker_middles(subject, take.bare_labels, take.markers)
            motions.append(BenchMotion(name, subject.skeleton, convert_motion(motion, take.rate), contacts, middles))
    if not motions:
        raise TakeError(f"{captures}: no C3D file in this folder shows a whole body; give another folder.")
    return motions


def _iterate_results(folder: Path | None, captures: Path | None, options: CleanOptions) -> Iterator[tuple[str, CleaningResult]]:
    if captures is None:
        for name, take in iterate_sound_takes(folder, MAX_PERFORMED if folder else COMPOSED):
            yield name, clean_composed_take(take, options)
        return
    for path in sorted(captures.rglob("*.c3d")) if captures.is_dir() else [captures]:
        try:
            result = pipeline.clean(path, options)
        except MocapfixError:
            continue
        yield from ((path.stem, each) for each in result.subject_results or (result,))


def find_marker_middles(subject: Subject, labels: Sequence[str], position: Float[np.ndarray, "T M 3"]) -> dict[str, Points]:
    """Return the middle of the markers beside each of the landmarks MARKED_LANDMARKS."""
    skeleton, middles = subject.skeleton, dict[str, Points]()
    rest = skeleton.rest_positions[subject.joints] + subject.marker_offsets
    for side, (landmark, (carrier, joint)) in product(SIDES, MARKED_LANDMARKS.items()):
        place = skeleton.rest_positions[skeleton.find_joint(side.capitalize() + joint)]
        is_beside = np.linalg.norm(rest - place, axis=1) < MAX_MARKER_DISTANCE_M
        is_beside &= subject.joints == skeleton.find_joint(side.capitalize() + carrier)
        columns = [labels.index(subject.labels[k]) for k in np.flatnonzero(is_beside) if subject.labels[k] in labels]
        if columns:
            middles[f"{side}_{landmark}"] = position[:, columns].mean(axis=1)
    return middles


def find_foot_corners(character: Character) -> dict[int, Points]:
    """Return by bone of the feet the corners of the mesh that mostly move with it, in its axes, in metres; {} without a mesh."""
    corners, bones, _ = compute_skin_vertices(character)
    position, rotation = character.skeleton.compute_rest_pose()
    feet = [character.mapping.bones[f"{side}_foot"][0] for side in SIDES]
    own = {bone for bone in bones.tolist() for foot in feet if bone == foot or is_below(bone, foot, character.skeleton.parents)}
    return {bone: (corners[bones == bone] - position[bone]) @ rotation[bone] for bone in own}


def find_landmarks(character: Character, motion: CharacterMotion, corners: Mapping[int, Points]) -> Landmarks:
    """Return the landmarks of a character.

    The soles are at the lowest of the `corners` of the mesh by `find_foot_corners`; without these at the lower of their two ends.
    """
    frame = build_body_frame(character)
    (position, rotation), segments = compute_character_poses(character, motion), compute_segment_motion(frame, motion)
    places, soles_m = dict(segments.position), dict[str, Float[np.ndarray, " T"]]()
    for side in SIDES:
        foot, ball, hand = (f"{side}_{name}" for name in ("foot", "ball", "hand"))
        if hand in places:
            places[f"{side}_palm"] = places[hand] + segments.rotation[hand] @ frame.compute_palm(side)
        places[ball] = segments.carry(foot, frame.compute_ball(side))
        upward, first = segments.rotation[foot][:, 1, 1], character.mapping.bones[foot][0]
        ends = (ball, frame.ball_height_m), (foot, frame.ankle_height_m)
        soles = [places[end][:, 1] - upward * height_m for end, height_m in ends]
        own = [bone for bone in corners if bone == first or is_below(bone, first, character.skeleton.parents)]
        soles = [position[:, bone, 1] + (rotation[:, bone, 1] @ corners[bone].T).min(axis=1) for bone in own] or soles
        soles_m[side] = np.min(soles, axis=0)
    for name, segment in (("hips", "thigh"), ("shoulders", "upper_arm")):
        places[name] = (places[f"left_{segment}"] + places[f"right_{segment}"]) / 2
    arm_m = frame.compute_length("upper_arm", "forearm", "hand") if frame.has_hands else 0.0
    return Landmarks(places, frame.leg_length_m, arm_m, frame.trunk_length_m, soles_m)


def measure_motion(each: BenchMotion, performer: Landmarks, figure: Landmarks) -> Quantities:
    """Measure the landmarks of a figure that moves like the performer; the figure's floor is at height 0."""
    rate, places, wanted = each.motion.rate, figure.places, performer.places
    floor = replace(each.contacts.floor, level_heights_m=each.contacts.floor.level_heights_m[:1])  # a bench is no floor for hands
    leg, arm, trunk = figure.leg_m / performer.leg_m, figure.arm_m / performer.arm_m, figure.trunk_m / performer.trunk_m
    quantities: Quantities = defaultdict(dict)

    def measure_height(place: Points, below: Floor) -> Float[np.ndarray, " T"]:
        """Return heights above the scaled floor."""
        return leg * below.compute_height_above(place / leg + [0.0, below.height_m, 0.0])

    for side, (start, end) in product(SIDES, LIMB_ENDS.items()):
        ends = f"{side}_{start}", f"{side}_{end}"
        if ends[1] in places:
            line = places[ends[1]] - places[ends[0]]
            quantities[f"{start}_deg"][side] = compute_angle_deg(line, wanted[ends[1]] - wanted[ends[0]])
            if all(name in each.markers for name in ends):
                marked = each.markers[ends[1]] - each.markers[ends[0]]
                quantities[f"{start}_to_markers_deg"][side] = compute_angle_deg(line, marked)
    for name, place in scale_by_limb(performer, figure).items():
        peak = max(float(compute_accelerations(place, rate).max(initial=0.0)), MIN_PEAK_M_S2)
        quantities["acceleration_ratio"][name] = compute_accelerations(places[name], rate) / peak
    for name in sorted(wanted.keys() & places.keys()):
        part = name.partition("_")[2] or name
        if part in HALF_THICKNESS_M:
            low = leg * np.minimum(floor.compute_height_above(wanted[name]), HALF_THICKNESS_M[part])
            quantities["in_floor_mm"][name] = 1e3 * np.maximum(low - measure_height(places[name], floor), 0.0)
    for side in SIDES:
        feet = each.contacts.is_contact[:, [each.contacts.joints.index(joint) for joint in FOOT_JOINTS[side]]]
        for column, name in enumerate((f"{side}_foot", f"{side}_ball")):
            speed = np.linalg.norm(np.gradient(places[name][:, [0, 2]], 1 / rate, axis=0), axis=1)
            quantities["slide_mm_s"][name] = np.where(feet[:, column], 1e3 * speed, np.nan)
        ball = places[f"{side}_ball"]
        sole = figure.soles_m[side] - ball[:, 1] + measure_height(ball, each.contacts.floor)
        for name, sign in (("sole_below_mm", -1.0), ("sole_above_mm", 1.0)):
            quantities[name][side] = np.where(feet.all(axis=1), 1e3 * np.maximum(sign * sole, 0.0), np.nan)
        if f"{side}_hand" in places:
            distances = [measure_part_distances(side, body.places) for body in (performer, figure)]
            for part, touching_m in TOUCHING_DISTANCE_M.items():
                least = trunk * np.minimum(distances[0][part], touching_m)
                quantities["in_body_mm"][f"{side}_palm in {part[0]}"] = 1e3 * np.maximum(least - distances[1][part], 0.0)
            shoulder, hand = f"{side}_upper_arm", f"{side}_hand"
            off = places[hand] - places[shoulder] - arm * (wanted[hand] - wanted[shoulder])
            is_free = np.min(list(distances[0].values()), axis=0) > TOUCH_DISTANCE * performer.trunk_m
            quantities["free_hand_mm"][side] = np.where(is_free, 1e3 * np.linalg.norm(off, axis=1), np.nan)
    return quantities


def scale_by_limb(performer: Landmarks, figure: Landmarks) -> dict[str, Points]:
    """Return where landmarks were if the lines from one to the next had the performer's directions and the figure's lengths."""
    wanted, places = performer.places, figure.places
    scaled = {"hips": figure.leg_m / performer.leg_m * wanted["hips"]}
    for side, chain in product(SIDES, LANDMARK_CHAINS):
        for start, end in pairwise(each if each in wanted else f"{side}_{each}" for each in chain.split()):
            if end in wanted and end in places:
                lines = np.stack([each[end] - each[start] for each in (wanted, places)])
                lengths = np.median(np.linalg.norm(lines, axis=2), axis=1)
                scaled[end] = scaled[start] + lengths[1] / lengths[0] * lines[0]
    return scaled


def measure_part_distances(side: str, places: Mapping[str, Points]) -> dict[tuple[str, str], Float[np.ndarray, " T"]]:
    """Return the distances in metres of a palm from the axes of the parts of the body, and from the other palm."""
    other = f"{SIDES[side == SIDES[0]]}_palm"
    parts = (*TOUCHING_DISTANCE_M, ("shoulders", "head" if "head" in places else "shoulders"), (other, other))
    vectors = {part: find_nearest_points(places[f"{side}_palm"], places[part[0]], places[part[1]])[1] for part in parts}
    return {part: np.linalg.norm(vector, axis=1) for part, vector in vectors.items()}


def compute_angle_deg(first: Points, second: Points) -> Float[np.ndarray, " T"]:
    """Return the angles between vectors in degrees."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(first, second), axis=1), np.einsum("ti,ti->t", first, second)))


def compute_accelerations(place: Points, rate: float) -> Float[np.ndarray, " T"]:
    """Return the accelerations in m/s2; of two neighbouring frames the smaller, so that one frame's noise does not count."""
    size = np.pad(np.linalg.norm(np.diff(place, n=2, axis=0), axis=1) * rate**2, (1, 1))
    return np.minimum(size, np.append(size[1:], 0.0))


PROPORTIONS: dict[str, dict[str, float]] = {"short legs": {"legs": 0.7}, "long legs": {"legs": 1.3}, "long arms": {"arms": 1.3}}
"""Figures that are the performer with limbs of other lengths."""


def scale_limbs(skeleton: Skeleton, legs: float = 1.0, arms: float = 1.0) -> Character:
    """Return a character with the bones of a skeleton, those of legs and arms times a factor."""
    above = [skeleton.names[parent] for parent in skeleton.parents]
    factors = [
        legs if name.endswith(("UpLeg", "LeftLeg", "RightLeg")) else arms if name.endswith("Arm") else 1.0 for name in above
    ]
    return build_cmu31_character(replace(skeleton, offsets=skeleton.offsets * np.array(factors)[:, None]))


def measure_characters(
    motions: Sequence[BenchMotion], characters: Sequence[str], report_progress: Callable[[str], None]
) -> dict[str, dict[str, Any]]:
    """Measure presets and files of characters, and figures of other proportions.

    Returns:
        By quantity and character: mean, 95th percentile and largest value over all motions, and where that is. "performer" is
        the solved body itself.
    """
    rows: dict[str, list[tuple[str, Quantities]]] = defaultdict(list)
    speeds: dict[str, dict[str, float]] = {}
    loaded = {name: load_character(name) for name in characters}
    corners = {name: find_foot_corners(character) for name, character in loaded.items()}
    performers = [find_landmarks(build_cmu31_character(each.skeleton), each.motion, {}) for each in motions]
    for name in ("performer", *loaded, *PROPORTIONS):
        report_progress(name)
        rates: list[float] = []
        for each, performer in zip(motions, performers, strict=True):
            target = loaded.get(name) or scale_limbs(each.skeleton, **PROPORTIONS.get(name, {}))
            moved = replace(each.motion, pelvis_position=each.motion.pelvis_position - [0.0, each.contacts.floor.height_m, 0.0])
            if name != "performer":
                start_s = time.perf_counter()
                moved = retarget_motion(build_cmu31_character(each.skeleton), each.motion, target, contacts=each.contacts)
                rates.append(each.motion.frame_count / (time.perf_counter() - start_s))
            rows[name].append((each.name, measure_motion(each, performer, find_landmarks(target, moved, corners.get(name, {})))))
        if rates:
            speeds[name] = {"median of motions": float(np.median(rates))}  # the first may compile kernels
    quantities = dict.fromkeys(quantity for row in rows.values() for _, measured in row for quantity in measured)
    return {
        quantity: {name: row for name, each in rows.items() if (row := summarise_quantity(quantity, each))}
        for quantity in quantities
    } | {"frames_per_second": speeds}


def summarise_quantity(quantity: str, measured: Sequence[tuple[str, Quantities]]) -> dict[str, float | str]:
    """Return mean, 95th percentile and largest value over motions by name, and the motion, place and frame of the largest."""
    series = [(f"{motion}: {place}", each) for motion, row in measured for place, each in row.get(quantity, {}).items()]
    if not len(values := np.concatenate([np.zeros(0), *(each[np.isfinite(each)] for _, each in series)])):
        return {}
    where, worst = max(series, key=lambda item: np.nanmax(item[1], initial=-1.0))
    mean, high, largest = (round(float(each), 3) for each in (values.mean(), np.percentile(values, 95), values.max()))
    return {"mean": mean, "95 %": high, "largest": largest, "where": f"{where}, frame {np.nanargmax(worst)}"}
