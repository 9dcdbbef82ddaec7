"""Benchmark of hands: the fingers of composed people whose hands are not those of the model.

Of each person, lengths of bones, directions of rays, axes of joints, coupling of end joints, the palm's place on the body and the
places of markers are drawn from published spreads (priors/hand.md). Joints turn about two axes, one after the other, an end joint
follows the joint before it by a share that changes with the grip, and markers slide on the skin. The hands make fists, points,
pinches, grips, counting, playing of a piano and waving, and hang while the person walks. Gaps have the lengths of productions.

The bones and axes of fingers may also be those of a character, whose author knew no model of ours.

For the labels of fingers, those of neighbouring fingers are exchanged at random, from where their markers are nearest, and from
the end of a gap in which both are missing; those of both hands where these are nearest. Ghosts stand still near a finger whose
marker is missing.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from mocapfix.characters.body_frames import build_body_frame
from mocapfix.characters.character import FINGERS
from mocapfix.characters.fingers import measure_finger
from mocapfix.characters.load_character import load_character
from mocapfix.errors import SceneError
from mocapfix.hands.calibrated_hand import CalibratedHand, PalmPath
from mocapfix.hands.finger_markers import SIDES, FingerMarkers, load_finger_schemes
from mocapfix.hands.hand_model import HAND_JOINTS, JOINTS_PER_RAY, RAY_ROOTS, RAYS, TIP_JOINTS, HandModel, Side, load_hand
from mocapfix.hands.solve_hands import HandMotion, pose_in_closed_form, solve_hands
from mocapfix.io.c3d import write_c3d
from mocapfix.lab.uncertainty import PredictedErrors, summarise_errors
from mocapfix.model.body_fit import BodyFit
from mocapfix.model.detected import Detected
from mocapfix.model.take import Take
from mocapfix.options import CleanOptions
from mocapfix.pipeline import plan_subject
from mocapfix.solve.hybrik import HybrikVariant
from mocapfix.solve.kinematics import Poses, build_kinematic_tree, compute_tree_poses, compute_world_poses
from mocapfix.stats.rigid_alignment import (
    align_to_shape,
    compute_lengths,
    compute_rotations,
    compute_shortest_rotation,
    fit_common_shape,
    transform_to_body_axes,
)
from mocapfix.stats.sequences import find_runs
from mocapfix.subject.library import load_marker_set
from mocapfix.synthetic import compose_motion, draw_subject, simulate_markers

HAND_SEEDS = range(6)  # people that no constant was tuned on; those used for tuning have seeds of 100 and more
SECONDS, HAND_RATE_HZ = 24.0, 100.0
LENGTH_SD, BONE_SD = 0.05, 0.05  # relative
RAY_SD_DEG, AXIS_SD_DEG = 4.0, 4.0  # of directions of rays and of axes of joints
PALM_SD_M, PALM_SD_DEG, BASE_SD_M = 0.008, 6.0, 0.003  # per axis; the last of knuckles and of the thumb's saddle joint
MARKER_RANGE_M = 0.008  # a marker is displaced by up to this along each axis
SKIN_SD_M, SKIN_TIME_S, NOISE_SD_M = 0.0015, 0.3, 0.0003
COUPLING_RANGE, COUPLING_CHANGE = (0.5, 0.8), 0.1  # of end joints: over people and fingers, and with the grip
WRIST_SD_DEG = (20.0, 6.0, 12.0)  # of pronation in the forearm, deviation and flexion at the wrist
GAP_LENGTHS = ([0.0, 0.33, 0.5, 0.75, 0.9, 0.95, 1.0], [1, 1, 3, 9, 30, 65, 300])  # frames at these shares of the gaps
MEAN_GAP_FRAMES = 16.0
LOST_SHARES = {"0": 0.017, "3": 0.02, "6": 0.035}  # of the samples, by the last digit of the label: tips are lost more often
KEYPOINT_SET, KEYPOINT_STEP = "coco133", 3  # one of so many frames: the rate of video
BODY_KEYPOINT_SD_M, HAND_KEYPOINT_SD_M, LOST_KEYPOINT_SHARE = 0.02, 0.008, 0.1  # per axis; of the samples
FINGER_NOISE_MM = (0, 5, 10)  # maximum along each axis: phalanges are 16 to 45 mm long
FINGER_POSES = 2000
FINGER_VARIANTS: tuple[HybrikVariant, HybrikVariant] = ("naive", "adaptive")
MIN_AXIS_COSINE = np.cos(np.radians(30))
"""of the angle between an axis of a rig's bone and that of the model's joint, from which it is the axis of flexion"""
MARKER_COUNTS = {  # of a hand pair, and the labels of a left hand
    20: ("LTHM3", "LTHM6", "LIDX3", "LIDX6", "LMID0", "LMID6", "LRNG3", "LRNG6", "LPNK3", "LPNK6"),
    10: ("LTHM6", "LIDX6", "LMID6", "LRNG6", "LPNK6"),
    6: ("LTHM3", "LIDX3", "LPNK3"),
    2: ("LMID6",),
}
FILL_COUNTS = (20, 10)
# Flexion of thumb (saddle joint, middle, end), of the fingers' knuckles and of their middle joints, spread, and abduction of the
# thumb, in degrees; several numbers are those of index to little finger.
GESTURES: dict[str, tuple[Any, Any, Any, float, float]] = {
    "relaxed": ((5, 15, 15), (20, 25, 30, 32), (25, 30, 32, 30), 2, 5),
    "flat": ((-10, 5, 5), 0, 5, 8, 0),
    "fist": ((15, 30, 40), (75, 80, 80, 75), (95, 98, 95, 90), 0, 10),
    "point": ((12, 28, 35), (5, 70, 75, 70), (8, 92, 95, 88), 0, 8),
    "pinch": ((8, 20, 15), (50, 35, 25, 20), (45, 35, 25, 20), 3, 22),
    "grip": ((5, 15, 20), (45, 48, 50, 55), (45, 48, 50, 48), 4, 20),
    "hook": ((0, 10, 10), (5, 5, 5, 8), (80, 85, 85, 75), 2, 0),
    "two": ((15, 30, 40), (5, 5, 72, 70), (8, 8, 92, 88), 9, 12),
    "three": ((15, 32, 45), (5, 5, 8, 70), (8, 8, 10, 85), 9, 12),
    "piano": ((5, 12, 12), (25, 25, 25, 25), (35, 35, 35, 35), 6, 10),
}


class TrueHand(NamedTuple):
    """One true hand over T frames, in metres, in the world."""

    palm: Poses  # place of the wrist, and axes of the palm
    points: Float[np.ndarray, "T 20 3"]  # 15 joints and five tips
    flexions: Float[np.ndarray, "T 15"]  # rad
    markers: Float[np.ndarray, "T K 3"]
    labels: tuple[str, ...]
    is_lost: Bool[np.ndarray, "T K"]  # the samples that the take lacks


class RigHand(NamedTuple):
    """The hand of a rig as a person's: of its first bones the lengths, places and directions in the rest pose."""

    model: HandModel  # of the model's length
    axis_tilts: Float[np.ndarray, "15 3 3"]  # from the axes of the model's joints to those of the rig's bones
    flexions: Float[np.ndarray, " 15"]  # rad, of the bones in the rest pose


