"""Synthetic takes as damaged as captures of a stage: a tenth of the samples missing, or many missing and displaced.

The duration of a gap has a log-uniform distribution: most gaps are short, and most of the missing samples are in long ones. The
markers of a limb are sometimes lost together, as behind another person.
"""

import numpy as np
from jaxtyping import Bool

from mocapfix.subject import Subject
from mocapfix.synthetic.motions import compose_motion
from mocapfix.synthetic.synthetic_takes import SyntheticTake, draw_subject, simulate_markers

TENTH_MISSING_SHARE = 0.1  # of the samples
STAGE_GAP_DURATION_S = (0.01, 5.0)  # of a gap of one marker
LIMB_GAP_DURATION_S = (0.1, 1.5)  # of a gap of all markers of a limb
LIMB_GAP_PROBABILITY = 0.05  # of a gap to be one of a whole limb
LIMB_JOINT_SUFFIXES = {  # ends of the names of each limb's joints, without the side
    "arm": ("Arm", "ForeArm", "Hand", "FingerBase", "HandIndex1", "Thumb"),
    "hand": ("Hand", "FingerBase", "HandIndex1", "Thumb"),
    "leg": ("UpLeg", "Leg", "Foot", "ToeBase"),
    "foot": ("Foot", "ToeBase"),
}

HEAVY_MARKER_SET = "production57"
HEAVY_MISSING_SHARE = 0.13  # of the samples
HEAVY_GAP_FRAMES = (1, 200)
HEAVY_MOVED_SHARE = 0.06  # of the visible samples, each displaced on its own
HEAVY_MOVED_M = 0.095  # distance of a displaced sample from the truth


def compose_tenth_missing_take(seed: int = 5, seconds: float = 45.0, rate: float = 120.0) -> SyntheticTake:
    """Return a take with a tenth of its samples missing and nothing displaced; the same for the same arguments."""
    rng = np.random.default_rng(seed)
    subject = draw_subject(rng, asymmetric=True)
    motion = compose_motion(subject, seconds, rate)
    joints, markers = simulate_markers(rng, subject, motion, rate)
    missing = draw_stage_gaps(rng, motion.frame_count, rate, find_limb_markers(subject), TENTH_MISSING_SHARE)
    damaged, no_spikes = np.where(missing[..., None], np.nan, markers), np.zeros_like(missing)
    return SyntheticTake(motion, subject, joints, markers, damaged, missing, no_spikes, subject.labels, rate)


def compose_heavily_damaged_take(seed: int = 11, seconds: float = 13.0, rate: float = 60.0) -> SyntheticTake:
    """Return a take of 57 markers with HEAVY_MISSING_SHARE of its samples missing and HEAVY_MOVED_SHARE of the others displaced.

    The `spike_mask` of the result has the displaced samples. The same arguments give the same take.
    """
    rng = np.random.default_rng(seed)
    subject = draw_subject(rng, asymmetric=True, marker_set_name=HEAVY_MARKER_SET)
    motion = compose_motion(subject, seconds, rate)
    joints, markers = simulate_markers(rng, subject, motion, rate)
    marker_count = len(subject.labels)
    missing = np.zeros((motion.frame_count, marker_count), bool)
    while missing.mean() < HEAVY_MISSING_SHARE:
        _hide_run(rng, missing, np.arange(marker_count) == rng.integers(marker_count), HEAVY_GAP_FRAMES)
    is_moved = (rng.random(missing.shape) < HEAVY_MOVED_SHARE) & ~missing
    direction = rng.normal(size=markers.shape)
    shift = HEAVY_MOVED_M * direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    damaged = np.where(missing[..., None], np.nan, markers + shift * is_moved[..., None])
    return SyntheticTake(motion, subject, joints, markers, damaged, missing, is_moved, subject.labels, rate)


def find_limb_markers(subject: Subject) -> Bool[np.ndarray, "L M"]:
    """Return which markers each limb carries: arms, hands, legs and feet on both sides."""
    joint_names = [subject.skeleton.names[j] for j in subject.joints]
    limbs = [{side + suffix for suffix in suffixes} for side in ("Left", "Right") for suffixes in LIMB_JOINT_SUFFIXES.values()]
    return np.array([[name in limb for name in joint_names] for limb in limbs])


def draw_stage_gaps(
    rng: np.random.Generator, frame_count: int, rate: float, limb_markers: Bool[np.ndarray, "L M"], share: float
) -> Bool[np.ndarray, "T M"]:
    """Return a mask of missing samples that covers this share of all samples, or little more."""
    marker_count = limb_markers.shape[1]
    missing = np.zeros((frame_count, marker_count), bool)
    while missing.mean() < share:
        is_limb_gap = rng.random() < LIMB_GAP_PROBABILITY
        markers = (
            limb_markers[rng.integers(len(limb_markers))]
            if is_limb_gap
            else np.arange(marker_count) == rng.integers(marker_count)
        )
        shortest_s, longest_s = LIMB_GAP_DURATION_S if is_limb_gap else STAGE_GAP_DURATION_S
        _hide_run(rng, missing, markers, (shortest_s * rate, longest_s * rate))
    return missing


def _hide_run(
    rng: np.random.Generator,
    missing: Bool[np.ndarray, "T M"],
    is_hidden: Bool[np.ndarray, " M"],
    range_frames: tuple[float, float],
) -> None:
    """Mark a run of frames of some markers as missing; its length is log-uniform in a range."""
    shortest, longest = range_frames
    length = max(1, int(shortest * (longest / shortest) ** rng.random()))
    first = rng.integers(len(missing))
    missing[first : first + length, is_hidden] = True
