"""Training windows of the motion prior: stretches of recorded motion in which joints go missing, as in captures.

The occlusions are those of whole limbs for 0.2 to 2 s, of the lower part of a limb, of several limbs, of the head, and of the
whole body; some windows have a second occlusion at another time. Half of the windows are mirrored.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.spatial.transform import Rotation

from mocapfix.errors import ReadError
from mocapfix.lab.recordings import UNKNOWN_SOURCE, RecordingSource, read_recordings
from mocapfix.lab.training_poses import detect_rotation_jumps, find_weakly_observed_joints, mirror_joint_name
from mocapfix.model.skeleton import load_cmu31_body
from mocapfix.solve.motion_prior import (
    INNER_TOKENS,
    MOTION_RATE_HZ,
    TOKEN_COUNT,
    build_motion_tree,
    compute_token_times,
    compute_vector_quaternions,
)
from mocapfix.stats.rigid_alignment import multiply_quaternions

MIN_STRETCH_FRAMES = 30  # shorter stretches between jumps of the solved motion are not used
MAX_RATE_DEVIATION = 0.02  # motion whose rate differs by a smaller share from that of the motion prior is not resampled
MIN_GAP_FRAMES, MAX_GAP_FRAMES = 5, 62  # durations of occlusions
MIN_KNOWN_FRAMES = 4  # known frames on either side of an occlusion
BODY_GAP_SHARE = 0.4  # share of windows in which the whole body is missing
SEVERAL_LIMBS_SHARE = 0.15
PARTIAL_LIMB_SHARE = 0.15
SECOND_GAP_SHARE = 0.2  # share of windows with another occlusion of a limb at another time
OCCLUDED_LIMBS = (
    ("LeftArm", "LeftForeArm", "LeftHand"),
    ("RightArm", "RightForeArm", "RightHand"),
    ("LeftUpLeg", "LeftLeg", "LeftFoot"),
    ("RightUpLeg", "RightLeg", "RightFoot"),
    ("Neck", "Neck1", "Head"),
)


class MotionStretches(NamedTuple):
    """Motion without jumps, joined: quaternions (N, J, 4), root positions (N, 3) m; S stretches from start to end, exclusive."""

    quaternions: np.ndarray
    position: np.ndarray
    starts: np.ndarray
    ends: np.ndarray
    subjects: np.ndarray  # (S,) the subject of each stretch
    sources: tuple[RecordingSource, ...]  # where each comes from

    def count_frames(self) -> Counter[str]:
        """Return the number of frames of each subject."""
        counts = Counter[str]()
        for subject, start, end in zip(self.subjects, self.starts, self.ends, strict=True):
            counts[str(subject)] += int(end - start)
        return counts

    def count_source_frames(self) -> Counter[RecordingSource]:
        """Return the number of frames of each source."""
        counts = Counter[RecordingSource]()
        for source, start, end in zip(self.sources, self.starts, self.ends, strict=True):
            counts[source] += int(end - start)
        return counts


class TrainingWindows(NamedTuple):
    """B gaps with T moments: quaternions (B, T, J, 4), root positions (B, T, 3) m, known joints (B, T, J), moments inside the
    take (B, T), times (B, T) s.
    """

    quaternions: np.ndarray
    position: np.ndarray
    is_known: np.ndarray
    is_inside: np.ndarray
    times_s: np.ndarray
    is_body_gap: np.ndarray  # (B,) whether the whole body is missing
    gap_s: np.ndarray  # (B,) duration


def gather_motion_stretches(
    folders: Sequence[Path], is_wanted: Callable[[str], bool], progress: Callable[[str], object]
) -> MotionStretches:
    """Return the motion of the wanted subjects. Raises ReadError if there is none."""
    tree, is_observed = build_motion_tree(), ~find_weakly_observed_joints(load_cmu31_body().skeleton.names)
    quaternions: list[np.ndarray] = []
    positions: list[np.ndarray] = []
    bounds: list[tuple[int, int]] = []
    subjects: list[str] = []
    sources: list[RecordingSource] = []
    count = 0
    for recording in read_recordings(folders):
        if not is_wanted(recording.subject):
            continue
        progress(f"reading {recording.name}")
        has_jump = detect_rotation_jumps(recording.rotations[:, is_observed], recording.rate_hz).any(axis=1)
        edges = np.r_[0, np.flatnonzero(has_jump) + 1, len(recording.rotations)]
        for first, end in pairwise(edges):
            if end - first < 2:
                continue
            rotations = recording.rotations[first:end, tree.joints].reshape(-1, 3, 3)
            stretch = Rotation.from_matrix(rotations).as_quat().astype(np.float32).reshape(end - first, -1, 4)
            root_position = recording.root_position[first:end].astype(np.float32)
            stretch, root_position = resample_stretch(stretch, root_position, recording.rate_hz)
            frame_count = len(stretch)
            if frame_count < MIN_STRETCH_FRAMES:
                continue
            quaternions.append(stretch)
            positions.append(root_position)
            bounds.append((count, count + frame_count))
            subjects.append(recording.subject)
            sources.append(recording.source)
            count += frame_count
    if not bounds:
        raise ReadError(f"{', '.join(map(str, folders))}: no motion of the required subjects.")
    starts, ends = np.array(bounds).T
    return MotionStretches(
        np.concatenate(quaternions), np.concatenate(positions), starts, ends, np.array(subjects), tuple(sources)
    )


def resample_stretch(
    quaternions: Float32[np.ndarray, "T J 4"], position: Float32[np.ndarray, "T 3"], rate_hz: float
) -> tuple[Float32[np.ndarray, "N J 4"], Float32[np.ndarray, "N 3"]]:
    """Return rotations and root positions at MOTION_RATE_HZ, of at least two frames."""
    if abs(rate_hz / MOTION_RATE_HZ - 1) < MAX_RATE_DEVIATION:
        return quaternions, position
    frames, ends = np.arange(0, len(position) - 1 + 1e-9, rate_hz / MOTION_RATE_HZ), np.array([len(position)])
    whole = MotionStretches(quaternions, position, np.zeros(1, int), ends, np.array([""]), (UNKNOWN_SOURCE,))
    resampled, moved = sample_stretches(whole, np.zeros(1, int), frames[None])
    return resampled[0], moved[0]


def compute_stretch_weights(
    stretches: MotionStretches, balance: float, retargeted_weight: float = 1.0
) -> Float[np.ndarray, " S"]:
    """Return the probability with which a window is drawn from each stretch.

    Args:
        balance: 0 draws from all frames equally often, 1 from all subjects.
        retargeted_weight: How often retargeted motion is drawn relative to other motion.
    """
    frames = (stretches.ends - stretches.starts).astype(float)
    _, number = np.unique(stretches.subjects, return_inverse=True)
    subject_frames = np.bincount(number, frames)
    weights = frames * subject_frames[number] ** -balance
    weights[np.array([source.is_retargeted for source in stretches.sources], bool)] *= retargeted_weight
    return weights / weights.sum()


def draw_training_windows(
    stretches: MotionStretches,
    weights: Float[np.ndarray, " S"],
    count: int,
    rng: np.random.Generator,
    speed_spread: float = 0.0,
    posture_sd_rad: float = 0.0,
) -> TrainingWindows:
    """Return windows with an occlusion in the middle.

    Args:
        speed_spread: Windows are up to this share faster or slower than recorded.
        posture_sd_rad: Standard deviation of the rotation vectors by which joints of a window are turned, as in other people.
    """
    chosen = rng.choice(len(weights), count, p=weights)
    lengths = (stretches.ends - stretches.starts)[chosen]
    longest = np.minimum(MAX_GAP_FRAMES, lengths - 2 * MIN_KNOWN_FRAMES)
    gap_frames = MIN_GAP_FRAMES + (rng.random(count) * (longest - MIN_GAP_FRAMES + 1)).astype(int)
    first = MIN_KNOWN_FRAMES + (rng.random(count) * (lengths - 2 * MIN_KNOWN_FRAMES - gap_frames + 1)).astype(int)
    faster = (1 + speed_spread) ** rng.uniform(-1, 1, count) if speed_spread else np.ones(count)
    rate_hz = MOTION_RATE_HZ * faster
    gap_s = (gap_frames + 1) / rate_hz
    times_s = compute_token_times(gap_s)
    frames = (first - 1)[:, None] + times_s * rate_hz[:, None]
    is_inside = (frames > -0.5) & (frames < lengths[:, None] - 0.5)
    quaternions, position = sample_stretches(stretches, chosen, np.clip(frames, 0, lengths[:, None] - 1))
    is_mirrored = rng.random(count) < 0.5
    quaternions[is_mirrored] = mirror_quaternions(quaternions[is_mirrored])
    position[is_mirrored] *= np.array([-1, 1, 1], np.float32)
    if posture_sd_rad:
        turn = rng.normal(0, posture_sd_rad, (count, 1, quaternions.shape[2], 3))
        turn[:, :, 0] = 0.0
        quaternions = multiply_quaternions(quaternions, compute_vector_quaternions(turn))
    is_known = np.broadcast_to(is_inside[..., None], (*is_inside.shape, quaternions.shape[2])).copy()
    is_body_gap = np.zeros(count, bool)
    for b in range(count):
        joints, is_body_gap[b] = draw_missing_joints(rng)
        is_known[b, INNER_TOKENS, joints] = False
        if not is_body_gap[b] and rng.random() < SECOND_GAP_SHARE:
            limb, duration = find_limb_joints()[rng.integers(len(OCCLUDED_LIMBS))], int(rng.integers(2, 12))
            start = int(rng.integers(0, TOKEN_COUNT - duration))
            hidden = is_known[b].copy()
            hidden[start : start + duration, limb] = False
            if hidden.any(axis=0).all():
                is_known[b] = hidden
    return TrainingWindows(quaternions, position, is_known, is_inside, times_s, is_body_gap, gap_s)


def sample_stretches(
    stretches: MotionStretches, chosen: Int[np.ndarray, " B"], frames: Float[np.ndarray, "B T"]
) -> tuple[Float32[np.ndarray, "B T J 4"], Float32[np.ndarray, "B T 3"]]:
    """Return rotations and root positions of stretches at fractional frames, interpolated linearly between frames."""
    lengths = (stretches.ends - stretches.starts)[chosen, None]
    lower = np.minimum(np.floor(frames).astype(int), lengths - 2)
    share, index = (frames - lower).astype(np.float32)[..., None], lower + stretches.starts[chosen, None]
    below, above = stretches.quaternions[index], stretches.quaternions[index + 1]
    above *= np.where((below * above).sum(-1, keepdims=True) < 0, np.float32(-1), np.float32(1))
    quaternions = below + share[..., None] * (above - below)
    quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
    position = (1 - share) * stretches.position[index] + share * stretches.position[index + 1]
    return quaternions, position


@cache
def find_limb_joints() -> list[Int[np.ndarray, " L"]]:
    """Return the joints of each limb among those of the motion prior, from the trunk outwards."""
    names = [load_cmu31_body().skeleton.names[j] for j in build_motion_tree().joints]
    return [np.array([names.index(name) for name in limb]) for limb in OCCLUDED_LIMBS]


def draw_missing_joints(rng: np.random.Generator) -> tuple[Int[np.ndarray, " L"], bool]:
    """Return the joints of an occlusion, and whether they are the whole body."""
    limbs, draw = find_limb_joints(), rng.random()
    if draw < BODY_GAP_SHARE:
        return np.arange(len(build_motion_tree().joints)), True
    if draw < BODY_GAP_SHARE + SEVERAL_LIMBS_SHARE:
        chosen = rng.choice(len(limbs), int(rng.integers(2, 4)), replace=False)
        return np.concatenate([limbs[i] for i in chosen]), False
    limb = limbs[rng.integers(len(limbs)) if rng.random() < 0.3 else rng.integers(4)]
    if draw < BODY_GAP_SHARE + SEVERAL_LIMBS_SHARE + PARTIAL_LIMB_SHARE:
        return limb[int(rng.integers(1, 3)) :], False
    return limb, False


def mirror_quaternions(quaternions: Float32[np.ndarray, "*batch J 4"]) -> Float32[np.ndarray, "*batch J 4"]:
    """Return mirrored local rotations: left becomes right, and rotations about y and z change sign."""
    names = [load_cmu31_body().skeleton.names[j] for j in build_motion_tree().joints]
    order = [names.index(mirror_joint_name(name)) for name in names]
    return quaternions[..., order, :] * np.array([1, -1, -1, 1], np.float32)