def read_rig_hands(path: Path) -> dict[Side, RigHand]:
    """Return the hands of a character. Raises SceneError if a finger has not three bones."""
    character = load_character(path)
    frame, found = build_body_frame(character, [side.lower() for side in SIDES]), dict[Side, RigHand]()
    for side in SIDES:
        model, hand = load_hand(side), frame.segment_bones[f"{side.lower()}_hand"]
        straight, palm = model.skeleton, frame.standard_rotations[hand] @ frame.rest_rotation[hand].T
        rest, offsets, tips = (each.copy() for each in (straight.rest_rotations, straight.offsets, straight.ends))
        tilts, bends = np.tile(np.eye(3), (len(HAND_JOINTS), 1, 1)), np.zeros((len(HAND_JOINTS), 3))
        for ray, (finger, root) in enumerate(zip(FINGERS, RAY_ROOTS.tolist(), strict=True)):
            bones = list(character.mapping.fingers.get(f"{side.lower()}_{finger}", ()))
            if len(bones) != JOINTS_PER_RAY:
                raise SceneError(f"{path.name}: the {finger} of the {side.lower()} hand needs three bones.")
            usual = straight.rest_rotations[root]
            vectors = measure_finger(character, frame.rest_position, frame.rest_end, f"{side.lower()}_{finger}") @ palm.T
            rest[root] = compute_shortest_rotation(usual @ straight.offsets[root + 2], vectors[0]) @ usual
            base, joints = palm @ (frame.rest_position[bones[0]] - frame.rest_position[hand]), slice(3 * ray, 3 * ray + 3)
            offsets[root if ray == 0 else root + 1] = base if ray == 0 else rest[root].T @ base
            offsets[root + 2], offsets[root + 3], tips[root + 3] = vectors @ rest[root]
            for joint, axes in enumerate(palm @ frame.rest_rotation[bones]):
                own = rest[root].T @ axes  # the bone turns about that of its axes which is the nearest to the model's
                nearest = own[:, np.abs(own[2]).argmax()]
                if abs(nearest[2]) > MIN_AXIS_COSINE:
                    tilts[3 * ray + joint] = compute_shortest_rotation(np.array([0, 0, 1.0]), nearest * np.sign(nearest[2]))
            lines = np.concatenate([[straight.offsets[root + 2]], vectors @ usual])
            bends[joints, 2] = np.diff(np.unwrap(np.arctan2(lines[:, 1], lines[:, 0])))
        chain = RAY_ROOTS[RAYS.index("Middle")] + np.arange(1, 4)
        size = model.length_m / compute_lengths(np.concatenate([offsets[chain], tips[chain[-1:]]])).sum()
        skeleton = replace(straight, rest_rotations=rest, offsets=size * offsets, ends=size * tips)
        found[side] = RigHand(replace(model, skeleton=skeleton), tilts, model.compute_angles(bends)[:, 2])
    return found


