"""A person, their motion and their markers, with everything known that a take does not tell."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from mocapfix import marker_sets
from mocapfix.motion import Motion
from mocapfix.skeleton import BodyModel, Skeleton, load_cmu31_body
from mocapfix.solve import kinematics
from mocapfix.subject import Subject
from mocapfix.synthetic import damage, motions
from mocapfix.take import Take
from mocapfix.write.c3d import write_c3d

# MERGED: mocapfix.synthetic.truth
BONE_GROUP_LENGTH_SD = 0.04  # standard deviation of a bone group's length, as a part of it
BONE_LENGTH_SD, BONE_LEAN_SD_RAD = 0.03, 0.06  # what a bone has for itself: a part of its length, radians (CMU's subjects, about)
LEANING_JOINTS = ("LeftUpLeg", "RightUpLeg", "Spine", "Spine1", "Neck", "Neck1", "Head", "LeftArm", "RightArm")  # limbs do not
MARKER_PLACEMENT_SD_M = 0.012  # metres: standard deviation per axis of a marker's place on the person
SKIN_SLIDE_SD_M, SKIN_SLIDE_TIME_S = 0.004, 0.3  # metres and seconds: how far skin carries a marker per axis, and for how long
CAMERA_NOISE_SD_M = 0.0003  # metres: the cameras' own


@dataclass(frozen=True)
class SyntheticTake:
    """A composed take: what happened and what the cameras say of it.

    motion   (T frames) of the subject's skeleton
    subject  the person's true bones and marker places
    joints   (T, J, 3) metres: where the joints are
    markers  (T, M, 3) metres: the markers, undamaged
    damaged  (T, M, 3) metres: the markers with spikes, NaN where missing
    struck   (T, M) bool: missing
    moved    (T, M) bool: displaced by a spike
    labels   M marker labels
    rate     frames a second
    """

    motion: Motion
    subject: Subject
    joint_positions: np.ndarray
    marker_positions: np.ndarray
    damaged_positions: np.ndarray
    missing_mask: np.ndarray
    spike_mask: np.ndarray
    labels: tuple[str, ...]
    rate: float


def compose_take(seed: int = 0, seconds: float = 10.0, rate: float = 120.0, asymmetric: bool = False) -> SyntheticTake:
    """-> somebody who walks, reaches, crouches and turns round, and again; the same for the same arguments.

    The seed draws the person, the skin and the damage; the motion differs with the person's legs only.

    crooked  left and right differ and bones lean as people's do, where else only groups of bones are longer or shorter
    """
    rng = np.random.default_rng(seed)
    subject = draw_subject(rng, asymmetric)
    motion = motions.compose_motion(subject, seconds, rate)
    joints, markers = simulate_markers(rng, subject, motion, rate)
    arm = np.isin(subject.joints, [subject.skeleton.find_joint(name) for name in damage.DAMAGED_ARM_JOINTS])
    struck = damage.draw_gaps(rng, motion.frame_count, rate, arm)
    shift = damage.draw_spikes(rng, ~struck, rate)
    damaged = np.where(struck[..., None], np.nan, markers + shift)
    return SyntheticTake(motion, subject, joints, markers, damaged, struck, (shift != 0).any(axis=2), subject.labels, rate)


def draw_subject(rng: np.random.Generator, asymmetric: bool) -> Subject:
    """-> the average body, every group of bones somewhat longer or shorter, markers put on by hand."""
    nominal = marker_sets.load_marker_set("cmu41")
    places = nominal.marker_offsets + rng.normal(0, MARKER_PLACEMENT_SD_M, nominal.marker_offsets.shape)
    spread = np.full(len(nominal.labels), SKIN_SLIDE_SD_M)
    skeleton = _vary_bone_groups(rng, load_cmu31_body())
    skeleton = _vary_bones(rng, skeleton) if asymmetric else skeleton
    return Subject(skeleton, nominal.name, nominal.labels, nominal.joints, places, spread)


def _vary_bone_groups(rng: np.random.Generator, body: BodyModel) -> Skeleton:
    offsets = body.skeleton.offsets.copy()
    for joints in body.bone_groups.values():
        offsets[list(joints)] *= rng.normal(1, BONE_GROUP_LENGTH_SD)
    return replace(body.skeleton, offsets=offsets)


def _vary_bones(rng: np.random.Generator, skeleton: Skeleton) -> Skeleton:
    """Every bone with a length and, where none lies along its own axis, a direction of its own."""
    offsets = skeleton.offsets * rng.normal(1, BONE_LENGTH_SD, (len(skeleton.names), 1))
    leans = Rotation.from_rotvec(rng.normal(0, BONE_LEAN_SD_RAD, offsets.shape)).as_matrix()
    leaning = [skeleton.find_joint(name) for name in LEANING_JOINTS]
    offsets[leaning] = np.einsum("jab,jb->ja", leans[leaning], offsets[leaning])
    shoulders = [skeleton.find_joint("LeftShoulder"), skeleton.find_joint("RightShoulder")]
    offsets[shoulders] = offsets[skeleton.find_joint("Neck")]  # one bone, the thorax, carries all three
    return replace(skeleton, offsets=offsets)


def simulate_markers(rng: np.random.Generator, subject: Subject, motion: Motion, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """-> joints (T, J, 3) and markers (T, M, 3), in metres, of a motion: the markers slide with the skin and are seen noisily."""
    _, rotation = kinematics.compute_world_poses(subject.skeleton, motion)
    slide = _simulate_skin_motion(rng, motion.frame_count, len(subject.labels), rate)
    joints, markers = kinematics.compute_joint_and_marker_positions(subject, motion)
    markers += np.einsum("tkab,tkb->tka", rotation[:, subject.joints], slide) + rng.normal(0, CAMERA_NOISE_SD_M, markers.shape)
    return joints, markers


def _simulate_skin_motion(rng: np.random.Generator, frames: int, markers: int, rate: float) -> np.ndarray:
    """-> (T, M, 3) metres: smooth wandering whose correlation falls to 1/e after SLIDE_TIME."""
    sigma = SKIN_SLIDE_TIME_S / 2 * rate  # white noise under a Gaussian of sigma has correlation exp(-lag^2 / 4 sigma^2)
    margin = round(4 * sigma)
    white = rng.normal(size=(frames + 2 * margin, markers, 3))
    smooth = gaussian_filter1d(white, sigma, axis=0)[margin : margin + frames]
    return smooth * SKIN_SLIDE_SD_M * np.sqrt(2 * np.sqrt(np.pi) * sigma)


# MERGED: mocapfix.synthetic.c3d
# A composed take as a C3D file, as a motion capture system would have exported it: millimetres, Z up, floats.
def write_synthetic_take(path: Path, synthetic: SyntheticTake) -> None:
    """Write the damaged take, its frames numbered from 1.

    Raises WriteError where the folder cannot be written.
    """
    markers = np.where(synthetic.missing_mask[..., None], np.nan, synthetic.damaged_positions)
    write_c3d(path, Take(markers, synthetic.labels, synthetic.rate))
