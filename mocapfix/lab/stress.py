"""Stress test: extreme motion with known truth, cleaned; limbs lost in sight, joint errors, and sound samples that were changed.

In composed takes the person warms up, without which it could not be calibrated, and does a motion of `extreme_motions` once and
then mirrored, at several rates, with slender limbs and soft tissue, and with gaps. Performed takes are the fastest tenth of
recordings of subjects that no model was trained on. Each is compared with ordinary motion of the same kind.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from mocapfix.lab import extreme_motions
from mocapfix.lab.common_task import clean_composed_take
from mocapfix.lab.lost_limbs import build_full_marker_subject
from mocapfix.lab.sound_takes import PerformedMotion, perform_take, read_performed_motions
from mocapfix.model.motion import FrameStatus, Motion
from mocapfix.model.stage_timer import ProgressCallback
from mocapfix.model.subject import Subject
from mocapfix.result import CleaningResult
from mocapfix.solve.kinematics import compute_joint_and_marker_positions
from mocapfix.synthetic import DAMAGED_ARM_JOINTS, SyntheticTake, compose_motion, draw_gaps, draw_subject, simulate_markers

ORDINARY_MOTION = "ordinary"  # walking, reaching, crouching and turning round
ORDINARY_DURATION_S = 15.0
SOFT_TISSUE_FREQUENCY_HZ = 16.0  # at which tissue under a marker swings: 15 mm of lag at 150 m/s2
MAX_SOFT_TISSUE_LAG_M = 0.03
SLENDER_LIMB_SHARE = 0.5  # of a marker's distance from the bone on a person with slender limbs: about 25 mm remain
SLENDER_LIMB_BONES = {  # the joint that carries the markers, and the joint at the other end of the bone
    f"{side}{bone}": f"{side}{end}"
    for side in ("Left", "Right")
    for bone, end in (("Arm", "ForeArm"), ("ForeArm", "Hand"), ("UpLeg", "Leg"), ("Leg", "Foot"))
}


def compose_extreme_motion(subject: Subject, name: str, rate: float) -> Motion:
    """Return the warm-up and a motion of EXTREME_MOTIONS, also mirrored, of this person at `rate` Hz."""
    motion, skeleton = extreme_motions.EXTREME_MOTIONS[name], subject.skeleton
    warm_up = extreme_motions.interpolate_key_poses(skeleton, extreme_motions.STAND, extreme_motions.WARM_UP)
    action = extreme_motions.interpolate_key_poses(skeleton, extreme_motions.STAND, motion.moves)
    nominal_speed, _ = extreme_motions.measure_extremity_motion(
        subject, extreme_motions.build_keyed_motion(subject, action, extreme_motions.KEY_RATE_HZ), extreme_motions.KEY_RATE_HZ
    )
    factor = nominal_speed / motion.peak_speed_m_per_s
    mirrored = extreme_motions.interpolate_key_poses(skeleton, extreme_motions.STAND, extreme_motions.mirror_moves(motion.moves))
    actions = (extreme_motions.stretch_time(each, factor) for each in (action, mirrored))
    keyed = warm_up
    for each in actions:
        keyed = extreme_motions.join_angles(keyed, each)
    return extreme_motions.build_keyed_motion(subject, extreme_motions.sample_angles(keyed, rate), rate)


def compose_extreme_take(
    name: str,
    seed: int = 0,
    rate: float = 120.0,
    *,
    with_gaps: bool = False,
    with_soft_tissue: bool = False,
    with_slender_limbs: bool = False,
) -> SyntheticTake:
    """Return a take of a motion of EXTREME_MOTIONS, or of ORDINARY_MOTION to compare with; the same for the same arguments.

    The seed determines the person, whose bones are asymmetric, the skin and the gaps.

    Args:
        with_gaps: Lose markers as `compose_take` does, without spikes.
        with_soft_tissue: Let the markers lag behind the bones in proportion to the acceleration, besides sliding with the skin.
        with_slender_limbs: Place the markers of upper arms, forearms, thighs and shins nearer to the bone.
    """
    rng = np.random.default_rng(seed)
    subject = draw_subject(rng, asymmetric=True)
    subject = move_markers_to_bones(subject) if with_slender_limbs else subject
    if name == ORDINARY_MOTION:
        motion = compose_motion(subject, ORDINARY_DURATION_S, rate)
    else:
        motion = compose_extreme_motion(subject, name, rate)
    joints, markers = simulate_markers(rng, subject, motion, rate)
    if with_soft_tissue:
        markers += simulate_soft_tissue(subject, motion, rate)
    missing = np.zeros(markers.shape[:2], bool)
    if with_gaps:
        is_arm_marker = np.isin(subject.joints, [subject.skeleton.find_joint(joint) for joint in DAMAGED_ARM_JOINTS])
        missing = draw_gaps(rng, motion.frame_count, rate, is_arm_marker)
    seen = np.where(missing[..., None], np.nan, markers)
    return SyntheticTake(motion, subject, joints, markers, seen, missing, np.zeros_like(missing), subject.labels, rate)


def move_markers_to_bones(subject: Subject) -> Subject:
    """Return the person with the limbs' markers nearer to the bones by SLENDER_LIMB_SHARE: they show a bone's turn less well."""
    skeleton, offsets = subject.skeleton, subject.marker_offsets.copy()
    for bone, end in SLENDER_LIMB_BONES.items():
        direction = skeleton.offsets[skeleton.find_joint(end)]
        along = np.outer(direction, direction) / (direction @ direction)
        own = subject.joints == skeleton.find_joint(bone)
        offsets[own] = SLENDER_LIMB_SHARE * offsets[own] + (1 - SLENDER_LIMB_SHARE) * offsets[own] @ along
    return replace(subject, marker_offsets=offsets)


def simulate_soft_tissue(subject: Subject, motion: Motion, rate: float) -> Float[np.ndarray, "T M 3"]:
    """Return the displacements in metres of markers on tissue that follows the bones like a mass on a spring."""
    _, markers = compute_joint_and_marker_positions(subject, motion)
    acceleration = np.gradient(np.gradient(markers, 1 / rate, axis=0), 1 / rate, axis=0)
    lag = -acceleration / (2 * np.pi * SOFT_TISSUE_FREQUENCY_HZ) ** 2
    length = np.linalg.norm(lag, axis=-1, keepdims=True)
    return lag * np.minimum(1, MAX_SOFT_TISSUE_LAG_M / np.maximum(length, MAX_SOFT_TISSUE_LAG_M))


STRESS_RATES_HZ = (60.0, 120.0, 240.0)
SLENDER_RATES_HZ = (60.0, 120.0)  # of the takes of slender limbs with markers that lag behind the bones
GAP_RATE_HZ = 120.0  # of the takes with gaps
ORDINARY_SEEDS = range(3)  # of the composed takes of ordinary motion, each also with slender limbs
FASTEST_SHARE = 0.1  # of the recordings of a folder
ORDINARY_RECORDING_COUNT = 4  # recordings of median speed of each folder
MIN_STRESS_RECORDING_S = 4.0  # shorter recordings are not used: a person cannot be calibrated on them
MAX_STRESS_RECORDING_S = 12.0  # of a longer recording the part about its fastest frame is used
MAX_LIMB_ERROR_M = 0.1  # limit of the error of a joint of a limb with all its markers seen
MAX_ERROR_RATIO = 1.5  # limit of the mean joint error over that of ordinary motion
UNOBSERVED_JOINTS = ("LeftHandIndex1", "RightHandIndex1")  # beyond joints that no marker turns; not scored
LIMBS_WITH_JOINTS = {  # joints that carry a limb's markers or follow from them
    "head": ("Neck1", "Head"),
    "trunk": ("Hips", "LowerBack", "Spine", "Spine1", "Neck", "LeftShoulder", "RightShoulder"),
    "left arm": ("LeftArm", "LeftForeArm", "LeftHand", "LeftFingerBase"),
    "right arm": ("RightArm", "RightForeArm", "RightHand", "RightFingerBase"),
    "left leg": ("LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase"),
    "right leg": ("RightUpLeg", "RightLeg", "RightFoot", "RightToeBase"),
}


class StressTake(NamedTuple):
    """A take of the test."""

    kind: str  # "composed", "slender" (composed, with slender limbs and soft tissue) or "performed"
    name: str
    truth: SyntheticTake
    is_ordinary: bool = False


def measure_stress(
    motion_folders: Sequence[Path] = (),
    motions: Iterable[str] = tuple(extreme_motions.EXTREME_MOTIONS),
    rates_hz: Iterable[float] = STRESS_RATES_HZ,
    progress: ProgressCallback = lambda _: None,
) -> dict[str, Any]:
    """Return the rows of all takes as `takes`, the mean joint error of ordinary motion by kind as `ordinary_mm`, the totals that
    the limits hold for as `all`, and as `skipped` why recordings are not used, or None.

    Args:
        motion_folders: Each holds test.npz and skeletons.json: motion of subjects that no model was trained on.

    Raises:
        ReadError: If a folder holds no such motion.
    """
    takes = [*iterate_composed_takes(motions, rates_hz), *iterate_performed_takes(motion_folders)]
    rows: list[dict[str, Any]] = []
    for number, take in enumerate(takes, start=1):
        progress(f"{take.name} ({number} of {len(takes)})")
        result = clean_composed_take(take.truth)
        rows.append({"kind": take.kind, "name": take.name, "ordinary": take.is_ordinary, **score_stress_take(take.truth, result)})
    ordinary_mm = {
        kind: float(np.mean([row["joint_error_mm"] for row in rows if row["kind"] == kind and row["ordinary"]]))
        for kind in dict.fromkeys(row["kind"] for row in rows)
    }
    for row in rows:
        row["over_ordinary"] = row["joint_error_mm"] / ordinary_mm[row["kind"]]
    skipped = None if motion_folders else "recordings were not used: name folders of motion with --data"
    return {"takes": rows, "ordinary_mm": ordinary_mm, "all": summarise_stress(rows), "skipped": skipped}


def iterate_composed_takes(motions: Iterable[str], rates_hz: Iterable[float]) -> Iterator[StressTake]:
    """Yield composed takes: ordinary motion, then every motion at all rates, with slender limbs, and with gaps."""
    for seed in ORDINARY_SEEDS:
        for is_slender in (False, True):
            truth = compose_extreme_take(ORDINARY_MOTION, seed, with_soft_tissue=is_slender, with_slender_limbs=is_slender)
            kind = "slender" if is_slender else "composed"
            yield StressTake(kind, f"ordinary, seed {seed}{', slender' if is_slender else ''}", truth, is_ordinary=True)
    for seed, motion in enumerate(motions):
        for rate in rates_hz:
            yield StressTake("composed", f"{motion}, {rate:g} Hz", compose_extreme_take(motion, seed, rate))
        for rate in SLENDER_RATES_HZ:
            slender = compose_extreme_take(motion, seed, rate, with_soft_tissue=True, with_slender_limbs=True)
            yield StressTake("slender", f"{motion}, {rate:g} Hz, slender", slender)
        gaps = compose_extreme_take(motion, seed, GAP_RATE_HZ, with_gaps=True)
        yield StressTake("composed", f"{motion}, {GAP_RATE_HZ:g} Hz, gaps", gaps)


def iterate_performed_takes(motion_folders: Iterable[Path]) -> Iterator[StressTake]:
    """Yield performed takes of each folder: those of median speed as ordinary motion, and the fastest.

    Raises:
        ReadError: If a folder holds no motion.
    """
    subject = build_full_marker_subject()
    for folder in motion_folders:
        motions = [each for each in read_performed_motions(folder / "test.npz") if get_duration_s(each) >= MIN_STRESS_RECORDING_S]
        speeds = [compute_marker_speeds(each, subject) for each in motions]
        order = np.argsort([speed.max() for speed in speeds])
        fastest = order[len(order) - max(1, round(FASTEST_SHARE * len(order))) :]
        first = max(0, (len(order) - ORDINARY_RECORDING_COUNT) // 2)
        for is_ordinary, chosen in ((True, order[first : first + ORDINARY_RECORDING_COUNT]), (False, fastest)):
            for n in chosen:
                part = cut_around(motions[n], int(speeds[n].argmax()))
                yield StressTake("performed", motions[n].name, perform_take(part, np.random.default_rng(int(n))), is_ordinary)


def get_duration_s(performance: PerformedMotion) -> float:
    """Return the duration of a recording in seconds."""
    return performance.motion.frame_count / performance.rate_hz


def compute_marker_speeds(performance: PerformedMotion, subject: Subject) -> np.ndarray:
    """Return the speed in m/s of the fastest marker from each frame (T - 1,) to the next."""
    _, markers = compute_joint_and_marker_positions(subject, performance.motion)
    return np.linalg.norm(np.diff(markers, axis=0), axis=-1).max(1) * performance.rate_hz


def cut_around(performance: PerformedMotion, frame: int) -> PerformedMotion:
    """Return the part of a recording about a frame, no longer than MAX_STRESS_RECORDING_S."""
    count = min(performance.motion.frame_count, round(MAX_STRESS_RECORDING_S * performance.rate_hz))
    first = min(max(0, frame - count // 2), performance.motion.frame_count - count)
    return performance._replace(motion=performance.motion.select_frames(np.arange(first, first + count)))


def score_stress_take(truth: SyntheticTake, result: CleaningResult) -> dict[str, Any]:
    """Return the measures of one cleaned take; frames are counted from 0.

    - `lost_in_sight`: frames by part of the body, as in the report
    - `joint_error_mm`: mean over all frames and joints
    - `limb_error_mm`: largest error of a joint of a limb whose markers are all seen, with `limb` and `frame`
    - `changed_share`: share of the seen samples that were changed
    - `poor_frames`: frames in which the markers lie far from the body
    """
    report, motion, joints, sample_sd = result.report, result.motion, result.joint_position_world, result.take.sample_sd
    if "solve" not in report or report["solve"] is None or motion is None or joints is None:
        raise ValueError("a composed take has a known marker set, so it is solved")
    error_m = np.linalg.norm(joints - truth.joint_positions, axis=-1)
    is_scored = ~np.isin(truth.subject.skeleton.names, UNOBSERVED_JOINTS)
    worst_m, limb, frame = find_worst_limb(truth, error_m)
    is_changed = np.zeros_like(truth.missing_mask) if sample_sd is None else ~np.isnan(sample_sd) & ~truth.missing_mask
    lost = report["solve"]["lost_in_sight"]
    return {
        "lost_frames": sum(lost.values()),
        "lost_in_sight": lost,
        "joint_error_mm": 1e3 * float(error_m[:, is_scored].mean()),
        "limb_error_mm": 1e3 * worst_m,
        "limb": limb,
        "frame": frame,
        "changed_samples": int(is_changed.sum()),
        "changed_share": float(is_changed.sum() / (~truth.missing_mask).sum()),
        "poor_frames": int((motion.status == FrameStatus.POOR_FIT).sum()),
    }


def find_worst_limb(truth: SyntheticTake, error_m: np.ndarray) -> tuple[float, str, int]:
    """Return the largest joint error of a limb whose markers are all seen, in metres, with the limb and the frame.

    Args:
        error_m: Error (T, J) of each joint.
    """
    worst = (0.0, "", -1)
    for limb, names in LIMBS_WITH_JOINTS.items():
        joints = [truth.subject.skeleton.find_joint(name) for name in names]
        is_own: Bool[np.ndarray, " M"] = np.isin(truth.subject.joints, joints)
        limb_error_m = np.where(truth.missing_mask[:, is_own].any(1), 0.0, error_m[:, joints].max(1))
        frame = int(limb_error_m.argmax())
        worst = max(worst, (float(limb_error_m[frame]), limb, frame))
    return worst


def summarise_stress(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the totals over the takes of extreme motion, and whether they are within the limits."""
    extreme = [row for row in rows if not row["ordinary"]]
    totals = {
        "lost_frames": sum(row["lost_frames"] for row in extreme),
        "limb_error_mm": max(row["limb_error_mm"] for row in extreme),
        "over_ordinary": float(np.mean([row["over_ordinary"] for row in extreme])),
        "changed_share": float(np.mean([row["changed_share"] for row in extreme])),
        "poor_frames": sum(row["poor_frames"] for row in extreme),
    }
    is_within = totals["lost_frames"] == 0 and totals["limb_error_mm"] <= 1e3 * MAX_LIMB_ERROR_M
    return totals | {"within_limits": bool(is_within and totals["over_ordinary"] <= MAX_ERROR_RATIO)}