class TrueHands(NamedTuple):
    """A take of a person with both hands."""

    take: Take
    hands: dict[Side, TrueHand]


def compose_angles(rng: np.random.Generator, frames: int) -> Float[np.ndarray, "T 15 2"]:
    """Return flexion and abduction of the 15 joints in radians, without the end joints of fingers."""
    angles, time, first, names = np.zeros((frames, 15, 2)), np.arange(frames) / HAND_RATE_HZ, 0, list(GESTURES)
    is_playing = np.zeros(frames)
    while first < frames:
        name, last = names[rng.integers(len(names))], min(frames, first + round(rng.uniform(0.8, 2.0) * HAND_RATE_HZ))
        thumb, knuckles, middles, spread, thumb_abduction = GESTURES[name]
        scale = rng.normal(1, 0.1, 4)
        angles[first:last, :3, 0] = np.array(thumb) * scale[0]
        angles[first:last, 0, 1] = thumb_abduction * scale[3]
        angles[first:last, 3::3, 0] = np.broadcast_to(knuckles, 4) * scale[1] + rng.normal(0, 5, 4)
        angles[first:last, 4::3, 0] = np.broadcast_to(middles, 4) * scale[2] + rng.normal(0, 5, 4)
        angles[first:last, 3::3, 1] = spread * np.array([1, 0.2, -0.7, -1.2]) * scale[3] + rng.normal(0, 2, 4)
        is_playing[first:last] = name == "piano"
        first = last
    for ray in range(5):  # fingers move at slightly different times
        joints, shift, sigma = slice(3 * ray, 3 * ray + 3), rng.integers(-8, 9), rng.uniform(0.05, 0.12) * HAND_RATE_HZ
        angles[:, joints] = gaussian_filter1d(np.roll(angles[:, joints], shift, axis=0), sigma, axis=0)
    playing = gaussian_filter1d(is_playing, 0.1 * HAND_RATE_HZ)
    for finger in range(4):
        taps = np.maximum(np.sin(2 * np.pi * rng.uniform(1.5, 3.0) * time + rng.uniform(0, 6)), 0) ** 2
        angles[:, 3 + 3 * finger, 0] += 25 * taps * playing
    angles[:, ::3, 0] += (
        3 * gaussian_filter1d(rng.normal(size=(frames, 5)), 0.3 * HAND_RATE_HZ, axis=0) * np.sqrt(0.6 * HAND_RATE_HZ)
    )
    return np.radians(angles)


def draw_hand(
    rng: np.random.Generator,
    side: Side,
    wrist: Float[np.ndarray, "T 3"],
    axes_world: Float[np.ndarray, "T 3 3"],
    size_ratio: float,
    rig: RigHand | None = None,
) -> TrueHand:
    """Return a hand at a wrist, in metres, whose palm has nearly these axes: that of a rig, or one that is drawn."""
    model, frames, spread = rig.model if rig else load_hand(side), len(wrist), 0.0 if rig else 1.0
    size = size_ratio * rng.normal(1, LENGTH_SD)
    hand = model.scale(size * rng.normal(1, spread * BONE_SD, 20))
    skeleton, angles = hand.skeleton, compose_angles(rng, frames)
    rest, offsets = skeleton.rest_rotations.copy(), skeleton.offsets.copy()
    tilts = Rotation.from_rotvec(rng.normal(0, spread * np.radians(RAY_SD_DEG), (5, 3))).as_matrix()
    rest[RAY_ROOTS] = rest[RAY_ROOTS] @ tilts
    offsets[RAY_ROOTS[0]] += rng.normal(0, spread * BASE_SD_M, 3)
    for root, tilt in zip(RAY_ROOTS[1:], tilts[1:], strict=True):  # a finger turns about its knuckle, which is displaced itself
        offsets[root + 1] = tilt.T @ (offsets[root + 1] + rng.normal(0, spread * BASE_SD_M, 3))
    coupling = (
        rng.uniform(*COUPLING_RANGE, 4)
        + COUPLING_CHANGE * np.sin(np.arange(frames) / HAND_RATE_HZ * 0.7 + rng.uniform(0, 6))[:, None]
    )
    angles[:, 5::3, 0] = coupling * angles[:, 4::3, 0]
    flexions = angles[..., 0].copy()
    if rig:
        angles[..., 0] -= rig.flexions
    local = np.tile(rest, (frames, 1, 1, 1))
    axes = model.compute_angles(np.eye(3))  # of twist, abduction, flexion
    for index, joint in enumerate(HAND_JOINTS):
        tilt = Rotation.from_rotvec(rng.normal(0, spread * np.radians(AXIS_SD_DEG), (2, 3))).as_matrix()
        tilt = rig.axis_tilts[index] @ tilt if rig else tilt
        turns = [Rotation.from_rotvec(np.outer(angles[:, index, a], tilt[a] @ axes[2 - a])).as_matrix() for a in (0, 1)]
        local[:, joint] = turns[0] @ turns[1]
    twist = 0.5 * angles[:, 0, 1] + 0.2 * angles[:, 0, 0]  # the thumb's saddle joint pronates as it opposes
    local[:, HAND_JOINTS[0]] = local[:, HAND_JOINTS[0]] @ Rotation.from_rotvec(np.outer(twist, axes[0])).as_matrix()
    local[:, 0] = axes_world @ Rotation.from_rotvec(rng.normal(0, np.radians(PALM_SD_DEG), 3)).as_matrix()
    tree = build_kinematic_tree(replace(skeleton, offsets=offsets))
    position, rotation = compute_tree_poses(tree, wrist, local)
    tips = position[:, TIP_JOINTS] + (rotation[:, TIP_JOINTS] @ hand.tips[..., None])[..., 0]
    scheme = next(each for each in load_finger_schemes() if each.name == "vicon-fingers").hands[side == "Right"]
    offset = scheme.marker_offsets * size + rng.uniform(-MARKER_RANGE_M, MARKER_RANGE_M, scheme.marker_offsets.shape)
    sigma = SKIN_TIME_S / 2 * HAND_RATE_HZ
    skin = (
        gaussian_filter1d(rng.normal(size=(frames, *offset.shape)), sigma, axis=0)
        * SKIN_SD_M
        * np.sqrt(2 * np.sqrt(np.pi) * sigma)
    )
    markers = position[:, scheme.joints] + (rotation[:, scheme.joints] @ (offset + skin)[..., None])[..., 0]
    markers += rng.normal(0, NOISE_SD_M, markers.shape)
    is_lost, palm = draw_finger_gaps(rng, frames, scheme.labels), (wrist, local[:, 0])
    points = np.concatenate([position[:, HAND_JOINTS], tips], axis=1)
    return TrueHand(palm, points, flexions, markers, scheme.labels, is_lost)


