"""Synthetic takes: a person, their motion and their markers, with the truth that a real take does not contain."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from mocapfix.io.c3d_writer import write_c3d
from mocapfix.model.motion import Motion
from mocapfix.model.skeleton import BodyModel, Skeleton, load_cmu31_body
from mocapfix.model.subject import Subject
from mocapfix.model.take import Take
from mocapfix.solve.kinematics import compute_joint_and_marker_positions, compute_world_poses
from mocapfix.stats.sequences import find_runs
from mocapfix.subject.library import load_marker_set
from mocapfix.synthetic.motions import compose_motion

BONE_GROUP_LENGTH_SD = 0.04  # of a bone group's length, relative
BONE_LENGTH_SD = 0.03  # of a single bone's length beside its group's, relative (about that of CMU's subjects)
BONE_LEAN_SD_RAD = 0.06  # per axis, of a single bone's direction
LEANING_JOINTS = ("LeftUpLeg", "RightUpLeg", "Spine", "Spine1", "Neck", "Neck1", "Head", "LeftArm", "RightArm")  # not the limbs
MARKER_PLACEMENT_SD_M = 0.012  # per axis, of a marker's offset on the person
SKIN_SLIDE_SD_M = 0.004  # per axis, of a marker's motion with the skin
SKIN_SLIDE_TIME_S = 0.3  # after which its correlation has fallen to 1/e
CAMERA_NOISE_SD_M = 0.0003  # per axis, of a sample

DAMAGED_ARM_JOINTS = ("LeftArm", "LeftForeArm", "LeftHand")
ARM_GAP_S = (1.0, 2.5)  # while the arm swings
LATE_START_S = 0.5  # until one of the markers is first visible
SHORT_GAP_RATE_HZ = 0.12  # gaps a second and marker
SHORT_GAP_DURATION_S = (0.03, 0.2)
LONG_GAP_RATE_HZ = 0.6  # gaps a second, over all markers
LONG_GAP_DURATION_S = (0.5, 3.0)
SPIKE_RATE_HZ = 1.5  # spikes a second, over all markers
SPIKE_DURATION_S = (0.008, 0.025)
MIN_SPIKE_M = 0.03  # a spike's displacement is up to ten times this


@dataclass(frozen=True)
class SyntheticTake:
    """A synthetic take: the truth, and what the cameras measured.

    motion             (T frames) of the subject's skeleton
    subject            the person's true bones and marker offsets
    joint_positions    metres, in the world
    marker_positions   metres, without damage
    damaged_positions  metres, with spikes, NaN where missing
    missing_mask       samples in gaps
    spike_mask         samples displaced by a spike
    labels             M marker labels
    rate               Hz
    """

    motion: Motion
    subject: Subject
    joint_positions: Float[np.ndarray, "T J 3"]
    marker_positions: Float[np.ndarray, "T M 3"]
    damaged_positions: Float[np.ndarray, "T M 3"]
    missing_mask: Bool[np.ndarray, "T M"]
    spike_mask: Bool[np.ndarray, "T M"]
    labels: tuple[str, ...]
    rate: float


def compose_take(seed: int = 0, seconds: float = 10.0, rate: float = 120.0, asymmetric: bool = False) -> SyntheticTake:
    """Return a take of a person who walks, reaches, crouches and turns round, repeatedly; the same for the same arguments.

    The seed determines the person, the skin and the damage; the motion depends on the length of the person's legs only.

    asymmetric  give every bone its own length and direction, as people have, instead of scaling groups of bones only
    """
    rng = np.random.default_rng(seed)
    subject = draw_subject(rng, asymmetric)
    motion = compose_motion(subject, seconds, rate)
    joints, markers = simulate_markers(rng, subject, motion, rate)
    is_arm_marker = np.isin(subject.joints, [subject.skeleton.find_joint(name) for name in DAMAGED_ARM_JOINTS])
    missing = draw_gaps(rng, motion.frame_count, rate, is_arm_marker)
    shift = draw_spikes(rng, ~missing, rate)
    damaged = np.where(missing[..., None], np.nan, markers + shift)
    return SyntheticTake(motion, subject, joints, markers, damaged, missing, (shift != 0).any(axis=2), subject.labels, rate)


def write_synthetic_take(path: Path, synthetic: SyntheticTake) -> None:
    """Write the damaged take as a C3D file, as a capture system would export it: millimetres, Z up, frames numbered from 1.

    Raises WriteError if the folder cannot be written.
    """
    markers = np.where(synthetic.missing_mask[..., None], np.nan, synthetic.damaged_positions)
    write_c3d(path, Take(markers, synthetic.labels, synthetic.rate))


def draw_subject(rng: np.random.Generator, asymmetric: bool, marker_set_name: str = "cmu41") -> Subject:
    """Return the average body with every group of bones scaled at random, and markers of a shipped set placed with errors."""
    nominal = load_marker_set(marker_set_name)
    offsets = nominal.marker_offsets + rng.normal(0, MARKER_PLACEMENT_SD_M, nominal.marker_offsets.shape)
    spread = np.full(len(nominal.labels), SKIN_SLIDE_SD_M)
    skeleton = _vary_bone_groups(rng, load_cmu31_body())
    skeleton = _vary_bones(rng, skeleton) if asymmetric else skeleton
    return Subject(skeleton, nominal.name, nominal.labels, nominal.joints, offsets, spread)


def _vary_bone_groups(rng: np.random.Generator, body: BodyModel) -> Skeleton:
    offsets = body.skeleton.offsets.copy()
    for joints in body.bone_groups.values():
        offsets[list(joints)] *= rng.normal(1, BONE_GROUP_LENGTH_SD)
    return replace(body.skeleton, offsets=offsets)


def _vary_bones(rng: np.random.Generator, skeleton: Skeleton) -> Skeleton:
    """Return the skeleton with an own length for each bone and, for bones that do not lie along their axis, an own direction."""
    offsets = skeleton.offsets * rng.normal(1, BONE_LENGTH_SD, (len(skeleton.names), 1))
    leans = Rotation.from_rotvec(rng.normal(0, BONE_LEAN_SD_RAD, offsets.shape)).as_matrix()
    leaning = [skeleton.find_joint(name) for name in LEANING_JOINTS]
    offsets[leaning] = np.einsum("jab,jb->ja", leans[leaning], offsets[leaning])
    shoulders = [skeleton.find_joint("LeftShoulder"), skeleton.find_joint("RightShoulder")]
    offsets[shoulders] = offsets[skeleton.find_joint("Neck")]  # the thorax, one bone, carries all three
    return replace(skeleton, offsets=offsets)


def simulate_markers(
    rng: np.random.Generator, subject: Subject, motion: Motion, rate: float
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T M 3"]]:
    """Return joints and markers of a motion, in metres; the markers slide with the skin and have camera noise."""
    _, rotation = compute_world_poses(subject.skeleton, motion)
    slide = _simulate_skin_motion(rng, motion.frame_count, len(subject.labels), rate)
    joints, markers = compute_joint_and_marker_positions(subject, motion)
    noise = rng.normal(0, CAMERA_NOISE_SD_M, markers.shape)
    markers += np.einsum("tkab,tkb->tka", rotation[:, subject.joints], slide) + noise
    return joints, markers


def _simulate_skin_motion(rng: np.random.Generator, frames: int, markers: int, rate: float) -> Float[np.ndarray, "T M 3"]:
    """Return smooth displacements in metres whose correlation falls to 1/e after SKIN_SLIDE_TIME_S."""
    sigma = SKIN_SLIDE_TIME_S / 2 * rate  # white noise filtered by a Gaussian of sigma has correlation exp(-lag^2 / 4 sigma^2)
    margin = round(4 * sigma)
    white = rng.normal(size=(frames + 2 * margin, markers, 3))
    smooth = gaussian_filter1d(white, sigma, axis=0)[margin : margin + frames]
    return smooth * SKIN_SLIDE_SD_M * np.sqrt(2 * np.sqrt(np.pi) * sigma)


def draw_gaps(
    rng: np.random.Generator, frames: int, rate: float, is_arm_marker: Bool[np.ndarray, " M"]
) -> Bool[np.ndarray, "T M"]:
    """Return a mask of the missing samples; the arm's markers are lost together."""
    missing = np.zeros((frames, len(is_arm_marker)), bool)
    seconds = frames / rate
    short_gaps = (SHORT_GAP_RATE_HZ * len(is_arm_marker), *SHORT_GAP_DURATION_S)
    for gap_rate_hz, shortest_s, longest_s in (short_gaps, (LONG_GAP_RATE_HZ, *LONG_GAP_DURATION_S)):
        for _ in range(rng.poisson(gap_rate_hz * seconds)):
            first, marker = rng.integers(frames), rng.integers(len(is_arm_marker))
            duration_s = shortest_s * (longest_s / shortest_s) ** rng.random()
            missing[first : first + max(1, round(duration_s * rate)), marker] = True
    first, end = (round(time_s * rate) for time_s in ARM_GAP_S)
    missing[first:end, is_arm_marker] = True
    late_marker = rng.integers(len(is_arm_marker))
    missing[: round(LATE_START_S * rate), late_marker] = True
    return missing


def draw_spikes(rng: np.random.Generator, is_visible: Bool[np.ndarray, "T M"], rate: float) -> Float[np.ndarray, "T M 3"]:
    """Return displacements in metres of the visible samples: 0 for nearly all."""
    frames, count = is_visible.shape
    shift = np.zeros((frames, count, 3))
    for _ in range(rng.poisson(SPIKE_RATE_HZ * frames / rate)):
        marker = rng.integers(count)
        visible_runs = find_runs(is_visible[:, marker])
        if not visible_runs:
            continue
        first, last = visible_runs[rng.integers(len(visible_runs))]
        start = rng.integers(first, last + 1)
        stop = min(last + 1, start + max(1, round(rng.uniform(*SPIKE_DURATION_S) * rate)))
        direction = rng.normal(size=3)
        shift[start:stop, marker] = direction / np.linalg.norm(direction) * MIN_SPIKE_M * 10 ** rng.random()
    return shift