def draw_finger_gaps(rng: np.random.Generator, frames: int, labels: tuple[str, ...]) -> Bool[np.ndarray, "T K"]:
    """Return which samples are missing: gaps of the lengths of productions, at 120 frames a second."""
    missing = np.zeros((frames, len(labels)), bool)
    for marker, label in enumerate(labels):
        for _ in range(rng.poisson(LOST_SHARES[label[-1]] * frames / MEAN_GAP_FRAMES)):
            first = rng.integers(frames)
            missing[first : first + round(float(np.interp(rng.random(), *GAP_LENGTHS))), marker] = True
    return missing


def compose_hands(seed: int, marker_set: str = "frontwaist53", rig: Mapping[Side, RigHand] | None = None) -> TrueHands:
    """Return a take of a person with the markers of a set of the body and 20 finger markers, and the hands of a rig if given.

    Forearms pronate in the body's hand joints. The hands bend at the wrists, which lie beyond these, with their markers.
    """
    rng = np.random.default_rng(seed)
    subject = draw_subject(rng, True, marker_set)
    motion, hands = compose_motion(subject, SECONDS, HAND_RATE_HZ), dict[Side, TrueHand]()
    local, sigma = motion.local_rotations.copy(), 0.25 * HAND_RATE_HZ
    sway = np.radians(WRIST_SD_DEG) * rng.normal(size=(2, motion.frame_count, 3)) * np.sqrt(2 * np.sqrt(np.pi) * sigma)
    sway = gaussian_filter1d(sway, sigma, axis=1)
    joints = [subject.skeleton.find_joint(f"{side}Hand") for side in SIDES]
    for joint, turns in zip(joints, sway, strict=True):
        local[:, joint] = local[:, joint] @ Rotation.from_rotvec(turns * np.eye(3)[0]).as_matrix()
    motion = replace(motion, local_rotations=local)
    _, markers = simulate_markers(rng, subject, motion, HAND_RATE_HZ)
    position, rotation = compute_world_poses(subject.skeleton, motion)
    size_ratio = subject.skeleton.size_ratio
    for side, joint, turns in zip(SIDES, joints, sway, strict=True):
        forearm = subject.skeleton.parents[joint]
        place = load_hand(side).palm_position * size_ratio + rng.normal(0, PALM_SD_M, 3)
        wrist = position[:, forearm] + rotation[:, forearm] @ place
        bent = rotation[:, joint] @ Rotation.from_rotvec(turns * (1 - np.eye(3)[0])).as_matrix()
        turn = bent @ rotation[:, joint].swapaxes(-1, -2)
        on_hand = np.flatnonzero(subject.joints == joint)
        from_wrist = rotation[:, joint] @ (subject.skeleton.offsets[joint] - place)  # the hand is rigid and turns about the wrist
        arms = markers[:, on_hand] - (position[:, joint] - from_wrist)[:, None]
        markers[:, on_hand] = wrist[:, None] + np.einsum("tab,tkb->tka", turn, arms)
        hands[side] = draw_hand(rng, side, wrist, bent, size_ratio, rig[side] if rig else None)
    shown = [np.where(hand.is_lost[..., None], np.nan, hand.markers) for hand in hands.values()]
    all_markers = np.concatenate([markers, *shown], axis=1)
    labels = (*subject.labels, *(label for hand in hands.values() for label in hand.labels))
    return TrueHands(Take(all_markers, labels, HAND_RATE_HZ), hands)


FILL_LENGTHS = {"up to 3 frames": 3, "4 to 30 frames": 30, "31 to 100 frames": 100, "over a second": 10**6}


def measure_finger_fills(
    seeds: Iterable[int] = HAND_SEEDS, report_progress: Callable[[str], None] = lambda _: None
) -> dict[str, dict[str, Any]]:
    """Return by finger markers of a hand pair and length of gap the errors of fills, and of lines, cubic splines and the palm."""
    found: dict[tuple[int, str], list[np.ndarray]] = {(count, name): [] for count in FILL_COUNTS for name in FILL_LENGTHS}
    for seed in seeds:
        truth = compose_hands(seed)
        for count in FILL_COUNTS:
            report_progress(f"fills, seed {seed}, {count} markers")
            kept = select_columns(truth, truth.take.labels, MARKER_COUNTS[count])
            with TemporaryDirectory() as folder:
                path = Path(folder) / "hands.c3d"
                write_c3d(path, truth.take.select(kept, truth.take.visible))
                [subject] = plan_subject(path, CleanOptions(), "hands.c3d")
                take, fitted = subject.whole, subject.fit()
                filled = next(fitted.fill_gaps([()], CleanOptions())).take
            for hand in truth.hands.values():
                for name, rows in compare_fills(hand, take, filled).items():
                    found[count, name] += rows
    return {f"{count} markers, {name}": summarise_fills(np.concatenate(rows)) for (count, name), rows in found.items() if rows}


def compare_fills(hand: TrueHand, take: Take, filled: Take) -> dict[str, list[Float[np.ndarray, "n 8"]]]:
    """Return by length of gap the distances from the truth (m) of fills, lines, splines and markers that move with the palm.

    Then the fills' errors along the axes, and their predicted deviations. The palm's axes are those of the markers on wrist and
    back of the hand; a marker moves on a line between its places in them beside the gap.
    """
    side, known = hand.labels[0][0], np.arange(take.frame_count)
    palm = take.markers[:, [take.labels.index(side + each) for each in ("IHAND", "OHAND", "IWR", "OWR")]]
    rotation, origin, is_aligned = align_to_shape(palm, ~np.isnan(palm[..., 0]), fit_common_shape(palm))
    rows: dict[str, list[np.ndarray]] = {name: [] for name in FILL_LENGTHS}
    for k, label in enumerate(hand.labels):
        if label not in take.labels:
            continue
        column, lost = take.labels.index(label), hand.is_lost[:, k]
        path, truth = take.markers[:, column], hand.markers[:, k]
        shown = np.flatnonzero(~lost & ~np.isnan(path[:, 0]))
        in_palm = transform_to_body_axes(path[:, None], origin, rotation)[:, 0]
        fixed = np.flatnonzero(~np.isnan(in_palm[:, 0]))
        on_palm = np.stack([np.interp(known, fixed, in_palm[fixed, a]) for a in range(3)], axis=1)
        line = np.stack([np.interp(known, shown, path[shown, a]) for a in range(3)], axis=1)
        with_palm = np.where(is_aligned[:, None], np.einsum("tab,tb->ta", rotation, on_palm) + origin, line)
        cubic = CubicSpline(shown, path[shown])(known)
        for first, last in find_runs(lost):
            if shown[0] < first and last < shown[-1]:
                gap = slice(first, last + 1)
                errors = [compute_lengths(each[gap] - truth[gap]) for each in (filled.markers[:, column], line, cubic, with_palm)]
                name = next(name for name, longest in FILL_LENGTHS.items() if last - first < longest)
                own = filled.markers[gap, column] - truth[gap], filled.estimated_sd[gap, column, None]
                rows[name].append(np.concatenate([np.stack(errors, axis=1), *own], axis=1))
    return rows


def summarise_fills(errors: Float[np.ndarray, "n 8"]) -> dict[str, Any]:
    """Return the mean distances in mm of samples that are filled, the ratio to the best of the others, and the calibration."""
    is_filled = ~np.isnan(errors[:, 0])
    ours, *others = 1e3 * errors[is_filled, :4].mean(0)
    predicted = summarise_errors(PredictedErrors(errors[is_filled, 4:7], errors[is_filled, 7]))
    return {
        "samples": len(errors),
        "filled_share": float(is_filled.mean()),
        "fill_mm": float(ours),
        **dict(zip(("line_mm", "cubic_mm", "palm_mm"), map(float, others), strict=True)),
        "ratio_to_best": float(ours / min(others)),
        "within_1_sigma": predicted["within_1_sigma"],
        "within_2_sigma": predicted["within_2_sigma"],
    }


def measure_hands(
    seeds: Iterable[int] = HAND_SEEDS,
    report_progress: Callable[[str], None] = lambda _: None,
    rig: Mapping[Side, RigHand] | None = None,
) -> dict[str, dict[str, Any]]:
    """Return a row for each number of finger markers of a hand pair, of people with drawn hands or with those of a rig."""
    found: dict[int, list[tuple[TrueHand, HandMotion]]] = {count: [] for count in MARKER_COUNTS}
    for seed in seeds:
        report_progress(f"seed {seed}")
        truth = compose_hands(seed, rig=rig)
        detected, body = fit_body(truth.take)
        for count, left in MARKER_COUNTS.items():
            kept = select_columns(truth, detected.take.labels, left)
            part, is_used = detected.take.select(kept, detected.solver_mask), detected.solver_mask[:, kept]
            hands = solve_hands(part, is_used, body.subject, body.motion)
            found[count] += [(truth.hands[hand.hand.model.side], hand) for hand in hands]
    return {f"{count} markers": summarise_hands(pairs) for count, pairs in found.items()}


def measure_keypoints(
    seeds: Iterable[int] = HAND_SEEDS, report_progress: Callable[[str], None] = lambda _: None
) -> dict[str, dict[str, Any]]:
    """Return a row for the keypoints of both hands, with the jitter of the tips in the axes of the palm."""
    pairs: list[tuple[TrueHand, HandMotion]] = []
    for seed in seeds:
        report_progress(f"keypoints, seed {seed}")
        truth = compose_keypoints(seed)
        detected, body = fit_body(truth.take)
        hands = solve_hands(detected.take, detected.solver_mask, body.subject, body.motion)
        pairs += [(truth.hands[hand.hand.model.side], hand) for hand in hands]
    solved = [measure_jitter(hand.tip_positions, (hand.palm_position, hand.palm_rotation)) for _, hand in pairs]
    true = [measure_jitter(truth.points[:, len(HAND_JOINTS) :], truth.palm) for truth, _ in pairs]
    jitter = {"jitter_mm": 1e3 * float(np.mean(solved)), "true_jitter_mm": 1e3 * float(np.mean(true))}
    return {"42 keypoints": summarise_hands(pairs) | jitter}


def measure_finger_noise(report_progress: Callable[[str], None] = lambda _: None) -> dict[str, dict[str, float]]:
    """Return the distances of tips from the truth in mm, by noise and variant: an average hand in the gestures."""
    points, model = next(each.hands[0] for each in load_finger_schemes() if KEYPOINT_SET in each.marker_sets), load_hand("Left")
    markers = FingerMarkers("Left", points, np.arange(len(points.labels)))
    hand = CalibratedHand(model, model.palm_position, np.eye(3), markers, points.marker_offsets, np.zeros(20))
    angles, rng = compose_angles(np.random.default_rng(0), FINGER_POSES), np.random.default_rng(1)
    angles[:, 5::3, 0] = angles[:, 4::3, 0] * 2 / 3
    vectors = np.concatenate([np.zeros((*angles.shape[:2], 1)), angles[..., ::-1]], axis=2)
    poses = np.zeros((FINGER_POSES, 3)), np.tile(model.skeleton.rest_rotations, (FINGER_POSES, 1, 1, 1))
    poses[1][:, HAND_JOINTS] = compute_rotations(model.compute_angles(vectors))
    poses[1][:, 0] = Rotation.random(FINGER_POSES, rng).as_matrix()
    position, rotation = compute_tree_poses(hand.tree, *poses)
    true, (joints, offsets) = hand.compute_points(poses)[:, len(HAND_JOINTS) :], hand.attachment
    unknown = PalmPath(poses[0], *np.tile(np.eye(3), (2, FINGER_POSES, 1, 1)), *np.full((2, FINGER_POSES), 1e3))
    centres = position[:, joints] + (rotation[:, joints] @ offsets[..., None])[..., 0]
    results = dict[str, dict[str, float]]()
    for noise_mm in FINGER_NOISE_MM:
        report_progress(f"noise of fingers of {noise_mm} mm")
        given = centres + 1e-3 * rng.uniform(-noise_mm, noise_mm, centres.shape)
        solved = {each: hand.compute_points(pose_in_closed_form(hand, given, unknown, each)) for each in FINGER_VARIANTS}
        errors = {each: np.linalg.norm(tips[:, len(HAND_JOINTS) :] - true, axis=2).mean() for each, tips in solved.items()}
        results[str(noise_mm)] = {each: 1e3 * float(error) for each, error in errors.items()}
    return results


def measure_jitter(tips: Float[np.ndarray, "T 5 3"], palm: Poses) -> float:
    """Return the RMS length in metres of the second differences of the tips, in the axes of the palm."""
    in_palm = (palm[1][:, None].swapaxes(-1, -2) @ (tips - palm[0][:, None])[..., None])[..., 0]
    return float(np.sqrt((np.diff(in_palm, 2, axis=0) ** 2).sum(-1).mean()))


def fit_body(take: Take) -> tuple[Detected, BodyFit]:
    """Return a take from a file, with its body, as cleaning finds them."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "hands.c3d"
        write_c3d(path, take)
        fitted = plan_subject(path, CleanOptions(), "hands.c3d")[0].fit()
    assert fitted.standing is not None
    return fitted.detected, fitted.standing.fit


def compose_keypoints(seed: int) -> TrueHands:
    """Return a take of a person with the keypoints of COCO-WholeBody on the body and the hands, with noise in every frame."""
    truth, rng = compose_hands(seed, KEYPOINT_SET), np.random.default_rng(1000 + seed)
    scheme = next(each for each in load_finger_schemes() if KEYPOINT_SET in each.marker_sets)
    fingers = {label for hand in scheme.hands for label in hand.labels}
    body = set(load_marker_set(KEYPOINT_SET).labels) - fingers
    kept = [column for column, label in enumerate(truth.take.labels) if label in body]
    keypoints, sd_m = [truth.take.markers[:, kept]], [BODY_KEYPOINT_SD_M] * len(kept)
    for side, hand in zip(SIDES, scheme.hands, strict=True):
        wrist, joints, tips = truth.hands[side].palm[0], *np.split(truth.hands[side].points, [len(HAND_JOINTS)], axis=1)
        rays = np.concatenate([joints.reshape(-1, len(RAYS), 3, 3), tips[:, :, None]], axis=2)  # in the order of the scheme
        keypoints += [wrist[:, None], rays.reshape(-1, 4 * len(RAYS), 3)]
        sd_m += [HAND_KEYPOINT_SD_M] * len(hand.labels)
    markers = np.concatenate(keypoints, axis=1)[::KEYPOINT_STEP]
    markers += rng.normal(size=markers.shape) * np.array(sd_m)[:, None]
    markers[rng.random(markers.shape[:2]) < LOST_KEYPOINT_SHARE] = np.nan
    labels = (*(truth.take.labels[column] for column in kept), *(label for hand in scheme.hands for label in hand.labels))
    hands, every = dict[Side, TrueHand](), slice(None, None, KEYPOINT_STEP)
    for side, hand in truth.hands.items():
        palm = hand.palm[0][every], hand.palm[1][every]
        hands[side] = hand._replace(palm=palm, points=hand.points[every], flexions=hand.flexions[every])
    return TrueHands(Take(markers, labels, HAND_RATE_HZ / KEYPOINT_STEP), hands)


def select_columns(truth: TrueHands, labels: tuple[str, ...], kept: tuple[str, ...]) -> Int[np.ndarray, " N"]:
    """Return the columns of a take without finger markers but some, which are given by their labels on a left hand."""
    dropped = {label for hand in truth.hands.values() for label in hand.labels if "L" + label[1:] not in kept}
    return np.array([m for m, label in enumerate(labels) if label not in dropped])


def summarise_hands(pairs: list[tuple[TrueHand, HandMotion]]) -> dict[str, Any]:
    """Return the mean errors of tips and angles, and how often errors lie within the predicted deviations."""
    tips = np.concatenate([np.linalg.norm((hand.point_positions - truth.points)[:, 15:], axis=-1) for truth, hand in pairs])
    angles = np.concatenate([np.abs(hand.angles[..., 2] - truth.flexions) for truth, hand in pairs])
    tip_errors = np.concatenate([(hand.point_positions - truth.points)[:, 15:].reshape(-1, 3) for truth, hand in pairs])
    joint_errors = np.concatenate([(hand.point_positions - truth.points)[:, :15].reshape(-1, 3) for truth, hand in pairs])
    tip_sd = np.concatenate([hand.point_sd[:, 15:].ravel() for _, hand in pairs])
    joint_sd = np.concatenate([hand.point_sd[:, :15].ravel() for _, hand in pairs])
    of_tips, of_joints = (
        summarise_errors(PredictedErrors(tip_errors, tip_sd)),
        summarise_errors(PredictedErrors(joint_errors, joint_sd)),
    )
    by_ray = dict(zip(RAYS, (1e3 * tips.mean(0)).tolist(), strict=True))
    return {
        "tip_error_mm": 1e3 * float(tips.mean()),
        "angle_error_deg": float(np.degrees(angles.mean())),
        "tips_within_1_sigma": of_tips["within_1_sigma"],
        "tips_within_2_sigma": of_tips["within_2_sigma"],
        "joints_within_1_sigma": of_joints["within_1_sigma"],
        "joints_within_2_sigma": of_joints["within_2_sigma"],
        "tip_error_by_finger_mm": {ray: round(value, 1) for ray, value in by_ray.items()},
    }


LABELLED_COUNTS, KINDS = (20, 10, 6), ("random", "near", "gap", "hands")  # markers of a hand pair; exchanges
EXCHANGES, MAX_TRIALS = 12, 2000  # of a take
EXCHANGE_FRAMES = (3, 300)  # their lengths are evenly distributed on a logarithmic scale
MARGIN_FRAMES, NEAR_FRAMES = 20, 60  # between exchanges of a label; within which the nearest frame is looked for
GHOSTS, GHOST_FRAMES, REFLECTION_RANGE_M = 6, (3, 40), (0.03, 0.12)
MAX_WRONG_SHARE = 0.1  # of the samples of an exchange that is undone: beside its ends a marker may be missing
RAY_LABELS = ("THM", "IDX", "MID", "RNG", "PNK")
LabelErrors: TypeAlias = tuple[Take, list[tuple[str, list[int], slice]], Bool[np.ndarray, "T M"]]


def make_label_errors(rng: np.random.Generator, take: Take, fingers: list[int]) -> LabelErrors:
    """Return a take with exchanged labels and ghosts, the exchanges (kind, markers, frames), and which samples are ghosts."""
    markers, busy, made = take.markers.copy(), np.zeros(take.visible.shape, bool), list[tuple[str, list[int], slice]]()
    is_ghost, labels = busy.copy(), take.labels
    for _ in range(MAX_TRIALS):
        kind, one, start = str(rng.choice(KINDS)), int(rng.choice(fingers)), int(rng.integers(5, take.frame_count))
        ray, most = RAY_LABELS.index(labels[one][1:4]), 3 if len(fingers) <= 6 else 1
        apart = [abs(RAY_LABELS.index(labels[m][1:4]) - ray) if labels[m][0] == labels[one][0] else -1 for m in fingers]
        others = [m for m, d in zip(fingers, apart, strict=True) if (d < 0 if kind == "hands" else 1 <= d <= most)]
        pair = [one, int(rng.choice(others))]
        distance_m = np.linalg.norm(markers[:, pair[0]] - markers[:, pair[1]], axis=-1)
        near = slice(max(5, start - NEAR_FRAMES), start + NEAR_FRAMES) if kind == "near" else slice(5, None)
        if kind in ("near", "hands") and np.isfinite(distance_m[near]).any():
            start = near.start + int(np.nanargmin(distance_m[near]))
        gaps = [gap for gap in find_runs(~take.visible[:, one]) if gap[1] < start] if kind == "gap" else []
        start = gaps[-1][1] + 1 if gaps else start
        part = slice(start, start + round(float(np.exp(rng.uniform(*np.log(EXCHANGE_FRAMES))))))
        around = slice(max(0, start - MARGIN_FRAMES), part.stop + MARGIN_FRAMES)
        is_shown = part.stop <= take.frame_count - 5 and take.visible[part, pair].mean(0).min() > 0.5
        if not is_shown or busy[around, pair].any() or (kind == "gap" and not gaps) or len(made) == EXCHANGES:
            continue
        busy[around, pair] = True
        if gaps:
            markers[gaps[-1][0] : start, pair] = np.nan
        markers[part, pair] = markers[part, pair[::-1]]
        made.append((kind, pair, part))
    free = [(m, *gap) for m in fingers for gap in find_runs(np.isnan(markers[:, m, 0])) if gap[1] - gap[0] >= GHOST_FRAMES[0] + 1]
    for m, first, last in (free[n] for n in rng.permutation(len(free))[:GHOSTS]):
        part = slice(first + 1, min(last, first + 1 + int(rng.integers(*GHOST_FRAMES))))
        away = rng.uniform(*REFLECTION_RANGE_M) * Rotation.random(None, rng).as_matrix()[0]
        if first and not busy[part, m].any():
            markers[part, m], is_ghost[part, m] = markers[first - 1, m] + away + rng.normal(0, 0.0003, 3), True
    return take.replace_markers(markers), made, is_ghost


def measure_finger_labels(
    seeds: Iterable[int] = HAND_SEEDS, report_progress: Callable[[str], None] = lambda _: None
) -> dict[str, dict[str, Any]]:
    """Return a row for each number of finger markers of a hand pair."""
    rows = {count: Counter[str]() for count in LABELLED_COUNTS}
    for seed in seeds:
        truth = compose_hands(seed)
        for count, row in rows.items():
            report_progress(f"labels of {count} markers, seed {seed}")
            kept = select_columns(truth, truth.take.labels, MARKER_COUNTS[count])
            take = replace(truth.take, markers=truth.take.markers[:, kept], labels=tuple(truth.take.labels[m] for m in kept))
            fingers = [m for m, label in enumerate(take.labels) if label[1:4] in RAY_LABELS and label[4:] in ("0", "3", "6")]
            wrong, exchanges, is_ghost = make_label_errors(np.random.default_rng(seed), take, fingers)
            is_wrong, detected = find_wrong_samples(take, wrong)
            for kind, pair, part in exchanges:
                is_undone = int(is_wrong[part][:, pair].mean() <= MAX_WRONG_SHARE)
                row.update({"exchanges": 1, "undone": is_undone, f"{kind}_exchanges": 1, f"{kind}_undone": is_undone})
                is_wrong[part, pair] = False
            row.update({"ghosts": int(is_ghost.sum()), "ghosts_found": int((is_ghost & ~detected.inlier_mask).sum())})
            row["invented_samples"] += int((is_wrong & ~is_ghost).sum()) + int(find_wrong_samples(take, take)[0].sum())
    return {f"{count} markers": {name: int(value) for name, value in sorted(row.items())} for count, row in rows.items()}


def find_wrong_samples(truth: Take, take: Take) -> tuple[Bool[np.ndarray, "T M"], Detected]:
    """Return the samples that are under another label than the true one after detection, and what was detected."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "hands.c3d"
        write_c3d(path, take)
        detected = plan_subject(path, CleanOptions(), "hands.c3d")[0].fit().detected
    return detected.take.visible & ~(np.abs(detected.take.markers - truth.markers).max(-1) < 1e-4), detected
